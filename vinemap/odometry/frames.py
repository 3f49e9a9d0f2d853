"""Recordings of a camera: grey frames of 8 bits, one after the other, from folders of images, images and videos."""

from __future__ import annotations

import os
import re
import warnings
from collections import deque
from concurrent.futures import ThreadPoolExecutor
from datetime import UTC, datetime
from itertools import islice
from typing import TYPE_CHECKING, NamedTuple, cast

import numpy as np

from vinemap.compute.extras import load
from vinemap.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence
    from pathlib import Path

    from vinemap.compute.arrays import Image
    from vinemap.config.camera import Camera

IMAGES = {".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp", ".pgm", ".ppm", ".webp"}
VIDEOS = {".mp4", ".avi", ".mkv", ".mov", ".m4v", ".webm", ".mjpg", ".mjpeg", ".mpg", ".mpeg", ".ts", ".wmv"}
VIDEOS |= {".mts", ".m2ts", ".flv", ".3gp", ".ogv", ".h264", ".264", ".h265", ".265", ".hevc"}
ENDS = {".jpg": b"\xff\xd9", ".jpeg": b"\xff\xd9", ".png": b"IEND"}
"""What a whole file has near its end; of one that was cut off, decoders make up the rest."""
EXIF = {".jpg", ".jpeg", ".tif", ".tiff"}
"""Images in which cameras write the time."""
END = 4096
"""Bytes at the end of a file among which that is looked for."""
AHEAD = 8
"""Frames that are decoded before they are asked for."""
BRIGHTEST = 99.9
"""Percentile of the grey levels that is brought into 8 bits."""
MISSES = 50
"""Frames of a video in a row, behind those that it says it has, that can't be read before it counts as ended."""
LEAST_FRAME = 16
"""Bytes of a frame: a video that says it has more frames than there is room for says nothing."""
BARE = {".mjpg", ".mjpeg", ".h264", ".264", ".h265", ".265", ".hevc"}
"""Videos that may be frames alone, one behind the other, without times."""
ALONE = (b"\xff\xd8", b"\0\0\1", b"\0\0\0\1", b"--")
"""What a file of frames alone begins with, whatever its name: an image, a frame, or a line between images."""
PACKED = b"\0\0\1\xba"
"""What begins like a frame, and is a container."""
CONTAINERS = (b"RIFF", b"ftyp", b"\x1aE\xdf\xa3")
"""What other files begin with that have such a name."""
WHOLE = "ignore_editlist;1"
"""What decoders are told: to leave no frame out that a container says is none of the film."""
NOISE, NOISE_AT_ONCE = 1, 3
"""Grey levels by which nearly no pixel of a frame differs from its repetition; the latter if both have one time."""
ALIKE = 0.95
"""Share of pixels that are nearly all. Noise of a sensor, half a level at least, changes more."""
EXPOSED = 16, 250
"""Grey levels between which pixels have noise."""
EPOCH = re.compile(r"(?<!\d)(1\d{9})(?:\.(\d{1,9})|(\d{3}|\d{6}|\d{9}))?(?!\d)")
"""Seconds since 1970 in a file's name, with decimals or as milli-, micro- or nanoseconds."""
CLOCK = re.compile(r"(?<!\d)(20\d\d)-?([01]\d)-?([0-3]\d)[T_ -]?([0-2]\d)[:-]?([0-5]\d)[:-]?([0-5]\d)[._,-]?(\d{1,9})?")


class Frame(NamedTuple):
    """One frame of a recording."""

    name: str
    """The file, and in a video the frame's number from 1 on."""
    time: float | None
    """Seconds: since 1970 where images tell it, else since a video's first frame."""
    image: Image | None
    """Grey levels (height, width), free of distortion; none where there is a flaw."""
    flaw: str = ""
    """"unreadable", or "size" where it isn't the camera's."""


class Recording(NamedTuple):
    """Frames in order, and how many there should be; None where a live video doesn't say."""

    frames: Iterator[Frame]
    n_frames: int | None


def read_recording(paths: Sequence[Path], *, camera: Camera) -> Recording:
    """Read frames one after the other, as they are asked for.

    Parameters
    ----------
    paths : sequence of Path
        Images, folders of images in the order of their names (numbers in them by value), and videos; each goes on
        where the one before it ended. Of videos all frames are read that there are, whatever they say of themselves.
    camera : Camera
        Its distortion is taken out of the frames.

    Raises
    ------
    InputError
        If a path holds no frames. Single frames that can't be read or have another size only have a flaw.
    """
    _quieten()
    parts = [_part(path) for path in paths]
    lengths = [_length(part) for part in parts]
    known = [length for length in lengths if length is not None]
    count = sum(known) if len(known) == len(lengths) else None
    return Recording(_prepared(_one_after_the_other(parts, lengths), camera), count)


def time_of(name: str) -> float | None:
    """Seconds since 1970 that the name of an image tells, as such or as a date and time of day in UTC."""
    if found := EPOCH.search(name):
        whole, decimals, digits = found.groups()
        rest = decimals or digits or "0"
        return float(whole) + float(f"0.{rest}")
    if found := CLOCK.search(name):
        *parts, decimals = found.groups()
        try:
            date = datetime.strptime("".join(parts), "%Y%m%d%H%M%S").replace(tzinfo=UTC)
        except ValueError:
            return None
        return date.timestamp() + float(f"0.{decimals or 0}")
    return None


def repeats(frame: Frame, next_frame: Frame) -> bool:
    """Whether a recorder wrote a frame again: a camera that stands still takes another, whose noise is its own."""
    a, b = frame.image, next_frame.image
    if a is None or b is None or a.shape != b.shape:
        return False
    at_once = frame.time is not None and frame.time == next_frame.time
    exposed = (b > EXPOSED[0]) & (b < EXPOSED[1])
    if not exposed.any():
        return False
    import cv2

    differ = cv2.absdiff(a, b)[exposed]
    return bool(np.mean(differ <= (NOISE_AT_ONCE if at_once else NOISE)) > ALIKE)


def _quieten() -> None:
    """What is wrong with a frame is said in the track; decoders would add lines of their own."""
    os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")
    os.environ.setdefault("OPENCV_FFMPEG_CAPTURE_OPTIONS", WHOLE)
    cv2 = load("cv2")
    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)


def _part(path: Path) -> list[Path] | Path:
    """The images of a path in order, or its video."""
    if path.is_dir():
        images = sorted((p for p in path.iterdir() if _is_image(p)), key=_natural)
        if not images:
            raise InputError(f"{path}: holds no images: give a folder of {', '.join(sorted(IMAGES))}, or a video")
        return images
    if not path.is_file():
        raise InputError(f"{path}: no such file or folder: give images, folders of images, or videos")
    if _is_image(path):
        return [path]
    if path.suffix.lower() not in VIDEOS:
        raise InputError(f"{path}: neither an image nor a video: give {', '.join(sorted(IMAGES | VIDEOS))}")
    return path


def _is_image(path: Path) -> bool:
    return path.suffix.lower() in IMAGES and not path.name.startswith(".")


def _natural(path: Path) -> list[tuple[int, int, str]]:
    """By numbers' values: frame 9 before frame 10."""
    return [(0, int(part), "") if part.isdigit() else (1, 0, part) for part in re.split(r"([0-9]+)", path.name)]


def _length(part: list[Path] | Path) -> int | None:
    """How many frames there should be; None if a video doesn't say, or can't be believed."""
    if isinstance(part, list):
        return len(part)
    import cv2

    video = cv2.VideoCapture(str(part))
    try:
        count = video.get(cv2.CAP_PROP_FRAME_COUNT) if video.isOpened() else 0
        known = 0 < count <= part.stat().st_size / LEAST_FRAME
        if not any(video.read()[0] for _ in range(max(MISSES, int(count) if known else 0))):
            raise InputError(f"{part}: can't be read as a video: was it cut off, or is its codec unknown?")
    finally:
        video.release()
    return int(count) if known else None


def _one_after_the_other(parts: Sequence[list[Path] | Path], lengths: Sequence[int | None]) -> Iterator[Frame]:
    """Frames of all parts; a video's times go on from those of the video before it."""
    begun, last, period = 0.0, 0.0, 0.0
    for part, length in zip(parts, lengths, strict=True):
        if isinstance(part, list):
            yield from _read_ahead(part)
            continue
        told = False
        for frame in _video(part, length or 0):
            time = None if frame.time is None else begun + frame.time
            if time is not None and told and time <= last:  # as where a stream was taken up again
                begun, time = begun + last + period - time, last + period if period else None
            if time is not None:
                last, period, told = time, max(time - last, 0.0), True
            yield frame._replace(time=time)
        begun = last + period


def _read_ahead(paths: Iterable[Path]) -> Iterator[Frame]:
    """Images, decoded beside what is done with them."""
    rest = iter(paths)
    with ThreadPoolExecutor(1) as pool:
        waiting = deque(pool.submit(_image, path) for path in islice(rest, AHEAD))
        while waiting:
            frame = waiting.popleft().result()
            waiting.extend(pool.submit(_image, path) for path in islice(rest, 1))
            yield frame


def _image(path: Path) -> Frame:
    import cv2

    time = time_of(path.stem) or _exif_time(path)
    try:
        data = path.read_bytes()
    except OSError:
        return Frame(path.name, time, None, "unreadable")
    image = None
    if data and ENDS.get(path.suffix.lower(), b"") in data[-END:]:
        how = cv2.IMREAD_GRAYSCALE | cv2.IMREAD_ANYDEPTH | cv2.IMREAD_IGNORE_ORIENTATION
        image = cv2.imdecode(np.frombuffer(data, np.uint8), how)
    if image is None or image.dtype not in (np.uint8, np.uint16):
        return Frame(path.name, time, None, "unreadable")
    return Frame(path.name, time, cast("Image", image))


def _exif_time(path: Path) -> float | None:
    """Seconds since 1970 that a camera wrote into a JPEG or TIFF, its clock taken for UTC."""
    if path.suffix.lower() not in EXIF:
        return None
    import rasterio

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # that a photograph has no place on the map
            with rasterio.open(path) as file:
                tags = file.tags()
    except rasterio.errors.RasterioIOError:
        return None
    date = tags.get("EXIF_DateTimeOriginal") or tags.get("EXIF_DateTime") or tags.get("TIFFTAG_DATETIME") or ""
    return time_of(f"{date}.{tags.get('EXIF_SubSecTime_Original', '').strip() or 0}".replace(":", ""))


def _is_bare(path: Path) -> bool:
    """Whether a video is frames alone, to which decoders make up times."""
    with path.open("rb") as stream:
        head = stream.read(12)
    if any(mark in head for mark in CONTAINERS):
        return False
    return path.suffix.lower() in BARE or (head.startswith(ALONE) and not head.startswith(PACKED))


def _video(path: Path, length: int) -> Iterator[Frame]:
    """Frames of a video; damaged ones within it are unreadable, those that its end lacks aren't there."""
    import cv2

    bare = _is_bare(path)
    video = cv2.VideoCapture(str(path))
    video.set(cv2.CAP_PROP_ORIENTATION_AUTO, 0)
    number, missed = 0, 0
    try:
        while missed < MISSES or number < length:
            number += 1
            read, image = video.read()
            if not read:
                missed += 1
                continue
            for lost in range(number - missed, number):
                yield Frame(f"{path.name} {lost}", None, None, "unreadable")
            missed = 0
            time = None if bare else video.get(cv2.CAP_PROP_POS_MSEC) / 1000
            grey = cast("Image", cv2.cvtColor(image, cv2.COLOR_BGR2GRAY))
            yield Frame(f"{path.name} {number}", time, grey)
    finally:
        video.release()


def _prepared(frames: Iterator[Frame], camera: Camera) -> Iterator[Frame]:
    """Frames in 8 bits and free of distortion; those of another size have a flaw."""
    import cv2

    size = camera.width, camera.height
    maps = None
    if camera.distortion:
        lens = np.array(camera.distortion)
        maps = cv2.initUndistortRectifyMap(camera.matrix, lens, np.eye(3), camera.matrix, size, cv2.CV_16SC2)
    bits = 8
    for frame in frames:
        image = frame.image
        if image is None:
            yield frame
            continue
        if image.shape != size[::-1]:
            yield frame._replace(image=None, flaw="size")
            continue
        if image.dtype != np.uint8:
            # Many sensors have 10 or 12 of 16 bits. Single hot pixels don't count.
            bits = max(bits, int(np.percentile(image, BRIGHTEST)).bit_length())
            image = np.minimum(image >> (bits - 8), 255).astype(np.uint8)
        if maps:
            image = np.asarray(cv2.remap(image, *maps, cv2.INTER_CUBIC), np.uint8)
        yield frame._replace(image=image)
