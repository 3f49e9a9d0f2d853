"""Exports for tractors, read back by parsers written from the formats' own descriptions."""

import json
import math
from xml.etree import ElementTree as ET

import isoxml_writer
import numpy as np
import shapely
from exported import NAME, assert_same, few, in_grid
from lxml import etree

from vinemap.export.write import export_products


def test_isoxml(exported, rows, lanes, outline):
    path = exported / "isoxml" / "TASKDATA" / "TASKDATA.XML"
    root = ET.parse(path).getroot()
    assert root.tag == "ISO11783_TaskData"
    assert (root.get("VersionMajor"), root.get("DataTransferOrigin")) == ("4", "1")
    (field,) = root.findall("PFD")
    assert field.get("C") == NAME
    assert field.get("F") == root.find("FRM").get("A")
    (boundary,) = field.findall("PLN")
    assert boundary.get("A") == "1"
    ring = shapely.Polygon(in_grid(points(boundary.find("LSG[@A='1']"))))
    assert ring.symmetric_difference(outline).area < 0.5
    assert int(field.get("D")) == round(outline.area)
    for group, truth, name in zip(field.findall("GGP"), (lanes, rows), ("lanes", "rows"), strict=True):
        patterns = group.findall("GPN")
        assert group.get("B") == f"{NAME} {name}"
        assert [pattern.get("B") for pattern in patterns] == truth["label"].tolist()
        assert {(pattern.get("E"), pattern.get("F")) for pattern in patterns} == {("4", "4")}
        lines = [pattern.find("LSG[@A='5']") for pattern in patterns]
        assert_same([in_grid(points(line)) for line in lines], truth.geometry)
        for pattern, line in zip(patterns, lines, strict=True):
            kinds = [point.get("A") for point in line]
            assert kinds == ["6", *["9"] * (len(kinds) - 2), "7"]
            assert pattern.get("C") == ("1" if len(kinds) == 2 else "3")
    numbers = [element.get("A") for element in root.iter("GPN")]
    assert len(set(numbers)) == len(lanes) + len(rows)


def test_isoxml_of_a_long_name(tmp_path, product):
    folder = few(product, tmp_path / "long", 2)
    record = json.loads((folder / "run.json").read_text())
    name = "Vigna Superiore di San Lorenzo in Collina presso la Cascina Alta"
    (folder / "run.json").write_text(json.dumps(record | {"parcel": name}))
    (folder / f"{NAME}.gpkg").rename(folder / f"{name}.gpkg")
    list(export_products([folder], tmp_path / "out", formats=["isoxml"], lines="both"))
    root = ET.parse(tmp_path / "out" / name / "isoxml" / "TASKDATA" / "TASKDATA.XML").getroot()
    assert [group.get("B") for group in root.iter("GGP")] == [f"{name[:26]} lanes", f"{name[:27]} rows"]


def points(line):
    return [(float(point.get("D")), float(point.get("C"))) for point in line.findall("PNT")]


def test_isoxml_holds_to_the_schema_of_iso_11783_10(exported):
    schema = etree.XMLSchema(file=f"{isoxml_writer.__path__[0]}/ISOXML_schema/ISO11783_TaskFile_V4-3.xsd")
    assert schema.validate(etree.parse(exported / "isoxml" / "TASKDATA" / "TASKDATA.XML")), schema.error_log


def from_agopengps(en, start):
    """Degrees of eastings and northings, as AgOpenGPS has it."""
    east, north = np.asarray(en, dtype=float)[:, :2].T
    f = math.radians(start[0])
    lat = start[0] + north / (111132.92 - 559.82 * math.cos(2 * f) + 1.175 * math.cos(4 * f) - 0.0023 * math.cos(6 * f))
    r = np.radians(lat)
    lon = start[1] + east / (111412.84 * np.cos(r) - 93.5 * np.cos(3 * r) + 0.118 * np.cos(5 * r))
    return np.column_stack([lon, lat])


def numbers(line, n):
    values = [float(part) for part in line.split(",")]
    assert len(values) == n
    return values


def test_agopengps(exported, rows, lanes, outline):
    folder = exported / "agopengps" / NAME
    header = (folder / "Field.txt").read_text(encoding="utf-8").splitlines()
    assert header[1:8] == ["$FieldDir", NAME, "$Offsets", "0,0", "Convergence", "0", "StartFix"]
    start = numbers(header[8], 2)

    text = iter((folder / "TrackLines.txt").read_text(encoding="utf-8").splitlines())
    assert next(text) == "$TrackLines"
    tracks = {}
    for name in text:
        heading = float(next(text))
        ends = [numbers(next(text), 2), numbers(next(text), 2)]
        assert [next(text), next(text), next(text)] == ["0", "4", "True"]
        course = np.array([numbers(next(text), 3) for _ in range(int(next(text)))])
        step = np.diff(course[:, :2], axis=0)
        assert ends == course[[0, -1], :2].tolist()
        assert np.hypot(*step.T).max() < 1.01
        way = np.arctan2(*step.mean(axis=0))
        assert math.cos(heading - way) > 0.9999
        assert np.cos(course[:-1, 2] - np.arctan2(*step.T)).min() > 0.99
        tracks[name] = in_grid(from_agopengps(course, start))
    assert list(tracks) == [f"lane {label}" for label in lanes["label"]] + [f"row {label}" for label in rows["label"]]
    assert_same(list(tracks.values()), [*lanes.geometry, *rows.geometry])

    fence, drive, count, *course = (folder / "Boundary.txt").read_text(encoding="utf-8").splitlines()
    assert (fence, drive, int(count)) == ("$Boundary", "False", len(course))
    ring = shapely.Polygon(in_grid(from_agopengps([numbers(line, 3) for line in course], start)))
    assert ring.symmetric_difference(outline).area < 0.5
