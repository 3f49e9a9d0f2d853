"""``python -m vinemap.measure.fuzz``: damage small clouds, work them, and count what comes of it."""

from __future__ import annotations

import sys
import tempfile
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import click
import numpy as np

from vinemap.errors import WorkerError
from vinemap.jobs.workers import Workers
from vinemap.measure.fuzz.damages import DAMAGES, write_wholes
from vinemap.measure.fuzz.trial import DIED, FAULT, GOOD, HUNG, MEMORY_OUT, OUTCOMES, Verdict, Whole, examine, measure
from vinemap.measure.tables import as_text
from vinemap.terminal import plain_errors

if TYPE_CHECKING:
    from collections.abc import Iterator

MEMORY = 1_500_000_000
"""Bytes that a case may take."""
LIMIT = 60.0
"""Seconds that a case may take; a whole file's takes 4."""


def case(number: int, wholes: list[Whole], folder: Path, workers: Workers) -> tuple[str, str, Verdict]:
    """Kind of file, kind of damage, and what came of a case."""
    whole, damage = wholes[number % len(wholes)], DAMAGES[number // len(wholes) % len(DAMAGES)]
    data = bytearray(whole.path.read_bytes())
    damage(data, np.random.default_rng(number))
    path = folder / f"{number}{''.join(whole.path.suffixes)}"
    path.write_bytes(data)
    try:
        verdict: Verdict = workers.run(examine, path, whole, limit=LIMIT)
    except WorkerError as error:
        said = str(error)
        kinds = {"longer than": HUNG, "not enough memory": MEMORY_OUT, "died": DIED}
        verdict = Verdict(next((kind for words, kind in kinds.items() if words in said), FAULT), said)
    path.unlink()
    return whole.path.name, damage.__name__, verdict


def cases(numbers: range, processes: int) -> Iterator[tuple[int, str, str, Verdict]]:
    """What comes of cases, in their order."""
    with tempfile.TemporaryDirectory(prefix="vinemap-fuzz-") as place:
        folder = Path(place).resolve()
        with Workers(processes, memory=MEMORY) as workers, ThreadPoolExecutor(processes) as threads:
            wholes = [workers.run(measure, path, boundary) for path, boundary in write_wholes(folder)]
            found = threads.map(partial(case, wholes=wholes, folder=folder, workers=workers), numbers)
            for number, (kind, damage, verdict) in zip(numbers, found, strict=True):
                yield number, kind, damage, verdict


@click.command()
@click.option("--cases", "n", type=click.IntRange(1), default=2000, show_default=True, help="How many files.")
@click.option("--first", type=click.IntRange(0), default=0, help="Number of the first, to see it again.")
@click.option("--processes", type=click.IntRange(1), default=2, show_default=True)
@click.option("-v", "--verbose", is_flag=True, help="Say what came of each.")
def main(n: int, first: int, processes: int, verbose: bool) -> None:
    """Damage small clouds at random; exit code 1 if one ends otherwise than in a right product or one clear line."""
    counts: Counter[tuple[str, str]] = Counter()
    for number, kind, damage, (outcome, said) in cases(range(first, first + n), processes):
        counts[damage, outcome] += 1
        if verbose or outcome not in GOOD:
            click.echo(f"{number} {kind} {damage}: {outcome}: {' '.join(said.split())[:400]}")
    met = [outcome for outcome in OUTCOMES if any(counts[damage.__name__, outcome] for damage in DAMAGES)]
    lines = [[d.__name__, *(str(counts[d.__name__, outcome]) for outcome in met)] for d in DAMAGES]
    sums = ["all", *(str(sum(counts[d.__name__, outcome] for d in DAMAGES)) for outcome in met)]
    click.echo(as_text([["damage", *met], *lines, sums]))
    sys.exit(not set(met) <= set(GOOD))


if __name__ == "__main__":
    with plain_errors():
        main(standalone_mode=False)
