"""A scene in Open3D's viewer, or as a picture where there is no screen.

Open3D draws in a process of its own, in which numba isn't: the compilers of numba and of the software that draws where
there is no graphics card are both LLVM, and wait for each other for ever.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

import numpy as np

from vinemap.compute.extras import load
from vinemap.compute.processes import python
from vinemap.errors import DependencyError
from vinemap.product.store import unwritable

if TYPE_CHECKING:
    from vinemap.view.scene import Scene

SIZE = 1600, 1000
"""Pixels of the window and of the picture."""
TITLE = "vinemap"
STEEP, ZOOM = 0.7, 0.6
"""How much a picture looks down, and Open3D's zoom."""
THICK = 0.06
"""Metres to each side that the ribbons of rows are wide."""
LINE, MESH = (0.80, 0.10, 0.45), (0.16, 0.42, 0.13)
"""RGB of rows, and of meshes."""
SUN = np.array([-0.5, -0.4, 0.77])
"""Where the light comes from."""
LONGEST = 300.0
"""Seconds in which a picture must be drawn."""
DRAW = "from vinemap.view.window import draw; draw()"
"""What the process of its own runs."""


def has_screen() -> bool:
    """Whether a window can be opened."""
    return sys.platform in ("win32", "darwin") or bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))


def show(scene: Scene, png: Path | None = None) -> None:
    """Open a window on a scene until it is closed, or write a picture of it.

    Raises
    ------
    DependencyError
        If Open3D can draw nothing here.
    OutputError
        If the picture can't be written.
    """
    if png:
        try:
            png.parent.mkdir(parents=True, exist_ok=True)
            png.touch()
        except OSError as error:
            raise unwritable(png, error) from error
    with tempfile.TemporaryDirectory() as folder:
        held = Path(folder) / "scene"
        with held.open("wb") as stream:
            vertices, faces = _ribbons(scene)
            np.savez(
                stream, **scene._replace(rows=[])._asdict(), row_vertices=vertices, row_faces=faces, look=_way(scene)
            )
        command = python(DRAW, str(held), *([str(png)] if png else []))
        try:
            most = LONGEST if png else None
            drawn = subprocess.run(command, check=False, capture_output=True, timeout=most)  # noqa: S603 - our own
            failed = drawn.returncode != 0
        except subprocess.TimeoutExpired:
            failed = True
    if failed:
        if png and png.stat().st_size == 0:
            png.unlink()
        raise DependencyError(
            "Open3D can't draw here: it wants a screen, or for a picture apt-get install libegl1 libgl1"
        )


def draw() -> NoReturn:
    """Be the process that draws what the file of its first argument holds, to that of its second or on the screen."""
    with np.load(sys.argv[1]) as arrays:
        sys.exit(not _draw(dict(arrays), sys.argv[2] if len(sys.argv) > 2 else None))


def _draw(held: dict[str, Any], png: str | None) -> bool:
    """Draw what is held of a scene; whether that was possible."""
    open3d = load("open3d")
    window = open3d.visualization.Visualizer()
    width, height = SIZE
    if not window.create_window(window_name=TITLE, width=width, height=height, visible=png is None):
        return False
    option = window.get_render_option()
    option.background_color, option.point_size, option.mesh_show_back_face = np.ones(3), 2.0, True
    for shape in _shapes(open3d, held):
        window.add_geometry(shape)
    view = window.get_view_control()
    shown = np.concatenate([held[name] for name in ("points", "vertices", "row_vertices")])
    view.set_lookat((shown.min(axis=0) + shown.max(axis=0)) / 2 if len(shown) else np.zeros(3))
    view.set_up(np.array([0.0, 0.0, 1.0]))
    view.set_front(held["look"])
    view.set_zoom(ZOOM)
    if png is None:
        window.run()
        return True
    window.poll_events()
    window.update_renderer()
    picture = np.asarray(window.capture_screen_float_buffer(do_render=True))
    image = open3d.geometry.Image(np.ascontiguousarray((255 * picture).astype(np.uint8)))
    return bool(open3d.io.write_image(png, image))


def _shapes(open3d: Any, held: dict[str, Any]) -> list[Any]:
    """Points, rows and meshes, those that there are, as Open3D has them."""
    vectors, corners = open3d.utility.Vector3dVector, open3d.utility.Vector3iVector
    found = []
    if len(held["points"]):
        points = open3d.geometry.PointCloud(vectors(held["points"]))
        points.colors = vectors(held["colours"])
        found.append(points)
    for vertices, faces, colour in (
        (held["vertices"], held["faces"], MESH),
        (held["row_vertices"], held["row_faces"], LINE),
    ):
        if len(faces):
            mesh = open3d.geometry.TriangleMesh(vectors(vertices), corners(faces.astype(np.int32)))
            mesh.compute_vertex_normals()
            light = 0.6 + 0.4 * np.clip(np.asarray(mesh.vertex_normals) @ SUN, -0.5, 1)
            mesh.vertex_colors = vectors(light[:, None] * colour)
            found.append(mesh)
    return found


def _ribbons(scene: Scene) -> tuple[Any, Any]:
    """Rows as flat ribbons: vertices and faces."""
    vertices, faces, first = [np.empty((0, 3))], [np.empty((0, 3), dtype=int)], 0
    for line in scene.rows:
        way = np.gradient(line[:, :2], axis=0)
        aside = np.column_stack([-way[:, 1], way[:, 0], np.zeros(len(line))])
        aside *= THICK / np.maximum(np.linalg.norm(aside, axis=1, keepdims=True), 1e-9)
        vertices.append(np.stack([line + aside, line - aside], axis=1).reshape(-1, 3))
        k = first + 2 * np.arange(len(line) - 1)[:, None]
        faces += [k + np.array(corners) for corners in ((0, 1, 2), (1, 3, 2))]
        first += 2 * len(line)
    return np.concatenate(vertices), np.concatenate(faces)


def _way(scene: Scene) -> Any:
    """Where a picture is seen from: aside of the rows, half from above, and from the south as far as that goes."""
    ways = [line[-1, :2] - line[0, :2] for line in scene.rows]
    way = max(ways, key=lambda one: float(np.linalg.norm(one))) if ways else np.array([1.0, 0.0])
    aside = np.array([way[1], -way[0]]) / max(float(np.linalg.norm(way)), 1e-9)
    aside = -aside if aside[1] > 0 else aside
    front = np.append(0.5 * aside + 0.8 * np.array([-aside[1], aside[0]]), STEEP)
    return front / np.linalg.norm(front)
