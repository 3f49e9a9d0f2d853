"""Names of parcels and surveys: those of surveys name folders, those of parcels may be any."""

from __future__ import annotations

import unicodedata
from typing import Annotated

from pydantic import AfterValidator

from vinemap.config.yaml_files import checked_by
from vinemap.errors import ConfigError
from vinemap.naming import composed, safe


def check_name(name: str) -> str:
    """Return the name of a survey, its Unicode composed, if it can be the name of a file.

    Raises
    ------
    ConfigError
        If it is empty, too long, or has characters of paths.
    """
    name = unicodedata.normalize("NFC", name)
    if safe(name) != name:
        raise ConfigError(f"name {name!r} can't name a file: use letters, digits, spaces, '-' and '_', a letter first")
    return name


def check_parcel(name: str) -> str:
    """Return the name of a parcel, its Unicode composed and its spaces single.

    Its files are named by what :func:`vinemap.naming.safe` makes of it ("123/4" lies in the folder "123-4").

    Raises
    ------
    ConfigError
        If it is empty, a way to another folder, or no text.
    """
    plain = composed(name)
    if not plain.strip(". ") or {".", ".."} & set(plain.replace("\\", "/").split("/")) or not plain.isprintable():
        raise ConfigError(f"name {name!r} can't name a file, nor a parcel: use letters and digits")
    return plain


Name = Annotated[str, checked_by(check_name), AfterValidator(check_name)]
ParcelName = Annotated[str, checked_by(check_parcel), AfterValidator(check_parcel)]
