"""`ldcnd schema`: the JSON Schemas of the public models."""

from pathlib import Path

import click

from ldcnd.daemon.contract import write_schemas


@click.command()
@click.argument("folder", type=click.Path(path_type=Path, file_okay=False), default=Path("schemas"))
def command(folder: Path) -> None:
    """Write the JSON Schemas of all that crosses the network, and of the configuration, into FOLDER.

    Schemas in it whose models are gone are removed.
    """
    click.echo(f"{write_schemas(folder)} schemas in {folder}")
