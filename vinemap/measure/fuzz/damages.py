"""Small whole files of each kind, and ways to damage them at random."""

from __future__ import annotations

from typing import TYPE_CHECKING

import click
import numpy as np

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from numpy.random import Generator

    from vinemap.compute.arrays import Floats

HEADER = 375
"""Bytes of the header that are damaged more often than others."""


def _flip(data: bytearray, rng: Generator, first: int, last: int) -> None:
    for at in rng.integers(first, last, rng.integers(1, 5)):
        data[at] ^= rng.integers(1, 256)


def header(data: bytearray, rng: Generator) -> None:
    """Flip bytes of the header and the records behind it."""
    last = HEADER if rng.random() < 0.5 else int.from_bytes(data[96:100], "little") + 8
    _flip(data, rng, 0, min(last, len(data)))


def anywhere(data: bytearray, rng: Generator) -> None:
    """Flip bytes anywhere."""
    _flip(data, rng, 0, len(data))


def end(data: bytearray, rng: Generator) -> None:
    """Flip bytes near the end, where LAZ has its table of chunks and COPC its index."""
    _flip(data, rng, len(data) - min(len(data), 2000), len(data))


def cut(data: bytearray, rng: Generator) -> None:
    """Cut the end off."""
    del data[int(len(data) * rng.random()) :]


def inserted(data: bytearray, rng: Generator) -> None:
    """Put bytes in."""
    at = rng.integers(len(data)) if rng.random() < 0.5 else rng.integers(HEADER)
    data[at:at] = rng.bytes(int(rng.integers(1, 65)))


def lost(data: bytearray, rng: Generator) -> None:
    """Take bytes out, or put zeros in their place."""
    at, n = rng.integers(len(data)), rng.integers(1, 5000)
    data[at : at + n] = bytes(len(data[at : at + n])) if rng.random() < 0.5 else b""


DAMAGES: tuple[Callable[[bytearray, Generator], None], ...] = header, anywhere, end, cut, inserted, lost


def write_wholes(folder: Path) -> list[tuple[Path, Path]]:
    """Write a small parcel as a file of each kind; COPC only where copclib is there.

    Gives their paths and those of their polygons; of COPC it is a part of the parcel, so that the index is used.
    """
    import geopandas as gpd
    import laspy
    from shapely import affinity

    from vinemap.simulate.plants import Vineyard
    from vinemap.simulate.scenes import rows_of
    from vinemap.simulate.survey import simulate
    from vinemap.simulate.terrain import hillside

    vineyard = Vineyard("A", rows_of(4, length=16, azimuth=33))
    survey = simulate([vineyard], hillside(0.1), density=250, surroundings=2, seed=1)
    parcel, part = folder / "parcel.gpkg", folder / "part.gpkg"
    survey.parcels.to_file(parcel)
    within = affinity.scale(survey.parcels.union_all(), 0.45, 0.45)
    gpd.GeoDataFrame({"name": ["A"]}, geometry=[within], crs=survey.parcels.crs).to_file(part)
    made = []
    for kind, form, version in (("las", 3, "1.2"), ("laz", 3, "1.2"), ("laz14", 7, "1.4")):
        head = laspy.LasHeader(point_format=form, version=version)
        head.scales, head.offsets = np.full(3, 0.001), np.floor(survey.xyz.min(axis=0))
        head.add_crs(survey.rows.crs)
        cloud = laspy.LasData(head)
        cloud.xyz = survey.xyz
        cloud.return_number[:] = cloud.number_of_returns[:] = 1
        made.append((folder / f"{kind}.{kind[:3]}", parcel))
        cloud.write(made[-1][0])
    try:
        made.append((_write_copc(folder / "copc.copc.laz", survey.xyz, survey.rows.crs.to_wkt()), part))
    except ImportError:
        click.echo("without COPC, as copclib isn't here", err=True)
    return made


def _write_copc(path: Path, xyz: Floats, wkt: str) -> Path:
    """Write points (n, 3) to the nodes of two levels of an octree."""
    import copclib

    low, high = xyz.min(axis=0), xyz.max(axis=0)
    middle, half = (low + high) / 2, 0.50001 * np.ptp(xyz, axis=0).max()
    config = copclib.CopcConfigWriter(7, copclib.Vector3(0.001, 0.001, 0.001), copclib.Vector3(*np.floor(low)), wkt)
    config.las_header.min, config.las_header.max = copclib.Vector3(*low), copclib.Vector3(*high)
    info = config.copc_info
    info.spacing, info.halfsize = 1, half
    info.center_x, info.center_y, info.center_z = middle
    writer = copclib.FileWriter(str(path), config)
    level = np.random.default_rng(0).integers(0, 3, len(xyz))
    keys = np.column_stack([level, ((xyz - middle + half) / (2 * half) * 2.0 ** level[:, None]).astype(int)])
    for key in np.unique(keys, axis=0):
        node = copclib.Points(writer.copc_config.las_header)
        for x, y, z in xyz[(keys == key).all(axis=1)].tolist():
            point = node.CreatePoint()
            point.x, point.y, point.z = x, y, z
            node.AddPoint(point)
        writer.AddNode(copclib.VoxelKey(*key.tolist()), node)
    writer.Close()
    return path
