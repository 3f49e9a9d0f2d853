"""Folders of products: what comes into them comes whole, and what another run holds is left to it."""

from __future__ import annotations

import ctypes
import errno
import os
import re
import shutil
import sys
import tempfile
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING

from vinemap import paths
from vinemap.compute.locks import held
from vinemap.errors import OutputError, VinemapError
from vinemap.product.json_values import read_object
from vinemap.product.qgis.changed import changed

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence
    from contextlib import AbstractContextManager

FULL = {errno.ENOSPC, errno.EDQUOT}
FIXED = {errno.EXDEV, errno.EBUSY}
"""What a system says of a folder that can't be moved, though its files can: one of an image's lower layers, say."""
BUSY = {5, 32}
"""What Windows says where another program has a file open."""
LONGEST_PATH = 259
"""Characters of a path that most programs take on Windows."""
ADDED = 50
"""Characters that are added to a product's folder while it is made, and to its name in a file's."""
AT_FDCWD, RENAME_EXCHANGE = -100, 2
"""Of Linux's renameat2(2)."""
PART = re.compile(r"\.(.+)\.[0-9a-f]{8}\.part")
"""Name of a product or a file in the making, or of an earlier one on its way out."""
SIDE = re.compile(r"(-wal|-shm|-journal|\.aux\.xml|\.ovr|\.msk)$")
"""What SQLite and GDAL add to the name of a file for one that they leave beside it."""
PATIENCE = 10.0
"""Seconds for which another run may keep a parcel, as one does that is being stopped."""


@contextmanager
def workshop(folder: Path) -> Iterator[Path]:
    """Hold the folder of a survey's products against other jobs, and give a folder in it for what goes again.

    What an earlier job has left that was killed goes first. The folder itself goes too if it was made for this and
    stays empty.

    Raises
    ------
    BusyError
        If another job holds it.
    OutputError
        If nothing can be written there.
    """
    _check_path(Path(os.path.realpath(folder)))
    made = [one for one in (folder, *folder.parents) if not one.exists()]
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with held(paths.lock(folder), f"{folder}: another job is at work here: wait until it is done"):
            _sweep(folder)
            try:
                with tempfile.TemporaryDirectory(prefix=paths.PIECES, dir=folder, ignore_cleanup_errors=True) as inner:
                    yield Path(inner).resolve()
            finally:
                _sweep(folder)
    except OSError as error:
        raise unwritable(folder, error) from error
    finally:
        _remove_empty(made)


@contextmanager
def product(target: Path, *, drafts: Path | None = None, within: Path | None = None) -> Iterator[Path]:
    """Give a folder to write a product into, and put it in place of ``target`` if all went well.

    An earlier product is replaced whole, at one stroke where the system can do that (on Linux), and other files beside
    it stay, as do its own that were ``changed``, by another name. In a folder that holds something else and is none of
    a survey's, the product's files replace those of the same name. The folder is made beside the target, or among
    ``drafts``, on the same disk; in the target if that is a disk of its own, whose files are replaced one by one.

    Parameters
    ----------
    target : Path
        Folder of the product.
    drafts : Path, optional
        Folder for it in the making, where somebody clears up even if this process dies.
    within : Path, optional
        Folder of the survey's products, in which the target must lie itself, and not be a link.

    Raises
    ------
    OutputError
        If nothing can be written there.
    BusyError
        If another run is at work there.
    """
    place = Path(os.path.realpath(target))
    if within and place != within.resolve() / target.name:
        raise OutputError(f"{target}: is a link to {place}: put a folder in its place")
    _check_path(place)
    made = [folder for folder in place.parents if not folder.exists()]
    seat = _seat(place)
    drafts = drafts if seat == place else None
    draft = paths.draft((drafts or seat.parent) / seat.name)
    try:
        place.parent.mkdir(parents=True, exist_ok=True)
        with alone(target, patience=PATIENCE):
            if place.exists() and not place.is_dir():
                raise NotADirectoryError(20, "is a file")
            if not drafts:
                _remove_parts(seat)
            draft.mkdir()
            try:
                yield draft
                _publish(draft, place, replace=within is not None)
            finally:
                shutil.rmtree(draft, ignore_errors=True)
    except OSError as error:
        raise unwritable(target, error) from error
    finally:
        _remove_empty(made)


def alone(target: Path, *, patience: float = 0.0) -> AbstractContextManager[None]:
    """Hold a product against other runs, as :func:`product` does; raises as :func:`vinemap.compute.locks.held`."""
    seat = _seat(Path(os.path.realpath(target)))
    return held(paths.lock_beside(seat), f"{target}: another run is at work here", patience=patience)


def _seat(place: Path) -> Path:
    """What the lock and the drafts of a product lie beside: its folder, or a name in it if that can't be moved."""
    return place / "product" if _is_mounted(place) else place


def _is_mounted(place: Path) -> bool:
    """Whether a folder is a disk of its own, or put in its place from elsewhere on the same."""
    if os.path.ismount(place):
        return True
    name = re.sub(rb"[ \t\n\\]", lambda one: b"\\%03o" % ord(one[0]), os.fsencode(place))
    try:
        mounts = Path("/proc/self/mountinfo").read_bytes().split(b"\n")
    except OSError:  # of Linux alone
        return False
    return any(line.split()[4:5] == [name] for line in mounts)


def _check_path(place: Path) -> None:
    """Refuse a path that pyogrio would cut at its "!", as that of an archive (its issue 632), or too long a one."""
    if "!" in str(place):
        raise OutputError(f"{place}: has a '!' in its path, which stands for an archive: choose another folder")
    n = len(str(place)) + len(place.name) + ADDED
    if os.name == "nt" and n > LONGEST_PATH:
        raise OutputError(
            f"{place}: paths of its files would have {n} characters, and Windows takes {LONGEST_PATH}: choose a shorter"
        )


def write_whole(path: Path, text: str) -> None:
    """Write a text into a file that readers see whole, or not at all.

    Raises
    ------
    OSError
        If it can't be written.
    """
    with drafted(path) as draft:
        draft.write_text(text, encoding="utf-8")


@contextmanager
def drafted(path: Path, suffix: str = "") -> Iterator[Path]:
    """Give a file's draft beside it, which takes the file's place if all goes well, and goes if it doesn't.

    What SQLite leaves beside a draft where the disk is full goes, too.

    Raises
    ------
    OSError
        If it can't take that place.
    """
    draft = paths.draft(path, suffix)
    try:
        yield draft
        draft.replace(path)
    finally:
        for left in (draft, draft.with_name(f"{draft.name}-journal")):
            with suppress(OSError):  # it took it, or was never there
                left.unlink()


def unwritable(place: Path, error: OSError) -> OutputError:
    """What is said of a folder in which nothing can be written."""
    advice = "make room there" if error.errno in FULL else "choose another folder"
    if getattr(error, "winerror", None) in BUSY:
        advice = "close what has its files open, as QGIS may, or choose another folder"
    return OutputError(f"{place}: can't be written ({error.strerror or error}): {advice}")


def _sweep(folder: Path) -> None:
    """Remove what runs have left that were killed, as far as that can be done."""
    for path in folder.iterdir():
        if path.name.startswith(paths.PIECES):
            shutil.rmtree(path, ignore_errors=True)
        elif part := PART.fullmatch(path.name):
            with suppress(VinemapError, OSError), held(paths.lock_beside(folder / part[1]), "held"):
                _remove(path)
        elif path.name.startswith(".") and path.suffix == ".lock" and path != paths.lock(folder):
            with suppress(VinemapError, OSError), held(path, "held"):
                pass


def _remove_parts(place: Path) -> None:
    for path in place.parent.iterdir():
        if (part := PART.fullmatch(path.name)) and part[1] == place.name:
            _remove(path)


def _remove(path: Path) -> None:
    """Remove a folder or a file, as far as that can be done."""
    if _is_folder(path):
        shutil.rmtree(path, ignore_errors=True)
    else:
        with suppress(OSError):
            path.unlink()


def _is_folder(path: Path) -> bool:
    return path.is_dir() and not path.is_symlink()


def _remove_empty(folders: Sequence[Path]) -> None:
    for folder in folders:
        with suppress(OSError):
            folder.rmdir()


def _publish(draft: Path, target: Path, *, replace: bool) -> None:
    if not target.exists():
        draft.rename(target)
        return
    whole = replace or _is_earlier(target, draft)
    for name, kept in changed(target).items():
        _keep(target / name, draft / kept)
    new = [path.relative_to(draft).as_posix() for path in draft.rglob("*") if not _is_folder(path)]
    ours, others = _parted(target, {paths.RUN, *new, *(_recorded(target) if whole else ())})
    if whole and draft.parent != target:
        for name in others:
            _keep(target / name, draft / name)
        try:
            _exchange(draft, target)
        except OSError as error:
            if error.errno not in FIXED:
                raise
        else:
            return
    _replace(target, draft, ours, new)


def _is_earlier(target: Path, draft: Path) -> bool:
    """Whether a folder is empty or holds an earlier product of the same parcel."""
    new, there = (read_object(paths.run_record(folder)) for folder in (draft, target))
    return not any(target.iterdir()) or bool(new and new.get("parcel") == there.get("parcel"))


def _recorded(target: Path) -> list[str]:
    """Files of a product, as its record has them."""
    files = read_object(paths.run_record(target)).get("files")
    return [*map(str, files)] if isinstance(files, (list, dict)) else []


def _parted(folder: Path, files: set[str], within: str = "") -> tuple[list[str], list[str]]:
    """What there is in a folder of a product's files, and of what QGIS made beside them; and what else is there."""
    ours: list[str] = []
    others: list[str] = []
    for path in folder.iterdir():
        name = f"{within}{path.name}"
        if _is_folder(path) and any(file.startswith(f"{name}/") for file in files):
            inner = _parted(path, files, f"{name}/")
            ours, others = ours + inner[0], others + inner[1]
        elif _is_folder(path) or not {name, SIDE.sub("", name)} & files:
            others.append(name)
        else:
            ours.append(name)
    return ours, others


def _keep(path: Path, kept: Path) -> None:
    kept.parent.mkdir(parents=True, exist_ok=True)
    if _is_folder(path):
        shutil.copytree(path, kept, symlinks=True, copy_function=_link)
    else:
        _link(path, kept)


def _link(path: str | Path, kept: str | Path) -> None:
    try:
        os.link(path, kept, follow_symlinks=False)
    except (OSError, NotImplementedError):  # a disk or a system without them
        shutil.copy2(path, kept, follow_symlinks=False)


def _replace(target: Path, draft: Path, ours: Sequence[str], new: Sequence[str]) -> None:
    """Put files into a folder one by one, the record last, in place of those of ours; all of them, or none."""
    old = draft / ".old"
    moves = [(target / name, old / name) for name in sorted(ours, key=lambda name: name != paths.RUN)]
    moves += [(draft / name, target / name) for name in sorted(new, key=lambda name: name == paths.RUN)]
    done: list[tuple[Path, Path]] = []
    try:
        for path, place in moves:
            place.parent.mkdir(parents=True, exist_ok=True)
            path.rename(place)
            done.append((path, place))
    except BaseException:
        for path, place in reversed(done):
            place.rename(path)
        raise


def _exchange(draft: Path, target: Path) -> None:
    """Put a folder in another's place, and the other in its."""
    if sys.platform == "linux":
        with suppress(AttributeError):  # a C library without it
            names = os.fsencode(draft), os.fsencode(target)
            if ctypes.CDLL(None).renameat2(AT_FDCWD, names[0], AT_FDCWD, names[1], RENAME_EXCHANGE) == 0:
                return
    old = paths.draft(draft.with_name(target.name))
    target.rename(old)
    try:
        draft.rename(target)
    except OSError:
        old.rename(target)
        raise
    old.rename(draft)
