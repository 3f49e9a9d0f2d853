"""ISOXML (ISO 11783-10, version 4.3), the task data that ISOBUS terminals of tractors read.

The schema is at https://www.isobus.net/isobus/file/supplementalSchema.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import isoxml.models.base.v4 as iso
import shapely
from isoxml.converter.shapely_geom import ShapelyConverterV4
from isoxml.util.isoxml_io import isoxml_to_dir

from vinemap import __version__, paths

if TYPE_CHECKING:
    from pathlib import Path

    import pandas as pd

    from vinemap.export.field import Field

LONGEST = 32
"""Characters of a designator."""


def write_isoxml(field: Field, folder: Path, *, lines: str) -> None:
    """Write a folder TASKDATA with one field: its boundary, and a guidance pattern for each of the chosen ``lines``.

    Lanes make one guidance group and rows another. A pattern is a curve from A to B, or an AB line where two points
    tell it all; the terminal is told neither to repeat it beside itself nor to lengthen it. Heights are left out, since
    the standard wants them above the ellipsoid.

    Raises
    ------
    InputError
        If coordinates are local.
    OSError
        If it can't be written.
    """
    convert = ShapelyConverterV4()
    parts = shapely.get_parts(shapely.force_2d(field.wgs84("outline").geometry.to_numpy()))
    table = field.guidance(lines)
    table = table.assign(geometry=shapely.force_2d(table.to_crs(4326).geometry.to_numpy()))
    table = table.assign(id=[f"GPN{k}" for k in range(1, len(table) + 1)])
    groups = [
        iso.GuidanceGroup(
            id=f"GGP{k}",
            designator=f"{field.parcel[: LONGEST - len(kind) - 2]} {kind}s",
            guidance_patterns=[_pattern(line, convert) for _, line in members.iterrows()],
        )
        for k, (kind, members) in enumerate(table.groupby("kind", sort=False), start=1)
    ]
    customer = iso.Customer(id="CTR1", last_name=field.survey[:LONGEST])
    farm = iso.Farm(id="FRM1", designator=field.survey[:LONGEST], customer_id_ref=customer.id)
    partfield = iso.Partfield(
        id="PFD1",
        designator=field.parcel[:LONGEST],
        area=round(field.outline.area.sum()),
        customer_id_ref=customer.id,
        farm_id_ref=farm.id,
        polygons=[convert.to_iso_polygon(part, iso.PolygonType.PartfieldBoundary) for part in parts],
        guidance_groups=groups,
    )
    data = iso.Iso11783TaskData(
        management_software_manufacturer="vinemap",
        management_software_version=__version__,
        data_transfer_origin=iso.Iso11783TaskDataDataTransferOrigin.FMIS,
        customers=[customer],
        farms=[farm],
        partfields=[partfield],
    )
    target = paths.task_data(folder)
    target.mkdir()
    isoxml_to_dir(target, data)


def _pattern(line: pd.Series, convert: ShapelyConverterV4) -> iso.GuidancePattern:
    course = convert.to_iso_line_string(line["geometry"], iso.LineStringType.GuidancePattern)
    for point in course.points:
        point.type = iso.PointType.GuidancePoint
    course.points[0].type = iso.PointType.GuidanceReferenceA
    course.points[-1].type = iso.PointType.GuidanceReferenceB
    course.width = round(1000 * line["width_m"]) if math.isfinite(line["width_m"]) else None
    return iso.GuidancePattern(
        id=line["id"],
        designator=line["label"][:LONGEST],
        type=iso.GuidancePatternType.AB if len(course.points) == 2 else iso.GuidancePatternType.Curve,
        propagation_direction=iso.GuidancePatternPropagationDirection.NoPropagation,
        extension=iso.GuidancePatternExtension.NoExtensions,
        gnss_method=iso.GuidancePatternGNSSMethod.DesktopGeneratedData,
        line_strings=[course],
    )
