"""The camera of a robot that looks straight down, and how it is mounted."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

import numpy as np
from pydantic import Field, model_validator

from vinemap.config.settings import Options

if TYPE_CHECKING:
    from vinemap.compute.arrays import Values

LENS_TERMS = (0, 4, 5, 8)
NARROWEST, WIDEST = 2.0, 150.0
"""Degrees across which a camera sees."""
UNSQUARE = 0.02
"""How much the two focal lengths may differ, as a share: templates are turned in pixels."""
Pixels = Annotated[int, Field(ge=32, le=20_000)]
Corner = tuple[float, float]
LensTerm = Annotated[float, Field(ge=-200, le=200)]


class Camera(Options):
    """A robot's camera that looks straight down, and how it is mounted."""

    width: Pixels = Field(description="width of its images (pixels)", examples=[320])
    height: Pixels = Field(description="height of its images (pixels)", examples=[240])
    fx: float = Field(gt=0, le=1_000_000, description="focal length along the width (pixels)", examples=[299.43])
    fy: float = Field(gt=0, le=1_000_000, description="focal length along the height (pixels)", examples=[299.41])
    cx: float | None = Field(None, ge=0, le=20_000, description="column of the optical axis (pixels); none: the middle")
    cy: float | None = Field(None, ge=0, le=20_000, description="row of the optical axis (pixels); none: the middle")
    distortion: tuple[LensTerm, ...] = Field(
        (), description="OpenCV's k1, k2, p1, p2, k3 (to k6) of the lens; none: a pinhole"
    )
    above_ground_mm: float = Field(
        ge=10, le=20_000, description="height of the lens above the ground (mm)", examples=[245]
    )
    x_mm: float = Field(0.0, ge=-20_000, le=20_000, description="place of the lens ahead of the robot's centre (mm)")
    y_mm: float = Field(0.0, ge=-20_000, le=20_000, description="place of the lens left of the robot's centre (mm)")
    turned_deg: float = Field(
        0.0, ge=-360, le=360, description="from straight ahead anticlockwise to where the images' right edge is (°)"
    )
    mask: tuple[Annotated[tuple[Corner, ...], Field(min_length=3)], ...] = Field(
        (),
        description="polygons of (column, row) in which images show no ground: parts of the robot, text; none: all do",
    )

    @model_validator(mode="after")
    def _sees(self) -> Camera:
        for name, size, focal in (("fx", self.width, self.fx), ("fy", self.height, self.fy)):
            across = np.degrees(2 * np.arctan(size / 2 / focal))
            if not NARROWEST <= across <= WIDEST:
                raise ValueError(f"{name} ({focal:g}) with {size} pixels makes {across:.1f}°: is it in pixels?")
        if abs(self.fx / self.fy - 1) > UNSQUARE:
            raise ValueError(f"fx ({self.fx:g}) and fy ({self.fy:g}) differ: pixels must be square")
        if not (0 <= self.axis[0] < self.width and 0 <= self.axis[1] < self.height):
            raise ValueError(f"cx, cy ({self.axis[0]:g}, {self.axis[1]:g}) lie outside of the image")
        if len(self.distortion) not in LENS_TERMS:
            raise ValueError(f"distortion {list(self.distortion)} must be 4, 5 or 8 numbers of OpenCV, or none")
        corners = np.array([corner for polygon in self.mask for corner in polygon]).reshape(-1, 2)
        if np.any((corners < -1) | (corners > [self.width, self.height])):
            raise ValueError(f"mask reaches beyond the image's {self.width} × {self.height} pixels: give column, row")
        return self

    @property
    def axis(self) -> tuple[float, float]:
        """Column and row where the optical axis meets the image; whole numbers are pixels' centres."""
        return (
            (self.width - 1) / 2 if self.cx is None else self.cx,
            (self.height - 1) / 2 if self.cy is None else self.cy,
        )

    @property
    def matrix(self) -> Values:
        """Intrinsic matrix (3, 3) of OpenCV."""
        return np.array([[self.fx, 0, self.axis[0]], [0, self.fy, self.axis[1]], [0, 0, 1.0]])

    @property
    def to_robot(self) -> Values:
        """Matrix (2, 3) from (column, row, 1) in an image to x forward and y to the left in mm (Eq. 2)."""
        c, s = np.cos(np.radians(self.turned_deg)), np.sin(np.radians(self.turned_deg))
        gx, gy = self.above_ground_mm / self.fx, self.above_ground_mm / self.fy
        turn = np.array([[c, -s], [s, c]]) @ np.diag([gx, -gy])
        return np.column_stack([turn, np.array([self.x_mm, self.y_mm]) - turn @ self.axis])

    def ground(self, column: float, row: float) -> Values:
        """Place (2,) in the robot's frame in mm of a point of the image."""
        return np.asarray(self.to_robot @ np.array([column, row, 1.0]))

    def pixel(self, x_mm: float, y_mm: float) -> Values:
        """Column and row (2,) of a place in the robot's frame: the inverse of :meth:`ground`."""
        return np.asarray(np.linalg.solve(self.to_robot[:, :2], np.array([x_mm, y_mm]) - self.to_robot[:, 2]))
