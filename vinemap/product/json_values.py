"""Values as JSON has them."""

from __future__ import annotations

import json
import math
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from pathlib import Path

PLAIN = {int, str, bool, type(None)}
"""Kinds whose values JSON has as they are."""


def jsonable(value: Any) -> Any:
    """A value of Python's own kinds alone: numpy's numbers and arrays as those, what isn't finite as None.

    What JSON doesn't know otherwise becomes its text.
    """
    if isinstance(value, dict):
        return {str(key): jsonable(item) for key, item in value.items()}
    if isinstance(value, (np.ndarray, np.generic)):
        value = value.tolist()
    if isinstance(value, (list, tuple)):
        if set(map(type, value)) <= PLAIN:
            return list(value)
        return [jsonable(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value if value is None or isinstance(value, (bool, int, float, str)) else str(value)


def read_object(path: Path) -> dict[str, Any]:
    """The object in a JSON file, as the record of a run is; an empty one where there is none that can be read."""
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return found if isinstance(found, dict) else {}
