"""`ldcnd console`: the rigs in a browser, from a process of its own."""

import asyncio
import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import click

from ldcnd.cli.connection import DEFAULT_ENDPOINT
from ldcnd.cli.served_at import CONSOLE_ADDRESS, address_option
from ldcnd.contract.errors import ConfigError
from ldcnd.listen_address import ListenAddress
from ldcnd.log import configure_logging
from ldcnd.net.zenoh_settings import ZenohSettings

if TYPE_CHECKING:
    from ldcnd.console.server import MoreRoutes

FILE = click.Path(path_type=Path, dir_okay=False)


@click.command()
@click.option(
    "--connect", "-e", multiple=True, help=f"Zenoh endpoint of a daemon or router; repeatable [{DEFAULT_ENDPOINT}]."
)
@click.option("--config", type=FILE, help="Zenoh configuration file to start from, for each endpoint.")
@click.option("--rig", multiple=True, help="Show this rig only; may be repeated.")
@address_option("--listen", CONSOLE_ADDRESS)
@click.option("--host", multiple=True, help="Name under which browsers reach it, beside that; may be repeated.")
@click.option("--certificate", type=FILE, help="PEM file: serve HTTPS with this certificate.")
@click.option("--key", type=FILE, help="PEM file with its key.")
@click.option("--token-file", type=FILE, help="File with the token that lets browsers in, instead of one-time links.")
@click.option(
    "--commission",
    type=FILE,
    help="Serve the commissioning page for this configuration of a rig: it writes the file, and its steps move axes.",
)
@click.option("--json", "as_json", is_flag=True, help="Print the link as a line of JSON.")
@click.option(
    "--log-level",
    type=click.Choice(["debug", "info", "warning", "error"]),
    default="warning",
    show_default=True,
    help="Log nothing below this.",
)
def command(
    connect: tuple[str, ...],
    config: Path | None,
    rig: tuple[str, ...],
    listen: ListenAddress,
    host: tuple[str, ...],
    certificate: Path | None,
    key: Path | None,
    token_file: Path | None,
    *,
    commission: Path | None,
    as_json: bool,
    log_level: str,
) -> None:
    """Show rigs in a browser until SIGTERM or SIGINT; prints the link that opens it. SIGUSR1 prints another one.

    It stops axes, it is not an emergency stop. With --commission every browser that is let in can also search a port
    for drives, write the configuration, and run the steps of `ldcnd commission` and `ldcnd tune`.
    """
    try:
        from ldcnd.console.rigs import Endpoint  # noqa: PLC0415 - its packages are optional
        from ldcnd.console.server import serve  # noqa: PLC0415
        from ldcnd.console.settings import ConsoleSettings, read_token  # noqa: PLC0415
    except ImportError as error:
        raise ConfigError(f"{error.name} is not installed", remedy="install ldcnd[console]") from error
    configure_logging(level=log_level)
    endpoints = connect or (() if config else (DEFAULT_ENDPOINT,))
    settings = ConsoleSettings(
        endpoints=tuple(
            Endpoint(name, ZenohSettings(mode="client", connect=(name,), config_file=config, instance="ldcnd console"))
            for name in endpoints
        )
        or (Endpoint(str(config), ZenohSettings(mode=None, config_file=config, instance="ldcnd console")),),
        rigs=rig,
        address=listen,
        hosts=host,
        certificate=certificate,
        key=key,
        token=read_token(token_file) if token_file else None,
        as_json=as_json,
    )
    asyncio.run(serve(settings, _commissioning(commission, endpoints) if commission else None))


def _commissioning(config: Path, endpoints: Sequence[str]) -> "MoreRoutes":
    """Return the routes of the commissioning page for a configuration."""
    from ldcnd.console.commissioning.routes import Commissioning  # noqa: PLC0415 - its packages are optional

    words = ["ldcnd", "run", "--config", str(config)]
    if endpoints and endpoints[0] != DEFAULT_ENDPOINT:
        words += ["--listen", endpoints[0]]  # where this console looks for it
    return lambda rigs: Commissioning(rigs, config, shlex.join(words)).routes()
