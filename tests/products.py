"""Products of surveys, made and compared byte for byte, and boundaries of many parcels."""

import json
from contextlib import nullcontext

import geopandas as gpd
import numpy as np
import pandas as pd
import pyogrio
import pytest
import shapely

from vinemap import paths
from vinemap.errors import VinemapError, WorkerError
from vinemap.geo.crs import WGS84, parse_crs, project
from vinemap.jobs import survey
from vinemap.product.layers import LAYERS, TEXT, WHOLE

SURVEYS = ["collection.json", "index.html", "survey.json", "three_stac.json", "tileset.json"]
"""Files of a survey, beside the folders of its products."""


class Here:
    """What runs calls in this very process, instead of others."""

    slots = 1

    def __init__(self, **options):
        pass

    def run(self, function, *args, limit=None, **kwargs):
        try:
            return function(*args, **kwargs)
        except VinemapError:
            raise
        except Exception as error:  # as a worker would
            raise WorkerError(f"a fault of vinemap's own ({error})") from error

    def stop(self):
        pass

    def close(self):
        pass


def without_workers(patch):
    """Have surveys worked in this process, as others are slow to start and often aren't what is tested."""
    patch.setattr(survey, "_engine", lambda plan, config: nullcontext(Here()))
    patch.setattr(survey, "Worker", Here)


def map_here(config, folder):
    with pytest.MonkeyPatch.context() as patch:
        without_workers(patch)
        return list(survey.map_survey(config, folder))


def tree(folder):
    """All files under a folder with their bytes; of the records of runs what isn't a time."""
    return {path.relative_to(folder).as_posix(): content(path) for path in folder.rglob("*") if path.is_file()}


def content(path):
    if path.name not in (paths.RUN, "survey.json"):
        return path.read_bytes()
    record = json.loads(path.read_text())
    for name in ("created", "seconds", "began"):
        record.pop(name, None)
    for one in (*record.get("sources", ()), *record.get("parcels", ())):
        one.pop("read" if "read" in one else "seconds")
    return record


def many(cloud, path, n):
    """Write the polygons of the three parcels so many times each, every time under another name."""
    parcels = gpd.read_file(cloud.with_name("parcels.gpkg"))
    names = [f"{name}{k}" for k in range(n) for name in parcels["name"]]
    gpd.GeoDataFrame({"name": names}, geometry=[*parcels.geometry] * n, crs=parcels.crs).to_file(path)


def place_product(folder, parcel, lines, *, survey, flown, crs="EPSG:32632", key="", **numbers):
    """Put a product with such rows in a folder of them: layer ``rows`` and the records, nothing else."""
    place = paths.parcel_folder(folder, parcel)
    place.mkdir(parents=True)
    known = {"height_m": 1.5, "width_m": 0.5, "volume_m3": 10.0, "spacing_m": 2.5, "confidence": 0.9} | numbers
    known["length_m"] = shapely.length(lines)
    kinds = LAYERS["rows"].columns
    blank = {name: "" if kind == TEXT else 0 if kind == WHOLE else 0.0 for name, kind in kinds.items()}
    ids = np.arange(1, len(lines) + 1)
    known |= {"row_id": ids, "label": [f"{k} {parcel}" for k in ids]}
    rows = gpd.GeoDataFrame(pd.DataFrame(blank, index=range(len(lines))).assign(**known), geometry=lines, crs=crs)
    pyogrio.write_dataframe(rows, paths.geopackage(place, parcel), layer="rows", driver="GPKG")
    outline = project(shapely.union_all(shapely.force_2d(lines)).buffer(2), parse_crs(crs), WGS84)
    item = {"geometry": json.loads(shapely.to_geojson(outline)), "properties": {"vinemap:area_m2": 100.0}}
    paths.stac_item(place, parcel).write_text(json.dumps(item))
    record = {"parcel": parcel, "survey": survey, "flown": f"{flown}T12:00:00+00:00", "crs": crs, "warnings": []}
    record |= {"key": key or f"{survey} {parcel}", "files": {paths.geopackage(place, parcel).name: 1}}
    record |= {"origin": {"lat": 45.0, "lon": 8.0, "alt": 100.0}}
    paths.run_record(place).write_text(json.dumps(record))
    return place
