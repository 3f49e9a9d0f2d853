"""Recordings: folders of images and videos, their order, their times, and what is wrong with some of them."""

import os

import cv2
import numpy as np
import pytest
from drives import ground, images, poses

from vinemap.config.camera import Camera
from vinemap.errors import InputError
from vinemap.odometry.frames import read_recording, time_of
from vinemap.odometry.poses import moved
from vinemap.odometry.step import estimate_motion
from vinemap.simulate.camera import LOW, Weather, render

N = 6
NUMBERS = (1, 2, 9, 10, 11, 100)


@pytest.fixture(scope="module", autouse=True)
def quiet():
    """FFmpeg asks once a process how much it may say: here when a video is written, before any is read."""
    os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")


@pytest.fixture(scope="module")
def shots():
    return images(poses(N))


def save(folder, named):
    folder.mkdir(exist_ok=True)
    for name, image in named.items():
        assert cv2.imwrite(str(folder / name), image)
    return folder


def read(*paths, camera=LOW):
    recording = read_recording(paths, camera=camera)
    return list(recording.frames), recording.n_frames


def test_images_come_in_the_order_of_their_numbers(tmp_path, shots):
    folder = save(tmp_path / "a", {f"frame{k}.png": shot for k, shot in zip(NUMBERS, shots, strict=True)})
    (folder / "notes.txt").write_text("not a frame")
    (folder / ".hidden.png").write_bytes(b"")
    frames, count = read(folder)
    assert count == N
    assert [frame.name for frame in frames] == [f"frame{k}.png" for k in NUMBERS]
    assert all(np.array_equal(frame.image, shot) for frame, shot in zip(frames, shots, strict=True))
    assert {frame.time for frame in frames} == {None}


def test_parts_follow_each_other(tmp_path, shots):
    one = save(tmp_path / "z", {"1.png": shots[0], "2.png": shots[1]})
    two = save(tmp_path / "a", {"1.png": shots[2]})
    frames, count = read(one, two, one / "2.png")
    assert [frame.name for frame in frames] == ["1.png", "2.png", "1.png", "2.png"]
    assert count == 4


@pytest.mark.parametrize(
    ("name", "seconds"),
    [
        ("1778745600", 1778745600),
        ("1778745600.25", 1778745600.25),
        ("cam0_1778745600250", 1778745600.25),
        ("1778745600250000", 1778745600.25),
        ("1778745600250000000", 1778745600.25),
        ("20260514T080000", 1778745600),
        ("IMG_20260514_080000_250", 1778745600.25),
        ("2026-05-14T08:00:00.5", 1778745600.5),
        ("frame_000123", None),
        ("20261399_080000", None),
        ("20260514", None),
        ("123456789012", None),
    ],
)
def test_times_in_names(name, seconds):
    assert time_of(name) == (pytest.approx(seconds, abs=1e-3) if seconds else None)


def test_a_time_in_the_image(tmp_path, shots):
    from PIL import Image

    exif = Image.Exif()
    exif.get_ifd(0x8769).update({0x9003: "2026:05:14 08:00:00", 0x9291: "25"})
    path = tmp_path / "DSC_7.jpg"
    Image.fromarray(shots[0]).save(path, exif=exif)
    (frame,), _ = read(path)
    assert frame.time == pytest.approx(1778745600.25, abs=1e-3)


def test_colour_and_16_bits_are_as_good_as_grey(tmp_path, shots):
    colour = cv2.cvtColor(shots[0], cv2.COLOR_GRAY2BGR)
    deep = shots[1].astype(np.uint16) * 16  # as of a sensor of 12 bits
    alpha = cv2.cvtColor(shots[2], cv2.COLOR_GRAY2BGRA)
    frames, _ = read(save(tmp_path / "a", {"1.png": colour, "2.png": deep, "3.png": alpha, "4.tif": deep * 16}))
    assert all(frame.image.dtype == np.uint8 and frame.image.shape == (240, 320) for frame in frames)
    assert np.abs(frames[0].image.astype(int) - shots[0]).max() <= 1
    assert np.corrcoef(frames[1].image.ravel(), shots[1].ravel())[0, 1] > 0.999
    assert frames[1].image.std() > 0.5 * shots[1].std()
    assert np.array_equal(frames[3].image, shots[1])


def test_a_hot_pixel_of_16_bits_blinds_nothing(tmp_path, shots):
    deep = [shot.astype(np.uint16) * 4 for shot in shots[:3]]
    deep[1][7, 7] = 65535
    frames, _ = read(save(tmp_path / "a", {f"{k}.png": image for k, image in enumerate(deep)}))
    assert np.array_equal(frames[2].image, shots[2])


def test_flaws_are_told_frame_by_frame(tmp_path, shots):
    folder = save(tmp_path / "a", {f"{k}.png": shot for k, shot in enumerate(shots)})
    save(folder, {"6.jpg": shots[0], "7.jpg": shots[0]})
    save(folder, {"1.png": np.zeros((480, 640), np.uint8), "8.tif": shots[0].astype(np.float32)})
    for name in ("2.png", "6.jpg"):
        data = (folder / name).read_bytes()
        (folder / name).write_bytes(data[: len(data) // 2])  # decoders would make up the rest
    (folder / "3.png").write_bytes(b"")
    (folder / "4.png").write_bytes(b"IEND" * 100)
    frames, _ = read(folder)
    assert [frame.flaw for frame in frames] == ["", "size", "unreadable", "unreadable", "unreadable", ""] + [
        "unreadable",
        "",
        "unreadable",
    ]
    assert [frame.image is None for frame in frames] == [frame.flaw != "" for frame in frames]


def write_video(path, shots, *, codec="MJPG", rate=10):
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*codec), rate, (320, 240))
    for shot in shots:
        writer.write(cv2.cvtColor(shot, cv2.COLOR_GRAY2BGR))
    writer.release()
    return path


def test_a_video(tmp_path, shots):
    path = write_video(tmp_path / "a.avi", shots)
    frames, count = read(path, path)
    assert count == len(frames) == 2 * N
    assert [frame.time for frame in frames] == pytest.approx(np.arange(2 * N) / 10, abs=1e-3)
    assert frames[1].name == "a.avi 2"
    assert np.corrcoef(frames[1].image.ravel(), shots[1].ravel())[0, 1] > 0.98


def test_a_video_that_ends_early(tmp_path, shots, capfd):
    path = write_video(tmp_path / "a.avi", shots * 4)
    data = path.read_bytes()
    path.write_bytes(data[: len(data) // 2])
    frames, count = read(path)
    assert count == 4 * N
    assert 2 * N - 3 < len(frames) < 2 * N + 3
    assert not any(frame.flaw for frame in frames)
    assert capfd.readouterr().err == ""


def test_a_video_with_damage_within_goes_on_behind_it(tmp_path, shots):
    path = write_video(tmp_path / "a.avi", shots * 4)
    data = bytearray(path.read_bytes())
    starts = [k for k in range(len(data)) if data[k : k + 4] == b"00dc" and data[k + 8 : k + 10] == b"\xff\xd8"]
    assert len(starts) == 4 * N
    data[starts[9] + 8 : starts[10]] = bytes(starts[10] - starts[9] - 8)
    path.write_bytes(data)
    frames, _ = read(path)
    assert [k for k, frame in enumerate(frames) if frame.flaw] == [9]
    assert len(frames) == 4 * N


def jpegs(shots):
    return [cv2.imencode(".jpg", shot)[1].tobytes() for shot in shots]


PART = b"--frame\r\nContent-Type: image/jpeg\r\nContent-Length: %d\r\n\r\n%b\r\n"
BARE = {
    "raw": b"".join,
    "begun within": lambda images: images[0][500:] + b"".join(images),
    "of a web camera": lambda images: b"".join(PART % (len(image), image) for image in images),
    "cut": lambda images: b"".join(images)[:-3000],
}


@pytest.mark.parametrize("kind", BARE)
@pytest.mark.parametrize("name", ["a.mjpeg", "a.mjpg"])
def test_images_one_behind_the_other_in_a_file(tmp_path, shots, kind, name):
    (tmp_path / name).write_bytes(BARE[kind](jpegs(shots)))
    frames, count = read(tmp_path / name)
    assert count is None
    assert len(frames) == pytest.approx(N, abs=kind in {"cut", "begun within"})
    assert {frame.time for frame in frames} == {None}
    assert np.corrcoef(frames[-2].image.ravel(), shots[len(frames) - 2].ravel())[0, 1] > 0.98


def as_live(data):
    """A WebM as it comes from a stream: of no stated length, without an index."""
    duration, segment, index = (bytes.fromhex(code) for code in ("448988", "18538067", "1c53bb6b"))
    at = data.index(duration)
    data[at : at + 11] = b"\xec\x89" + bytes(9)
    at = data.index(segment) + 4
    data[at : at + 8] = b"\x01" + 7 * b"\xff"
    return data[: data.rindex(index)]


def without_index(data):
    """An AVI whose writer died: it counts no frames, and has no index."""
    for mark, place in ((b"avih", 24), (b"strh", 40)):
        at = data.index(mark) + place
        data[at : at + 4] = bytes(4)
    return data[: data.rindex(b"idx1")]


def of_many(data):
    """An AVI that says it has four billion frames."""
    at = data.index(b"strh") + 40
    data[at : at + 4] = (4_000_000_000).to_bytes(4, "little")
    return data


LIVE = [("a.webm", "VP80", as_live), ("a.avi", "MJPG", without_index), ("a.avi", "MJPG", of_many)]


@pytest.mark.parametrize(("name", "codec", "change"), LIVE)
@pytest.mark.parametrize("kept", [1.0, 0.7])
def test_a_video_that_does_not_say_how_many_frames_it_has(tmp_path, shots, name, codec, change, kept):
    path = write_video(tmp_path / name, shots * 3, codec=codec)
    data = change(bytearray(path.read_bytes()))
    path.write_bytes(data[: int(kept * len(data))])
    frames, count = read(path)
    assert count is None
    assert len(frames) == pytest.approx(kept * 3 * N, abs=0 if kept == 1 else 2)
    assert [frame.time for frame in frames] == pytest.approx(np.arange(len(frames)) / 10, abs=1e-3)


def slower(data):
    """An MP4 whose frames last seven times as long as its list of edits says that the film does."""
    at = data.index(b"stts") + 16
    data[at : at + 4] = (7 * int.from_bytes(data[at : at + 4], "big")).to_bytes(4, "big")
    return data


@pytest.mark.parametrize(("change", "last"), [(slower, 7 * (3 * N - 1) / 10), (lambda data: data, (3 * N - 1) / 10)])
def test_frames_that_a_container_says_are_none_of_the_film(tmp_path, shots, change, last):
    path = write_video(tmp_path / "a.mp4", shots * 3, codec="mp4v")
    path.write_bytes(change(bytearray(path.read_bytes())))
    frames, _ = read(path)
    assert len(frames) == 3 * N
    assert frames[-1].time == pytest.approx(last, abs=1e-3)


def test_the_times_of_a_stream_that_was_taken_up_again_go_on(tmp_path, shots):
    path = write_video(tmp_path / "a.ts", shots * 3, codec="mp2v")
    path.write_bytes(2 * path.read_bytes())
    frames, _ = read(path)
    assert [frame.time for frame in frames] == pytest.approx(np.arange(6 * N) / 10, abs=1e-3)


@pytest.mark.parametrize("name", ["a.avi", "a.mp4", "a.ts"])
def test_frames_alone_under_a_containers_name_have_no_times(tmp_path, shots, name):
    (tmp_path / name).write_bytes(b"".join(jpegs(shots)))
    frames, _ = read(tmp_path / name)
    assert len(frames) == N
    assert {frame.time for frame in frames} == {None}


def test_a_long_hole_in_a_video_does_not_end_it(tmp_path, shots):
    path = write_video(tmp_path / "a.mp4", shots * 20, codec="mp4v")
    data = bytearray(path.read_bytes())
    first, last = len(data) // 8, len(data) * 7 // 8
    data[first:last] = bytes(last - first)
    path.write_bytes(data)
    frames, count = read(path)
    flaws = "".join("." if frame.flaw else "#" for frame in frames)
    assert count == len(frames) == 20 * N
    assert flaws.strip("#").count(".") > 50
    assert flaws.endswith("#####")


@pytest.mark.parametrize(
    ("make", "says"),
    [
        (lambda path: path, "no such file or folder"),
        (lambda path: path.mkdir(), "holds no images"),
        (lambda path: path.write_text("a,b"), "neither an image nor a video"),
    ],
)
def test_what_holds_no_frames(tmp_path, make, says):
    make(tmp_path / "a")
    with pytest.raises(InputError, match=says):
        read_recording([tmp_path / "a"], camera=LOW)


def test_what_is_no_video(tmp_path):
    (tmp_path / "a.mp4").write_bytes(b"nothing" * 1000)
    with pytest.raises(InputError, match="can't be read as a video"):
        read_recording([tmp_path / "a.mp4"], camera=LOW)


def test_a_video_of_a_codec_that_is_unknown(tmp_path, shots):
    """Its container tells how many frames it has."""
    path = write_video(tmp_path / "a.avi", shots)
    path.write_bytes(path.read_bytes().replace(b"MJPG", b"QQQQ").replace(b"\xff\xd8\xff", b"QQQ"))
    with pytest.raises(InputError, match=r"a\.avi: can't be read as a video: .* is its codec unknown"):
        read_recording([path], camera=LOW)


def test_the_lens_is_taken_out(tmp_path):
    """A step seen by a lens that bends by some pixels is measured as if it were a pinhole."""
    lens = Camera(**LOW.model_dump() | {"distortion": [-0.25, 0.08, 0.001, -0.001, 0.0]})
    robot, laid = poses(2, step=55, turn=2, x=-1000), ground()
    bent = [render(laid, pose, camera=lens, weather=Weather(2, 0.02), seed=k) for k, pose in enumerate(robot)]
    frames, _ = read(save(tmp_path / "a", {f"{k}.png": image for k, image in enumerate(bent)}), camera=lens)
    truth, errors = moved(*robot), []
    for pair in (bent, [frame.image for frame in frames]):
        motion = estimate_motion(*pair, camera=LOW)
        errors.append(np.hypot(motion.dx_mm - truth.x_mm, motion.dy_mm - truth.y_mm))
    assert errors[1] < 0.4
    assert errors[0] > 4 * errors[1]
