"""`ldcnd console`: rigs in a browser."""

import shlex
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import click

from ldcnd.cli.connection import CONFIG_HELP, Target
from ldcnd.cli.interrupts import run
from ldcnd.cli.typed import CONFIGURATION, CONSOLE_ADDRESS, address_option
from ldcnd.client.network import DEFAULT_ENDPOINT, ZenohSettings
from ldcnd.listen_address import ListenAddress
from ldcnd.log import configure_logging
from ldcnd.parts import require

if TYPE_CHECKING:
    from ldcnd.console.server import MoreRoutes


@click.command()
@click.option(
    "--connect",
    "-e",
    multiple=True,
    envvar="LDCND_CONNECT",
    help=f"Zenoh endpoint of a daemon or router; repeatable [$LDCND_CONNECT, or {DEFAULT_ENDPOINT}].",
)
@click.option("--config", type=CONFIGURATION, help=CONFIG_HELP)
@click.option("--rig", multiple=True, help="Show this rig only; may be repeated.")
@address_option("--listen", CONSOLE_ADDRESS)
@click.option("--host", multiple=True, help="Name under which browsers reach it, beside that; may be repeated.")
@click.option("--certificate", type=CONFIGURATION, help="PEM file: serve HTTPS with this certificate.")
@click.option("--key", type=CONFIGURATION, help="PEM file with its key.")
@click.option(
    "--token-file", type=CONFIGURATION, help="File with the token that lets browsers in, instead of one-time links."
)
@click.option(
    "--commission",
    type=CONFIGURATION,
    help="Serve the commissioning page for this configuration of a rig: it writes the file, and its steps move axes.",
)
@click.option("--link", is_flag=True, help="Print another link of the console that listens at --listen.")
@click.option("--json", "as_json", is_flag=True, help="Print the link as a line of JSON.")
@click.option("--with-input", is_flag=True, hidden=True, help="End when the standard input ends: `run` has that pipe.")
@click.option(
    "--log-level",
    type=click.Choice(["debug", "info", "warning", "error"]),
    default="warning",
    show_default=True,
    help="Log nothing below this.",
)
def console(
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
    link: bool,
    as_json: bool,
    with_input: bool,
    log_level: str,
) -> None:
    """Show rigs in a browser until SIGTERM or SIGINT; prints the link that opens it; --link prints another.

    It stops axes, it is not an emergency stop. With --commission every browser that is let in can also search a port
    for drives, write the configuration, and run the steps of `ldcnd commission` and `ldcnd tune`.
    """
    require("markdown_it", "segno", "starlette", "uvicorn", "websockets")
    from ldcnd.console.link_socket import ask_for_link  # noqa: PLC0415 - its packages are optional
    from ldcnd.console.rigs import Endpoint  # noqa: PLC0415
    from ldcnd.console.server import serve, show_link  # noqa: PLC0415
    from ldcnd.console.settings import ConsoleSettings, read_token  # noqa: PLC0415

    if link:
        show_link(run(partial(ask_for_link, listen)), as_json=as_json)
        return
    configure_logging(level=log_level)
    if config and config.suffix == ".toml":
        target = Target.given(connect, (), config, None, as_json=as_json)
        connect, config, rig = target.connect, None, rig or ((target.rig,) if target.rig else ())
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
        with_input=with_input,
    )
    run(partial(serve, settings, _commissioning(commission, endpoints) if commission else None))


def _commissioning(config: Path, endpoints: Sequence[str]) -> "MoreRoutes":
    """Return the routes of the commissioning page for a configuration."""
    from ldcnd.console.commissioning.routes import Commissioning  # noqa: PLC0415 - its packages are optional

    words = ["ldcnd", "run", "--config", str(config)]
    if endpoints and endpoints[0] != DEFAULT_ENDPOINT:
        words += ["--listen", endpoints[0]]  # where this console looks for it
    return lambda rigs: Commissioning(rigs, config, shlex.join(words)).routes()
