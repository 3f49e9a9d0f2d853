"""What the benchmark runs, each a process: ``python -m vinemap.measure.bench.jobs JOB RESULT ARGUMENTS``."""

from __future__ import annotations

import json
import os
import sys
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from vinemap.measure.bench.alternatives import best, ground, polygons, rows
from vinemap.measure.bench.surveys import estate, example, survey
from vinemap.measure.bench.watched import high_water
from vinemap.measure.bench.whole import whole

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

MEMORY = 0.75
"""Share of the machine's memory that a job may address."""
INSTEAD = ground, rows, polygons, whole


def reading(cloud: str) -> dict[str, Any]:
    """Seconds of plain laspy until the coordinates are there, best of three."""
    import laspy

    seconds, points = best(lambda: len(np.asarray(laspy.read(cloud).xyz)))
    return {"points": points, "seconds": seconds}


def peaks(cloud: str, boundary: str, out: str) -> dict[str, int | None]:
    """Most memory (bytes) that every stage of a run holds, and what lies between them ("other")."""
    from vinemap.parcel import map_parcel

    held: dict[str, int | None] = {}

    def note(name: str) -> None:
        now = high_water()
        held[name] = None if now is None else max(now, held.get(name) or 0)

    def step(name: str, function: Callable[..., Any], *args: Any, **kwargs: Any) -> Any:
        note("other")
        result = function(*args, **kwargs)
        note(name)
        return result

    map_parcel(Path(cloud), Path(out), parcel="F", named=False, boundary=Path(boundary), step=step)
    note("other")
    return held


def judged(rows: str, truth: str, volume: float) -> dict[str, Any]:
    """What of rows, with their volumes, is right (:class:`vinemap.measure.bench.bars.Found`)."""
    from vinemap.evaluate.reference import read_lines
    from vinemap.evaluate.rows import evaluate_rows

    found, drawn = read_lines(rows, "rows"), read_lines(truth, "rows")
    evaluation = evaluate_rows(found[["geometry"]], drawn[["geometry"]])
    return {
        "rows": len(drawn),
        "right": len(evaluation.pairs),
        "extra": len(evaluation.extra_rows),
        "length": float(found.length.sum()),
        "volume": float(found["volume_m3"].sum()) / volume - 1,
    }


OURS = survey, estate, example, reading, peaks, judged

JOBS: Mapping[str, Callable[..., dict[str, Any]]] = {job.__name__: job for job in OURS + INSTEAD}


def main(name: str, result: str, arguments: str) -> None:
    """Do a job with arguments given as JSON, and leave what it returns in a file as JSON."""
    job = JOBS[name]
    if job in INSTEAD:
        limit_memory()
    try:
        Path(result).write_text(json.dumps(job(**json.loads(arguments))), encoding="utf-8")
    except MemoryError:
        sys.exit(f"wants more than {MEMORY:.0%} of this machine's memory")


def limit_memory() -> None:
    """Let what wants too much memory fail, rather than take the machine down."""
    with suppress(ImportError):  # on Windows
        import resource

        most = int(MEMORY * os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES"))
        resource.setrlimit(resource.RLIMIT_AS, (most, resource.getrlimit(resource.RLIMIT_AS)[1]))


if __name__ == "__main__":
    main(*sys.argv[1:])
