"""All commands. Heavy modules are imported where a command needs them, so that ``--help`` is at once."""

from __future__ import annotations

import gc
import os

import click

from vinemap import __version__
from vinemap.cli.config import config
from vinemap.cli.doctor import doctor
from vinemap.cli.estate import example, nightly, parcel
from vinemap.cli.evaluate import evaluate
from vinemap.cli.export import export, view
from vinemap.cli.register import register
from vinemap.cli.run import run
from vinemap.cli.setup import qgis_plugin, warm
from vinemap.cli.survey import survey
from vinemap.cli.track import track
from vinemap.terminal import hushed, plain_errors

QUICKER = ("NUMBA_OPT", "NUMBA_DISABLE_ERROR_MESSAGE_HIGHLIGHTING", "OPENBLAS_NUM_THREADS")
"""Variables that are best 1: numba compiles in a tenth less time, to what is as fast, and the threads of NumPy's BLAS,
which wait for work by spinning, don't keep the cores from ours."""


@click.group(context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(__version__, prog_name="vinemap")
def commands() -> None:
    """Vine rows and light canopy meshes from UAV point clouds."""


for command in (run, survey, parcel, nightly, register, config, evaluate, export, view, track, example):
    commands.add_command(command)
for command in (warm, doctor, qgis_plugin):
    commands.add_command(command)


def main() -> None:
    """Run a command of the command line."""
    gc.set_threshold(100_000)  # what is imported lives on: seldom looked through for garbage
    for name in QUICKER:
        os.environ.setdefault(name, "1")
    with hushed(), plain_errors():
        commands.main(prog_name="vinemap", standalone_mode=False)
    gc.freeze()  # the process ends: nothing is looked through for garbage
