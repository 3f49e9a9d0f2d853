"""Small LAS, LAZ and COPC files of each kind."""

from datetime import UTC, datetime

import laspy
import numpy as np
import pytest
from pyproj import CRS

UTM = CRS.from_epsg(32632)
FORMATS = {"las 1.2": (3, "1.2"), "las 1.4": (6, "1.4"), "laz 1.2": (3, "1.2"), "laz 1.4": (7, "1.4")}


def points(n, seed=0):
    return np.random.default_rng(seed).uniform([414_700, 4_940_700, 0], [414_730, 4_940_730, 3], (n, 3))


def in_order(xyz):
    """Points (n, 3) in an order of their own, to the millimetre, in whichever they came."""
    return xyz[np.lexsort(xyz.round(3).T)]


def as_las(n, kind):
    form, version = FORMATS[kind]
    header = laspy.LasHeader(point_format=form, version=version)
    header.scales = np.full(3, 0.001)
    header.offsets = [414_700, 4_940_700, 0]
    header.creation_date = datetime(2024, 6, 1, tzinfo=UTC)
    las = laspy.LasData(header)
    las.xyz = points(n)
    return las


def write_each(folder):
    """Write a whole file of each kind; gives their paths."""
    made = {}
    for kind in FORMATS:
        made[kind] = folder / f"{kind}.{kind[:3]}"
        as_las(2000, kind).write(made[kind])
    made["evlr"] = folder / "evlr.laz"
    las = as_las(2000, "laz 1.4")
    las.evlrs = laspy.vlrs.vlrlist.VLRList([laspy.VLR("vines", 1, "of the survey", bytes(100))])
    las.write(made["evlr"])
    made["copc"] = folder / "copc.copc.laz"
    try:
        import copclib
    except ImportError:
        del made["copc"]
        return made
    low = points(2000).min(axis=0)
    config = copclib.CopcConfigWriter(7, copclib.Vector3(0.001, 0.001, 0.001), copclib.Vector3(*np.floor(low)), "")
    config.copc_info.halfsize, config.copc_info.spacing = 20, 10
    writer = copclib.FileWriter(str(made["copc"]), config)
    for x, chunk in enumerate(np.split(points(2000), 2)):
        node = copclib.Points(writer.copc_config.las_header)
        for xyz in chunk:
            point = node.CreatePoint()
            point.x, point.y, point.z = xyz
            node.AddPoint(point)
        writer.AddNode(copclib.VoxelKey(1, x, 0, 0), node)
    writer.Close()
    return made


def write_copc(path, xyz, *, crs=UTM, scales=(0.001, 0.001, 0.001), levels=4, noise=(), withheld=()):
    """Write points (n, 3) to nodes of an octree of so many levels, chosen at random."""
    copclib = pytest.importorskip("copclib", reason="copclib, which writes COPC files, is not on this machine")
    low, high = xyz.min(axis=0), xyz.max(axis=0)
    middle, half = (low + high) / 2, 0.50001 * np.ptp(xyz, axis=0).max()
    config = copclib.CopcConfigWriter(7, copclib.Vector3(*scales), copclib.Vector3(*np.floor(low)), crs.to_wkt())
    config.las_header.min, config.las_header.max = copclib.Vector3(*low), copclib.Vector3(*high)
    info = config.copc_info
    info.spacing, info.halfsize = 10, half
    info.center_x, info.center_y, info.center_z = middle
    writer = copclib.FileWriter(str(path), config)
    level = np.random.default_rng(0).integers(0, levels, len(xyz))
    place = (xyz - middle + half) / (2 * half) * 2.0 ** level[:, None]
    keys = np.column_stack([level, place.astype(int)])
    for key in np.unique(keys, axis=0):
        node = copclib.Points(writer.copc_config.las_header)
        for k in np.flatnonzero((keys == key).all(axis=1)):
            point = node.CreatePoint()
            point.x, point.y, point.z = xyz[k]
            point.classification, point.withheld = 7 if k in noise else 2, k in withheld
            node.AddPoint(point)
        writer.AddNode(copclib.VoxelKey(*key.tolist()), node)
    writer.Close()
    return path
