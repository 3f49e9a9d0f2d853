"""How well odometry measures on simulated frames, whose movement is known: ``python -m vinemap.odometry_accuracy``.

Tables 4.3 and 4.4 of the thesis, its Fig. 4.11, the error gathered along its paths, and what happens when lost.
"""

from __future__ import annotations

import time
from itertools import pairwise
from typing import TYPE_CHECKING, NamedTuple

import click
import numpy as np

from vinemap.odometry import estimate_motion
from vinemap.poses import Pose, moved, onward
from vinemap.tables import as_text
from vinemap.virtual_camera import (
    HIGH,
    LOW,
    MADE,
    PHOTOGRAPHS,
    Ground,
    lay_ground,
    render,
    rough,
    sinusoid,
    wander,
)

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from numpy.typing import NDArray

    from vinemap.camera import Camera
    from vinemap.odometry import Method
    from vinemap.virtual_camera import Image

    Array = NDArray[np.floating]

ROOM = (1000.0, 1000.0)
"""Millimetres of ground for robots that wander."""
FAILURE = 5.0
"""Millimetres from which on a step is wrong."""
METHODS: tuple[Method, ...] = ("maximum", "centroid", "quadratic", "aligned")
NAMES = {"maximum": "standard"}
SHARES = (0.05, 0.1, 0.2, 0.35, 0.5, 0.65, 0.8)
PATHS = 20


class Errors(NamedTuple):
    """What is wrong with the steps of a ground by a method."""

    place: Array
    """Error (n,) of the template's place in mm (Eq. 13)."""
    turn: Array
    """Error (n,) of the rotation in degrees (Eq. 14)."""
    flagged: Array
    seconds: Array

    def cep(self) -> float:
        """Circular error probable: half of the steps are better."""
        return float(np.median(self.place))


Step = tuple["Image", "Image", Pose]


def steps_of(ground: Ground, poses: Sequence[Pose], *, camera: Camera = LOW, seed: int = 0) -> Iterator[Step]:
    """Frames of the poses of a path, pair by pair, each with the true movement."""
    frames = (render(ground, pose, camera=camera, seed=seed + k) for k, pose in enumerate(poses))
    for pair, step in zip(pairwise(frames), pairwise(poses), strict=True):
        yield *pair, moved(*step)


def template_error(movement: Pose, truth: Pose, camera: Camera) -> float:
    """Millimetres in the next frame from where the middle of a frame is found to where it is."""
    x, y = camera.ground(camera.width // 2, camera.height // 2)
    middle = Pose(x, y, 0.0)
    found, true = (moved(step, middle) for step in (movement, truth))
    return float(np.hypot(found.x_mm - true.x_mm, found.y_mm - true.y_mm))


def measure(steps: Iterator[Step], methods: Sequence[Method], *, camera: Camera = LOW) -> dict[Method, Errors]:
    """Errors of methods on the same steps."""
    found: dict[Method, list[tuple[float, float, bool, float]]] = {method: [] for method in methods}
    for frame, next_frame, truth in steps:
        for method, errors in found.items():
            began = time.perf_counter()
            motion = estimate_motion(frame, next_frame, camera=camera, method=method)
            took = time.perf_counter() - began
            off = template_error(motion.movement, truth, camera), abs(motion.rotation_deg - truth.heading_deg)
            errors.append((*off, motion.flag != "", took))
    return {method: Errors(*np.transpose(errors)) for method, errors in found.items()}


def terrains(steps: int) -> str:
    """Tables 4.3 and 4.4: a line a ground, and those of grass with relief."""
    cases = [(name, 0.0) for name in (*PHOTOGRAPHS, *MADE)] + [("grass", 8.0), ("grass", 25.0)]
    place = [["ground", *(f"{NAMES.get(m, m)}: {what}" for m in METHODS for what in ("CEP mm", "σ mm")), "better: %"]]
    turn = [["ground", *(f"{NAMES.get(m, m)}: {what}" for m in METHODS for what in ("mean °", "σ °")), "better: %"]]
    lost = [["ground", "wrong: steps", "flagged: of these", "flagged: of the right", "of: steps"]]
    for name, relief in cases:
        ground = lay_ground(name, size_mm=ROOM, seed=1)
        if relief:
            ground = rough(ground, amplitude_mm=relief, correlation_mm=30.0, seed=1)
        errors = measure(steps_of(ground, wander(steps + 1, seed=2)), METHODS)
        label = f"{name}, relief {relief:g} mm" if relief else name
        right = {m: e.place < FAILURE for m, e in errors.items()}
        ceps = [e.cep() for e in errors.values()]
        sigmas = [float(e.place[right[m]].std()) for m, e in errors.items()]
        means = [float(e.turn[right[m]].mean()) for m, e in errors.items()]
        spreads = [float(e.turn[right[m]].std()) for m, e in errors.items()]
        place.append([label, *_woven(ceps, sigmas), f"{100 * (1 - ceps[-1] / ceps[0]):.0f}"])
        turn.append([label, *_woven(means, spreads), f"{100 * (1 - means[-1] / means[0]):.0f}"])
        flagged, good = errors["aligned"].flagged.astype(bool), right["aligned"]
        counts = (~good).sum(), (flagged & ~good).sum(), (flagged & good).sum(), steps
        lost.append([label, *map(str, counts)])
    title = "Place of the template (Table 4.3)", "Rotation (Table 4.4)", f"Lost: errors above {FAILURE:g} mm"
    return "\n\n".join(f"{head}\n{as_text(lines)}" for head, lines in zip(title, (place, turn, lost), strict=True))


def times(repeats: int) -> str:
    """Fig. 4.11: time of a pair and highest speed against the size of the template."""
    lines = [
        ["template", *(f"{size}: {what}" for size in ("320 × 240", "1280 × 720") for what in ("ms", "most mm", "m/s"))]
    ]
    ground = lay_ground("gravel", size_mm=ROOM, seed=1)
    pairs = {c: [render(ground, p, camera=c, seed=k) for k, p in enumerate(wander(2, seed=3))] for c in (LOW, HIGH)}
    for share in SHARES:
        cells = []
        for camera, pair in pairs.items():
            took = _fastest(pair, camera, share, repeats)
            most = (1 - share) / 2 * camera.height * camera.above_ground_mm / camera.fy
            cells += [f"{1000 * took:.1f}", f"{most:.0f}", f"{most / 1000 / took:.1f}"]
        lines.append([f"{share:g}", *cells])
    began = time.perf_counter()
    estimate_motion(*pairs[LOW], camera=LOW, search="exhaustive")
    whole = f"Exhaustive search, 320 × 240, template 0.2: {1000 * (time.perf_counter() - began):.1f} ms"
    title = "Time of a pair, and highest speed at which the template stays in the next frame (Fig. 4.11)"
    return f"{title}\n{as_text(lines)}\n{whole}"


def paths(count: int) -> str:
    """Error gathered along the thesis's sinusoidal path, over the length travelled."""
    poses = sinusoid()
    length = sum(np.hypot(*moved(*step)[:2]) for step in pairwise(poses)) / 1000
    lines = [["method", "translation: mm/m", "its worst", "heading: °/m", "its worst"]]
    gathered: dict[Method, list[tuple[float, float]]] = {method: [] for method in METHODS}
    names = (*PHOTOGRAPHS, *MADE)
    shifted = [Pose(pose.x_mm - 5750.0, pose.y_mm, pose.heading_deg) for pose in poses]
    for k in range(count):
        ground = lay_ground(names[k % len(names)], size_mm=(10300.0, 1100.0), seed=100 + k)
        tracks = {method: [shifted[0]] for method in METHODS}
        for frame, next_frame, _ in steps_of(ground, shifted, seed=1000 * k):
            for method, track in tracks.items():
                motion = estimate_motion(frame, next_frame, camera=LOW, method=method)
                track.append(onward(track[-1], motion.movement))
        for method, track in tracks.items():
            off = moved(shifted[-1], track[-1])
            gathered[method].append((float(np.hypot(*off[:2])) / length, abs(off[2]) / length))
    for method, errors in gathered.items():
        place, turn = np.transpose(errors)
        cells = [f"{value:.3f}" for value in (place.mean(), place.max(), turn.mean(), turn.max())]
        lines.append([NAMES.get(method, method), *cells])
    return f"Error at the end of {count} paths of {length:.1f} m, over their length (Fig. 4.8)\n{as_text(lines)}"


def _woven(values: Sequence[float], spreads: Sequence[float]) -> list[str]:
    return [f"{number:.3f}" for pair in zip(values, spreads, strict=True) for number in pair]


def _fastest(pair: Sequence[Image], camera: Camera, share: float, repeats: int) -> float:
    """Median seconds of a pair."""
    took = []
    for _ in range(repeats):
        began = time.perf_counter()
        estimate_motion(*pair, camera=camera, template_share=share)
        took.append(time.perf_counter() - began)
    return float(np.median(took))


@click.command(context_settings={"help_option_names": ["-h", "--help"]})
@click.option("--steps", type=click.IntRange(2), default=300, show_default=True, help="Pairs of frames a ground.")
@click.option("--paths", "count", type=click.IntRange(0), default=PATHS, show_default=True, help="Paths of 9.6 m.")
def command(steps: int, count: int) -> None:
    """Measure odometry on simulated frames, on one core."""
    import cv2

    cv2.setNumThreads(1)
    click.echo(terrains(steps))
    click.echo(f"\n{times(9)}")
    if count:
        click.echo(f"\n{paths(count)}")


if __name__ == "__main__":
    command()
