"""``vinemap warm``: compile all that is compiled, ahead of the first run."""

from __future__ import annotations

import click


@click.command()
def warm() -> None:
    """Compile what is slow in Python and keep it, as the first run would; at once where that is done."""
    from vinemap import warm

    click.echo(warm.warm().line())
