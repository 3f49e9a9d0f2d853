"""A stand-in for PDAL's Python package, which does in numpy what its stages do, as far as they are used."""

import re
from typing import ClassVar

import laspy
import numpy as np
import shapely
from pyproj import Transformer


def numbers(text):
    return [float(number) for number in re.findall(r"-?\d+(?:\.\d+)?(?:e-?\d+)?", text)]


class Stage:
    """A stage of PDAL's Python package: its type, its options, and how it is joined with others."""

    def __init__(self, kind, **options):
        self.type, self.options = kind, options

    def __or__(self, other):
        return Pipeline([self, other])

    def pipeline(self, *arrays):
        return Pipeline([self], arrays)


class Pipeline:
    """A pipeline that does in numpy what PDAL's stages do, as far as they are used here."""

    made: ClassVar[list] = []
    terrain = staticmethod(lambda x, y: np.zeros_like(x))
    """What ``filters.smrf`` takes for ground."""

    def __init__(self, stages, inputs=()):
        self.stages, self.inputs, self.arrays = list(stages), list(inputs), None
        self.made.append(self)

    def __or__(self, other):
        return Pipeline([*self.stages, *(other.stages if isinstance(other, Pipeline) else [other])], self.inputs)

    def execute(self):
        views = self.inputs
        for stage in self.stages:
            views = getattr(self, stage.type.replace(".", "_"))(views, **stage.options)
        self.arrays = views
        return sum(len(view) for view in views)

    def readers_las(self, views, filename, override_srs, bounds=None):
        las = laspy.read(filename)
        if bounds:
            west, east, south, north = numbers(bounds)
            las.points = las.points[(las.x >= west) & (las.x <= east) & (las.y >= south) & (las.y <= north)]
        flags = [np.asarray(las[name], dtype="u1") for name in ("return_number", "classification", "withheld")]
        names = "X,Y,Z,ReturnNumber,Classification,Withheld"
        return [np.rec.fromarrays([*np.array(las.xyz).T, *flags], names=names)]

    readers_copc = readers_las

    def filters_expression(self, views, expression):
        terms = " & ".join(f"({term})" for term in expression.split("&&"))
        return [view[eval(terms, {}, {name: view[name] for name in view.dtype.names})] for view in views]

    def filters_reprojection(self, views, in_srs, out_srs):
        convert = Transformer.from_crs(in_srs, out_srs, always_xy=True).transform
        for view in views:
            view["X"], view["Y"], view["Z"] = convert(view["X"], view["Y"], view["Z"])
        return views

    def filters_crop(self, views, polygon, a_srs):
        parts = shapely.get_parts(shapely.from_wkt(polygon))
        return [view[shapely.contains_xy(part, view["X"], view["Y"])] for view in views for part in parts]

    def filters_smrf(self, views, **options):
        out = []
        for x, y, z in ([view[name] for name in "XYZ"] for view in views):
            ground = np.abs(z - self.terrain(x, y)) < 0.1
            out.append(np.rec.fromarrays([x, y, z, np.where(ground, 2, 1).astype("u1")], names="X,Y,Z,Classification"))
        return out
