"""Products of surveys, compared byte for byte, and boundaries of many parcels."""

import json

import geopandas as gpd

from vinemap import paths

SURVEYS = ["collection.json", "index.html", "survey.json", "three_stac.json", "tileset.json"]
"""Files of a survey, beside the folders of its products."""


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
