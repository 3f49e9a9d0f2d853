"""Frames of a robot's camera over ground that is known, for measuring odometry: every movement in them is exact."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from vinemap.config.camera import Camera
from vinemap.errors import DependencyError, InputError
from vinemap.odometry.poses import Pose
from vinemap.simulate.grounds import MADE, RESOLUTION, noise

if TYPE_CHECKING:
    from vinemap.compute.arrays import Image, Values

LOW = Camera(width=320, height=240, fx=299.4303, fy=299.4122, above_ground_mm=245.0, x_mm=950.0)
HIGH = Camera(width=1280, height=720, fx=888.8749, fy=888.5340, above_ground_mm=245.0, x_mm=950.0)
"""The two cameras of Table 4.1, the size as width × height."""
PHOTOGRAPHS = ("gravel", "grass", "brick")
"""Public domain (CC0) photographs of scikit-image, 512 × 512 pixels."""
RAY = 0.3
"""Millimetres of ground between two rays, at most; the high resolution's pixels have one ray each."""
AMPLITUDE, PERIOD, STEP = 150.0, 3200.0, 61.0
"""Millimetres: of the thesis's sine, and from pose to pose along it."""
PIECE = 256
"""Pixels across each piece of a photograph that grounds are laid of."""


class Ground(NamedTuple):
    """A piece of ground about the origin, x to the right and y up."""

    image: Image
    """Grey levels (ny, nx), :data:`vinemap.simulate.grounds.RESOLUTION` mm apart, the first row at the top."""
    relief: Values | None = None
    """Height above the plane in mm, of the same shape."""


class Weather(NamedTuple):
    """What spoils a frame."""

    noise: float = 3.0
    """Standard deviation in grey levels."""
    light: float = 0.05
    """How much brighter and darker than the middle its edges are, as a share, along a direction that changes."""
    blur: float = 0.0
    """Sigma in pixels."""


WEATHER = Weather()


def lay_ground(ground: str | Path, *, size_mm: tuple[float, float], seed: int = 0) -> Ground:
    """Ground, wide and high, of a name of :data:`PHOTOGRAPHS` or of those that are made, or of a photograph's file.

    Photographs are laid as round pieces, each turned and cut at random, so that no place has a copy; where they
    overlap their contrast is kept (Heitz and Neyret 2018, High-performance by-example noise).

    Raises
    ------
    InputError
        If a file isn't an image, or is one of fewer than :data:`PIECE` pixels across.
    """
    rng = np.random.default_rng(seed)
    nx, ny = (round(size / RESOLUTION) for size in size_mm)
    if ground in MADE:
        values = MADE[str(ground)]((ny, nx), rng)
    else:
        photograph = _file(ground) if isinstance(ground, Path) else _photograph(ground)
        values = _pieces(photograph, (ny, nx), rng)
    return Ground(np.clip(np.rint(values), 0, 255).astype(np.uint8))


def rough(ground: Ground, *, amplitude_mm: float, correlation_mm: float, seed: int = 0) -> Ground:
    """Ground with hills: from lowest to highest one amplitude, correlated by 1/e at a distance."""
    rng = np.random.default_rng(seed)
    coarse = 8
    shape = tuple(n // coarse + 2 for n in ground.image.shape)
    hills = noise(shape, correlation_mm / 2 / RESOLUTION / coarse, rng)
    hills *= amplitude_mm / np.ptp(hills)
    import cv2

    whole = cv2.resize(hills, ground.image.shape[::-1], interpolation=cv2.INTER_CUBIC)
    return ground._replace(relief=whole - whole.mean())


def render(ground: Ground, pose: Pose, *, camera: Camera = LOW, weather: Weather = WEATHER, seed: int = 0) -> Image:
    """What a robot's camera sees.

    Raises
    ------
    ValueError
        If it sees beyond the ground.
    """
    import cv2

    rng = np.random.default_rng(seed)
    rays = _rays(camera)
    columns, rows = _seen(ground, pose, camera, rays, np.zeros((1, 1)))
    ny, nx = ground.image.shape
    if min(columns.min(), rows.min()) < 1 or columns.max() > nx - 2 or rows.max() > ny - 2:
        raise ValueError(f"The camera sees beyond the ground at {pose}")
    if ground.relief is not None:
        for _ in range(4):  # where rays meet the surface
            height = cv2.remap(ground.relief, columns, rows, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
            columns, rows = _seen(ground, pose, camera, rays, height.astype(np.float32))
    fine = cv2.remap(ground.image, columns, rows, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE).astype(np.float32)
    values = cv2.resize(fine, (camera.width, camera.height), interpolation=cv2.INTER_AREA)
    if weather.blur:
        values = cv2.GaussianBlur(values, (0, 0), weather.blur)
    away = np.radians(25.0)  # the lamps ride with the camera
    x, y = np.linspace(-1, 1, camera.width), np.linspace(-1, 1, camera.height)[:, None]
    light = 1 + weather.light * (x * np.cos(away) + y * np.sin(away)) / np.sqrt(2)
    noisy = values * light + rng.normal(0, weather.noise, values.shape)
    out: Image = np.clip(np.rint(noisy), 0, 255).astype(np.uint8)
    return out


def sinusoid(*, length_mm: float = 9600.0) -> list[Pose]:
    """Poses of a robot that follows a sine from the left to the right, equally far apart along it."""
    x = np.linspace(0, length_mm, 20001)
    wave = 2 * np.pi / PERIOD
    y = AMPLITUDE * np.sin(wave * x)
    along = np.concatenate([[0], np.cumsum(np.hypot(np.diff(x), np.diff(y)))])
    at = np.interp(np.arange(0, along[-1], STEP), along, x)
    headings = np.degrees(np.arctan(AMPLITUDE * wave * np.cos(wave * at)))
    return [Pose(*map(float, pose)) for pose in zip(at, AMPLITUDE * np.sin(wave * at), headings, strict=True)]


def above(place: Values, heading_deg: float) -> Pose:
    """Pose of a robot whose camera, straight ahead of it as ``LOW`` and ``HIGH`` are, is above a place (2,)."""
    a = np.radians(heading_deg)
    x, y = place - LOW.x_mm * np.array([np.cos(a), np.sin(a)])
    return Pose(float(x), float(y), heading_deg)


def wander(n: int, *, seed: int = 0) -> list[Pose]:
    """Poses of a robot whose camera moves at random by up to 70 mm and 9°, and stays within 250 mm of the origin."""
    rng = np.random.default_rng(seed)
    poses: list[Pose] = []
    place, heading = np.zeros(2), 0.0
    while len(poses) < n:
        poses.append(above(place, heading))
        heading += rng.uniform(-9.0, 9.0)
        step = np.full(2, np.inf)
        while np.abs(place + step).max() > 250.0:
            away = rng.uniform(0, 2 * np.pi)
            step = 70.0 * np.sqrt(rng.uniform()) * np.array([np.cos(away), np.sin(away)])
        place = place + step
    return poses


@lru_cache(maxsize=4)
def _rays(camera: Camera) -> tuple[Values, Values]:
    """Directions of a camera's rays, forward and to the left over downward, some for each pixel."""
    import cv2

    n = max(1, round(camera.above_ground_mm / camera.fx / RAY))
    columns = (np.arange(camera.width * n) + 0.5) / n - 0.5
    rows = (np.arange(camera.height * n) + 0.5) / n - 0.5
    points: Values = np.stack(np.meshgrid(columns, rows), axis=-1).reshape(-1, 1, 2)
    if camera.distortion:
        lens = np.array(camera.distortion)
        points = np.asarray(cv2.undistortPoints(points, camera.matrix, lens, P=camera.matrix), float)
    forward, left = (camera.to_robot[:, :2] @ (points[:, 0] - camera.axis).T) / camera.above_ground_mm
    shape = len(rows), len(columns)
    return forward.reshape(shape), left.reshape(shape)


def _seen(
    ground: Ground, pose: Pose, camera: Camera, rays: tuple[Values, Values], height: Values
) -> tuple[Values, Values]:
    """Columns and rows of the ground where rays are at a height."""
    a = np.radians(pose.heading_deg)
    left = camera.above_ground_mm - height
    x, y = camera.x_mm + rays[0] * left, camera.y_mm + rays[1] * left
    ny, nx = ground.image.shape
    columns = (pose.x_mm + x * np.cos(a) - y * np.sin(a)) / RESOLUTION + (nx - 1) / 2
    rows = (ny - 1) / 2 - (pose.y_mm + x * np.sin(a) + y * np.cos(a)) / RESOLUTION
    return columns.astype(np.float32), rows.astype(np.float32)


def _photograph(name: str) -> Values:
    try:
        from skimage import data
    except ImportError as error:
        raise DependencyError(f"The photograph of {name} comes with scikit-image: pip install scikit-image") from error
    photograph: Values = getattr(data, name)().astype(np.float32)
    return photograph


def _file(path: Path) -> Values:
    import cv2

    try:
        image = cv2.imdecode(np.frombuffer(path.read_bytes(), np.uint8), cv2.IMREAD_GRAYSCALE)
    except (OSError, cv2.error) as error:
        why = error.strerror if isinstance(error, OSError) else "it is empty"
        raise InputError(f"Cannot read the photograph {path}: {why}") from error
    if image is None:
        raise InputError(f"Cannot read the photograph {path}: give an image, for example PNG, JPEG or TIFF")
    height, width = image.shape
    if min(height, width) < PIECE:
        raise InputError(f"The photograph {path} has {width} × {height} pixels: give one of {PIECE} at least each way")
    return image.astype(np.float32)


def _pieces(photograph: Values, shape: tuple[int, int], rng: np.random.Generator) -> Values:
    import cv2

    mean, half = photograph.mean(), PIECE // 2
    total, squares = np.zeros((2, shape[0] + 2 * PIECE, shape[1] + 2 * PIECE), np.float32)
    away = np.hypot(*np.mgrid[-half:half, -half:half] + 0.5) / half
    weight = (np.clip(np.cos(np.pi / 2 * np.clip(away, 0, 1)), 0, 1) ** 4).astype(np.float32)
    reach = np.array(photograph.shape[::-1]) - 2 * half
    step = half
    for top in range(0, shape[0] + PIECE, step):
        for left in range(0, shape[1] + PIECE, step):
            centre = half + rng.uniform(0, 1, 2) * reach
            turn = cv2.getRotationMatrix2D(tuple(map(float, centre)), rng.uniform(0, 360), 1.0)
            turn[:, 2] += half - 0.5 - centre
            piece = cv2.warpAffine(
                photograph, turn, (PIECE, PIECE), flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT
            )
            i, j = (int(at + rng.integers(-step // 4, step // 4 + 1)) for at in (top, left))
            where = np.s_[max(i, 0) : i + PIECE, max(j, 0) : j + PIECE]
            cut = np.s_[max(-i, 0) :, max(-j, 0) :]
            room = total[where].shape
            total[where] += (weight * (piece - mean))[cut][: room[0], : room[1]]
            squares[where] += (weight * weight)[cut][: room[0], : room[1]]
    inner = np.s_[PIECE : PIECE + shape[0], PIECE : PIECE + shape[1]]
    out: Values = mean + total[inner] / np.sqrt(squares[inner] + 1e-6)
    return out
