"""A stand-in for PDAL's Python package: it does in numpy what PDAL 2.10's stages do, as far as they are used.

That includes what surprises: names of files are patterns, points that are all left out make no array, and some damaged
files end the process.
"""

import glob
import json
import os
import re
import signal
from pathlib import Path
from types import SimpleNamespace
from typing import ClassVar

import laspy
import numpy as np
from scipy.ndimage import gaussian_gradient_magnitude, grey_opening

__version__, info = "3.5.5", SimpleNamespace(version="2.10.0")
READ = "VINEMAP_PDAL_READ"
"""Variable that names a file, to which is added what is read."""
CRASHES = b"ends PDAL"
"""What a file begins with that its reader dies of."""
STREAMED = {"readers.las", "readers.copc", "readers.text"}
ENDS = {"las": "las", "laz": "las", "copc.laz": "copc", "txt": "text", "bpf": "bpf"}
CSF = {"resolution", "threshold", "smooth", "step", "rigidness", "iterations"}
PMF = {"cell_size", "slope", "initial_distance", "max_distance", "max_window_size", "exponential"}
OPTIONS = {
    "readers.las": {"filename"},
    "readers.copc": {"filename", "bounds"},
    "readers.text": {"filename"},
    "readers.bpf": {"filename"},
    "filters.smrf": {"cell", "slope", "window", "scalar", "threshold"},
    "filters.csf": CSF,
    "filters.pmf": PMF,
    "filters.expression": {"expression"},
    "filters.assign": {"value"},
    "filters.reprojection": {"out_srs"},
}


class Stage:
    """A stage: its type and its options."""

    def __init__(self, **options):
        self.options = options

    @property
    def type(self):
        return self.options["type"]

    def pipeline(self, *arrays):
        return Pipeline([self], arrays)


class Reader(Stage):
    """A reader, of the type that goes with the end of a name."""

    def __init__(self, filename, **options):
        ends = Path(filename).name.lower()
        kind = next((kind for end, kind in sorted(ENDS.items()) if ends.endswith("." + end)), None)
        if "type" not in options and kind is None:
            raise RuntimeError(f"Cannot determine reader for input file: {filename}")
        super().__init__(type=options.pop("type", f"readers.{kind}"), filename=filename, **options)


class Filter(Stage):
    """A filter."""


for _kind in OPTIONS:
    _group, _name = _kind.split(".")
    setattr(Reader if _group == "readers" else Filter, _name, staticmethod(lambda _k=_kind, **o: Filter(**o, type=_k)))


class Pipeline:
    """Stages one after the other, of which the first reads a file, or takes arrays."""

    made: ClassVar[list] = []

    def __init__(self, spec, arrays=()):
        self.stages = [Filter(**one) for one in json.loads(spec)] if isinstance(spec, str) else list(spec)
        self.inputs, self.arrays = list(arrays), None
        self.made.append(self)
        for stage in self.stages:
            for option in stage.options.keys() - OPTIONS[stage.type] - {"type"}:
                raise RuntimeError(f"{stage.type}: Unexpected argument '{option}'.")

    @property
    def streamable(self):
        return all(stage.type in STREAMED | {"filters.expression"} for stage in self.stages)

    @property
    def quickinfo(self):
        stage = self.stages[0]
        if stage.type in {"readers.text", "readers.bpf"}:
            raise RuntimeError(f"No summary data available for stage '{stage.type}'")
        try:
            with laspy.open(_matching(stage.options["filename"])[0]) as file:
                crs = file.header.parse_crs()
        except laspy.LaspyException as error:
            raise RuntimeError(f"{stage.type}: {error}") from error
        return {stage.type: {"srs": {"wkt": crs.to_wkt() if crs else ""}, "num_points": file.header.point_count}}

    def execute(self):
        views = self.inputs
        if READ in os.environ and not views:
            with Path(os.environ[READ]).open("a") as log:
                log.write(f"{Path(self.stages[0].options['filename']).name}\n")
        for stage in self.stages:
            options = {key: value for key, value in stage.options.items() if key != "type"}
            views = globals()[stage.type.replace(".", "_")](views, **options)
        self.arrays = [view for view in views if len(view)]
        return sum(map(len, self.arrays))

    def iterator(self, chunk_size=10_000):
        if not self.streamable:
            raise RuntimeError("Attempting to use stream mode with a stage that doesn't support it")
        self.execute()
        return (view[k : k + chunk_size] for view in self.arrays for k in range(0, len(view), chunk_size))


def _matching(filename):
    """Files whose names match a pattern; the name itself where none does."""
    if filename.startswith("~"):
        raise RuntimeError("PDAL does not support shell expansion")
    found = [Path(name) for name in sorted(glob.glob(filename))] or [Path(filename)]  # noqa: PTH207
    for path in found:
        if not path.is_file():
            raise RuntimeError(f"readers: Couldn't open '{filename}'.")
        if path.read_bytes()[:400].find(CRASHES) >= 0:
            os.kill(os.getpid(), signal.SIGSEGV)
    return found


def _records(xyz, **more):
    return np.rec.fromarrays([*np.asarray(xyz, dtype=float).T, *more.values()], names=["X", "Y", "Z", *more])


def readers_las(views, filename, bounds=None):
    out = []
    for path in _matching(filename):
        try:
            las = laspy.read(path)
        except laspy.LaspyException as error:
            raise RuntimeError(f"readers.las: {error}\nNumber of points too large for file size.") from error
        if bounds:
            west, east, south, north = numbers(bounds)
            las.points = las.points[(las.x >= west) & (las.x <= east) & (las.y >= south) & (las.y <= north)]
        flags = {"Classification": "classification", "Withheld": "withheld"}
        out.append(_records(las.xyz, **{name: np.asarray(las[own], dtype="u1") for name, own in flags.items()}))
    return out


readers_copc = readers_las


def readers_text(views, filename):
    return [_records(np.loadtxt(path, skiprows=1, delimiter=",", ndmin=2)) for path in _matching(filename)]


def readers_bpf(views, filename):
    return [_records(np.fromfile(path).reshape(-1, 3)) for path in _matching(filename)]


def numbers(text):
    return [float(number) for number in re.findall(r"-?\d+(?:\.\d+)?(?:e-?\d+)?", text)]


def filters_expression(views, expression):
    return [view[eval(expression, {}, {name: view[name] for name in view.dtype.names})] for view in views]


def filters_assign(views, value):
    name, number, where = re.fullmatch(r"(\w+) = (.+?)(?: WHERE (.+))?", value).groups()
    out = []
    for view in views:
        columns = {one: np.array(view[one]) for one in view.dtype.names}
        columns.setdefault(name, np.zeros(len(view)))
        chosen = eval(where or "X < inf", {"inf": np.inf}, columns)
        columns[name][chosen] = np.broadcast_to(eval(number, {}, columns), len(view))[chosen]
        out.append(np.rec.fromarrays(list(columns.values()), names=list(columns)))
    return out


def filters_smrf(views, cell=1.0, slope=0.15, window=18.0, scalar=1.25, threshold=0.5):
    """Points near the raster of lowest ones, once what is narrower than a window is cut off it."""
    out = []
    for view in views:
        x, y, z = (view[name] for name in "XYZ")
        plane = np.column_stack([x - x.mean(), y - y.mean(), np.ones(len(x))])
        z = z - plane @ np.linalg.lstsq(plane, z)[0]
        column, row = (((values - values.min()) / cell).astype(int) for values in (x, y))
        lowest = np.full((row.max() + 1, column.max() + 1), np.inf)
        np.minimum.at(lowest, (row, column), z)
        lowest[np.isinf(lowest)] = np.median(z)
        surface = grey_opening(lowest, size=2 * round(window / cell / 4) + 1)
        steep = gaussian_gradient_magnitude(surface, 1)[row, column] / cell
        ground = np.abs(z - surface[row, column]) < threshold + scalar * steep
        names = [name for name in view.dtype.names if name != "Classification"]
        columns = [view[name] for name in names]
        classes = np.where(ground, 2, 1).astype("u1")
        out.append(np.rec.fromarrays([*columns, classes], names=[*names, "Classification"]))
    return out


def filters_csf(views, resolution=1.0, threshold=0.5, **others):
    return filters_smrf(views, cell=resolution, threshold=threshold)


def filters_pmf(views, cell_size=1.0, initial_distance=0.15, **others):
    return filters_smrf(views, cell=cell_size, threshold=initial_distance)
