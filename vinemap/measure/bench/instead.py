"""What a user would pick instead of a step of the chain, or of all of it, beside ours: tables."""

from __future__ import annotations

from importlib.util import find_spec
from typing import TYPE_CHECKING, NamedTuple

import click

from vinemap.measure.bench.bars import Found, Run, span
from vinemap.measure.bench.runs import ensure_survey, job, judge, load
from vinemap.measure.bench.watched import run_process

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from vinemap.measure.bench.tables import Lines

LIMIT = 600.0
"""Seconds that an alternative may take."""
CLUSTERINGS = "HDBSCAN", "DBSCAN"
"""Of scikit-learn, by each of which the whole job is done."""


class Alternative(NamedTuple):
    """What a user would pick instead of a step."""

    step: str
    job: str
    """Of ``vinemap.measure.bench.jobs``."""
    module: str
    """That it needs."""
    stages: tuple[str, str] | None
    """First and last of ours that do the same; None where the job times ours as well."""
    thin: float | None = None
    """Cells (m) of which each leaves a point; 0 leaves all."""


ALTERNATIVES = [
    Alternative("ground", "ground", "CSF", ("DTM", "DTM")),
    Alternative("rows", "rows", "sklearn", ("Canopy cover", "Curves"), thin=0.0),
    Alternative("rows, thinned", "rows", "sklearn", ("Canopy cover", "Curves"), thin=0.1),
    Alternative("c-gons", "polygons", "cv2", None),
]


def instead(millions: float, family: str, run: Run, out: Path) -> Lines:
    """Table of what a user would pick instead of a step, on the survey of that size, beside ours in its run."""
    survey = ensure_survey(millions, out, family)
    lines = [["step", "instead", "takes", "gives", "ours takes", "ours gives"]]
    for one in ALTERNATIVES:
        ours = f"{span(run.seconds, *one.stages):.2f} s" if one.stages else "–"
        if find_spec(one.module) is None:
            how = f"{one.module} isn't installed: pip install 'vinemap[bench]'"
            lines.append([one.step, how, "–", "–", ours, "–"])
            continue
        click.echo(f"{one.step} instead…", err=True)
        result = out / "jobs" / f"instead-{one.job}.json"
        given = {key: survey[key] for key in ("cloud", "boundary")}
        given |= {"millions": millions} if one.job == "ground" else {}
        given |= {"truth": survey["truth"], "thin": one.thin} if one.job == "rows" else {}
        outcome = run_process(job(one.job, result, **given), limit=LIMIT)
        if outcome.code:
            lines.append([one.step, one.module, "–", outcome.said, ours, "–"])
            continue
        found = load(result)
        parts = (found["tool"], found["seconds"], found["result"], found.get("our_seconds", ours), found["ours"])
        lines.append([one.step, *parts])
    return lines


def whole(measured: Sequence[tuple[float, str, Run]], out: Path) -> Lines:
    """Table of the whole job by the best tools there are, and by us: of each survey its size, family and run."""
    lines = [["survey", "with", "takes", "most memory, MB", "rows", "volume of all canopies"]]
    for millions, family, run in measured:
        name = f"{family}, {run.points / 1e6:.1f} M points"
        lines += [[name, *cells] for cells in _by_others(millions, family, out)]
        lines.append([name, "vinemap run", f"{run.wall:.1f} s", _memory(run.peak), *_found(run.found)])
    return lines


def _by_others(millions: float, family: str, out: Path) -> Lines:
    """What each clustering took and gave."""
    wanted = ("sklearn",) if find_spec("pdal") else ("CSF", "sklearn")
    missing = [module for module in wanted if find_spec(module) is None]
    if missing:
        said = f"{' and '.join(missing)} not installed: pip install 'vinemap[bench]'"
        return [[said, *["–"] * 4]]
    click.echo(f"The whole job instead, {family}…", err=True)
    survey, lines = ensure_survey(millions, out, family), []
    for clustering in CLUSTERINGS:
        result, rows = (out / "jobs" / f"whole-{family}-{clustering}.{kind}" for kind in ("json", "gpkg"))
        given = {"cloud": survey["cloud"], "boundary": survey["boundary"], "clustering": clustering, "out": str(rows)}
        outcome = run_process(job("whole", result, **given), limit=LIMIT)
        if outcome.code:
            lines.append([clustering, outcome.said, *["–"] * 3])
            continue
        told, found = load(result), judge(rows, survey, result.with_suffix(".found"))
        takes = f"{outcome.seconds:.1f} s: {told['seconds']}"
        lines.append([told["tools"], takes, _memory(outcome.peak), *_found(found)])
    return lines


def _memory(most: int) -> str:
    return f"{most / 1e6:.0f}" if most else "–"


def _found(found: Found) -> list[str]:
    return [f"{found.right} of {found.rows} right, {found.extra} extra", f"{100 * found.volume:+.0f}%"]
