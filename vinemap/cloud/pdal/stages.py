"""What calls PDAL: functions for a process of their own, which import no more than they need."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from numpy.typing import NDArray

CHUNK = 500_000
"""Points that are read, or given back, at once."""
NOISE = (7, 18)
"""ASPRS classes of points that are none of anything."""
FLAGS = ("Withheld", "Omit")
"""Dimensions of LAS and E57 that are 0 for points that count."""
AXES = ("X", "Y", "Z")


def read(options: dict[str, Any]) -> Iterator[Any]:
    """Read a file: first what its reader tells of it, then of each chunk its number of points, and usable ones (n, 3).

    What can be streamed is, so that a file's points are never held at once.

    Parameters
    ----------
    options : dict
        Of the reader, which PDAL chooses by the file's name if there is no ``type`` among them.
    """
    import pdal

    pipeline = pdal.Reader(**options).pipeline()
    yield _told(pipeline)
    if pipeline.streamable:
        chunks: Any = pipeline.iterator(chunk_size=CHUNK)
    else:
        pipeline.execute()
        chunks = (view[k : k + CHUNK] for view in pipeline.arrays for k in range(0, len(view), CHUNK))
    for chunk in chunks:
        yield len(chunk), usable(chunk)


def _told(pipeline: Any) -> dict[str, Any]:
    """What a reader tells of a file beforehand: ``srs``, ``bounds``, ``num_points``; nothing, of some formats."""
    try:
        return next((dict(told) for told in pipeline.quickinfo.values()), {})
    except (RuntimeError, AttributeError, ValueError, TypeError):
        return {}


def usable(points: NDArray[np.void]) -> NDArray[np.float64]:
    """Coordinates (n, 3) that are numbers, of points that are neither noise nor withheld, as far as they tell."""
    names = points.dtype.names or ()
    if missing := [axis for axis in AXES if axis not in names]:
        raise RuntimeError(f"its points have no {missing[0]}")
    xyz = np.column_stack([points[axis] for axis in AXES]).astype(np.float64, copy=False)
    keep = np.isfinite(xyz).all(axis=1)
    if "Classification" in names:
        keep &= ~np.isin(points["Classification"], NOISE)
    for flag in FLAGS:
        if flag in names:
            keep &= points[flag] == 0
    return xyz if keep.all() else xyz[keep]


def classify(
    stages: Sequence[dict[str, Any]], xyz: NDArray[np.float64], own: NDArray[np.bool_] | None = None
) -> Iterator[NDArray[np.float64]]:
    """Points (n, 4) with their classes as stages leave them, chunk by chunk, without noise.

    Parameters
    ----------
    stages : sequence of dict
        Filters, as PDAL's pipelines have them.
    xyz : ndarray (n, 3)
        Points in metres.
    own : ndarray (n,), optional
        Which of them are given back; the others only stand around.
    """
    import pdal

    mark, class_ = "UserData", "Classification"
    points = np.zeros(len(xyz), dtype=[*((axis, "f8") for axis in AXES), (class_, "u1"), (mark, "u1")])
    for axis, column in zip(AXES, xyz.T, strict=True):
        points[axis] = column
    points[mark] = 1 if own is None else own
    pipeline = pdal.Pipeline(json.dumps(stages), arrays=[points])
    pipeline.execute()
    for view in pipeline.arrays:
        for k in range(0, len(view), CHUNK):
            part = view[k : k + CHUNK]
            part = part[(part[mark] == 1) & ~np.isin(part[class_], NOISE)]
            yield np.column_stack([part[name] for name in (*AXES, class_)]).astype(np.float64, copy=False)
