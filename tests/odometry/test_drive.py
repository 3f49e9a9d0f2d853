"""A drive from its recording to the GeoPackage, as a user makes it."""

from itertools import pairwise

import cv2
import geopandas as gpd
import numpy as np
import pyogrio
import pytest
import shapely
from commands import vinemap
from drives import images, poses
from pyproj import Geod

from vinemap.config.camera import Camera
from vinemap.config.drives import Start
from vinemap.errors import InputError, OutputError
from vinemap.odometry.drive import map_drive
from vinemap.odometry.layers import TRACK_LAYERS
from vinemap.odometry.poses import Pose, moved
from vinemap.simulate.camera import LOW

N = 12
START = Start(44.61167, 7.92442, 72.5)
FILE = "\n".join(f"{key}: {value}" for key, value in LOW.model_dump(exclude_defaults=True).items())


@pytest.fixture(scope="module")
def robot():
    return poses(N, turn=2)


@pytest.fixture(scope="module")
def recording(robot, tmp_path_factory):
    folder = tmp_path_factory.mktemp("frames")
    for k, image in enumerate(images(robot)):
        cv2.imwrite(str(folder / f"{1778745600 + k / 4:.2f}.png"), image)
    return folder


@pytest.fixture(scope="module")
def rows(tmp_path_factory):
    """Two rows 2.5 m apart, the start 1 m to the right of the first, in Gauss–Boaga: not the track's own CRS."""
    geod, lines = Geod(ellps="WGS84"), []
    for left in (1.0, -1.5):
        ends = []
        for along in (-10.0, 20.0):
            lon, lat, _ = geod.fwd(START.lon, START.lat, START.heading_deg, along)
            ends.append(geod.fwd(lon, lat, START.heading_deg - 90, left)[:2])
        lines.append(shapely.LineString(ends))
    frame = gpd.GeoDataFrame({"label": ["7 F", "8 F"]}, geometry=lines, crs=4326)
    path = tmp_path_factory.mktemp("rows") / "rows.gpkg"
    frame.to_crs(3003).to_file(path, layer="rows")
    return path


def test_a_track_lies_where_the_robot_drove(recording, robot, rows, tmp_path):
    out = tmp_path / "track.gpkg"
    summary = map_drive([recording], out, camera=LOW, start=START, rows=rows)
    length = sum(np.hypot(*moved(*pair)[:2]) for pair in pairwise(robot)) / 1000
    assert summary.line() == f"{out}: {length:.2f} m in {N} frames"
    found = gpd.read_file(out, layer="poses")
    assert found.crs.to_epsg() == 3003
    geod = Geod(ellps="WGS84")
    for true, pose in zip(robot, found.itertuples(), strict=True):
        known = moved(robot[0], true)
        away = np.degrees(np.arctan2(known.y_mm, known.x_mm))
        lon, lat, _ = geod.fwd(START.lon, START.lat, START.heading_deg - away, np.hypot(*known[:2]) / 1000)
        assert abs(geod.inv(lon, lat, pose.lon, pose.lat)[2]) < 0.001
        assert pose.heading_deg == pytest.approx((START.heading_deg - known.heading_deg) % 360, abs=0.06)
        assert np.hypot(pose.x_m, pose.y_m) * 1000 == pytest.approx(np.hypot(*known[:2]), abs=0.8)
        assert pose.row == "7 F"
        assert pose.row_distance_m == pytest.approx(1 - known.y_mm / 1000, abs=0.003)
        assert pose.row_position_m == pytest.approx(10 + known.x_mm / 1000, abs=0.01)
    on_the_map = found.to_crs(4326).geometry
    assert on_the_map.y.to_numpy() == pytest.approx(found["lat"].to_numpy(), abs=1e-8)
    assert (found["time"].dt.tz_convert("UTC") - found["time"].iloc[0]).dt.total_seconds().tolist() == list(
        np.arange(N) / 4
    )
    assert found["time"].iloc[0].isoformat() == "2026-05-14T08:00:00+00:00"
    track = gpd.read_file(out, layer="track")
    assert len(track) == 1
    assert track.geometry[0].length == pytest.approx(track["length_m"][0], rel=5e-4)
    assert track["seconds"][0] == pytest.approx((N - 1) / 4)


def test_a_track_without_a_start_goes_north_from_nothing(recording, robot, tmp_path):
    out = tmp_path / "track.gpkg"
    map_drive([recording], out, camera=LOW)
    found = gpd.read_file(out, layer="poses")
    end = moved(robot[0], robot[-1])
    assert (found["x_m"].iloc[-1], found["y_m"].iloc[-1]) == pytest.approx(
        (-end.y_mm / 1000, end.x_mm / 1000), abs=1e-3
    )
    assert found["lat"].isna().all()
    assert found["row_distance_m"].isna().all()
    assert set(found["row"]) == {""}
    assert not (found.crs and (found.crs.is_projected or found.crs.is_geographic))


def test_the_geopackage_keeps_its_contract(recording, tmp_path):
    paths = [tmp_path / name for name in ("one.gpkg", "two.gpkg")]
    for path in paths:
        map_drive([recording], path, camera=LOW, start=START)
    assert paths[0].read_bytes() == paths[1].read_bytes()
    layers = {str(name): str(kind) for name, kind in pyogrio.list_layers(paths[0])}
    assert {name: layer.geometry for name, layer in TRACK_LAYERS.items()} == {
        name: layers[name] for name in TRACK_LAYERS
    }
    for name, layer in TRACK_LAYERS.items():
        assert pyogrio.read_info(paths[0], layer=name)["fields"].tolist() == list(layer.columns)
    map_drive([recording], paths[0], camera=LOW, start=START)  # in place of an earlier track
    assert sorted(path.name for path in tmp_path.iterdir()) == ["one.gpkg", "two.gpkg"]


def test_a_band_of_two_standard_deviations_lies_about_the_track(recording, tmp_path):
    out, coarse = tmp_path / "track.gpkg", LOW.model_copy(update={"above_ground_mm": 2450.0})
    map_drive([recording], out, camera=coarse, start=START)
    found, band = (gpd.read_file(out, layer=name) for name in ("poses", "band"))
    heading = found.set_index("pose")["sd_heading_deg"]
    assert (heading.iloc[1:].to_numpy() > heading.loc[found["measured_from"][1:]].to_numpy()).all()
    assert found["sd_m"][0] == 0
    assert found["sd_m"][1] < found["sd_m"].iloc[-1] < 0.002
    assert found["height_mm"].to_numpy() == pytest.approx(2450, abs=5)
    assert len(band) == 1
    assert band.contains(found.geometry.iloc[-1]).all()
    assert band["width_m"][0] == pytest.approx(4 * found["sd_m"].max())
    ahead = found.geometry.iloc[-1].distance(band.boundary[0])
    assert ahead == pytest.approx(2 * found["sd_m"].iloc[-1], rel=0.1)


def test_other_sensors_go_along(recording, robot, tmp_path):
    wheels, known = tmp_path / "wheels.csv", tmp_path / "fixes.csv"
    begun = 1778745600
    wheels.write_text("time,speed_m_s\n" + "".join(f"{begun + k / 4},0.18\n" for k in range(-1, N + 1)))
    end = moved(robot[0], robot[-1])
    away = START.heading_deg - np.degrees(np.arctan2(end.y_mm, end.x_mm))
    lon, lat, _ = Geod(ellps="WGS84").fwd(START.lon, START.lat, away, np.hypot(*end[:2]) / 1000 + 0.05)
    last = f"{begun + (N - 1) / 4},{lat!r},{lon!r},0.001\n"
    known.write_text(f"time,lat,lon,accuracy_m\n{begun},{START.lat},{START.lon},0.001\n{last}")
    out = tmp_path / "track.gpkg"
    summary = map_drive([recording], out, camera=LOW, start=START, motion=wheels, fixes=known)
    assert "wheels say +13% of the way" in summary.line()
    known.write_text(f"time,lat,lon,accuracy_m\n{begun},{START.lat},{START.lon},1\n{last}{begun + 1},45,9,0.1\n")
    summary = map_drive([recording], out, camera=LOW, start=START, fixes=known)
    assert "1 of 3 fixes left out" in summary.line()
    found = gpd.read_file(out, layer="poses").iloc[-1]
    assert abs(Geod(ellps="WGS84").inv(lon, lat, found["lon"], found["lat"])[2]) < 0.005
    wheels.write_text(
        f"time,speed_m_s\n{begun - 1},1.8\n{begun},1.8\n{begun + 1},1.8\n{begun + 2},1.8\n{begun + 3},1.8\n"
    )
    for options, says in [
        ({"motion": wheels}, "of the way that frames show: is the unit"),
        ({"fixes": known, "start": None}, "fixes need a start"),
    ]:
        with pytest.raises(InputError, match=says):
            map_drive([recording], out, camera=LOW, **{"start": START} | options)


def test_a_gap_is_crossed_by_what_lies_behind_it_too(tmp_path):
    robot = [Pose(-1600 + 25 * k + 0.5 * k**2, 0.0, 0.0) for k in range(32)]  # it goes faster and faster
    for k, image in enumerate(images(robot)):
        lost = 12 <= k < 18
        cv2.imwrite(str(tmp_path / f"{1778745600 + k / 4:.2f}.png"), np.zeros_like(image) if lost else image)
    summary = map_drive([tmp_path], tmp_path / "track.gpkg", camera=LOW, start=START)
    assert (summary.n_stretches, summary.flags["blank"]) == (2, 6)
    found = gpd.read_file(tmp_path / "track.gpkg", layer="poses")
    way = np.hypot(found["x_m"], found["y_m"]).to_numpy()
    assert way[[11, 15, 18, 31]] == pytest.approx([(robot[k].x_mm + 1600) / 1000 for k in (11, 15, 18, 31)], abs=0.003)
    assert found["sd_m"][18] < 0.02


def test_lost_steps_break_the_line_and_are_told(recording, tmp_path):
    shots = sorted(recording.iterdir())
    (tmp_path / "broken.png").write_bytes(b"\x89PNG")
    black = tmp_path / "black.png"
    cv2.imwrite(str(black), np.zeros((240, 320), np.uint8))
    order = [*shots[:4], tmp_path / "broken.png", *shots[5:8], black, shots[0], *shots[1:4]]
    summary = map_drive(order, tmp_path / "track.gpkg", camera=LOW, start=START)
    assert summary.n_stretches == 2
    assert "1 blank" in summary.line()
    assert "1 unreadable" in summary.line()
    found = gpd.read_file(tmp_path / "track.gpkg", layer="poses")
    assert found["flag"].tolist()[4] == "unreadable"
    assert found["flag"].tolist()[8] == "blank"
    assert found["flag"].tolist()[9] != ""
    assert found["stretch"].tolist() == [1] * 4 + [0] + [1] * 3 + [0] + [2] * 4
    lines = gpd.read_file(tmp_path / "track.gpkg", layer="track")
    assert [len(line.coords) for line in lines.geometry] == [7, 4]


def other_size(folder):
    for k in range(3):
        cv2.imwrite(str(folder / f"{k}.png"), np.zeros((480, 640), np.uint8))


def one_frame(folder):
    cv2.imwrite(str(folder / "1.png"), np.full((240, 320), 90, np.uint8))


def broken(folder):
    for k in range(3):
        (folder / f"{k}.png").write_bytes(b"\x89PNG")


def black(folder):
    for k in range(3):
        cv2.imwrite(str(folder / f"{k}.png"), np.zeros((240, 320), np.uint8))


@pytest.mark.parametrize(
    ("make", "says"),
    [
        (black, r"none of 3 frames could be measured from another \(blank\)"),
        (one_frame, "one frame alone shows no movement: give two at least"),
        (other_size, "3 of 3 frames don't have the camera's 320 × 240 pixels"),
        (broken, "3 of 3 frames can't be read"),
    ],
)
def test_frames_without_a_movement_leave_nothing(make, says, tmp_path):
    folder = tmp_path / "frames"
    folder.mkdir()
    make(folder)
    with pytest.raises(InputError, match=says):
        map_drive([folder], tmp_path / "track.gpkg", camera=LOW)
    assert not list(tmp_path.glob("*.gpkg"))


def test_what_is_there_stays(recording, rows, tmp_path):
    (tmp_path / "text.gpkg").write_text("mine")
    gpd.GeoDataFrame(geometry=[shapely.Point(0, 0)], crs=32632).to_file(tmp_path / "poses.gpkg", layer="poses")
    for out, says in [
        (rows, "holds"),
        (tmp_path / "text.gpkg", "isn't a track"),
        (tmp_path / "poses.gpkg", "holds other layers"),
        (tmp_path / "track.shp", "ends in .gpkg"),
        (tmp_path / "nowhere" / "track.gpkg", "its folder isn't there"),
    ]:
        with pytest.raises(OutputError, match=says):
            map_drive([recording], out, camera=LOW, start=START, rows=rows)
    assert (tmp_path / "text.gpkg").read_text() == "mine"
    assert len(gpd.read_file(rows, layer="rows")) == 2


def test_a_start_elsewhere_is_told(recording, rows, tmp_path):
    with pytest.raises(InputError, match="km from the nearest row: give it as latitude, longitude"):
        map_drive([recording], tmp_path / "a.gpkg", camera=LOW, start=Start(7.92442, 44.61167, 0), rows=rows)
    empty = gpd.GeoDataFrame({"label": ["1"]}, geometry=[shapely.LineString()], crs=32632)
    empty.to_file(tmp_path / "empty.gpkg", layer="rows")
    with pytest.raises(InputError, match="holds no row"):
        map_drive([recording], tmp_path / "a.gpkg", camera=LOW, start=START, rows=tmp_path / "empty.gpkg")
    with pytest.raises(InputError, match="need a start"):
        map_drive([recording], tmp_path / "a.gpkg", camera=LOW, rows=rows)


def test_the_command(recording, rows, tmp_path):
    (tmp_path / "camera.yaml").write_text(FILE)
    args = ("track", recording, "--camera", "camera.yaml", "--rows", rows)
    done = vinemap(*args, "--start", "44.61167,7.92442,72.5", "--method", "quadratic", cwd=tmp_path)
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.startswith("track.gpkg: 0.4")
    assert set(gpd.read_file(tmp_path / "track.gpkg", layer="poses")["row"]) == {"7 F"}


@pytest.mark.parametrize(
    ("args", "says"),
    [
        (["--start", "44.6,7.9"], "isn't latitude, longitude and heading"),
        (["--start", "144.6,7.9,10"], "lies nowhere"),
        (["--start", "44.6,7.9,nan"], "clockwise from north"),
        (["--template-share", "0.01"], "0.01 of 240 pixels: give 0.8 at most"),
        (["--template-share", "0"], "0"),
        (["--camera", "other.yaml"], "other.yaml: no such file"),
        (["--camera", "bad.yaml"], "bad.yaml: fx is missing"),
        (["nothing"], "nothing: no such file or folder"),
    ],
)
def test_what_is_wrong_is_said_in_one_line(recording, tmp_path, args, says):
    (tmp_path / "camera.yaml").write_text(FILE)
    (tmp_path / "bad.yaml").write_text(FILE.replace("fx:", "#"))
    done = vinemap("track", recording, "--camera", "camera.yaml", *args, cwd=tmp_path)
    assert done.returncode == 2
    assert says in done.stderr
    assert len(done.stderr.strip().splitlines()) == 1
    assert not (tmp_path / "track.gpkg").exists()


def test_another_camera_than_the_files_is_seen(recording, tmp_path):
    with pytest.raises(InputError, match="the camera's 640 × 480"):
        map_drive(
            [recording],
            tmp_path / "a.gpkg",
            camera=Camera(**LOW.model_dump() | {"width": 640, "height": 480, "fx": 600.0, "fy": 600.0}),
        )
