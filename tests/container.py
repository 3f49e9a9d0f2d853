"""A Containerfile as data, and its steps in this machine's shell, below a folder that stands for the image's root."""

import os
import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path
from typing import NamedTuple

from commands import ROOT

FOLDER = ROOT / "configs" / "container"
CONTAINERFILE, IGNORED = FOLDER / "Containerfile", FOLDER / "Containerfile.dockerignore"
OF_THE_IMAGE = re.compile(r"(?<![\w.$}/*-])/(?=(?:src|wheels|opt|vinemap|surveys|products|var)\b)")
"""Where a path begins that is the image's."""
OF_ROOT = re.compile(r"\b(?:apt-get|useradd)\b")
"""Steps that change the machine: the image's alone."""


class Step(NamedTuple):
    word: str
    rest: str


def steps():
    """All instructions, each on one line."""
    lines = [line for line in CONTAINERFILE.read_text(encoding="utf-8").splitlines() if not line.startswith("#")]
    joined = re.sub(r"\s*\\\n\s*", " ", "\n".join(lines))
    return [Step(*line.split(maxsplit=1)) for line in joined.splitlines() if line]


def copied(step):
    """What is copied from the repository, and where to."""
    *sources, target = step.rest.split()
    return ([], target) if sources[0].startswith("--from") else (sources, target)


def build(root):
    """Go through all steps below ``root``; gives the folder of work and the environment of what runs in the image."""
    known = {key: value for key, value in os.environ.items() if not key.startswith(("PYTHON", "NUMBA"))}
    machine = f"{Path(sys.executable).parent}:{known['PATH']}"
    work, environment = root, known | {"PATH": machine}

    def here(text):
        return OF_THE_IMAGE.sub(f"{root}/", text)

    for word, rest in steps():
        if word == "FROM":
            work, environment = root, known | {"PATH": machine}
        elif word == "WORKDIR":
            work = Path(here(rest))
            work.mkdir(parents=True, exist_ok=True)
        elif word == "ARG":
            environment |= dict([rest.split("=", 1)])
        elif word == "ENV":
            said = dict(pair.split("=", 1) for pair in shlex.split(rest))
            environment |= {key: here(value).replace("$PATH", machine) for key, value in said.items()}
        elif word == "COPY":
            sources, target = copied(Step(word, rest))
            for source in sources:
                copy(ROOT / source, work / target / ("" if (ROOT / source).is_dir() else Path(source).name))
        elif word == "RUN" and not OF_ROOT.search(rest):
            run(["sh", "-c", here(rest)], work, environment)
    return work, environment


def copy(source, target):
    if source.is_dir():
        shutil.copytree(source, target, ignore=shutil.ignore_patterns("__pycache__", "node_modules"))
    else:
        target.parent.mkdir(parents=True, exist_ok=True)
        shutil.copy2(source, target)


def run(command, work, environment):
    done = subprocess.run(command, cwd=work, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, f"{command}: {done.stderr}"
    return done.stdout
