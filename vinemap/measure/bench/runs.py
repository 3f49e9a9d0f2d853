"""How fast the chain is and how much memory it takes, on parcels of several sizes: ``python -m vinemap.measure.bench``.

A run of ``vinemap run`` as a user starts it is held against plain reading of the same file, against what is promised,
and against what a user would pick instead of a step. Everything that is measured has a process of its own.
"""

from __future__ import annotations

import json
import math
import os
import platform
import sys
from importlib.metadata import version
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import click

from vinemap import __version__, paths
from vinemap.cli.main import FILE, plain_errors
from vinemap.compute.processes import must, run_process, summed_memory
from vinemap.errors import ConfigError
from vinemap.measure.tables import as_markdown, as_text, fill

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

Lines = list[list[str]]
"""A table, headings first."""

SIZES = "1 2 4 8 16"
ALL = "All"
OTHER = "other"
ROWS = ("DTM", "Ends and gaps")
"""First and last of the stages that find rows."""
GROUPS = {
    "Reading": ("Reading", "Reading"),
    "DTM": ("DTM", "DTM"),
    "Canopy cover … Curves": ("Canopy cover", "Curves"),
    "Sections … Mesh": ("Sections", "Mesh"),
    "Writing": ("Writing", "Writing"),
}
"""First and last stage of what is drawn beside rows and the whole."""
COLOURS = ("tab:blue", "tab:brown", "tab:olive", "tab:purple", "tab:cyan")
SMALL = 3e6
"""Points below which a bar is a matter of seconds."""
HECTARE = 10_000.0
START_UP = 2.0
"""Seconds."""
GROWTH = 1.15
"""Of the seconds a point, from ``BASE`` to the largest survey."""
BASE = 2e6
LIMIT = 600.0
"""Seconds that an alternative may take."""
MANY = 60.0, 20
"""Million points and parcels of the survey that is one job."""
EXAMPLE = Path("configs/barolo.yaml")
LIBRARIES = ("numpy", "scipy", "numba", "laspy", "lazrs")


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


class Run(NamedTuple):
    """One size, measured."""

    points: int
    """In the file."""
    area: float
    """Of the parcel, m²."""
    reading: float
    """Seconds of plain laspy."""
    reading_peak: int
    """Most memory that takes, bytes."""
    wall: float
    """Seconds of the command, as a user waits."""
    peak: int
    """Most memory of the command, bytes."""
    seconds: dict[str, float]
    """Of every stage in order, of what lies between them, and of all."""
    peaks: dict[str, int | None]
    """Most memory (bytes) in every stage; None where the system doesn't tell."""


class Bar(NamedTuple):
    """A figure, and what it may be at the most."""

    name: str
    terms: str
    value: float
    most: float
    digits: int = 2


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


def with_other(seconds: Mapping[str, float]) -> dict[str, float]:
    """Seconds of stages and of all, with what lies between the stages as one more."""
    stages = {name: value for name, value in seconds.items() if name != ALL}
    return stages | {OTHER: max(seconds[ALL] - sum(stages.values()), 0.0), ALL: seconds[ALL]}


def span(seconds: Mapping[str, float], first: str, last: str) -> float:
    """Seconds of the stages from one to another, both included."""
    names = list(seconds)
    return sum(seconds[name] for name in names[names.index(first) : names.index(last) + 1])


def growth_exponent(points: Sequence[float], seconds: Sequence[float]) -> float:
    """Slope of log seconds against log points by least squares; NaN of a single size."""
    x, y = [math.log(value) for value in points], [math.log(value) for value in seconds]
    middle, height = sum(x) / len(x), sum(y) / len(y)
    spread = sum((a - middle) ** 2 for a in x)
    return sum((a - middle) * (b - height) for a, b in zip(x, y, strict=True)) / spread if spread else math.nan


def growth_ratio(runs: Sequence[Run]) -> float:
    """Seconds a point in the largest survey over those in the one nearest to ``BASE``; NaN if that is the same."""
    base, top = min(runs, key=lambda run: abs(run.points - BASE)), max(runs, key=lambda run: run.points)
    if base.points >= top.points:
        return math.nan
    return (top.seconds[ALL] / top.points) / (base.seconds[ALL] / base.points)


def bars(run: Run) -> list[Bar]:
    """What is promised of every size."""
    small, hectares = run.points < SMALL, run.area / HECTARE
    rows = 2.0 if small else run.reading + hectares
    whole = 4.0 if small else 2 * run.reading + 2 * hectares
    terms = "{} × reading + {} s a hectare; below 3 M points {} s"
    return [
        Bar(f"rows ({ROWS[0]} … {ROWS[1]}), s", terms.format(1, 1, 2), span(run.seconds, *ROWS), rows),
        Bar("whole parcel, s", terms.format(2, 2, 4), run.seconds[ALL], whole),
        Bar("start-up, s", "2 s", run.wall - run.seconds[ALL], START_UP),
        Bar("most memory, MB", "60 bytes a point + 400 MB", run.peak / 1e6, 60e-6 * run.points + 400, 0),
    ]


def of_bar(bar: Bar) -> str:
    """A figure and its bar, "!" where it misses it; as precise as it is printed."""
    value, most = (round(number, bar.digits) for number in (bar.value, bar.most))
    return f"{value:.{bar.digits}f} of {most:.{bar.digits}f}{'!' if value > most else ''}"


def size_of(run: Run) -> str:
    """A size as a heading says it."""
    return f"{run.points / 1e6:.1f} M points, {run.area / HECTARE:.2f} ha"


def bar_table(runs: Sequence[Run]) -> Lines:
    """Table of what is promised: a line a bar, a column a size."""
    columns = [bars(run) for run in runs]
    lines = [["figure", "may be", *map(size_of, runs)]]
    lines += [[line[0].name, line[0].terms, *map(of_bar, line)] for line in zip(*columns, strict=True)]
    ratio, rest = growth_ratio(runs), [""] * (len(runs) - 1)
    growth = "–" if math.isnan(ratio) else of_bar(Bar("", "", ratio, GROWTH))
    lines.append(["seconds a point, over those at 2 M", f"{GROWTH} at the largest", *rest, growth])
    exponent = growth_exponent([run.points for run in runs], [run.seconds[ALL] for run in runs])
    lines.append(["growth exponent of the whole", "", *rest, "–" if math.isnan(exponent) else f"{exponent:.2f}"])
    return lines


def stage_table(runs: Sequence[Run]) -> Lines:
    """Table of what every stage takes: a line a stage, a column a size."""
    lines = [["stage", *[f"{size_of(run)}: s, M points/s, × laspy, B/point" for run in runs]]]
    names = list(dict.fromkeys(name for run in runs for name in run.seconds if name != ALL))
    lines.append(["laspy.read, xyz", *[figures(run, run.reading, run.reading_peak) for run in runs]])
    lines += [[name, *[figures(run, run.seconds.get(name), run.peaks.get(name)) for run in runs]] for name in names]
    lines.append(["whole parcel", *[figures(run, run.seconds[ALL], run.peak) for run in runs]])
    lines.append(["with start-up", *[figures(run, run.wall, run.peak) for run in runs]])
    return lines


def figures(run: Run, seconds: float | None, peak: int | None) -> str:
    """Seconds, million points a second, ratio to reading, and most memory a point (bytes)."""
    if seconds is None:
        return "–"
    speed = f"{run.points / seconds / 1e6:.1f}" if seconds >= 0.0005 else "–"
    held = "–" if peak is None else f"{peak / run.points:.0f}"
    return f"{seconds:.2f}, {speed}, {seconds / run.reading:.2f}, {held}"


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


def machine() -> str:
    """The machine and the versions in a sentence, without its name."""
    try:
        about = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        about = []
    named = (line.partition(":")[2].strip() for line in about if line.startswith("model name"))
    processor = next(named, platform.processor() or platform.machine())
    libraries = ", ".join(f"{name} {version(name)}" for name in LIBRARIES)
    return (
        f"Measured on {os.cpu_count()} cores ({processor}), with Python {platform.python_version()}, "
        f"vinemap {__version__}, {libraries}."
    )


def draw(runs: Sequence[Run], path: Path) -> None:
    """Draw seconds and memory against points, with what they may be dotted."""
    from matplotlib.figure import Figure  # a tool of development
    from matplotlib.ticker import LogLocator

    points = [run.points / 1e6 for run in runs]
    rows, whole, _, memory = zip(*map(bars, runs), strict=True)
    figure = Figure(figsize=(11, 5.4), layout="constrained")
    left, right = figure.subplots(1, 2)
    lines = {"laspy.read, xyz": ("k--", [run.reading for run in runs], [run.reading_peak / 1e6 for run in runs])}
    lines["whole parcel"] = ("ro-", [bar.value for bar in whole], [bar.value for bar in memory])
    lines["may take"] = ("r:", [bar.most for bar in whole], [bar.most for bar in memory])
    for name, (style, seconds, held) in lines.items():
        left.plot(points, seconds, style, label=name, linewidth=2)
        right.plot(points, held, style, linewidth=2)
    left.plot(points, [bar.value for bar in rows], "s-", color="tab:green", label=rows[0].name.removesuffix(", s"))
    left.plot(points, [bar.most for bar in rows], ":", color="tab:green", linewidth=2, label="may take")
    for (name, stages), colour in zip(GROUPS.items(), COLOURS, strict=True):
        seconds = [max(span(run.seconds, *stages), 1e-3) for run in runs]
        left.plot(points, seconds, ".-", color=colour, linewidth=1, label=name)
    for axes, what in ((left, "seconds"), (right, "most memory (MB)")):
        axes.set(xscale="log", yscale="log", xlabel="million points", ylabel=what)
        axes.set_xticks(points, [f"{x:.1f}" for x in points])
        axes.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        axes.yaxis.set_major_formatter("{x:g}")
        axes.minorticks_off()
        axes.grid(visible=True, alpha=0.3)
    figure.legend(loc="outside lower center", ncols=5, fontsize=9)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=90)


def parse_sizes(text: str) -> list[float]:
    """Sizes in million points from a text, ascending.

    Raises
    ------
    ConfigError
        If they aren't numbers above 0.
    """
    try:
        sizes = sorted({float(word) for word in text.replace(",", " ").split()})
    except ValueError:
        sizes = []
    if not sizes or not 0 < sizes[0] <= sizes[-1] < math.inf:
        raise ConfigError(f"sizes {text!r} aren't million points, for example --sizes '{SIZES}'")
    return sizes


def write_tables(tables: Mapping[str, Lines], path: Path) -> None:
    """Fill tables, and the machine, into a document between its marks."""
    text = fill(path.read_text(encoding="utf-8"), "machine", machine())
    for name, lines in tables.items():
        text = fill(text, name, as_markdown(lines))
    path.write_text(text, encoding="utf-8")


@click.command()
@click.option("--sizes", default=SIZES, show_default=True, help="Million points, in quotes.")
@click.option("--out", type=FILE, default=Path("build/bench"), show_default=True, help="Folder of all that is made.")
@click.option("--docs", type=FILE, help="Markdown file to fill between its marks; the plot goes beside it.")
@click.option("--instead-at", default=4.0, show_default=True, help="Million points for what a user would pick instead.")
@click.option("--without", multiple=True, type=click.Choice(["many", "instead", "prefect"]), help="What to leave out.")
def main(sizes: str, out: Path, docs: Path | None, instead_at: float, without: Iterable[str]) -> None:
    """Measure seconds and memory of the chain on simulated parcels of several sizes."""
    millions = parse_sizes(sizes)
    runs = []
    for size in millions:
        click.echo(f"{size:g} million points…", err=True)
        runs.append(measure(size, out))
    (out / "runs.json").write_text(json.dumps([run._asdict() for run in runs], indent=2), encoding="utf-8")
    tables = {"bars": bar_table(runs), "stages": stage_table(runs)}
    if "many" not in without:
        tables["many"] = many(*MANY, out)
    if "instead" not in without:
        k = min(range(len(runs)), key=lambda i: abs(millions[i] - instead_at))
        tables["instead"] = instead(millions[k], runs[k], out)
    if "prefect" not in without:
        tables["prefect"] = prefect(out)
    click.echo(machine())
    for lines in tables.values():
        click.echo("\n" + as_text(lines))
    draw(runs, docs.with_suffix(".png") if docs else out / "speed.png")
    if docs:
        write_tables(tables, docs)


if __name__ == "__main__":
    with plain_errors():
        main(standalone_mode=False)
