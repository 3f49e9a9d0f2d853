"""Pages that need nothing but themselves: one HTML file that holds its data, scripts and style, and asks no network."""

from __future__ import annotations

import base64
import hashlib
import html
import json
import zlib
from functools import cache
from string import Template
from typing import TYPE_CHECKING, Any

import numpy as np
import shapely

from vinemap import paths
from vinemap.product.json_values import jsonable

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from pathlib import Path

    from numpy.typing import ArrayLike

LEVEL = 4
"""Of compression."""


def page(
    name: str,
    title: str,
    data: Mapping[str, Any],
    *,
    packed: Mapping[str, bytes],
    scripts: Sequence[str] = (),
    key: str = "",
) -> str:
    """A page as one HTML file.

    Its policy forbids the browser to load anything, and to run any script but those that were bundled with it.

    Parameters
    ----------
    name : str
        Template, style and first script: ``report`` or ``index``.
    title : str
        Of the page; as all words of the data, any text.
    data : mapping
        What the script shows, as JSON.
    packed : mapping of str to bytes
        What it unpacks later, by name.
    scripts : sequence of str
        Further scripts, which the first starts when they are needed.
    key : str
        Tells what the page was made of, see :func:`page_hash`.

    References
    ----------
    https://www.w3.org/TR/CSP3/
    """
    parts = [_part(paths.page_script(script)) for script in (name, *scripts)]
    style = _part(paths.PAGE_STYLE)
    policy = (
        f"default-src 'none'; script-src {' '.join(_hash(part) for part in parts)}; style-src {_hash(style)}; "
        "img-src data:; base-uri 'none'; form-action 'none'"
    )
    later = [
        f'<script type="text/plain" id="{one}-js">{part}</script>' for one, part in zip(scripts, parts[1:], strict=True)
    ]
    blocks = [_block(name, value) for name, value in packed.items()]
    licences = f'<script type="text/plain" id="licences">\n{_part(paths.PAGE_LICENCES)}\n</script>'
    return Template(_part(paths.page_template(name))).substitute(
        policy=policy,
        key=html.escape(key),
        title=html.escape(title),
        style=style,
        data=_embedded(data),
        blocks="\n".join([*blocks, *later, licences]),
        script=parts[0],
    )


def _block(name: str, data: bytes) -> str:
    return f"{_opening(name)}{_pack(data)}</script>"


def _opening(name: str) -> str:
    return f'<script type="text/plain" id="{name}">'


def unpacked(page: str, name: str) -> Any:
    """What a page holds packed by a name, as JSON; None if it has nothing of that name, or nothing that can be read."""
    found = page.partition(_opening(name))[2].partition("</script>")[0]
    try:
        return json.loads(zlib.decompress(base64.b64decode(found)))
    except (ValueError, zlib.error):
        return None


def repacked(page: str, name: str, data: bytes) -> str:
    """A page with other data packed by a name; as it was if it has nothing of that name."""
    before, opening, rest = page.partition(_opening(name))
    return before + _block(name, data) + rest.partition("</script>")[2] if opening else page


def page_hash(name: str) -> str:
    """Changes when a page's template, script or style does."""
    parts = paths.page_template(name), paths.page_script(name), paths.PAGE_STYLE
    return hashlib.sha256("".join(map(_part, parts)).encode()).hexdigest()


@cache
def _part(path: Path) -> str:
    return path.read_text(encoding="utf-8").strip("\n")


@cache
def _hash(part: str) -> str:
    digest = hashlib.sha256(part.encode()).digest()
    return f"'sha256-{base64.b64encode(digest).decode()}'"


def _embedded(data: Mapping[str, Any]) -> str:
    """JSON, ASCII alone, that can't end the element it stands in."""
    return as_json(data).replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")


def _pack(data: bytes) -> str:
    return base64.b64encode(zlib.compress(data, LEVEL)).decode()


def as_json(data: Any) -> str:
    """Data as JSON, in which what isn't finite is null."""
    return json.dumps(jsonable(data), allow_nan=False, separators=(",", ":"))


def mean_of(values: ArrayLike, weights: ArrayLike) -> float:
    """Weighted mean of the values (n,) that are finite; NaN if none is."""
    values, weights = np.asarray(values, dtype=float), np.asarray(weights, dtype=float)
    known = np.isfinite(values)
    return float(np.average(values[known], weights=weights[known])) if known.any() else np.nan


def whole_numbers(values: ArrayLike, *, unit: float) -> list[Any]:
    """Values, of any shape, in whole units, 0.01 for centimetres; None for what isn't finite."""
    counts = np.asarray(values, dtype=float) / unit
    known = np.isfinite(counts)
    whole = np.full(counts.shape, None, dtype=object)
    whole[known] = np.rint(counts[known]).astype(np.int64)
    out: list[Any] = whole.tolist()
    return out


def polylines(lines: ArrayLike, zero: ArrayLike, *, tolerance: float, digits: int = 2) -> list[list[list[float]]]:
    """Points of lines or rings in plan, about a point, without those that lie within ``tolerance`` of the others."""
    simple = shapely.simplify(shapely.force_2d(np.asarray(lines, dtype=object)), tolerance)
    return [np.round(shapely.get_coordinates(line) - np.asarray(zero), digits).tolist() for line in simple]


def rings(polygon: shapely.Geometry, zero: ArrayLike, *, tolerance: float, digits: int = 2) -> list[list[list[float]]]:
    """Rings of a polygon or several, outer and inner, as :func:`polylines`."""
    return polylines(shapely.get_rings(shapely.get_parts(polygon)), zero, tolerance=tolerance, digits=digits)
