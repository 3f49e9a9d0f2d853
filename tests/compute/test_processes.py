"""Processes of our own: what they import."""

import subprocess

from vinemap.compute.apart import apart
from vinemap.compute.processes import python


def test_a_process_of_ours_imports_nothing_from_where_it_is_called(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name in ("numpy", "random", "vinemap"):
        (tmp_path / f"{name}.py").write_text("raise SystemExit('of somebody else')")
    code = "import random, sys; import vinemap; print(sys.argv[1:])"
    done = subprocess.run(python(code, "a b", "é"), capture_output=True, text=True, check=False)
    assert (done.stdout, done.stderr) == ("['a b', 'é']\n", "")
    assert list(apart(reversed, [1, 2])) == [2, 1]
