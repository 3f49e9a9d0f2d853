"""The Prefect flows: the same chain with a task run a stage, silent, and errors in one line."""

import json
import shutil

import cv2
import geopandas as gpd
import pytest
import yaml
from commands import ROOT, assert_refused, free_of_prefect, python
from drives import images, poses
from place import Place

from vinemap.config.surveys import load_estate
from vinemap.simulate.camera import LOW
from vinemap.simulate.survey import write_survey
from vinemap.stages import STAGES

NIGHTLY = """
from pathlib import Path
from prefect import flow, get_run_logger
from prefect.states import Completed

@flow(name="nightly")
def nightly(config: str):
    get_run_logger().info("mapped")
    return Completed(message=f"{config} in {Path.cwd()}")
"""


@pytest.fixture(scope="module")
def place(vineyard, tmp_path_factory):
    """A working folder with a survey 'small' of parcel A, and its own Prefect home."""
    folder = tmp_path_factory.mktemp("place")
    write_survey(vineyard, folder / "data" / "surveys" / "small")
    (folder / "small.yaml").write_text("survey: small\nparcels: [A, missing]\n")
    yield folder
    shutil.rmtree(folder, ignore_errors=True)


@pytest.fixture(scope="module")
def served(place):
    """The same folder with a server that has the runs of all flows, whose starts take longest."""
    served = Place(place)
    (place / "prefect").mkdir(exist_ok=True)
    with served.server(place / "prefect"):
        yield served


def alone(place, *words):
    """Run what has no server but one that it starts itself."""
    return python(*words, cwd=place, environment=free_of_prefect() | {"PREFECT_HOME": str(place / "prefect")})


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
    done = alone(place, "-c", code)
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""
    said, runs = done.stdout.strip().split("\n")
    assert said.startswith("A: 6 rows, ")
    assert json.loads(runs) == [[name, "Completed"] for name in sorted(STAGES)]
    assert (place / "data" / "products" / "small" / "A" / "run.json").is_file()


WRONG = [
    (("small.yaml", "B"), "survey small has no parcel 'B'"),
    (("small.yaml", "Missing"), "did you mean 'missing'?"),
    (("small.yaml", "../A"), "can't name a file"),
    (("smal.yaml", "A"), "did you mean 'small.yaml'?"),
    ((), "give a survey's configuration and a parcel"),
]


@pytest.fixture(scope="module")
def refusals(place):
    """What the command says to each of the wrong words, and its exit code."""
    code = (
        "import contextlib, io, json, sys\n"
        "import flows.parcel\n"
        "said = []\n"
        "for sys.argv[1:] in json.loads(sys.argv[1]):\n"
        "    with contextlib.redirect_stderr(io.StringIO()) as stderr:\n"
        "        try:\n"
        "            said.append([flows.parcel.main(), ''])\n"
        "        except SystemExit as end:\n"
        "            said.append([end.code, stderr.getvalue()])\n"
        "print(json.dumps(said))\n"
    )
    done = alone(place, "-c", code, json.dumps([words for words, _ in WRONG]))
    assert (done.returncode, done.stderr) == (0, "")
    return dict(zip((words for words, _ in WRONG), json.loads(done.stdout), strict=True))


def test_prefects_services_say_nothing_once_all_is_over(place):
    """What stderr was while the flow ran is closed then."""
    code = (
        "import logging\n"
        "from vinemap.terminal import hushed\n"
        "with hushed():\n"
        "    import flows.parcel\n"
        "    from prefect.logging.configuration import setup_logging\n"
        "    setup_logging()\n"
        "logging.getLogger('APILogWorker').warning('1 items remaining')\n"
    )
    done = alone(place, "-c", code)
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")


@pytest.mark.parametrize(("words", "said"), WRONG)
def test_wrong_words(refusals, words, said):
    code, line = refusals[words]
    assert code == 2
    assert said in line
    assert line.count("\n") == 1


def test_error_in_a_stage_is_one_line(place, served):
    (place / "broken.yaml").write_text("survey: broken\nparcels: [A]\n")
    folder = place / "data" / "surveys" / "broken"
    shutil.copytree(place / "data" / "surveys" / "small", folder)
    cloud = folder / "broken.laz"
    cloud.write_bytes((folder / "small.laz").read_bytes()[:5000])
    assert_refused(served.run("-m", "flows.parcel", "broken.yaml", "A", cwd=place), "broken.laz")
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


def test_a_survey_is_a_flow_with_a_task_a_parcel(place, served):
    """Of two parcels in the same polygon, one with an origin that lies elsewhere."""
    one = gpd.read_file(place / "data" / "surveys" / "small" / "parcels.gpkg")
    gpd.GeoDataFrame({"name": ["B", "C"]}, geometry=[*one.geometry] * 2, crs=one.crs).to_file(place / "two.gpkg")
    (place / "two.yaml").write_text(
        "survey: twice\ncloud: data/surveys/small/small.laz\nboundaries: two.gpkg\n"
        "parcels: [B, C]\noverrides: {C: {origin: [0, 0, 0]}}\n"
    )
    code = SEEN + "sys.argv[1:] = ['two.yaml']\ntry:\n    flows.survey.main()\nfinally:\n    show()"
    done = served.run("-c", code, cwd=place)
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


def test_only_what_may_heal_is_tried_again(place, served):
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
    done = served.run("-c", code, cwd=place)
    assert done.returncode == 0, done.stderr
    assert done.stdout == "BUSY busy busy busy bad failed stuck stuck stuck stuck failed\n"


def test_drives_in_one_job(served, tmp_path):
    """A drive that fails, of its frames or of its own sensors' files, costs no other; each stage is a task run."""
    for k, image in enumerate(images(poses(4))):
        (tmp_path / "frames").mkdir(exist_ok=True)
        cv2.imwrite(str(tmp_path / "frames" / f"{k}.png"), image)
    (tmp_path / "camera.yaml").write_text(yaml.safe_dump(LOW.model_dump(exclude_defaults=True)))
    (tmp_path / "drives.yaml").write_text(
        "camera: camera.yaml\nout: tracks\ndrives:\n  bad: {frames: [nothing]}\n"
        "  unplaced: {frames: [frames], fixes: fixes.csv}\n  slipping: {frames: [frames], motion: wheels.csv}\n"
        "  good: {frames: [frames], start: [44.61167, 7.92442, 72.5]}\n"
    )
    done = served.run("-m", "flows.odometry", "drives.yaml", cwd=tmp_path)
    assert done.returncode == 1
    assert done.stdout == "tracks/good_track.gpkg: 0.12 m in 4 frames\n"
    assert done.stderr.splitlines() == [
        "vinemap: bad: nothing: no such file or folder: give images, folders of images, or videos",
        "vinemap: unplaced: fixes.csv: fixes need a start: give --start lat,lon,heading, roughly",
        "vinemap: slipping: wheels.csv: can't be read (No such file or directory): give a CSV with a line of names",
    ]
    assert [path.name for path in (tmp_path / "tracks").iterdir()] == ["good_track.gpkg"]


def test_prefect_yaml_deploys_and_a_worker_runs_it(served, tmp_path):
    shutil.copy(ROOT / "prefect.yaml", tmp_path)
    shutil.copytree(ROOT / "flows", tmp_path / "flows")
    pool = served.run("-m", "prefect", "work-pool", "create", "vinemap", "--type", "process", cwd=tmp_path)
    assert pool.returncode == 0, pool.stderr
    deployed = served.run("-m", "prefect", "deploy", "--all", "--no-prompt", cwd=tmp_path)
    assert deployed.returncode == 0, deployed.stdout + deployed.stderr
    (deployment,) = served.ask("/deployments/filter", {"deployments": {"name": {"any_": ["nightly"]}}})
    assert deployment["schedules"][0]["schedule"] == {"cron": "0 2 * * *", "timezone": "Europe/Rome", "day_or": True}
    assert deployment["global_concurrency_limit"]["limit"] == 1
    assert deployment["concurrency_options"]["collision_strategy"] == "CANCEL_NEW"
    (tmp_path / "flows" / "nightly.py").write_text(NIGHTLY)
    run = served.ask(f"/deployments/{deployment['id']}/create_flow_run", {"state": {"type": "SCHEDULED"}})["id"]
    worked = served.run("-m", "prefect", "worker", "start", "--pool", "vinemap", "--run-once", cwd=tmp_path.parent)
    assert worked.returncode == 0, worked.stdout + worked.stderr
    (run,) = served.ask("/flow_runs/filter", {"flow_runs": {"id": {"any_": [run]}}})
    assert run["state"]["message"] == f"configs/nightly.yaml in {tmp_path}"


def test_prefect_yaml_names_no_machine():
    text = (ROOT / "prefect.yaml").read_text(encoding="utf-8")
    assert "http" not in text
    assert "/home" not in text
    (deployment,) = yaml.safe_load(text)["deployments"]
    assert (ROOT / deployment["entrypoint"].split(":")[0]).is_file()


def test_prefect_yaml_has_the_schedule_of_the_estate():
    (deployment,) = yaml.safe_load((ROOT / "prefect.yaml").read_text(encoding="utf-8"))["deployments"]
    estate = load_estate(ROOT / deployment["parameters"]["config"])
    assert deployment["schedules"] == [{"cron": estate.cron, "timezone": estate.timezone}]
