"""What became of a survey's parcels, and what the last job has left of that for the next."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from vinemap import __version__, paths
from vinemap.errors import OutputError
from vinemap.product.recipe import Source
from vinemap.product.record import in_words
from vinemap.product.seasons.products import places_of
from vinemap.product.store import write_whole

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

DONE, CURRENT, OUTSIDE, LEFT, FAILED = "done", "up to date", "not in the cloud", "left out", "failed"
"""What can become of a parcel, beside that it is ``GONE``."""


@dataclass(frozen=True)
class Outcome:
    """What became of a parcel."""

    parcel: str
    state: str
    rows: int = 0
    length: float = 0.0
    """Of all rows (m)."""
    seconds: float = 0.0
    reason: str = ""
    """Why it failed, or what is to be known of it."""
    heals: bool = False
    """Whether it may go well another time, with the same input."""
    key: str = ""
    """Of the recipe."""

    def line(self) -> str:
        """What became of the parcel, as a sentence."""
        what = f"{in_words(self.rows, self.length)}, in {self.seconds:.1f} s" if self.state == DONE else self.state
        colon = "; " if self.state == DONE else ": "
        return f"{self.parcel}: {what}{colon if self.reason else ''}{' '.join(self.reason.split())}"


COLUMNS = ("parcel", "rows", "seconds", "state", "reason")
"""Of a table of what became of parcels."""


def in_table(outcomes: Iterable[Outcome]) -> list[tuple[str, ...]]:
    """What became of parcels in words, as rows of a table of ``COLUMNS``."""
    return [(o.parcel, str(o.rows), f"{o.seconds:.1f}", o.state, " ".join(o.reason.split())) for o in outcomes]


class Earlier(NamedTuple):
    """What the last job in a folder has left."""

    sources: list[Source]
    outcomes: dict[str, Outcome]


def earlier_in(folder: Path) -> Earlier:
    """What the last job in a folder has left, if it can be read."""
    try:
        record = json.loads(paths.survey_record(folder).read_text(encoding="utf-8"))
        sources = [
            Source(Path(s["path"]), str(s["sha256"]), tuple(s["stamp"]), float(s["read"])) for s in record["sources"]
        ]
        outcomes = {one["parcel"]: Outcome(**one) for one in record["parcels"] if isinstance(one["parcel"], str)}
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        return Earlier([], {})
    return Earlier(sources, outcomes)


def check_same(folder: Path, clouds: Sequence[Path]) -> None:
    """Make sure that a folder of products is no other survey's, as clouds' names alone don't tell them apart.

    Parameters
    ----------
    folder : Path
        Folder of products' folders.
    clouds : sequence of Path
        Files that are to be mapped there: one must lie where one of the earlier lay, in whatever format, or have its
        name and size; of several it is enough that one lies in the same folder.

    Raises
    ------
    OutputError
        If it holds products of others.
    """
    earlier = earlier_in(folder).sources if places_of(folder) else []
    known = {(one.path.name, *one.stamp[:1]) for one in earlier}
    known |= {(one.path.absolute().parent, paths.bare(one.path)) for one in earlier}
    known |= {(one.path.absolute().parent,) for one in earlier if len(clouds) > 1}
    for cloud in clouds:
        place = cloud.absolute().parent
        size = cloud.stat().st_size if cloud.is_file() else None
        if known & {(cloud.name, size), (place, paths.bare(cloud)), (place,)}:
            return
    if earlier:
        raise OutputError(f"{folder}: holds the products of {earlier[0].path}: give another folder with --out")


def write_record(
    folder: Path,
    survey: str,
    sources: Iterable[Source],
    outcomes: Iterable[Outcome],
    *,
    began: datetime,
    listed: bool,
) -> None:
    """Write ``survey.json``: what became of each parcel, for people and for the next job.

    Parameters
    ----------
    folder : Path
        Folder of products' folders.
    survey : str
        Its name.
    sources : iterable of Source
        What it was made of.
    outcomes : iterable of Outcome
        What became of its parcels.
    began : datetime
        When.
    listed : bool
        Whether somebody has named the parcels, so that what became of others before still holds.

    Raises
    ------
    OSError
        If it can't be written.
    """
    known = earlier_in(folder).outcomes if listed else {}
    known |= {o.parcel: replace(o, state=DONE if o.state == CURRENT else o.state) for o in outcomes}
    record = {
        "vinemap": __version__,
        "survey": survey,
        "began": began.isoformat(timespec="seconds"),
        "seconds": round((datetime.now(UTC) - began).total_seconds(), 3),
        "sources": [{"path": str(s.path), "sha256": s.sha256, "stamp": s.stamp, "read": s.read} for s in sources],
        "parcels": [asdict(known[name]) for name in sorted(known)],
    }
    write_whole(paths.survey_record(folder), json.dumps(record, indent=2, ensure_ascii=False))
