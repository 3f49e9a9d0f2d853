"""Settings of the stages: one flat model each."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, model_validator

Metres = Annotated[float, Field(gt=0, le=100)]
Share = Annotated[float, Field(ge=0, le=1)]


class Options(BaseModel):
    """Strict options: unknown keys are errors, and nothing changes after loading."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    @model_validator(mode="before")
    @classmethod
    def _without_empty(cls, data: Any) -> Any:
        """Leave out sections in which nothing stands, but comments perhaps."""
        if not isinstance(data, dict):
            return data
        sections = {name for name, field in cls.model_fields.items() if isinstance(field.default, (Options, dict))}
        return {key: value for key, value in data.items() if value is not None or key not in sections}


class ReadingOptions(Options):
    """Points in memory."""

    max_points: int | None = Field(
        None, ge=1000, description="points held in memory, more are worked in tiles; none: what half of it holds"
    )


class SmrfOptions(Options):
    """PDAL's simple morphological filter (Pingel et al. 2013)."""

    cell: Metres = Field(0.5, description="raster of lowest points, finer than an inter-row (m); PDAL's: 1")
    slope: float = Field(0.7, gt=0, le=10, description="rise over run above which an edge isn't terrain; PDAL's: 0.15")
    window: Metres = Field(8.0, description="half the width of trees and houses (m); PDAL's: 18")
    scalar: float = Field(0.35, ge=0, le=10, description="threshold more, for each unit of slope (m); PDAL's: 1.25")
    threshold: Metres = Field(0.15, description="distance from the lowest surface of ground (m); PDAL's: 0.5")


class CsfOptions(Options):
    """PDAL's cloth simulation filter (Zhang et al. 2016)."""

    resolution: Metres = Field(0.5, description="meshes of the cloth (m); PDAL's: 1")
    threshold: Metres = Field(0.15, description="distance from the cloth of ground (m); PDAL's: 0.5")
    rigidness: int = Field(1, ge=1, le=3, description="stiffness of the cloth: 1 on slopes, 3 on plains; PDAL's: 3")
    iterations: int = Field(500, ge=1, le=100_000, description="steps of time at the most; PDAL's: 500")
    step: float = Field(0.65, gt=0, le=10, description="length of a step of time; PDAL's: 0.65")
    smooth: bool = Field(default=True, description="whether steep slopes are seen to afterwards; PDAL's: true")


class PmfOptions(Options):
    """PDAL's progressive morphological filter (Zhang et al. 2003)."""

    cell_size: Metres = Field(0.5, description="raster of lowest points, finer than an inter-row (m); PDAL's: 1")
    slope: float = Field(0.7, gt=0, le=10, description="rise over run up to which all is terrain; PDAL's: 1")
    initial_distance: Metres = Field(0.15, description="distance from the lowest surface of ground (m); PDAL's: 0.15")
    max_distance: Metres = Field(0.5, description="the same, at the most (m); PDAL's: 2.5")
    max_window_size: Metres = Field(16.0, description="width of trees and houses (m); PDAL's: 33")
    exponential: bool = Field(default=True, description="whether windows double, or grow evenly; PDAL's: true")


class GroundOptions(Options):
    """Terrain model."""

    engine: Literal["vinemap", "pdal"] = Field("vinemap", description="ours, or PDAL's readers and its filters")
    filter: Literal["smrf", "csf", "pmf"] = Field("smrf", description="filter of PDAL's that finds ground")
    smrf: SmrfOptions = SmrfOptions()
    csf: CsfOptions = CsfOptions()
    pmf: PmfOptions = PmfOptions()
    pipeline: Path | None = Field(None, description="file with PDAL's filters, in JSON; none: the one above")
    resolution: float = Field(0.25, ge=0.05, le=2, description="cell size of the DTM (m)")
    quantile: float = Field(0.1, gt=0, le=0.5, description="order of the height that stands for a cell's terrain")
    tolerance: Metres = Field(0.12, description="height above the surface around it at which a cell is terrain (m)")
    terrace_height: float = Field(1.0, ge=0, le=5, description="height up to which a thin layer is a terrace (m)")

    @model_validator(mode="after")
    def _fitting(self) -> GroundOptions:
        if self.pipeline and self.engine != "pdal":
            raise ValueError("a pipeline of PDAL's wants engine: pdal")
        return self


class CoverOptions(Options):
    """Raster of canopy cover."""

    resolution: float = Field(0.1, ge=0.02, le=0.5, description="cell size (m)")
    low: Metres = Field(0.5, description="height above ground at which canopy begins, or less where all is low (m)")
    high: Metres = Field(3.6, description="height above ground at which it ends, and vines do (m)")
    smoothing: float | None = Field(None, gt=0, le=1, description="Gaussian (m); none: the mean point distance")

    @model_validator(mode="after")
    def _ordered(self) -> CoverOptions:
        if self.low >= self.high:
            raise ValueError(f"low ({self.low}) must be below high ({self.high})")
        return self


class RowFieldOptions(Options):
    """Direction, spacing and likelihood of rows."""

    method: Literal["spectrum", "cylinders"] = Field("spectrum", description="ours, or the thesis's cylinders")
    window: float = Field(18.0, ge=6, le=60, description="width of the spectrum's windows (m)")
    radius: float = Field(6.5, ge=2, le=30, description="radius of the cylinders (m)")
    step: float = Field(2.0, ge=0.5, le=20, description="distance of the windows (m)")
    min_spacing: float = Field(0.8, ge=0.5, le=10, description="smallest inter-row spacing (m)")
    max_spacing: float = Field(6.0, ge=0.8, le=10, description="largest inter-row spacing (m)")
    row_direction: float | None = Field(
        None, ge=-180, le=180, description="direction of all rows (degrees anticlockwise from east); none: found"
    )

    @model_validator(mode="after")
    def _ordered(self) -> RowFieldOptions:
        if self.min_spacing >= self.max_spacing:
            raise ValueError(f"min_spacing ({self.min_spacing}) must be below max_spacing ({self.max_spacing})")
        if self.method == "cylinders" and self.radius <= self.max_spacing:
            raise ValueError(f"radius ({self.radius}) must be above max_spacing ({self.max_spacing})")
        if self.window < 3 * self.max_spacing:
            raise ValueError(f"window ({self.window}) must hold three times max_spacing ({self.max_spacing})")
        return self


class KeyPointOptions(Options):
    """Key points of the canopy."""

    grid_step: float = Field(0.5, ge=0.1, le=5, description="distance of the nodes (m)")
    reach: float = Field(0.6, ge=0.5, le=5, description="reach of a profile to both sides (spacings)")
    slice_width: Metres = Field(0.5, description="width of a slice along the rows (m)")
    bin_width: float = Field(0.05, ge=0.01, le=0.5, description="bins of a profile (m)")
    smoothing: float = Field(0.15, gt=0, le=1, description="Gaussian along a profile (m)")
    min_cover: Share = Field(0.12, description="cover of a maximum")
    min_likelihood: Share = Field(0.1, description="vineyard likelihood of a node")


class ClusteringOptions(Options):
    """Clusters of key points."""

    method: Literal["pieces", "ellipse"] = Field("pieces", description="ours, or the thesis's ellipse alone")
    along: float = Field(1.0, gt=0, le=10, description="semi-axis of the ellipse along the row (spacings)")
    across: float = Field(0.2, gt=0, le=2, description="semi-axis across the row (spacings)")
    min_points: int = Field(6, ge=1, description="key points of a piece")
    max_gap: float = Field(20.0, ge=0, le=100, description="missing vines that a row bridges (m)")
    track_width: Metres = Field(2.5, description="gap shared by the neighbours that is a track (m)")


class KnownRowOptions(Options):
    """Rows that are known, and not sought."""

    course: Literal["fit", "keep"] = Field("fit", description="whether a line moves sideways onto its canopy, or stays")
    ends: Literal["fit", "keep"] = Field("fit", description="whether its ends move to its canopy's, or stay")
    align: bool = Field(default=False, description="whether the cloud is moved onto them first, by its shift")


class CurveOptions(Options):
    """Courses of rows."""

    threshold: Metres = Field(2.0, description="distance t of the enhanced key points (m)")
    min_length: Metres = Field(4.0, description="length of a row (m)")
    min_radius: Metres = Field(8.0, description="radius of the tightest bend (m)")
    max_width: Metres = Field(1.6, description="width of a row's canopy (m)")
    min_support: Share = Field(0.25, description="share of a row's length that has canopy")


class FitOptions(Options):
    """Centre lines, ends and gaps of rows."""

    smoothing: Metres = Field(2.5, description="wavelength below which bends are noise (m)")
    end_share: float = Field(0.6, gt=0, lt=1, description="share of the cover thereabouts at which canopy ends")
    min_gap: Metres = Field(0.8, description="length without canopy that is a gap (m)")


class JudgingOptions(Options):
    """What is a row, and what isn't."""

    min_confidence: Share = Field(0.45, description="confidence below which it is none, but stands in unmapped")


class MissingOptions(Options):
    """Missing vines."""

    vine_spacing: float | None = Field(None, ge=0.3, le=5, description="distance of vines (m); none: estimated")


class SectionOptions(Options):
    """Sections across the rows."""

    width: float = Field(0.4, ge=0.05, le=2, description="extent a along the row (m)")
    step: float = Field(0.25, ge=0.05, le=5, description="distance b along the row (m)")
    min_points: int = Field(45, ge=0, le=1000, description="canopy points for which sections are widened")
    max_width: float = Field(10.0, ge=0.05, le=50, description="extent to which they may be (m)")


class CanopyOptions(Options):
    """Canopy told from terrain."""

    margin: float = Field(
        0.4, ge=0, le=2, description="height above plane and terrain at which canopy begins, as a rule (m)"
    )
    half_width: float | None = Field(
        None, gt=0, le=100, description="distance from γ at which canopy ends (m); none: what holds the row's"
    )
    min_neighbours: Share = Field(0.02, description="share of a section's points around a point that isn't noise")
    min_points: int = Field(8, ge=3, description="canopy points of a section")
    min_share: Share = Field(0.15, description="share of the median section's points that a section has")
    min_height: float = Field(0.8, ge=0, le=5, description="height of a section's highest tenth, less in low rows (m)")


class PolygonOptions(Options):
    """Minimum-area polygons."""

    c: int = Field(7, ge=5, le=30, description="vertices of a section's polygon")
    share: float = Field(0.02, ge=0, le=0.5, description="share of a section's points that is peeled off")
    foot: Literal["foliage", "soil"] = Field("foliage", description="where v1, v2 and vc stand; the thesis's: soil")


class ProductOptions(Options):
    """What a product holds beside the usual."""

    classified: bool = Field(default=False, description="the cloud with a class and a row for every point, as LAZ")
    plain: bool = Field(default=False, description="meshes for readers of glTF that know no extension: larger files")
    audit: bool = Field(default=False, description="meshes checked by Open3D, and a warning for each that has a flaw")
    geoid: float | None = Field(
        None,
        ge=-120,
        le=120,
        description="height of the geoid above the ellipsoid, added on the globe (m); none: PROJ's grids, else 0",
    )


class OdometryOptions(Options):
    """Visual odometry."""

    template_share: float = Field(0.2, gt=0, le=0.8, description="width of the template, of the images' shorter side")
    turn_deg: float = Field(9.0, ge=1, le=90, description="largest turn from a frame to the next, beyond the usual (°)")
    method: Literal["aligned", "quadratic", "centroid", "maximum"] = Field(
        "aligned", description="how steps are refined: ours, two of less, or the standard's bare maximum"
    )


class Settings(Options):
    """Settings of every stage."""

    reading: ReadingOptions = ReadingOptions()
    ground: GroundOptions = GroundOptions()
    cover: CoverOptions = CoverOptions()
    row_field: RowFieldOptions = RowFieldOptions()
    key_points: KeyPointOptions = KeyPointOptions()
    clustering: ClusteringOptions = ClusteringOptions()
    rows: KnownRowOptions = KnownRowOptions()
    curves: CurveOptions = CurveOptions()
    fit: FitOptions = FitOptions()
    judging: JudgingOptions = JudgingOptions()
    missing: MissingOptions = MissingOptions()
    sections: SectionOptions = SectionOptions()
    canopy: CanopyOptions = CanopyOptions()
    polygon: PolygonOptions = PolygonOptions()
    product: ProductOptions = ProductOptions()
