"""What the software says to people, collected from its source: refusals, and texts of the files that write remarks."""

import ast
import re
from pathlib import Path

from vinemap import errors

PACKAGE = Path(errors.__file__).parent
DEVELOPERS = {"measure", "simulate"}
"""Rooms whose messages are for those who work on the software."""
REMARKS = {
    "cloud/formats/surface.py",
    "cloud/las_end.py",
    "errors.py",
    "evaluate/trunks.py",
    "geo/boundaries.py",
    "geo/lines.py",
    "geo/place.py",
    "jobs/estate.py",
    "jobs/outcomes.py",
    "jobs/plan.py",
    "jobs/register.py",
    "product/notices.py",
    "product/pages/parcel.py",
    "product/recipe.py",
    "product/record.py",
    "product/register/edits.py",
    "product/store.py",
    "product/write.py",
    "rows/curtains.py",
    "rows/known.py",
    "surfaces/lines.py",
}
"""Files whose sentences are remarks, reasons and warnings."""
WORDS = 4
"""Words that a sentence has at the least."""
REFUSALS = {name for name, kind in vars(errors).items() if isinstance(kind, type) and issubclass(kind, Exception)}
REFUSALS |= {"NoAreaError", "Flaw"}


def messages():
    """All messages, with … where a value stands, and the file of each."""
    found = {}
    for path in sorted([*PACKAGE.rglob("*.py"), *(PACKAGE.parent / "flows").glob("*.py")]):
        name = path.relative_to(PACKAGE).as_posix() if path.is_relative_to(PACKAGE) else f"flows/{path.name}"
        if name.partition("/")[0] not in DEVELOPERS and "node_modules" not in path.parts:
            found |= dict.fromkeys(said(path.read_text(encoding="utf-8"), sentences=name in REMARKS), name)
    return found


def _name(function):
    return getattr(function, "id", None)


def _adds_a_remark(function):
    return isinstance(function, ast.Attribute) and function.attr == "append" and _name(function.value) == "remarks"


def said(source, *, sentences=False):
    """Messages of the errors that a module makes, and all sentences in it where these are messages, too."""
    tree = ast.parse(source)
    other = {id(node.value) for node in ast.walk(tree) if isinstance(node, ast.Expr)}
    other |= {id(part) for node in ast.walk(tree) if isinstance(node, ast.JoinedStr) for part in node.values}
    for node in ast.walk(tree):
        if isinstance(node, ast.Call) and node.args and (_name(node.func) in REFUSALS or _adds_a_remark(node.func)):
            text = plain(node.args[0])
        elif sentences and id(node) not in other and len(re.findall(r"(?<!\S)[\w'(]+", plain(node))) >= WORDS:
            text = plain(node)
        else:
            continue
        if re.search(r"\w", text):
            yield text


def plain(node):
    """A text, or a text with values in it, in words."""
    if not isinstance(node, ast.JoinedStr | ast.Constant):
        return ""
    parts = node.values if isinstance(node, ast.JoinedStr) else [node]
    words = [part.value if isinstance(getattr(part, "value", None), str) else "…" for part in parts]
    named = re.sub(r"\{[a-z_]+:[^{}]*\}", "…", "".join(words))
    return re.sub(r"…+", "…", " ".join(named.split()))
