"""What files, and addresses on web servers, can be called on any system, and how that is shown."""

from __future__ import annotations

import os
import re
import unicodedata
from pathlib import Path, PurePath, PurePosixPath

from vinemap.errors import InputError

LONGEST_NAME = 64
MOST_BYTES = 160
"""Bytes of a name, so that what is added to it for files stays below the 255 of most disks."""
FORBIDDEN = re.compile(r'[/\\:*?"<>|!;\x00-\x1f\x7f-\x9f\u2028\u2029\ud800-\udfff]|%(?=[0-9a-fA-F]{2})')
"""What a name of a file can't have on one system or another; pyogrio cuts it, QGIS takes %20 for a space."""
CUT = re.compile(r"!|;(?=[^/\\]*$)")
"""Where pyogrio cuts a path: as that of an archive (its issue 632), or as an address with parameters."""
DEVICES = re.compile(r"(con(in\$|out\$)?|prn|aux|nul|(com|lpt)[\d¹²³]) *(\..*)?", re.IGNORECASE)
"""Names that Windows keeps for itself."""


def safe(name: str) -> str:
    """A name as a file can have it on any system: the name itself, if it can."""
    plain = _cut(FORBIDDEN.sub("-", name).lstrip(".- "))
    return f"_{plain}" if not plain or DEVICES.fullmatch(plain) else plain


def _cut(name: str) -> str:
    """A name no longer than one may be, and without the end that Windows would leave out."""
    return name[:LONGEST_NAME].encode()[:MOST_BYTES].decode(errors="ignore").rstrip(". ")


def composed(name: str) -> str:
    """A name with its Unicode composed and its spaces single: the same, however it was typed."""
    return " ".join(unicodedata.normalize("NFC", name).split())


def plain(name: str) -> str:
    """A name without what makes trouble in names of files and on command lines."""
    return _cut(re.sub(r"^[. -]+|[. ]+$|[^\w .()+#&-]", "", name)) or "cloud"


def uncut(path: Path) -> Path:
    """A file's path, if pyogrio takes it as it is.

    Raises
    ------
    InputError
        If it would take a part of it for the whole.
    """
    if cut := CUT.search(str(path)):
        raise InputError(f"{shown(path)}: has a {cut[0]!r} in its path, at which it would be cut: rename that")
    return path


def url_of(cloud: Path) -> str | None:
    """Address of a cloud on a web server, of which a path has one slash less; None of a file."""
    return str(Address(cloud.as_posix())) if cloud.parts[:1] in (("http:",), ("https:",)) else None


class Address(PurePosixPath):
    """A path of a file on a web server, as people know it."""

    def __str__(self) -> str:
        """Address of the file."""
        scheme, _, rest = super().__str__().partition(":/")
        return f"{scheme}://{rest.lstrip('/')}"


def named(cloud: Path) -> PurePath:
    """A cloud's path as a sentence has it: of one on a web server its address."""
    return Address(cloud.as_posix()) if url_of(cloud) else cloud


def shown(path: Path | str) -> str:
    """A path as it can be printed and stored, even if its name isn't Unicode."""
    return os.fsencode(path).decode(errors="replace")
