"""Commands as a person types them."""

import subprocess
import sys

VINEMAP = [sys.executable, "-m", "vinemap"]


def vinemap(*args, cwd):
    return subprocess.run(
        [*VINEMAP, *map(str, args)], cwd=cwd, capture_output=True, text=True, timeout=300, check=False
    )


def assert_refused(done, *words):
    """One line on stderr that says what was wrong, exit code 2, nothing on stdout."""
    assert done.returncode == 2, done.stderr
    assert done.stderr.startswith("vinemap: ")
    assert done.stderr.count("\n") == 1
    for word in words:
        assert word in done.stderr
    assert done.stdout == ""
