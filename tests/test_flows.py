"""The Prefect flow: the same chain with a task run a stage, silent, and errors in one line."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from vinemap.parcel import STAGES
from vinemap.synthetic import write_survey

ROOT = Path(__file__).parents[1]


@pytest.fixture(scope="module")
def place(vineyard, tmp_path_factory):
    """A working folder with a survey 'small' of parcel A, and its own Prefect home."""
    folder = tmp_path_factory.mktemp("place")
    write_survey(vineyard, folder / "data" / "surveys" / "small")
    (folder / "small.yaml").write_text("survey: small\nparcels: [A, missing]\n")
    yield folder
    shutil.rmtree(folder, ignore_errors=True)


def flow(place, *args, code=None):
    environment = {k: v for k, v in os.environ.items() if not k.startswith("PREFECT_")}
    environment |= {"PREFECT_HOME": str(place / "prefect"), "PYTHONPATH": str(ROOT)}
    command = [sys.executable, "-c", code] if code else [sys.executable, "-m", "flows.parcel", *args]
    return subprocess.run(command, cwd=place, capture_output=True, text=True, timeout=300, env=environment, check=False)


def test_flow_runs_every_stage_as_a_task_and_says_one_line(place):
    code = (
        "import sys\n"
        "sys.argv = ['flows.parcel', 'small.yaml', 'A']\n"
        "import flows.parcel\n"
        "flows.parcel.main()\n"
        "import asyncio\n"
        "from prefect import get_client\n"
        "async def names():\n"
        "    async with get_client() as client:\n"
        "        return sorted((r.name.rsplit('-', 1)[0], r.state_name) for r in await client.read_task_runs())\n"
        "import json\n"
        "print(json.dumps(asyncio.run(names())))\n"
    )
    done = flow(place, code=code)
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""
    said, runs = done.stdout.strip().split("\n")
    assert said.startswith("A: 6 rows, ")
    assert json.loads(runs) == [[name, "Completed"] for name in sorted(STAGES)]
    assert (place / "data" / "products" / "small" / "A" / "run.json").is_file()


@pytest.mark.parametrize(
    ("args", "said"),
    [
        (("small.yaml", "B"), "survey small has no parcel 'B'"),
        (("small.yaml", "Missing"), "did you mean 'missing'?"),
        (("small.yaml", "../A"), "can't name a file"),
        (("smal.yaml", "A"), "did you mean 'small.yaml'?"),
        ((), "give a survey's configuration and a parcel"),
    ],
)
def test_wrong_words(place, args, said):
    done = flow(place, *args)
    assert done.returncode == 2
    assert said in done.stderr
    assert done.stderr.count("\n") == 1


def test_error_in_a_stage_is_one_line(place):
    (place / "broken.yaml").write_text("survey: broken\nparcels: [A]\n")
    folder = place / "data" / "surveys" / "broken"
    shutil.copytree(place / "data" / "surveys" / "small", folder)
    cloud = folder / "broken.laz"
    cloud.write_bytes((folder / "small.laz").read_bytes()[:5000])
    done = flow(place, "broken.yaml", "A")
    assert done.returncode == 2, done.stderr
    assert "broken.laz" in done.stderr
    assert done.stderr.count("\n") == 1
    assert not (place / "data" / "products" / "broken" / "A").exists()
