"""A file is read again if it may have changed, and only then."""

import errno
import json
import os
from datetime import UTC, datetime
from pathlib import Path

import pytest
from ingredients import write_las
from systems import POSIX

from vinemap.errors import BusyError, InputError
from vinemap.product import recipe
from vinemap.product.recipe import Source, flown, read_source


@pytest.fixture
def cloud(tmp_path):
    return write_las(tmp_path / "may.las")


def test_the_date_is_the_headers_or_else_the_files(tmp_path):
    cloud = write_las(tmp_path / "a.las", date=datetime(2023, 2, 1, tzinfo=UTC))
    assert flown(read_source(cloud)) == datetime(2023, 2, 1, tzinfo=UTC)
    with cloud.open("r+b") as stream:
        stream.seek(90)
        stream.write(bytes(4))
    os.utime(cloud, (1_700_000_000.9, 1_700_000_000.9))
    assert flown(read_source(cloud)) == datetime.fromtimestamp(1_700_000_000, UTC)
    source = read_source(cloud)
    cloud.unlink()
    with pytest.raises(InputError, match=r"a\.las: no such file"):
        flown(source)


@pytest.fixture
def hashed(monkeypatch):
    """Names of the files whose content is read."""
    read, digest = [], recipe.hashlib.file_digest

    def file_digest(stream, kind):
        read.append(Path(stream.name).name)
        return digest(stream, kind)

    monkeypatch.setattr(recipe.hashlib, "file_digest", file_digest)
    return read


def long_ago(path, seconds=100.0):
    """What is known of a file that was read so many seconds after its last change."""
    stat = path.stat()
    return read_source(path)._replace(read=max(stat.st_mtime, stat.st_ctime) + seconds)


def test_a_file_that_is_known_is_not_read_again(cloud, hashed):
    known = long_ago(cloud)
    assert read_source(cloud, [known._replace(path=Path("other.las")), known]) is known
    assert hashed == ["may.las"]


def test_what_is_known_goes_through_json(cloud, hashed):
    """As a survey's record keeps it."""
    known = long_ago(cloud)
    stored = json.loads(json.dumps({**known._asdict(), "path": str(cloud)}))
    again = Source(Path(stored["path"]), stored["sha256"], tuple(stored["stamp"]), stored["read"])
    assert read_source(cloud, [again]) is again
    assert hashed == ["may.las"]


def test_a_file_read_within_the_clocks_granularity_of_its_change_is_read_again(cloud, hashed):
    """It may have changed once more without its time telling."""
    for seconds in (-1, 0, 1, recipe.SETTLED - 0.1):
        read_source(cloud, [long_ago(cloud, seconds)])
    assert len(hashed) == 8
    read_source(cloud, [long_ago(cloud, recipe.SETTLED + 0.1)])
    assert len(hashed) == 9


@POSIX
def test_a_file_of_the_future_is_read_again(cloud, hashed):
    """Written by a machine whose clock is ahead."""
    os.utime(cloud, (4e9, 4e9))
    known = read_source(cloud)
    assert read_source(cloud, [known]).sha256 == known.sha256
    assert len(hashed) == 2


@POSIX
def test_another_file_of_the_same_size_and_time_is_read(cloud, tmp_path, hashed):
    known = long_ago(cloud)
    stat = cloud.stat()
    other = write_las(tmp_path / "other.las", seed=1)
    os.utime(other, ns=(stat.st_atime_ns, stat.st_mtime_ns))
    other.replace(cloud)
    assert (cloud.stat().st_size, cloud.stat().st_mtime_ns) == (stat.st_size, stat.st_mtime_ns)
    assert read_source(cloud, [known]).sha256 != known.sha256


@POSIX
def test_a_file_changed_in_place_whose_time_was_set_back_is_read(cloud, hashed):
    known = long_ago(cloud)
    stat = cloud.stat()
    with cloud.open("r+b") as stream:
        stream.seek(-1, os.SEEK_END)
        stream.write(b"\x7f")
    os.utime(cloud, ns=(stat.st_atime_ns, stat.st_mtime_ns))
    assert cloud.stat().st_mtime_ns == stat.st_mtime_ns
    assert read_source(cloud, [known]).sha256 != known.sha256


@pytest.mark.parametrize("how", ["grows", "is replaced", "is gone"])
def test_a_file_that_changes_while_it_is_read(cloud, tmp_path, monkeypatch, how):
    other, digest = write_las(tmp_path / "other.las", seed=1), recipe.hashlib.file_digest

    def file_digest(stream, kind):
        found = digest(stream, kind)
        if how == "grows":
            with cloud.open("ab") as more:
                more.write(b"more")
        elif how == "is replaced":
            other.replace(cloud)
        else:
            cloud.unlink()
        return found

    monkeypatch.setattr(recipe.hashlib, "file_digest", file_digest)
    with pytest.raises(BusyError, match=r"may\.las: changed while it was read: try again") as error:
        read_source(cloud)
    assert error.value.heals


def test_a_source_can_be_checked_later(cloud):
    source = read_source(cloud)
    source.check()
    with cloud.open("ab") as stream:
        stream.write(b"more")
    with pytest.raises(BusyError):
        source.check()


@pytest.mark.parametrize(
    ("number", "kind"), [(errno.EIO, BusyError), (errno.ESTALE, BusyError), (errno.EACCES, InputError)]
)
def test_a_disk_that_fails(cloud, monkeypatch, number, kind):
    """What may pass is told from what won't."""
    for name in ("open", "stat"):
        with monkeypatch.context() as patch:
            patch.setattr(Path, name, lambda *words, **options: (_ for _ in ()).throw(OSError(number, "broken")))
            with pytest.raises(kind, match=r"may\.las: can't be read \(broken\)"):
                read_source(cloud)


def test_what_is_no_file(tmp_path):
    with pytest.raises(InputError, match="none: no such file"):
        read_source(tmp_path / "none")
    with pytest.raises(InputError, match="can't be read"):
        read_source(tmp_path)
    with pytest.raises(InputError, match="can't be read"):
        read_source(tmp_path / ("x" * 300))


@POSIX
def test_a_name_that_is_no_unicode_can_be_told(tmp_path):
    """As of a file that was copied from an old disk."""
    path = tmp_path / os.fsdecode(b"Nebbiolo \xe0.las")
    write_las(tmp_path / "a.las").rename(path)
    with pytest.raises(InputError, match="rename it") as error:
        read_source(path)
    assert str(error.value).encode()
