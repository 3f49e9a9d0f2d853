"""Runs of the benchmark: every size, many parcels in one job, a cold start, Prefect."""

from __future__ import annotations

import json
import os
import sys
import tempfile
import time
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from vinemap import paths
from vinemap.measure.bench.bars import ALL, COLD, GOAL, MANY_MEMORY, MANY_TIMES, Bar, Found, Run, of_bar, with_other
from vinemap.measure.bench.watched import must, summed_memory

if TYPE_CHECKING:
    from vinemap.measure.bench.tables import Lines

TURNS = {"F": 2, "dense": 3}
"""Of each family, of which the fastest counts."""
COLD_TURNS = 3
EXAMPLE = Path("configs/barolo.yaml")


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


def ensure_survey(millions: float, out: Path, family: str = "F") -> dict[str, Any]:
    """Files of the survey of that size and family, and its parcel's area (m²) and canopies' volume (m³)."""
    made = out / "jobs" / f"survey-{family}-{millions:g}M.json"
    must(job("survey", made, millions=millions, folder=str(out / "surveys"), family=family))
    survey: dict[str, Any] = load(made)
    return survey


def measure(millions: float, out: Path, family: str = "F") -> Run:
    """Measure one size: reading, a few times the whole command, of which the fastest counts, then memory by stage."""
    survey = ensure_survey(millions, out, family)
    name = f"{family}-{millions:g}M"
    read, held = (out / "jobs" / f"{kind}-{name}.json" for kind in ("reading", "peaks"))
    product = out / "products" / name
    record = paths.run_record(product)
    plain = must(job("reading", read, cloud=survey["cloud"]))
    turns = []
    for _ in range(TURNS[family]):
        began = time.time()
        whole = must(vinemap_run(survey["cloud"], "--boundary", survey["boundary"], "--out", str(product)))
        seconds = load(record)["seconds"]
        start = record.stat().st_mtime - seconds[ALL] - began  # the record is the last that is written
        turns.append((whole.seconds, whole.peak, start, seconds))
    wall, peak, start, seconds = min(turns, key=lambda turn: turn[0])
    files = {key: survey[key] for key in ("cloud", "boundary")}
    must(job("peaks", held, **files, out=f"{product}-peaks"))
    rows = paths.geopackage(product, paths.stem(Path(survey["cloud"])))
    found = load(read)
    return Run(
        found["points"],
        survey["area"],
        found["seconds"],
        plain.peak,
        wall,
        start,
        peak,
        with_other(seconds),
        load(held),
        judge(rows, survey, out / "jobs" / f"found-{name}.json"),
    )


def judge(rows: Path, survey: dict[str, Any], result: Path) -> Found:
    """Hold rows and their volumes, in a GeoPackage, against the truth of a survey."""
    must(job("judged", result, rows=str(rows), truth=survey["truth"], volume=survey["volume"]))
    return Found(**load(result))


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
    seconds = Bar("", "", whole.seconds, MANY_TIMES * found["seconds"], 1)
    memory = of_bar(Bar("", "", most[0] / 1e6, MANY_MEMORY, 0)) if most[0] else "–"
    return [
        ["survey", "laspy.read, xyz", "one job", "all its processes' memory, MB"],
        [
            f"{found['points'] / 1e6:.1f} M points, {parcels} parcels",
            f"{found['seconds']:.1f} s",
            f"{of_bar(seconds)} s",
            memory,
        ],
    ]


def cold(out: Path) -> Lines:
    """Table of what a first run takes that has to compile: parcel F of the example, with an empty cache and with it."""
    click.echo("Cold start…", err=True)
    made = out / "jobs" / "example.json"
    must(job("example", made, folder=str(out / "surveys")))
    files = load(made)
    command = vinemap_run(files["cloud"], "--boundary", files["boundary"], "--parcel", "F")
    command += ["--out", str(out / "products" / "cold")]
    turns = []
    for _ in range(COLD_TURNS):
        with tempfile.TemporaryDirectory() as cache:
            env = os.environ | {"NUMBA_CACHE_DIR": cache}
            turns.append([must(command, env=env).seconds for _ in range(2)])
    first, again = map(min, zip(*turns, strict=True))
    return [
        ["parcel F of barolo", "with an empty cache", "again", "beyond warm"],
        [
            f"best of {COLD_TURNS}",
            f"{first:.1f} s",
            f"{again:.1f} s",
            f"{of_bar(Bar('', '', first - again, COLD, 1))} s; {GOAL:g} s are the goal",
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
