"""The Prefect flow: the same chain with a task run a stage, silent, and errors in one line."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import geopandas as gpd
import pytest

from vinemap.parcel import STAGES
from vinemap.simulate.survey import write_survey

ROOT = Path(__file__).parents[2]


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


SEEN = """
import flows, asyncio, json, sys
from prefect import get_client
from prefect.client.schemas.filters import ArtifactFilter, ArtifactFilterKey
import flows.survey

async def seen():
    async with get_client() as client:
        runs = [r for r in await client.read_flow_runs() if r.name == "twice"]
        tasks = [
            (r.name, r.state_name, r.run_count)
            for r in await client.read_task_runs()
            if r.flow_run_id in [run.id for run in runs]
        ]
        chosen = ArtifactFilter(key=ArtifactFilterKey(any_=["survey"]))
        tables = [json.loads(a.data) for a in await client.read_artifacts(artifact_filter=chosen)]
        flows = [(r.state_name, r.state.message) for r in runs]
        return {"tasks": sorted(tasks), "tables": tables, "flows": flows}

def show():
    print(json.dumps(asyncio.run(seen())))
"""


def test_a_survey_is_a_flow_with_a_task_a_parcel(place):
    """Of two parcels in the same polygon, one with an origin that lies elsewhere."""
    one = gpd.read_file(place / "data" / "surveys" / "small" / "parcels.gpkg")
    gpd.GeoDataFrame({"name": ["B", "C"]}, geometry=[*one.geometry] * 2, crs=one.crs).to_file(place / "two.gpkg")
    (place / "two.yaml").write_text(
        "survey: twice\ncloud: data/surveys/small/small.laz\nboundaries: two.gpkg\n"
        "parcels: [B, C]\noverrides: {C: {origin: [0, 0, 0]}}\n"
    )
    done = flow(place, code=SEEN + "sys.argv[1:] = ['two.yaml']\ntry:\n    flows.survey.main()\nfinally:\n    show()")
    assert done.returncode == 1
    assert done.stderr == "vinemap: 1 of 2 parcels failed\n"
    head, first, second, told = done.stdout.strip().split("\n")
    assert head.split() == ["parcel", "rows", "seconds", "state", "reason"]
    assert first.split()[:2] == ["B", "6"]
    assert first.split()[-1] == "done"
    assert "failed  origin 0, 0 is over 50 km from the cloud" in second
    seen = json.loads(told)
    assert seen["tasks"] == [["B", "Completed", 1], ["C", "Failed", 1]]
    assert seen["flows"] == [["Failed", "1 of 2 parcels failed: C"]]
    (table,) = seen["tables"]
    assert [(row["parcel"], row["state"]) for row in table] == [("B", "done"), ("C", "failed")]


def test_only_what_may_heal_is_tried_again(place):
    code = SEEN + (
        "from prefect import flow\n"
        "from vinemap.errors import BusyError, InputError\n"
        "flows.survey.RETRIES = (0.1, 0.2, 0.3)\n"
        "calls = []\n"
        "def work(name, error, times):\n"
        "    calls.append(name)\n"
        "    if calls.count(name) <= times:\n"
        "        raise error(name)\n"
        "    return name.upper()\n"
        "@flow\n"
        "def job():\n"
        "    given = flows.survey.as_task('busy', work, 'busy', BusyError, 2)\n"
        "    for name, error in (('bad', InputError), ('stuck', BusyError)):\n"
        "        try:\n"
        "            flows.survey.as_task(name, work, name, error, 9)\n"
        "        except error:\n"
        "            calls.append('failed')\n"
        "    return given\n"
        "print(job(), ' '.join(calls))\n"
    )
    done = flow(place, code=code)
    assert done.returncode == 0, done.stderr
    assert done.stdout == "BUSY busy busy busy bad failed stuck stuck stuck stuck failed\n"
