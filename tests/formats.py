"""Points written in the formats that vinemap reads besides LAS."""

import json
import struct

import laspy
import numpy as np
import rasterio

PLY = {"ascii": "ascii", "<": "binary_little_endian", ">": "binary_big_endian"}


def write_ply(path, xyz, *, order="<", before=""):
    """Points as doubles with a class each, after some other element, and a face behind them."""
    head = f"ply\nformat {PLY[order]} 1.0\ncomment made here\n{before}element vertex {len(xyz)}\n"
    head += "".join(f"property {kind} {name}\n" for kind, name in FIELDS)
    head += "element face 1\nproperty list uchar int vertex_index\nend_header\n"
    classes = np.full(len(xyz), 2)
    with path.open("wb") as stream:
        stream.write(head.encode())
        if order == "ascii":
            np.savetxt(stream, np.column_stack([xyz[:, 0], classes, xyz[:, 1:]]), fmt=["%.3f", "%d", "%.3f", "%.3f"])
            stream.write(b"3 0 1 2\n")
        else:
            out = np.empty(len(xyz), [("x", f"{order}f8"), ("c", "u1"), ("y", f"{order}f8"), ("z", f"{order}f8")])
            out["x"], out["y"], out["z"], out["c"] = *xyz.T, classes
            stream.write(out.tobytes() + struct.pack(f"{order}B3i", 3, 0, 1, 2))
    return path


FIELDS = (("double", "x"), ("uchar", "scalar_Classification"), ("double", "y"), ("double", "z"))


def write_pcd(path, xyz, *, form="binary"):
    """Points as doubles, with padding."""
    head = "# .PCD v0.7\nVERSION 0.7\nFIELDS x y z _\nSIZE 8 8 8 1\nTYPE F F F U\nCOUNT 1 1 1 4\n"
    head += f"WIDTH {len(xyz)}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {len(xyz)}\nDATA {form}\n"
    with path.open("wb") as stream:
        stream.write(head.encode())
        if form == "ascii":
            np.savetxt(stream, np.column_stack([xyz, np.zeros((len(xyz), 4))]), fmt=["%.3f"] * 3 + ["%d"] * 4)
        else:
            out = np.zeros(len(xyz), [("xyz", "<f8", 3), ("pad", "u1", 4)])
            out["xyz"] = xyz
            stream.write(out.tobytes())
    return path


def write_text(path, xyz, *, head="", sep=" ", decimal=".", order=(0, 1, 2)):
    """Points a line each."""
    lines = [sep.join(f"{value:.3f}".replace(".", decimal) for value in point) for point in xyz[:, order].tolist()]
    path.write_text(head + "\n".join(lines) + "\n", encoding="utf-8")
    return path


def write_ept(folder, xyz, crs, *, kind="laszip", depth=2):
    """Entwine Point Tiles: each point in a cube of one of the levels, in turn; the last is listed apart."""
    for name in ("ept-data", "ept-hierarchy"):
        (folder / name).mkdir(parents=True)
    low = np.floor(xyz.min(axis=0))
    side = float(np.ceil(np.ptp(xyz, axis=0).max())) + 1
    level = np.arange(len(xyz)) % (depth + 1)
    cell = np.floor((xyz - low) / side * 2.0 ** level[:, None]).astype(int)
    keys, which = np.unique(np.column_stack([level, cell]), axis=0, return_inverse=True)
    counts = {}
    for k, key in enumerate(keys):
        points, name = xyz[which.ravel() == k], "-".join(map(str, key))
        counts[name] = len(points)
        steps = np.round((points - low) / 0.001).astype("<i4")
        if kind == "laszip":
            write_las(folder / "ept-data" / f"{name}.laz", points, None)
        else:
            (folder / "ept-data" / f"{name}.bin").write_bytes(np.ascontiguousarray(steps).tobytes())
    top = {name: n for name, n in counts.items() if not name.startswith("2-")}
    for first in [name for name in counts if name.startswith("1-")]:
        inner = {name: n for name, n in counts.items() if name.startswith("2-") and above(name) == first}
        if inner:
            (folder / "ept-hierarchy" / f"{first}.json").write_text(json.dumps({first: counts[first]} | inner))
            top[first] = -1
    (folder / "ept-hierarchy" / "0-0-0-0.json").write_text(json.dumps(top))
    schema = [
        {"name": axis, "type": "signed", "size": 4, "scale": 0.001, "offset": offset}
        for axis, offset in zip("XYZ", low.tolist(), strict=True)
    ]
    about = {"bounds": [*low.tolist(), *(low + side).tolist()], "dataType": kind, "points": len(xyz), "schema": schema}
    about |= {"boundsConforming": [*xyz.min(axis=0).tolist(), *xyz.max(axis=0).tolist()], "srs": {"wkt": crs.to_wkt()}}
    (folder / "ept.json").write_text(json.dumps(about))
    return folder / "ept.json"


def above(name):
    """Name of the cube in which one lies."""
    depth, *place = map(int, name.split("-"))
    return "-".join(map(str, [depth - 1, *(k // 2 for k in place)]))


def write_las(path, xyz, crs):
    header = laspy.LasHeader(version="1.4", point_format=6)
    header.scales, header.offsets = np.full(3, 0.001), np.floor(xyz.min(axis=0))
    if crs:
        header.add_crs(crs)
    cloud = laspy.LasData(header)
    cloud.x, cloud.y, cloud.z = xyz.T
    cloud.write(str(path))
    return path


def write_surface(path, xyz, crs, *, resolution=0.05):
    """The highest point of each cell."""
    west, north = np.floor(xyz[:, 0].min()), np.ceil(xyz[:, 1].max())
    column, row = ((xyz[:, 0] - west) / resolution).astype(int), ((north - xyz[:, 1]) / resolution).astype(int)
    heights = np.full((row.max() + 1, column.max() + 1), -9999.0, np.float32)
    np.maximum.at(heights, (row, column), xyz[:, 2])
    transform = rasterio.Affine(resolution, 0, west, 0, -resolution, north)
    how = {"driver": "GTiff", "count": 1, "dtype": "float32", "nodata": -9999, "crs": crs.to_wkt()}
    with rasterio.open(
        path, "w", height=heights.shape[0], width=heights.shape[1], transform=transform, **how
    ) as raster:
        raster.write(heights, 1)
    return path
