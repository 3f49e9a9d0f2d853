"""Runs of the benchmark: every size, what a user would pick instead, many parcels in one job, Prefect."""

from __future__ import annotations

import json
import sys
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import click

from vinemap import paths
from vinemap.compute.processes import must, run_process, summed_memory
from vinemap.measure.bench.bars import Bar, Run, of_bar, span, with_other

if TYPE_CHECKING:
    from vinemap.measure.bench.tables import Lines

LIMIT = 600.0
"""Seconds that an alternative may take."""
EXAMPLE = Path("configs/barolo.yaml")


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


def job(name: str, result: Path, **arguments: Any) -> list[str]:
    """Command of a job of ``vinemap.measure.bench.jobs``."""
    result.parent.mkdir(parents=True, exist_ok=True)
    return [sys.executable, "-m", "vinemap.measure.bench.jobs", name, str(result), json.dumps(arguments)]


def load(path: Path) -> Any:
    """What a JSON file holds."""
    return json.loads(path.read_text(encoding="utf-8"))


def vinemap_run(cloud: Path | str, *options: str) -> list[str]:
    """Command that maps a cloud."""
    return [sys.executable, "-m", "vinemap", "run", str(cloud), *options]


def ensure_survey(millions: float, out: Path) -> dict[str, Any]:
    """Files of the survey of that size, and the area (m²) of its parcel; simulated if it isn't there."""
    made = out / "jobs" / f"survey-{millions:g}M.json"
    must(job("survey", made, millions=millions, folder=str(out / "surveys")))
    survey: dict[str, Any] = load(made)
    return survey


def measure(millions: float, out: Path) -> Run:
    """Measure one size: reading, then twice the whole command, of which the faster counts, then memory by stage."""
    survey = ensure_survey(millions, out)
    read, held = (out / "jobs" / f"{name}-{millions:g}M.json" for name in ("reading", "peaks"))
    product = out / "products" / f"{millions:g}M"
    plain = must(job("reading", read, cloud=survey["cloud"]))
    turns = []
    for _ in range(2):
        whole = must(vinemap_run(survey["cloud"], "--boundary", survey["boundary"], "--out", str(product)))
        turns.append((whole.seconds, whole.peak, load(paths.run_record(product))["seconds"]))
    wall, peak, seconds = min(turns, key=lambda turn: turn[0])
    files = {key: survey[key] for key in ("cloud", "boundary")}
    must(job("peaks", held, **files, out=f"{product}-peaks"))
    found = load(read)
    return Run(
        found["points"],
        survey["area"],
        found["seconds"],
        plain.peak,
        wall,
        peak,
        with_other(seconds),
        load(held),
    )


def instead(millions: float, run: Run, out: Path, *, limit: float = LIMIT) -> Lines:
    """Table of what a user would pick instead of a step, on the survey of that size, beside ours in its run."""
    survey = ensure_survey(millions, out)
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
        outcome = run_process(job(one.job, result, **given), limit=limit)
        if outcome.code:
            lines.append([one.step, one.module, "–", outcome.said, ours, "–"])
            continue
        found = load(result)
        parts = (found["tool"], found["seconds"], found["result"], found.get("our_seconds", ours), found["ours"])
        lines.append([one.step, *parts])
    return lines


def many(millions: float, parcels: int, out: Path) -> Lines:
    """Table of a survey of many parcels in one job, and what it may take."""
    click.echo(f"{millions:g} million points, {parcels} parcels…", err=True)
    made, read = (out / "jobs" / f"{name}-{millions:g}M-{parcels}.json" for name in ("estate", "reading"))
    must(job("estate", made, millions=millions, parcels=parcels, folder=str(out / "surveys")))
    files = load(made)
    must(job("reading", read, cloud=files["cloud"]))
    products = out / "products" / f"estate-{millions:g}M"
    command = [sys.executable, "-m", "vinemap", "survey", files["cloud"], "--again"]
    with summed_memory() as most:
        whole = must([*command, "--boundaries", files["boundaries"], "--out", str(products)])
    found = load(read)
    seconds = Bar("", "", whole.seconds, 2.5 * found["seconds"], 1)
    memory = of_bar(Bar("", "", most[0] / 1e6, 2000, 0)) if most[0] else "–"
    return [
        ["survey", "laspy.read, xyz", "one job", "all its processes' memory, MB"],
        [
            f"{found['points'] / 1e6:.1f} M points, {parcels} parcels",
            f"{found['seconds']:.1f} s",
            f"{of_bar(seconds)} s",
            memory,
        ],
    ]


def prefect(out: Path) -> Lines:
    """Table of what a flow adds to the command: parcel F of the example, the second run of each.

    Raises
    ------
    VinemapError
        If a run fails.
    """
    heading = ["parcel F of barolo", "vinemap run", "as a Prefect flow", "Prefect adds"]
    if not EXAMPLE.is_file() or find_spec("flows") is None:
        return [heading, [f"{EXAMPLE} isn't here: start from the repository's folder", "–", "–", "–"]]
    click.echo("Prefect…", err=True)
    flow = [sys.executable, "-m", "flows.parcel", str(EXAMPLE), "F"]
    must(flow)
    wall = must(flow).seconds
    files = paths.survey_cloud("barolo"), "--boundary", str(paths.survey_boundaries("barolo"))
    plain = vinemap_run(*files, "--parcel", "F", "--out", str(out / "products" / "F"))
    must(plain)
    bare = must(plain).seconds
    return [heading, ["second run", f"{bare:.2f} s", f"{wall:.2f} s", f"{wall - bare:.2f} s"]]
