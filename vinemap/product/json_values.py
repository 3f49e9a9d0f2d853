"""Values as JSON has them."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

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
