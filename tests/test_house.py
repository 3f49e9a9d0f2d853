"""The house's own rules: who imports whom, names, what starts quickly, what is pinned."""

import ast
import json
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
MODULES = sorted([*ROOT.glob("vinemap/**/*.py"), *ROOT.glob("flows/**/*.py")])

BASE = {"errors", "crs", "compiled", "machine"}
DATA = {
    "cloud",
    "raster",
    "vector",
    "mesh",
    "row_frame",
    "zones",
    "bins",
    "las",
    "las_end",
    "pieces",
    "tiles",
    "pdal_engine",
    "camera",
    "poses",
    "correlation",
}
STAGES = {
    "ground",
    "cover",
    "row_field",
    "key_points",
    "clustering",
    "curves",
    "row_fit",
    "row_table",
    "blocks",
    "confidence",
    "missing",
}
STAGES |= {"sections", "canopy", "cgon", "section_table", "classification", "odometry"}
BESIDE = {"evaluate", "synthetic", "scenes"}
GUIDANCE = {"agopengps", "geojson", "isoxml", "nav2", "opennav_coverage", "shapefile"}
SETTINGS = {"settings", "config", "paths"}
CHAIN = BASE | DATA | STAGES | BESIDE | SETTINGS
# What each module of vinemap, and any flow, may import of vinemap. Its version is everyone's.
MAY_IMPORT = {
    "__init__": set(),
    "errors": set(),
    "compiled": {"machine"},
    "machine": set(),
    "crs": {"errors"},
    "symbology": set(),
    "style": {"symbology"},
    "print_layout": {"symbology"},
    "project": BASE | {"style", "symbology", "print_layout", "raster"},
    "json_values": set(),
    "tables": set(),
    "processes": {"errors"},
    **dict.fromkeys(DATA, BASE | DATA | {"style", "json_values"}),
    "camera": {"settings"},
    **dict.fromkeys(STAGES, BASE | DATA),
    **dict.fromkeys(BESIDE, BASE | {"vector", "cloud"}),
    "scenes": BASE | {"synthetic"},
    "virtual_camera": {"errors", "camera", "poses"},
    "virtual_drive": {"cli", "paths", "poses", "virtual_camera"},
    "virtual_steps": {"camera", "poses", "virtual_camera"},
    "odometry_trials": {"camera", "frames", "poses", "odometry", "track", "virtual_camera", "virtual_steps"},
    "odometry_tables": {"odometry", "odometry_trials"},
    "odometry_plots": {"odometry_trials", "odometry_tables"},
    "odometry_accuracy": {
        "virtual_camera",
        "virtual_steps",
        "odometry_trials",
        "odometry_tables",
        "odometry_plots",
        "tables",
        "cli",
    },
    "settings": set(),
    "config": BASE | {"camera", "settings", "paths"},
    "template": {"camera", "settings", "config"},
    "frames": {"errors", "camera"},
    "track": {"camera", "frames", "odometry", "poses"},
    "track_table": {"crs", "errors", "poses", "track"},
    "drive": BASE | {"camera", "evaluate", "frames", "odometry", "poses", "track", "track_table", "vector"},
    "paths": set(),
    "store": {"errors", "paths"},
    "recipe": CHAIN,
    "notices": CHAIN,
    "geoid": {"crs"},
    "globe": {"crs", "geoid", "mesh"},
    "mesh_files": {"crs", "errors", "mesh"},
    "product": CHAIN | {"project", "style", "globe"},
    "neighbours": {"row_frame"},
    "lanes": {"neighbours", "row_frame"},
    "export": set(),
    "export.field": BASE | {"paths", "lanes"},
    **{f"export.{name}": {"errors", "paths", "lanes", "export.field"} for name in GUIDANCE},
    "export.meshes": {"crs", "mesh", "mesh_files", "paths", "export.field"},
    "export.gazebo": {"crs", "errors", "mesh", "mesh_files", "paths", "export.field", "export.meshes"},
    "export.write": {"errors", "paths", "store", "export"}
    | {f"export.{name}" for name in (*GUIDANCE, "field", "meshes", "gazebo")},
    "page": {"paths", "json_values"},
    "report": {"page", "raster"},
    "changes": {"evaluate"},
    "index": BASE | {"paths", "store", "page", "changes"},
    "stac": CHAIN | {"store"},
    "parcel": CHAIN | {"product", "recipe", "notices", "report", "store", "stac"},
    "workers": BASE,
    "dask_engine": BASE | {"workers"},
    "plan": CHAIN | {"parcel", "recipe", "store"},
    "survey": CHAIN | {"globe", "index", "parcel", "plan", "recipe", "stac", "store", "workers", "dask_engine"},
    "estate": CHAIN,
    "canopy_accuracy": CHAIN | {"parcel"},
    "accuracy": CHAIN | {"parcel", "canopy_accuracy", "tables"},
    "bench_jobs": CHAIN | {"parcel"},
    "bench": {"errors", "paths", "tables", "processes", "cli"},
    "tune": CHAIN | {"parcel", "cli"},
    "picture": {"paths", "style", "mesh_files"},
    "cli": CHAIN | {"drive", "parcel", "plan", "survey", "template", "export", "export.write"},
    "__main__": {"cli"},
    "flows": CHAIN | {"drive", "parcel", "recipe", "plan", "survey", "estate", "processes", "cli", "flows"},
}


def imports(source, package):
    """Return the dotted names that a module imports anywhere in it, for type checking as well."""
    names = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            origin = ".".join(filter(None, [package if node.level else "", node.module]))
            names |= {f"{origin}.{alias.name}" for alias in node.names}
    return names


def name_of(path):
    """What a module goes by in the rule: its own name, after that of its package inside of vinemap ("export.nav2")."""
    _, *rooms, _ = path.relative_to(ROOT).parts
    return ".".join(rooms if rooms and path.stem == "__init__" else [*rooms, path.stem])


def breaches(source, package, module):
    """Return what a module imports against the rule; a module is what its name or its flow's package stands for."""
    me = "flows" if package == "flows" else module
    if me not in MAY_IMPORT:
        return [f"{module}: give it a place in tests/test_house.py"]
    wrong = []
    for name in sorted(imports(source, package)):
        top, _, rest = name.partition(".")
        if top == "flows":
            other = "flows"
        elif top == "vinemap":
            room, *doors = rest.split(".")
            other = ".".join([room, *doors[:1]])
            other = other if other in MAY_IMPORT else room
        else:
            other = top if top == "prefect" else ""
        ours = other in MAY_IMPORT or other == "prefect"
        if ours and other != me and other not in MAY_IMPORT[me] | ({"prefect"} if me == "flows" else set()):
            wrong.append(f"{module} imports {other}")
    return wrong


@pytest.mark.parametrize("path", MODULES, ids=lambda path: str(path.relative_to(ROOT)))
def test_imports_go_one_way(path):
    assert breaches(path.read_text(encoding="utf-8"), path.relative_to(ROOT).parts[0], name_of(path)) == []


@pytest.mark.parametrize(
    ("source", "module", "wrong"),
    [
        ("import numpy\nfrom vinemap.errors import InputError\nfrom vinemap import __version__", "ground", []),
        ("from vinemap.cloud.points import PointCloud", "evaluate", []),
        ("from vinemap.rows.key_points import find", "curves", ["key_points"]),
        ("from vinemap import curves, raster", "key_points", ["curves"]),
        ("import vinemap.parcel", "ground", ["parcel"]),
        ("from . import cloud", "errors", ["cloud"]),
        ("from .vector import write", "crs", ["vector"]),
        ("if TYPE_CHECKING:\n    from vinemap.rows.field import RowField", "mesh", ["row_field"]),
        ("def f():\n    from vinemap.config.surveys import Config", "curves", ["config"]),
        ("from vinemap.config.surveys import Config\nfrom vinemap import paths", "parcel", []),
        ("from vinemap.parcel import follow", "config", ["parcel"]),
        ("from vinemap.geo.raster import Raster", "synthetic", ["raster"]),
        ("from vinemap.simulate.scenes import rows_of", "synthetic", ["scenes"]),
        ("from vinemap.simulate.survey import simulate", "scenes", []),
        ("from prefect import task", "parcel", ["prefect"]),
        ("import prefect.futures", "cli", ["prefect"]),
        ("from flows.parcel import map_parcel", "cli", ["flows"]),
        ("from vinemap.cli.main import main", "parcel", ["cli"]),
        ("from vinemap.export.nav2 import write_nav2", "export.write", []),
        ("from vinemap.export.nav2 import write_nav2", "export.isoxml", ["export.nav2"]),
        ("from vinemap.export import nav2", "lanes", ["export.nav2"]),
        ("from vinemap.product.store import product", "export.nav2", ["store"]),
    ],
)
def test_the_rule_sees_a_breach(source, module, wrong):
    assert breaches(source, "vinemap", module) == [f"{module} imports {other}" for other in wrong]


def test_flows_are_the_only_place_for_prefect():
    assert breaches("from prefect import flow\nfrom vinemap.parcel import map_parcel", "flows", "parcel") == []


def test_a_new_module_needs_a_place():
    assert "give it a place" in breaches("", "vinemap", "gadgets")[0]


def test_every_room_has_a_purpose_in_its_name():
    assert [path for path in MODULES if re.fullmatch(r"_*(utils?|helpers?|misc|common)", path.stem)] == []


def test_the_command_line_starts_without_heavy_libraries():
    code = "import json, sys, vinemap.cli.main; print(json.dumps(sorted(sys.modules)))"
    run = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    assert {"prefect", "open3d", "geopandas", "rasterio"} & set(json.loads(run.stdout)) == set()


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
    pinned = {key(line.split("==")[0]) for line in constraints()}
    assert {key(re.match(r"[\w.-]+", need)[0]) for need in needed} - pinned == set()


def test_constraints_hold_the_set_with_which_prefect_runs():
    versions = {key(name): version for name, version in (line.split("==") for line in constraints())}
    release = {name: tuple(map(int, versions[name].split(".")[:2])) for name in ("prefect", "fastapi", "sqlalchemy")}
    assert (3, 8) <= release["prefect"] < (4, 0)
    assert release["fastapi"] < (0, 151)
    assert release["sqlalchemy"] < (2, 1)
