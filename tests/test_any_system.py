"""What is needed of a system: it runs where POSIX's modules, signals and calls aren't, and with paths as of Windows."""

import ast
import inspect
import json
import os
import subprocess
import sys
from pathlib import Path, PurePosixPath, PureWindowsPath
from types import SimpleNamespace

import geopandas as gpd
import pytest
from without_posix.posix_only import CALLS, MODULES, SIGNALS

from vinemap import paths
from vinemap.compute import machine, processes
from vinemap.config.surveys import load_survey
from vinemap.errors import OutputError, WorkerError
from vinemap.jobs import workers
from vinemap.measure.bench import watched
from vinemap.product import store
from vinemap.product.geopackage import write_layer

ROOT = Path(__file__).parents[1]
HIDING = ROOT / "tests" / "without_posix"
ASKING = ("hasattr(os", "os.name", "sys.platform", "ON_WINDOWS")
WORKS = """
import json, os, sys, warnings
from pathlib import Path
warnings.simplefilter("ignore")
from vinemap.terminal import plain_errors
from vinemap.compute import machine
from vinemap.measure.bench.watched import run_process
from vinemap.jobs.workers import Workers
from vinemap.product import store
with plain_errors():
    folder = Path(sys.argv[1])
    sys.platform = "other"  # than Linux, which exchanges folders at one stroke
    for text in ("old", "new"):
        with store.product(folder / "F", within=folder) as draft:
            (draft / "F.gpkg").write_text(text)
    with Workers(1, memory=machine.share(1)) as found:
        found.run(len, "abc", limit=60)
        try:
            found.run(os._exit, 3)
        except Exception as error:
            died = str(error)
    ended = run_process([sys.executable, "-c", "raise SystemExit('so')"])
    print("18 rows \\u2192 F")
    print(json.dumps([(folder / "F/F.gpkg").read_text(), died, ended.code, ended.peak, ended.said, machine.cores()]))
    from vinemap.errors import InputError
    raise InputError("a line\\u2192")
"""


def without_posix(code, *args, **environment):
    paths_ = os.pathsep.join([str(HIDING), str(ROOT)])
    command = [sys.executable, "-c", code, *map(str, args)]
    settings = os.environ | {"PYTHONPATH": paths_} | environment
    return subprocess.run(command, env=settings, capture_output=True, text=True, timeout=120, check=False)


def unguarded(source):
    """What of POSIX a module uses without an ``if`` that asks for it, outside of ``try`` and ``with suppress(…)``."""
    found = []

    def walk(node):
        asks = isinstance(node, (ast.If, ast.IfExp)) and any(word in ast.unparse(node.test) for word in ASKING)
        if asks or isinstance(node, (ast.Try, ast.With)):
            return
        for name in [alias.name for alias in node.names] if isinstance(node, (ast.Import, ast.ImportFrom)) else ():
            found.extend({name, getattr(node, "module", None)} & MODULES)
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name):
            whole = f"{node.value.id}.{node.attr}"
            found.extend({whole} & {f"signal.{name}" for name in [*SIGNALS, "SIGKILL"]})
            found.extend({whole} & {f"os.{name}" for name in CALLS})
        for child in ast.iter_child_nodes(node):
            walk(child)

    walk(ast.parse(source))
    return found


def test_nothing_needs_posix_alone():
    files = [*ROOT.glob("vinemap/**/*.py"), *ROOT.glob("flows/**/*.py")]
    found = {str(path.relative_to(ROOT)): unguarded(path.read_text(encoding="utf-8")) for path in files}
    assert {path: names for path, names in found.items() if names} == {}


def test_the_rule_sees_what_only_posix_has():
    assert unguarded("import fcntl\nfrom resource import setrlimit\nx = signal.SIGHUP, signal.SIGTERM") == [
        "fcntl",
        "resource",
        "signal.SIGHUP",
    ]
    assert unguarded("def f():\n    os.sysconf('SC_PAGE_SIZE')\n    with suppress(OSError):\n        os.wait4(1)") == [
        "os.sysconf"
    ]


def test_only_an_if_that_asks_for_it_guards_what_posix_has():
    assert unguarded("if x:\n    os.getuid()") == ["os.getuid"]
    assert unguarded("if hasattr(os, 'getuid'):\n    os.getuid()\nx = 1 if os.name == 'nt' else os.getuid()") == []


def test_folders_locks_and_workers_without_posix(tmp_path):
    done = without_posix(WORKS, tmp_path, PYTHONIOENCODING="cp1252")
    assert done.stderr == "vinemap: a line\\u2192\n"
    assert done.returncode == 2
    text, died, code, peak, said, cores = json.loads(done.stdout.removeprefix("18 rows ? F\n"))
    assert text == "new"
    assert died == "its process died (exit code 3)"
    assert (code, peak, said) == (1, 0, "so")
    assert cores == os.cpu_count()
    assert [path.name for path in tmp_path.iterdir()] == ["F"]


def test_only_signals_that_are_there_stop_it():
    assert {"SIGTERM"} <= {number.name for number in processes.STOPPING} <= {"SIGTERM", "SIGHUP", "SIGBREAK"}


def test_memory_where_the_system_does_not_tell(monkeypatch):
    monkeypatch.delattr(os, "sysconf", raising=False)
    monkeypatch.setattr(watched, "Path", lambda path: Path(path.replace("/proc", "/no/proc")))
    assert machine.memory() <= 8 << 30
    assert watched.resident(os.getpid()) == 0


@pytest.mark.parametrize(("code", "heals"), [(3221225477, False), (1, False), (-9, True)])
def test_a_worker_that_died_is_told_by_whatever_code(code, heals):
    error = workers.Worker()._dead(code)
    assert isinstance(error, WorkerError)
    assert error.heals == heals
    assert str(code) in str(error) or "SIGKILL" in str(error)


WINDOWS = PureWindowsPath(r"C:\Users\Zoë\Surveys 2026\may")
NAMED = {
    name: function
    for name, function in vars(paths).items()
    if inspect.isfunction(function) and next(iter(inspect.signature(function).parameters), "") in {"folder", "path"}
}


@pytest.mark.parametrize("name", [name for name in NAMED if name != "shown"])
def test_names_of_files_on_a_drive(name):
    values = {"str": "North 3", "int": 7, "float": 7.5, "Path": WINDOWS}
    found = NAMED[name](*(values[p.annotation] for p in inspect.signature(NAMED[name]).parameters.values()))
    assert isinstance(found, PureWindowsPath)
    assert found.drive == "C:"
    assert WINDOWS.parent in found.parents
    assert not set('<>:"|?*') & set(found.name)


@pytest.mark.parametrize("cloud", [WINDOWS / "may.copc.laz", PureWindowsPath("D:may.laz"), PurePosixPath("a/may.las")])
def test_a_cloud_is_called_by_its_name_alone(cloud):
    assert paths.stem(cloud) == "may"


@pytest.mark.parametrize("path", [r"C:\surveys\may.laz", r"\\server\share\may.laz", "C:/surveys/may.laz"])
@pytest.mark.parametrize("quoted", ["{}", "'{}'"])
def test_paths_of_windows_in_yaml(tmp_path, path, quoted):
    file = tmp_path / "may.yaml"
    file.write_text(f"survey: may\ncloud: {quoted.format(path)}\nboundaries: {path}\n", encoding="utf-8")
    config = load_survey(file)
    assert (str(config.cloud), str(config.boundaries)) == (path, path)


@pytest.mark.parametrize("same", [False, True])
def test_names_on_a_disk_that_takes_capitals_for_small_letters(tmp_path, same):
    """As one of a network does on Linux, too; the lock that a job holds tells."""
    for name in (".lock", ".LOCK")[: 1 + same]:
        (tmp_path / name).touch()
    assert paths.is_caseless(tmp_path) == (same or sys.platform != "linux")


def test_a_path_of_more_than_260_characters(tmp_path):
    folder = tmp_path / ("a" * 150) / ("b" * 150) / "North"
    layer = gpd.GeoDataFrame({"row_id": [1]}, geometry=gpd.points_from_xy([1], [2]), crs=32632)
    with store.product(folder) as draft:
        write_layer(layer, paths.geopackage(draft, "North"), layer="rows")
    assert len(str(folder)) > 300
    assert gpd.read_file(paths.geopackage(folder, "North")).row_id.tolist() == [1]


@pytest.mark.parametrize(("n", "fits"), [(150, True), (200, True), (215, False), (300, False)])
def test_a_path_that_is_too_long_for_windows(monkeypatch, n, fits):
    place = PureWindowsPath("C:\\" + "a" * (n - 9) + "\\North")
    longest = store.ADDED + len(str(place)) + len("North")
    store._check_path(place)
    monkeypatch.setattr(store.os, "name", "nt")
    try:
        store._check_path(place)
    except OutputError as error:
        said = str(error)
    else:
        said = ""
    assert said.endswith(f"would have {longest} characters, and Windows takes 259: choose a shorter") == (not fits)


def test_what_a_name_gets_on_windows_fits_into_what_is_added():
    """Of all files that a product may have, and what is put beside them while they are made."""
    place = PureWindowsPath("C:\\products\\North")
    draft = place.with_name(f".{place.name}.{'0' * 8}.part")
    kinds = [paths.raster(draft, "North", "vineyard_likelihood"), paths.classified_cloud(draft, "North")]
    kinds += [paths.exported_frame(draft, "North"), paths.report(draft, "North"), paths.geopackage(draft, "North")]
    longest = max(len(str(kind)) for kind in kinds) + len(".aux.xml")
    assert longest <= len(str(place)) + len("North") + store.ADDED


@pytest.mark.parametrize("code", [5, 32])
def test_a_file_that_qgis_has_open_on_windows(code):
    error = OSError(13, "The process cannot access the file")
    error.winerror = code
    assert "QGIS" in str(store.unwritable(Path("F"), error))
    assert "QGIS" not in str(store.unwritable(Path("F"), OSError(13, "Permission denied")))


def test_links_that_the_system_does_not_know_are_copies(tmp_path, monkeypatch):
    def unknown(*args, **kwargs):
        raise NotImplementedError("follow_symlinks unavailable on this platform")

    monkeypatch.setattr(store, "os", SimpleNamespace(link=unknown))
    (tmp_path / "a").write_text("kept")
    store._link(tmp_path / "a", tmp_path / "b")
    assert (tmp_path / "b").read_text() == "kept"
