"""`ldcnd foxglove`: a running rig, live in the Foxglove app."""

import asyncio

import click

from ldcnd.cli.connection import Target, with_target
from ldcnd.cli.ending import on_end
from ldcnd.cli.served_at import address_option
from ldcnd.client.rig_client import RigClient
from ldcnd.contract.errors import ConfigError
from ldcnd.listen_address import ListenAddress

DEFAULT_ADDRESS = "127.0.0.1:8765"


@click.command()
@address_option("--address", DEFAULT_ADDRESS)
@with_target
def command(target: Target, address: ListenAddress) -> None:
    """Show a rig in Foxglove until SIGTERM or SIGINT; read-only, and open to everyone who can reach the address."""
    target.run(lambda client: _serve(client, address))


async def _serve(client: RigClient, address: ListenAddress) -> None:
    try:
        from ldcnd.lab.recording.live_view import LiveView  # noqa: PLC0415 - needs an optional package
    except ImportError as error:
        raise ConfigError("foxglove-sdk is not installed", remedy="install ldcnd[foxglove]") from error
    ending = asyncio.Event()
    on_end(ending.set)
    with LiveView(f"ldcnd {client.rig}", address.host, address.port) as view:
        async with client.published(view.take):
            click.echo(f"rig {client.rig} on ws://{address.in_url}:{view.port}")
            await ending.wait()
