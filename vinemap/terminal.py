"""What people see in a terminal: bars of progress, and errors in one line."""

from __future__ import annotations

import logging
import os
import signal
import sys
from contextlib import contextmanager
from io import TextIOWrapper
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn, TypeVar

import click

from vinemap.compute.processes import STOPPING
from vinemap.errors import VinemapError, own_fault
from vinemap.stages import STAGES

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Sequence

    from rich.progress import Progress, ProgressColumn

    from vinemap.jobs.outcomes import Outcome

T = TypeVar("T")


def frame_progress(frames: Iterable[T], count: int | None) -> Iterator[T]:
    """Give frames on and move a bar, on stderr."""
    from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeRemainingColumn

    columns = TextColumn("Frames"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn()
    with _bar(*columns) as bar:
        yield from bar.track(frames, total=count)


@contextmanager
def progress(parcel: str) -> Iterator[Callable[..., Any]]:
    """Give a ``step`` for :func:`vinemap.parcel.map_parcel` that moves a bar and names the stage, on stderr.

    With ``VINEMAP_PROGRESS=1`` it writes a line a stage instead (``4/14 Key points``), for programs that show it
    themselves.
    """
    if os.environ.get("VINEMAP_PROGRESS"):
        yield _told
        return
    from rich.progress import BarColumn, TextColumn, TimeElapsedColumn

    columns = TextColumn("{task.fields[parcel]}"), BarColumn(), TextColumn("{task.description}"), TimeElapsedColumn()
    with _bar(*columns) as bar:
        task = bar.add_task("Starting", total=None, parcel=parcel)

        def step(name: str, function: Callable[..., Any], *args: Any, **kwargs: Any) -> Any:
            bar.update(task, description=name, total=len(STAGES), completed=STAGES.index(name))
            return function(*args, **kwargs)

        yield step


def _told(name: str, function: Callable[..., Any], *args: Any, **kwargs: Any) -> Any:
    click.echo(f"{STAGES.index(name)}/{len(STAGES)} {name}", err=True)
    return function(*args, **kwargs)


def show(columns: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
    """Print a table."""
    widths = [max(map(len, column)) for column in zip(columns, *rows, strict=True)]
    for row in (columns, *rows):
        click.echo("  ".join(word.ljust(width) for word, width in zip(row, widths, strict=True)).rstrip())


def tell(outcomes: Sequence[Outcome]) -> None:
    """Print what became of parcels, and end with exit code 1 if one failed."""
    from vinemap.jobs.outcomes import COLUMNS, FAILED, in_table

    show(COLUMNS, in_table(outcomes))
    if failed := sum(outcome.state == FAILED for outcome in outcomes):
        click.echo(f"vinemap: {failed} of {len(outcomes)} parcels failed", err=True)
        sys.exit(1)


def _bar(*columns: ProgressColumn) -> Progress:
    """A bar on stderr that isn't there where that is no terminal."""
    from rich.console import Console
    from rich.progress import Progress

    console = Console(stderr=True)
    return Progress(*columns, console=console, transient=True, disable=not console.is_terminal)


@contextmanager
def plain_errors() -> Iterator[None]:
    """Say errors in one line on stderr: exit code 2 for what the user can mend, 1 for a fault of vinemap's own.

    ``VINEMAP_TRACEBACK=1`` lets a fault through with its traceback. A termination signal unwinds like Ctrl-C, so that
    drafts are removed and servers stopped.
    """
    for number in STOPPING:
        signal.signal(number, _stop)
    if isinstance(sys.stdout, TextIOWrapper):
        sys.stdout.reconfigure(errors="replace")  # not all signs are in each code page of Windows
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


@contextmanager
def hushed() -> Iterator[None]:
    """Keep what libraries write on stderr from people, as what matters of it stands in a line of ours.

    Decoders, GDAL and others write there beside Python. With ``VINEMAP_TRACEBACK=1``, or where Python's stderr is no
    longer the process's, nothing is kept back.
    """
    ours = sys.stderr
    logging.getLogger().addHandler(logging.NullHandler())  # else warnings of theirs go to stderr
    if os.environ.get("VINEMAP_TRACEBACK") or ours is not sys.__stderr__ or ours is None or ours.fileno() != 2:
        yield
        return
    ours.flush()
    with (
        os.fdopen(os.dup(2), "w", buffering=1, encoding=ours.encoding, errors=ours.errors) as people,
        Path(os.devnull).open("wb") as nobody,
    ):
        os.dup2(nobody.fileno(), 2)
        sys.stderr = people
        try:
            yield
        finally:
            sys.stderr = ours
            os.dup2(people.fileno(), 2)


def _stop(number: int, frame: object) -> NoReturn:
    del frame
    raise SystemExit(128 + number)


def _fail(reason: object, code: int) -> NoReturn:
    click.echo(f"vinemap: {' '.join(str(reason).split())}", err=True)
    sys.exit(code)
