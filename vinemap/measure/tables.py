"""Tables of figures: as Markdown, for a terminal, and filled into a document between marks."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Sequence


def as_markdown(lines: Sequence[Sequence[str]]) -> str:
    """Lay a table out for Markdown."""
    return "\n".join("| " + " | ".join(cells) + " |" for cells in [lines[0], ["---"] * len(lines[0]), *lines[1:]])


def as_text(lines: Sequence[Sequence[str]]) -> str:
    """Lay a table out for a terminal, headings on two lines."""
    heads = [[*head.split(": ", 1), ""][:2] for head in lines[0]]
    rows = [*zip(*heads, strict=True), *lines[1:]]
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return "\n".join("  ".join(map(str.ljust, row, widths)).rstrip() for row in rows)


def fill(text: str, name: str, body: str) -> str:
    """Markdown in which what stands between ``<!-- name -->`` and ``<!-- /name -->`` is replaced."""
    before, mark, rest = text.partition(f"<!-- {name} -->")
    _, end, after = rest.partition(f"<!-- /{name} -->")
    return f"{before}{mark}\n{body}\n{end}{after}" if mark and end else text
