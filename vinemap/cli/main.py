"""Commands of vinemap. Heavy modules are imported where a command needs them, so that ``--help`` is at once."""

from __future__ import annotations

import os
import signal
import sys
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn, TypeVar

import click

from vinemap import __version__
from vinemap.errors import VinemapError, own_fault
from vinemap.export import FORMATS, LINES

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator

    from rich.progress import Progress, ProgressColumn

T = TypeVar("T")

FILE = click.Path(path_type=Path)
SHARE = click.FloatRange(0, 0.8, min_open=True)
METHODS = ("aligned", "quadratic", "centroid", "maximum")


class _Origin(click.ParamType):  # type: ignore[type-arg]
    name = "LAT,LON,ALT"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        from vinemap.geo.crs import Origin, check_origin

        try:
            lat, lon, alt = (float(part) for part in str(value).split(","))
        except ValueError:
            self.fail(
                f"{value!r} isn't latitude, longitude and altitude: for example 44.61167,7.92442,428.7", param, ctx
            )
        return check_origin(Origin(lat, lon, alt))


class _Start(click.ParamType):  # type: ignore[type-arg]
    name = "LAT,LON,HEADING"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        from vinemap.geo.crs import Start, check_start

        try:
            start = Start(*(float(part) for part in str(value).split(",")))
        except (TypeError, ValueError):
            self.fail(
                f"{value!r} isn't latitude, longitude and heading in degrees: for example 44.61167,7.92442,72.5",
                param,
                ctx,
            )
        return check_start(start)


@click.group(context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(__version__, prog_name="vinemap")
def commands() -> None:
    """Vine rows and light canopy meshes from UAV point clouds."""


@commands.command()
@click.argument("cloud", type=FILE)
@click.option("--boundary", type=FILE, help="Polygon to clip to: GeoPackage, GeoJSON or Shapefile, in any CRS.")
@click.option("--crs", help="CRS of the cloud, as EPSG:n, where the file states none or a wrong one.")
@click.option("--parcel", help="Name of the parcel; the cloud's by default.")
@click.option("--out", type=FILE, help="Folder of the product; data/products/<cloud>/<parcel> by default.")
@click.option("--origin", type=_Origin(), help="Origin of the local frame {Main}; the parcel's corner by default.")
@click.option("--settings", type=FILE, help="YAML file with settings of the stages.")
@click.option("--classified", is_flag=True, help="Write the points with a class and a row each, too.")
@click.option("--plain", is_flag=True, help="Write meshes for readers of glTF that know no extension: larger files.")
def run(
    cloud: Path,
    boundary: Path | None,
    crs: str | None,
    parcel: str | None,
    out: Path | None,
    origin: Any,
    settings: Path | None,
    classified: bool,
    plain: bool,
) -> None:
    """Map the rows and canopies in CLOUD (LAS, LAZ or COPC)."""
    from vinemap import paths
    from vinemap.config.names import check_name
    from vinemap.config.settings import Settings
    from vinemap.config.surveys import load_settings
    from vinemap.geo.crs import parse_crs

    name = check_name(parcel) if parcel is not None else paths.stem(cloud)
    folder = out or paths.product_folder(paths.stem(cloud), name)
    chosen = load_settings(settings) if settings else Settings()
    extra = {key: True for key, wanted in {"classified": classified, "plain": plain}.items() if wanted}
    options = {
        "crs": parse_crs(crs) if crs else None,
        "settings": chosen.model_copy(update={"product": chosen.product.model_copy(update=extra)}),
        "boundary": boundary,
        "origin": origin,
        "named": parcel is not None,
    }
    with progress(name) as step:
        from vinemap.parcel import map_parcel

        summary = map_parcel(cloud, folder, parcel=name, step=step, **options)
    click.echo(summary.line())


@commands.command()
@click.argument("cloud", type=FILE)
@click.option("--boundaries", type=FILE, required=True, help="Polygons of the parcels, named in one of their columns.")
@click.option("--parcel", "parcels", multiple=True, help="Name of a parcel, any number of times; all by default.")
@click.option("--crs", help="CRS of the cloud, as EPSG:n, where the file states none or a wrong one.")
@click.option("--out", type=FILE, help="Folder of the products' folders; data/products/<cloud> by default.")
@click.option("--origin", type=_Origin(), help="Origin of the local frame {Main}; each parcel's corner by default.")
@click.option("--settings", type=FILE, help="YAML file with settings of the stages.")
@click.option("--again", is_flag=True, help="Map parcels that are up to date, too.")
@click.option("--workers", type=int, help="Parcels worked at once; as many as there are cores.")
@click.option("--limit", type=float, help="Seconds that a parcel may take; an hour by default.")
@click.option("--memory", type=float, help="Memory that a parcel may take, in GB; its share of what there is.")
@click.option("--engine", type=click.Choice(["processes", "dask"]), help="What works the parcels; processes here.")
@click.option("--scheduler", help="Address of the Dask scheduler, as tcp://host:8786.")
def survey(
    cloud: Path,
    boundaries: Path,
    parcels: tuple[str, ...],
    crs: str | None,
    out: Path | None,
    origin: Any,
    settings: Path | None,
    again: bool,
    **job: Any,
) -> None:
    """Map many parcels of CLOUD (LAS, LAZ or COPC) in one job; exit code 1 if one of them fails."""
    from vinemap import paths
    from vinemap.config.surveys import load_settings, survey_config
    from vinemap.jobs.plan import FAILED
    from vinemap.jobs.survey import map_survey

    name = paths.stem(cloud)
    config = survey_config(
        survey=name,
        cloud=cloud,
        boundaries=boundaries,
        parcels=list(parcels) or None,
        crs=crs,
        origin=origin,
        settings=load_settings(settings) if settings else None,
        job={key: value for key, value in job.items() if value is not None},
    )
    failed = False
    for outcome in map_survey(config, out or paths.survey_products(name), again=again):
        failed |= outcome.state == FAILED
        click.echo(outcome.line(), err=outcome.state == FAILED)
    if failed:
        sys.exit(1)


@commands.command()
@click.argument("kind", type=click.Choice(["estate", "survey", "settings", "camera"]), default="estate")
def config(kind: str) -> None:
    """Print all that can be configured, with its defaults, as a commented YAML file.

    KIND is what the file is for: the surveys of an estate night after night, one survey, the stages alone, or the
    camera of a robot.
    """
    from vinemap.config.template import template

    click.echo(template(kind), nl=False)


@commands.command()
@click.argument("result", type=FILE)
@click.argument("reference", type=FILE)
@click.option("--layer", help="Layer of REFERENCE; rows, or its only layer of lines, by default.")
@click.option("--parcel", help="Only the lines of REFERENCE in which a column holds this name.")
@click.option("--pairs", type=FILE, help="GeoPackage to write: matched, extra and missed rows with their indices.")
def evaluate(result: Path, reference: Path, layer: str | None, parcel: str | None, pairs: Path | None) -> None:
    """Compare the rows of RESULT with lines drawn in REFERENCE: the six indices of Table 2.2."""
    from vinemap.evaluate.rows import as_layer, evaluate_rows, format_table
    from vinemap.geo.lines import read_lines
    from vinemap.product.geopackage import write_layer

    found, drawn = read_lines(result), read_lines(reference, layer, parcel=parcel)
    evaluation = evaluate_rows(found, drawn)
    if pairs:
        write_layer(as_layer(evaluation, found, drawn), pairs, layer="pairs")
    click.echo(format_table(evaluation))


@commands.command()
@click.argument("products", metavar="PRODUCT...", nargs=-1, required=True, type=FILE)
@click.option(
    "--format",
    "formats",
    multiple=True,
    required=True,
    type=click.Choice([*FORMATS, "all"]),
    help="Any number of times.",
)
@click.option("--out", type=FILE, help="Folder of the parcels' folders; exports by default.")
@click.option("--lines", type=click.Choice(LINES), default="lanes", help="What guidance follows; lanes by default.")
@click.option(
    "--headland", type=click.FloatRange(0, 50), default=3.0, help="Metres of lanes beyond rows; 3 by default."
)
@click.option("--outer", is_flag=True, help="Lanes beside the first row of a block and its last, too.")
@click.option("--frame", default="map", help="Name of the frame of a robot's coordinates; map by default.")
@click.option("--grid", is_flag=True, help="Robots' coordinates and meshes in the product's CRS; in {Main} by default.")
@click.option("--vertices", type=click.IntRange(2, 10_000), help="Vertices of every lane; by default few.")
def export(products: tuple[Path, ...], formats: tuple[str, ...], out: Path | None, **options: Any) -> None:
    """Write the rows of each PRODUCT (its folder or GeoPackage), and lanes between them, for tractors and robots."""
    from vinemap import paths
    from vinemap.export.write import export_products

    chosen = FORMATS if "all" in formats else tuple(dict.fromkeys(formats))
    for line in export_products(products, out or paths.exports(), formats=chosen, **options):
        click.echo(line)


@commands.command()
@click.argument("frames", nargs=-1, required=True, type=FILE)
@click.option("--camera", type=FILE, required=True, help="YAML file of the camera: see vinemap config camera.")
@click.option("--out", type=FILE, default="track.gpkg", help="GeoPackage to write; track.gpkg by default.")
@click.option("--start", type=_Start(), help="Where the first frame was taken, heading clockwise from north.")
@click.option("--rows", type=FILE, help="GeoPackage of vine rows, for the distance to the nearest one.")
@click.option(
    "--template-share",
    type=SHARE,
    default=0.2,
    help="Template, of the image's height; 0.2.",
)
@click.option("--turn", type=click.FloatRange(1, 90), default=9.0, help="Most degrees a frame; 9 by default.")
@click.option(
    "--method", type=click.Choice(METHODS), default="aligned", help="How peaks are refined; aligned by default."
)
def track(
    frames: tuple[Path, ...],
    camera: Path,
    out: Path,
    start: Any,
    rows: Path | None,
    template_share: float,
    turn: float,
    method: Any,
) -> None:
    """Follow a robot by the FRAMES of its camera that looks down: images, folders of images, or videos, in order."""
    from vinemap.config.drives import load_camera
    from vinemap.odometry.drive import map_drive

    summary = map_drive(
        frames,
        out,
        camera=load_camera(camera),
        start=start,
        rows=rows,
        template_share=template_share,
        angles=(-turn, turn),
        method=method,
        show=frame_progress,
    )
    click.echo(summary.line())


def frame_progress(frames: Iterable[T], count: int) -> Iterator[T]:
    """Give frames on and move a bar, on stderr."""
    from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeRemainingColumn

    columns = TextColumn("Frames"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn()
    with _bar(*columns) as bar:
        yield from bar.track(frames, total=count)


@contextmanager
def progress(parcel: str) -> Iterator[Callable[..., Any]]:
    """Give a ``step`` for :func:`vinemap.parcel.map_parcel` that moves a bar and names the stage, on stderr."""
    from rich.progress import BarColumn, TextColumn, TimeElapsedColumn

    columns = TextColumn("{task.fields[parcel]}"), BarColumn(), TextColumn("{task.description}"), TimeElapsedColumn()
    with _bar(*columns) as bar:
        task = bar.add_task("Starting", total=None, parcel=parcel)

        def step(name: str, function: Callable[..., Any], *args: Any, **kwargs: Any) -> Any:
            from vinemap.parcel import STAGES

            bar.update(task, description=name, total=len(STAGES), completed=STAGES.index(name))
            return function(*args, **kwargs)

        yield step


def _bar(*columns: ProgressColumn) -> Progress:
    """A bar on stderr that isn't there where that is no terminal."""
    from rich.console import Console
    from rich.progress import Progress

    console = Console(stderr=True)
    return Progress(*columns, console=console, transient=True, disable=not console.is_terminal)


def main() -> None:
    """Run a command of the command line."""
    with plain_errors():
        commands.main(prog_name="vinemap", standalone_mode=False)


@contextmanager
def plain_errors() -> Iterator[None]:
    """Say errors in one line on stderr: exit code 2 for what the user can mend, 1 for a fault of vinemap's own.

    ``VINEMAP_TRACEBACK=1`` lets a fault through with its traceback. A termination signal unwinds like Ctrl-C, so that
    drafts are removed and servers stopped.
    """
    for number in (signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, _stop)
    try:
        yield
    except VinemapError as error:
        _fail(error, 2)
    except click.ClickException as error:
        _fail(error.format_message(), 2)
    except (KeyboardInterrupt, click.exceptions.Abort):
        _fail("stopped", 130)
    except MemoryError:
        _fail("not enough memory: clip the cloud with --boundary", 2)
    except Exception as error:
        if os.environ.get("VINEMAP_TRACEBACK"):
            raise
        _fail(f"{own_fault(error)}; VINEMAP_TRACEBACK=1 shows where", 1)


def _stop(number: int, frame: object) -> NoReturn:
    del frame
    raise SystemExit(128 + number)


def _fail(reason: object, code: int) -> NoReturn:
    click.echo(f"vinemap: {' '.join(str(reason).split())}", err=True)
    sys.exit(code)


if __name__ == "__main__":
    main()
