"""The house's own rules: its rooms and their order, names, what starts quickly, what is pinned."""

import ast
import graphlib
import json
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
import yaml

ROOT = Path(__file__).parents[1]
ROOMS = [
    "errors",
    "naming",
    "paths",
    "compute",
    "geo",
    "config",
    "cloud",
    "surfaces",
    "rows",
    "canopy",
    "evaluate",
    "product",
    "odometry",
    "export",
    "view",
    "stages",
    "chain",
    "making",
    "parcel",
    "warm",
    "jobs",
    "plugin",
    "terminal",
    "simulate",
    "example",
    "flows",
    "cli",
    "__main__",
    "measure",
]
"""From the ground up: a module may import its own room and those above it in this list, never those below."""
STAGES = {
    "surfaces": {"ground", "canopy_height", "cover"},
    "rows": {"field", "key_points", "clusters", "curves", "known", "fit", "blocks", "numbers"},
    "canopy": {"sections", "foliage", "feet", "growth", "cgon", "numbers", "mesh", "classification"},
}
"""Steps of the chain: what two of them need lies in a file of its own."""
ONLY_IN = {"prefect": "flows", "distributed": "jobs", "dask": "jobs", "pdal": "cloud"}
ONLY_IN |= {"qgis": "plugin", "processing": "plugin"}
"""Libraries that one room alone imports."""
NAMERS = {"paths", "simulate", "measure"}
"""Rooms that write names of files: `paths`, and tools of development."""
MOST_LINES, MOST_FILES = 350, 12
FILE = re.compile(
    r"[\w{}.-]*\.(csv|geojson|glb|gpkg|html|json|las|laz|obj|ply|png|qgs|qgz|qml|sdf|shp|tif|xml|xyz|yaml)"
)


def modules():
    """Dotted names of all modules, with their files."""
    found = {}
    for path in sorted([*ROOT.glob("vinemap/**/*.py"), *ROOT.glob("flows/**/*.py")]):
        if "node_modules" not in path.parts:
            parts = path.relative_to(ROOT).with_suffix("").parts
            found[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = path
    return found


MODULES = modules()


def room_of(name):
    """Room of a dotted name of ours; None of others', and of the door, ``vinemap`` itself."""
    top, _, rest = name.partition(".")
    if top == "flows":
        return "flows"
    return rest.partition(".")[0] or None if top == "vinemap" else None


def imports(source, package=""):
    """Dotted names that a module imports anywhere in it, for type checking as well; of a module its own name alone."""
    names = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            origin = ".".join(filter(None, [package if node.level else "", node.module]))
            names |= {f"{origin}.{alias.name}" for alias in node.names}
    return {
        name if name in MODULES or name.rpartition(".")[0] not in MODULES else name.rpartition(".")[0] for name in names
    }


def breaches(source, name):
    """What a module imports against the rules."""
    mine, wrong = room_of(name), []
    for other in sorted(imports(source, name.rpartition(".")[0]) - {name, "vinemap", "vinemap.__version__"}):
        room, stage = room_of(other), other.rpartition(".")[2]
        below = room is not None and (room not in ROOMS or ROOMS.index(room) > ROOMS.index(mine))
        aside = room == mine and {stage, name.rpartition(".")[2]} <= STAGES.get(mine, set())
        elsewhere = mine != ONLY_IN.get(other.partition(".")[0], mine)
        if below or aside or elsewhere:
            wrong.append(f"{name} imports {other}")
    return wrong


def test_every_room_has_its_place_in_the_order():
    assert {room_of(name) for name in MODULES} - {None} == set(ROOMS)
    assert set(STAGES) <= set(ROOMS)
    assert {f"vinemap.{room}.{stage}" for room, stages in STAGES.items() for stage in stages} <= set(MODULES)


@pytest.mark.parametrize("name", MODULES)
def test_imports_go_one_way(name):
    if name != "vinemap":  # the door offers what lies in all rooms
        assert breaches(MODULES[name].read_text(encoding="utf-8"), name) == []


@pytest.mark.parametrize(
    ("source", "name", "wrong"),
    [
        ("import numpy\nfrom vinemap.errors import InputError\nfrom vinemap import __version__", "rows.field", []),
        ("from vinemap.cloud.points import PointCloud", "evaluate.rows", []),
        ("from vinemap.canopy.hull import cross", "canopy.cgon", []),
        ("from vinemap.rows.key_points import find", "rows.curves", ["vinemap.rows.key_points"]),
        ("from vinemap.rows import curves, centre_line", "rows.key_points", ["vinemap.rows.curves"]),
        ("import vinemap.parcel", "surfaces.ground", ["vinemap.parcel"]),
        ("from . import cloud", "errors", ["vinemap.cloud"]),
        ("from ..product import store", "geo.crs", ["vinemap.product.store"]),
        ("if TYPE_CHECKING:\n    from vinemap.rows.field import x", "geo.raster", ["vinemap.rows.field"]),
        ("def f():\n    from vinemap.product.recipe import Recipe", "config.surveys", ["vinemap.product.recipe"]),
        ("from vinemap.config.surveys import x\nfrom vinemap import paths", "parcel", []),
        ("from vinemap.nowhere import x", "measure.tune", ["vinemap.nowhere.x"]),
        ("from prefect import task", "parcel", ["prefect.task"]),
        ("import prefect.futures", "cli.run", ["prefect.futures"]),
        ("from dask import delayed", "parcel", ["dask.delayed"]),
        ("from flows.parcel import as_tasks", "jobs.survey", ["flows.parcel"]),
        ("from vinemap.cli.main import main", "parcel", ["vinemap.cli.main"]),
        ("from vinemap.export.nav2 import write_nav2", "export.write", []),
    ],
)
def test_the_rule_sees_a_breach(source, name, wrong):
    source = source.replace("from ..product", "from vinemap.product")
    assert breaches(source, f"vinemap.{name}") == [f"vinemap.{name} imports {other}" for other in wrong]


def test_flows_may_use_the_chain_and_prefect():
    assert breaches("from prefect import flow\nfrom vinemap.parcel import map_parcel", "flows.parcel") == []


def test_no_two_modules_need_each_other():
    graph = {
        name: imports(path.read_text(encoding="utf-8"), name.rpartition(".")[0]) & set(MODULES) - {name, "vinemap"}
        for name, path in MODULES.items()
        if name != "vinemap"
    }
    graphlib.TopologicalSorter(graph).prepare()


def names_of_files(source):
    """Texts that are the name of a file, or end as one."""
    tree = ast.parse(source)
    docs = {id(node.value) for node in ast.walk(tree) if isinstance(node, ast.Expr)}
    return [
        node.value
        for node in ast.walk(tree)
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in docs
        if FILE.fullmatch(node.value) and not node.value.startswith(("vinemap.", "."))
    ]


@pytest.mark.parametrize("name", [name for name in MODULES if room_of(name) not in NAMERS])
def test_names_of_files_are_written_in_paths(name):
    assert names_of_files(MODULES[name].read_text(encoding="utf-8")) == []


def test_the_rule_sees_a_name():
    assert names_of_files('"""a.json"""\nx = folder / "run.json"\ny = f"{name}_dtm.tif"\nz = "a sentence. json"') == [
        "run.json",
        "_dtm.tif",
    ]


def test_files_are_short():
    sources = [*MODULES.values(), *(ROOT / "tests").rglob("*.py")]
    lines = {str(path.relative_to(ROOT)): path.read_text(encoding="utf-8").count("\n") for path in sources}
    assert {path: n for path, n in lines.items() if n > MOST_LINES} == {}


def test_rooms_are_small_and_say_what_belongs_there():
    folders = {path.parent for path in MODULES.values()} - {ROOT / "vinemap"}
    crowded = {f.name: n for f in folders if (n := len({*f.glob("*.py")} - {f / "__init__.py"})) > MOST_FILES}
    assert crowded == {}
    for folder in folders:
        assert ast.get_docstring(ast.parse((folder / "__init__.py").read_text(encoding="utf-8"))), folder


def test_names_dont_repeat_their_room():
    repeated = [
        n for n in MODULES if n.count(".") > 1 and n.rpartition(".")[2].startswith(n.split(".")[-2].rstrip("s") + "_")
    ]
    assert repeated == []


def test_every_file_has_a_purpose_in_its_name():
    assert [path for path in MODULES.values() if re.fullmatch(r"_*(utils?|helpers?|misc|common)", path.stem)] == []


def test_tests_lie_in_folders_like_the_rooms():
    folders = {path.relative_to(ROOT / "tests").parts[0] for path in (ROOT / "tests").glob("*/**/test_*.py")}
    assert folders <= set(ROOMS)


def compiled_names(source):
    """Names that compiled functions of a module take from others of ours, with the modules they come from."""
    tree = ast.parse(source)
    ours = {
        alias.asname or alias.name: node.module
        for node in ast.walk(tree)
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("vinemap")
        for alias in node.names
    }
    used = {
        name.id
        for node in tree.body
        if isinstance(node, ast.FunctionDef) and any(getattr(d, "id", "") == "compiled" for d in node.decorator_list)
        for part in node.body
        for name in ast.walk(part)
        if isinstance(name, ast.Name)
    }
    return {(name, ours[name]) for name in used & set(ours)}


@pytest.mark.parametrize("name", [name for name, path in MODULES.items() if "@compiled" in path.read_text("utf-8")])
def test_compiled_functions_take_nothing_from_files_that_their_cache_ignores(name):
    """The cache is of a hash of all files with compiled functions, one folder deep."""
    assert name.count(".") == 2
    for used, module in compiled_names(MODULES[name].read_text(encoding="utf-8")):
        assert "@compiled" in MODULES[module].read_text(encoding="utf-8"), f"{name} takes {used} from {module}"


def test_the_command_line_starts_without_heavy_libraries():
    code = "import json, sys, vinemap.cli.main; print(json.dumps(sorted(sys.modules)))"
    run = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    heavy = {"prefect", "open3d", "geopandas", "rasterio", "numpy", "pydantic", "numba", "cv2"}
    assert heavy & set(json.loads(run.stdout)) == set()


def test_the_library_is_light_until_it_is_used():
    code = (
        "import json, sys, vinemap; before = sorted(sys.modules)\n"
        "assert set(vinemap.__all__) <= set(dir(vinemap))\n"
        "assert all(callable(getattr(vinemap, name)) for name in vinemap.__all__)\n"
        "print(json.dumps([before, sorted(sys.modules)]))"
    )
    run = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    before, after = map(set, json.loads(run.stdout))
    assert {name.partition(".")[0] for name in before} & {"numpy", "click", "pydantic"} == set()
    assert "vinemap.parcel" in after
    assert {"prefect", "open3d"} & after == set()


def test_a_cloud_is_read_before_what_works_on_it_is_loaded():
    code = "import json, sys, vinemap.parcel; print(json.dumps(sorted(sys.modules)))"
    run = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    assert {"geopandas", "pandas", "rasterio", "scipy.ndimage", "vinemap.chain"} & set(json.loads(run.stdout)) == set()


def test_what_the_library_does_not_offer_is_told():
    import vinemap

    with pytest.raises(AttributeError, match="no attribute 'map_row'"):
        _ = vinemap.map_row


def constraints():
    lines = (ROOT / "configs" / "constraints.txt").read_text(encoding="utf-8").splitlines()
    return [line for line in lines if line and not line.startswith("#")]


def key(name):
    return re.sub(r"[-_.]+", "-", name).lower()


def test_constraints_are_names_and_versions():
    assert [line for line in constraints() if not re.fullmatch(r"[A-Za-z0-9][\w.-]*==[0-9][A-Za-z0-9.]*", line)] == []
    names = [key(line.split("==")[0]) for line in constraints()]
    assert len(names) == len(set(names))


def test_constraints_cover_what_the_project_needs():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    needed = [
        *project["dependencies"],
        *(need for extra in project["optional-dependencies"].values() for need in extra),
    ]
    pinned = {key(line.split("==")[0]) for line in constraints()} | {"vinemap"}
    assert {key(re.match(r"[\w.-]+", need)[0]) for need in needed} - pinned == set()


def test_condas_environment_is_what_the_project_needs():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    given = yaml.safe_load((ROOT / "environment.yml").read_text(encoding="utf-8"))["dependencies"]
    given = [*(one for one in given if isinstance(one, str)), *given[-1]["pip"]]
    wanted = {need.replace("[lazrs]", "") for need in project["dependencies"]}
    assert wanted - set(given) == set()
    assert {"lazrs-python", "python-pdal>=3.4", "--editable ."} <= set(given)


def test_constraints_hold_the_set_with_which_prefect_runs():
    versions = {key(name): version for name, version in (line.split("==") for line in constraints())}
    release = {name: tuple(map(int, versions[name].split(".")[:2])) for name in ("prefect", "fastapi", "sqlalchemy")}
    assert (3, 8) <= release["prefect"] < (4, 0)
    assert release["fastapi"] < (0, 151)
    assert release["sqlalchemy"] < (2, 1)
