"""Common parts of the commands on recordings."""

from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path

import click

from ldcnd.contract.errors import ConfigError

RECORDING = click.Path(path_type=Path, exists=True, dir_okay=False)
EXIT_INCOMPLETE = 1
"""The recording is damaged; what could be read of it was used."""


def require_mcap() -> None:
    """Refuse to go on without the extra.

    Raises:
        ConfigError: it is missing.
    """
    try:
        import mcap  # noqa: F401, PLC0415 - an optional package
    except ImportError as error:
        raise ConfigError("mcap is not installed", remedy="install ldcnd[record]") from error


def tell_damages(path: Path, damages: Sequence[object]) -> None:
    """Say what cannot be read of a recording."""
    for damage in damages:
        click.echo(f"{path}, {damage}", err=True)


def utc(t_ns: int) -> str:
    """Return an instant for people."""
    return datetime.fromtimestamp(t_ns / 1e9, UTC).isoformat(timespec="milliseconds")
