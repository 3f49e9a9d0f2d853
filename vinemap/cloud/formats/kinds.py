"""Which format a file is in, by its name."""

from __future__ import annotations

from typing import TYPE_CHECKING

from vinemap import naming, paths

if TYPE_CHECKING:
    from pathlib import Path

KINDS = {
    ".e57": "e57",
    ".ply": "ply",
    ".pcd": "pcd",
    **dict.fromkeys((".xyz", ".pts", ".csv", ".txt", ".asc"), "text"),
    **dict.fromkeys((".tif", ".tiff"), "surface"),
}
"""Formats by what names of files end in."""
MINGLED = (".csv", ".txt", ".asc", ".tif", ".tiff")
"""Ends of names that in a folder are mostly of other things: such files are clouds only if they are named."""
IN_FOLDERS = tuple(kind for kind in KINDS if kind not in MINGLED)


def kind_of(path: Path) -> str | None:
    """Format of a file other than LAS, LAZ and COPC on a disk; None of those, and of what can't be told."""
    if naming.url_of(path):
        return "remote"
    if path.name.lower() == paths.EPT:
        return "ept"
    return KINDS.get(path.suffix.lower())


def is_surface(path: Path) -> bool:
    """Whether a file is a surface model."""
    return kind_of(path) == "surface"
