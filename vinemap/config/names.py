"""Names of parcels and surveys, which name files too."""

from __future__ import annotations

import re
import unicodedata
from typing import Annotated

from pydantic import AfterValidator

from vinemap.config.yaml_files import checked_by
from vinemap.errors import ConfigError
from vinemap.paths import LONGEST_NAME, MOST_BYTES

FORBIDDEN = re.compile(r'[/\\:*?"<>|!\x00-\x1f\x7f-\x9f\u2028\u2029\ud800-\udfff]|%[0-9a-fA-F]{2}')
"""What a name of a file can't have on one system or another; pyogrio cuts it at "!", QGIS takes %20 for a space."""
DEVICES = re.compile(r"(con|prn|aux|nul|com\d|lpt\d)(\..*)?", re.IGNORECASE)
"""Names that Windows keeps for itself."""


def check_name(name: str) -> str:
    """Return the name of a parcel or survey, its Unicode composed, if it can be the name of a file.

    Raises
    ------
    ConfigError
        If it is empty, too long, or has characters of paths.
    """
    name = unicodedata.normalize("NFC", name)
    if (
        not 0 < len(name) <= LONGEST_NAME
        or FORBIDDEN.search(name)
        or DEVICES.fullmatch(name)
        or name[0] in ".- "
        or name[-1] in ". "
        or len(name.encode()) > MOST_BYTES
    ):
        raise ConfigError(f"name {name!r} can't name a file: use letters, digits, spaces, '-' and '_', a letter first")
    return name


Name = Annotated[str, AfterValidator(lambda name: unicodedata.normalize("NFC", name)), checked_by(check_name)]
