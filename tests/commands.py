"""Commands as a person types them, each in a process of its own."""

import atexit
import json
import os
import subprocess
import sys
import tempfile
from functools import cache
from pathlib import Path

ROOT = Path(__file__).parents[1]


def vinemap(*args, cwd):
    return python("-m", "vinemap", *args, cwd=cwd)


def python(*words, cwd, environment=None):
    """Run Python with ``-m`` a module or ``-c`` a program, and words for it; gives its exit code and what it said."""
    words, environment = [*map(str, words)], here(os.environ if environment is None else environment)
    if sys.platform != "linux":  # where a process that has begun threads can't be forked
        return subprocess.run(
            [sys.executable, *words], cwd=cwd, env=environment, capture_output=True, text=True, timeout=300, check=False
        )
    with tempfile.NamedTemporaryFile("r") as stdout, tempfile.NamedTemporaryFile("r") as stderr:
        server = _forks()
        server.stdin.write(json.dumps([words, str(cwd), environment, [stdout.name, stderr.name]]) + "\n")
        server.stdin.flush()
        return subprocess.CompletedProcess(words, int(server.stdout.readline()), stdout.read(), stderr.read())


@cache
def _forks():
    """The process whose forks the commands are; it ends with this one."""
    command = [sys.executable, ROOT / "tests" / "forks.py"]
    server = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    atexit.register(server.communicate)
    return server


def here(environment, *folders):
    """An environment in which Python finds this checkout, and what lies in folders, whatever else is installed."""
    known = environment.get("PYTHONPATH")
    paths = [*map(str, folders), str(ROOT), *([known] if known else [])]
    return {**environment, "PYTHONPATH": os.pathsep.join(paths)}


def free_of_prefect():
    """The environment without settings of Prefect's."""
    return {name: value for name, value in os.environ.items() if not name.startswith("PREFECT_")}


def size(folder):
    """Bytes of all files in a folder."""
    return sum(path.stat().st_size for path in folder.rglob("*") if path.is_file() and not path.is_symlink())


def assert_refused(done, *words):
    """One line on stderr that says what was wrong, exit code 2, nothing on stdout."""
    assert done.returncode == 2, done.stderr
    assert done.stderr.startswith("vinemap: ")
    assert done.stderr.count("\n") == 1
    for word in words:
        assert word in done.stderr
    assert done.stdout == ""


def gone(process):
    """Whether no such process runs, though it may not have been buried."""
    try:
        return Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0] == "Z"
    except OSError:
        return True
