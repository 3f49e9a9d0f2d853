"""The stages of a run, by name, and how each is called."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, TypeVar

if TYPE_CHECKING:
    from collections.abc import Callable

T = TypeVar("T")

STAGES: tuple[str, ...] = ("Reading", "DTM", "Canopy cover", "Row field", "Key points", "Clusters", "Curves")
STAGES += ("Ends and gaps", "Sections", "Canopy", "Vines", "Mesh", "Unmapped", "Writing")


def call(name: str, function: Callable[..., T], *args: Any, **kwargs: Any) -> T:
    """Run a stage as it is."""
    del name
    return function(*args, **kwargs)
