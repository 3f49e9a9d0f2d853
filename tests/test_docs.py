"""The documentation says what is so: its links, commands, columns and defaults."""

import ast
import re
import shutil
from pathlib import Path

import pytest
from messages import messages, said

from vinemap.cli.main import commands
from vinemap.config.drives import load_camera, load_drives
from vinemap.config.template import template
from vinemap.odometry.layers import TRACK_LAYERS
from vinemap.product.layers import LAYERS
from vinemap.simulate.survey import write_survey

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]


def text(name):
    return (ROOT / "docs" / name).read_text(encoding="utf-8")


def headings(page):
    """Names by which links may call the headings of a page."""
    titles = re.findall(r"^#+ (.*)$", page.read_text(encoding="utf-8"), re.MULTILINE)
    return {re.sub(r"[^\w -]", "", title.lower()).replace(" ", "-") for title in titles}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_links_lead_somewhere(page):
    links = re.findall(r"\]\(([^)#\s]*)(?:#([^)]*))?\)", page.read_text(encoding="utf-8"))
    within = [(page.parent / link if link else page, heading) for link, heading in links if ":" not in link]
    assert [path for path, _ in within if not path.exists()] == []
    assert [(path.name, heading) for path, heading in within if heading and heading not in headings(path)] == []


def test_every_page_is_reached_from_the_readme():
    readme = PAGES[0].read_text(encoding="utf-8")
    assert [page.name for page in PAGES[1:] if f"docs/{page.name}" not in readme] == []


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_commands_exist(page):
    written = page.read_text(encoding="utf-8")
    code = "\n".join(re.findall(r"```sh\n(.*?)```", written, re.DOTALL) + re.findall(r"`([^`\n]+)`", written))
    verbs = set(re.findall(r"^([a-z-]+):.*##", (ROOT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE))
    assert set(re.findall(r"^make ([a-z-]+)", code, re.MULTILINE)) <= verbs
    for name, line in re.findall(r"^(?:\.venv/bin/)?vinemap ([a-z][a-z-]*)(.*)", code, re.MULTILINE):
        assert name in commands.commands
        options = {flag for option in commands.commands[name].params for flag in option.opts}
        assert set(re.findall(r"--[a-z-]+", line.split("#")[0])) <= options


@pytest.mark.parametrize(
    ("page", "layer"), [*(("products.md", name) for name in LAYERS), *(("track.md", name) for name in TRACK_LAYERS)]
)
def test_every_column_is_described(page, layer):
    section = re.search(rf"### Layer `{layer}`.*?(?=\n##|\Z)", text(page), re.DOTALL)[0]
    firsts = [line.split("|")[1] for line in section.splitlines() if line.startswith("|")]
    assert set(re.findall(r"`(\w+)`", " ".join(firsts))) == set((LAYERS | TRACK_LAYERS)[layer].columns)


def test_the_camera_of_the_docs_is_one(tmp_path):
    found = re.findall(r"```yaml\n(.*?)```", text("track.md"), re.DOTALL)
    for name, body in zip(("camera.yaml", "drives.yaml"), found, strict=True):
        (tmp_path / name).write_text(body)
    assert load_camera(tmp_path / "camera.yaml").turned_deg == -90
    assert list(load_drives(tmp_path / "drives.yaml").drives) == ["monday", "tuesday"]


def test_every_key_is_described():
    assert f"```yaml\n{template('survey')}```" in text("configuration.md"), "vinemap config survey has changed"


def test_every_message_is_explained():
    """With … where a value stands; what the page tells of, the software says."""
    cells = [line.split(" | ") for line in text("messages.md").splitlines() if line.startswith("| `")]
    listed = [message for cell, *_ in cells for message in re.findall(r"`([^`]+)`", cell)]
    assert {message: file for message, file in messages().items() if message not in listed} == {}
    assert sorted(set(listed) - set(messages())) == []
    assert [cell for cell in cells if len(cell) != 3 or not all(part.strip(" |") for part in cell)] == []


@pytest.mark.parametrize(
    ("source", "found"),
    [
        ('raise InputError(f"{path}: holds {n} things")', ["…: holds … things"]),
        ('raise OutsideError("nothing " "there")', ["nothing there"]),
        ('remarks.append(f"{name} is left out")\nnames.append("no remark")', ["… is left out"]),
        ('raise Flaw("ends too early")\nx = "as high as {height_m:.0f} m"', ["ends too early", "as high as … m"]),
        ('raise InputError(reason)\nx = "five words are a remark"', ["five words are a remark"]),
        ('"""A docstring of five words."""\nx = "no remark"\ny = f"{a}: {b}"', []),
    ],
)
def test_messages_are_found_in_a_source(source, found):
    assert list(said(source, sentences=True)) == found


def test_every_room_is_on_the_map():
    section = re.search(r"## The house\n.*?\n## ", text("method.md"), re.DOTALL)[0]
    there = {path.name for path in (ROOT / "vinemap").iterdir() if (path / "__init__.py").is_file()}
    assert there <= set(re.findall(r"`(\w+)`", section))


def test_files_that_tasks_open_exist():
    section = re.search(r"\| to … \| open \|\n.*?\n\n", text("method.md"), re.DOTALL)[0]
    files = re.findall(r"`((?:\w+/)*\w+\.(?:py|js))`", section)
    assert len(files) > 15
    assert [file for file in files if not (ROOT / "vinemap" / file).is_file()] == []


def test_the_library_in_twenty_lines(tmp_path, monkeypatch, vineyard):
    """What is printed on the page runs, on a small survey, and leaves a picture and a mesh."""
    (code,) = re.findall(r"```python\n(.*?)```", text("library.md"), re.DOTALL)
    assert len([line for line in code.splitlines() if line and not line.startswith(("import", "from"))]) <= 20
    survey = tmp_path / "data" / "surveys" / "barolo"
    cloud = write_survey(vineyard, survey)
    shutil.move(cloud, survey / "barolo.laz")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("MPLBACKEND", "agg")
    names = {}
    exec(code.replace('parcel="curved"', 'parcel="A"'), names)
    assert len(names["rows"]) == len(vineyard.rows)
    assert (tmp_path / "rows.png").read_bytes().startswith(b"\x89PNG")
    assert (tmp_path / "canopies.glb").read_bytes().startswith(b"glTF")


SOURCES = sorted(path for path in (ROOT / "vinemap").rglob("*.py") if "node_modules" not in path.parts)


def defined(path):
    """Names that a module defines at its top, and those within its classes."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    named = [node for node in ast.walk(tree) if isinstance(node, ast.ClassDef | ast.FunctionDef)]
    assigned = [name.id for node in tree.body for name in ast.walk(node) if isinstance(name, ast.Name)]
    return {node.name for node in named} | set(assigned)


def resolves(target):
    """Whether a dotted name is a module, or one that a module defines."""
    here, words = ROOT, target.split(".")
    while words and (here / words[0]).is_dir():
        here = here / words.pop(0)
    here = here / f"{words.pop(0)}.py" if words and (here / f"{words[0]}.py").is_file() else here / "__init__.py"
    return here.is_file() and (not words or words[0] in defined(here))


@pytest.mark.parametrize("path", SOURCES, ids=lambda path: str(path.relative_to(ROOT)))
def test_references_lead_somewhere(path):
    own = defined(path)
    targets = re.findall(r":(?:func|class|data|meth|mod):`([\w.]+)`", path.read_text(encoding="utf-8"))
    wrong = [t for t in targets if not (resolves(t) if t.startswith("vinemap.") else t.rpartition(".")[2] in own)]
    assert wrong == []


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_files_that_pages_name_exist(page):
    named = re.findall(r"`((?:vinemap|tests|flows|configs)/[\w./-]+)`", page.read_text(encoding="utf-8"))
    assert [name for name in named if not (ROOT / name).exists()] == []
