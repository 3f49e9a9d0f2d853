"""``vinemap config``: print what can be configured."""

from __future__ import annotations

import click


@click.command(short_help="Print a configuration file with every key.")
@click.argument("kind", type=click.Choice(["estate", "survey", "settings", "camera"]), default="estate")
def config(kind: str) -> None:
    """Print all that can be configured, with its defaults, as a commented YAML file.

    KIND is what the file is for: the surveys of an estate night after night, one survey, the stages alone, or the
    camera of a robot.
    """
    from vinemap.config.template import template

    click.echo(template(kind), nl=False)
