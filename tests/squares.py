"""A survey of square parcels under one small cloud, and its job, whose parcels are worked by doubles."""

import json
from datetime import UTC, datetime

import geopandas as gpd
import laspy
import numpy as np
import shapely

from vinemap import paths
from vinemap.config.surveys import survey_config
from vinemap.geo.crs import parse_crs
from vinemap.jobs.plan import plan_survey
from vinemap.jobs.survey import map_survey

PLACE = np.array([414_700.0, 4_940_700.0])
SIDE = 10.0
"""Metres of a parcel; they stand in a line, the cloud is over all of the first nine."""
CRS = parse_crs("EPSG:32632")


def write_cloud(path, *, seed=0):
    header = laspy.LasHeader(point_format=6, version="1.4")
    header.scales = np.full(3, 0.001)
    header.offsets = [*PLACE, 0]
    header.creation_date = datetime(2024, 6, 1, tzinfo=UTC)
    header.add_crs(CRS)
    las = laspy.LasData(header)
    las.xyz = np.random.default_rng(seed).uniform([*PLACE, 0], [*(PLACE + [9 * SIDE, SIDE]), 2], (900, 3))
    las.write(path)
    return path


def square(k, *, grow=0.0):
    return shapely.box(*(PLACE + [k * SIDE, 0]), *(PLACE + [(k + 1) * SIDE, SIDE])).buffer(grow)


def write_polygons(path, polygons, *, crs=32632):
    """Polygons by name; a number stands for a square."""
    shapes = [square(shape) if isinstance(shape, int) else shape for shape in polygons.values()]
    path.unlink(missing_ok=True)
    gpd.GeoDataFrame({"name": list(polygons)}, geometry=shapes, crs=crs).to_file(path)
    return path


class Job:
    """A survey with its folder of products, whose parcels are worked by a double."""

    def __init__(self, place):
        self.cloud = write_cloud(place / "may.las")
        self.boundaries = place / "parcels.geojson"
        self.folder = place / "products"
        self.worked = []
        self.draw(A=0, B=1, C=2)

    def draw(self, **polygons):
        self.polygons = polygons
        write_polygons(self.boundaries, polygons)

    def config(self, **options):
        return survey_config(**{"survey": "may", "cloud": self.cloud, "boundaries": self.boundaries} | options)

    def run(self, *, again=False, **options):
        """Outcomes by parcel; what was worked stands in ``worked``."""
        self.worked = []
        found = {outcome.parcel: outcome for outcome in self.outcomes(again=again, **options)}
        assert left(self.folder) == []
        return found

    def outcomes(self, *, again=False, **options):
        return map_survey(self.config(**options), self.folder, again=again, step=self.step)

    def step(self, parcel, function, *args, **kwargs):
        self.worked.append(parcel)
        return function(*args, **kwargs)

    def states(self, **options):
        return {parcel: outcome.state for parcel, outcome in self.run(**options).items()}

    def planned(self, **options):
        return [one.parcel for one in plan_survey(self.config(**options), self.folder).recipes]

    def record(self):
        return json.loads(paths.survey_record(self.folder).read_text(encoding="utf-8"))


def left(folder):
    """What has a temporary name in a folder."""
    return [path.name for path in folder.iterdir() if path.name.startswith(".")] if folder.is_dir() else []
