"""`ldcnd epics`: the axes of a rig as EPICS motor records, from a process of its own."""

import asyncio

import click

from ldcnd.cli.connection import Target, with_target
from ldcnd.cli.ending import on_end
from ldcnd.cli.served_at import address_option
from ldcnd.client.rig import Rig
from ldcnd.client.rig_client import RigClient
from ldcnd.contract.errors import ConfigError
from ldcnd.listen_address import ListenAddress

DEFAULT_ADDRESS = "127.0.0.1:5064"


@click.command()
@click.argument("axes", nargs=-1)
@click.option("--prefix", help="Of every process variable; the rig's name and a colon when missing.")
@click.option(
    "--moves", is_flag=True, help="Let puts move the axes, under a lease of this program; it is read-only otherwise."
)
@address_option("--address", DEFAULT_ADDRESS)
@with_target
def command(target: Target, address: ListenAddress, axes: tuple[str, ...], prefix: str | None, moves: bool) -> None:  # noqa: FBT001 - click's
    """Serve AXES (all of them by default) as motor records until SIGTERM or SIGINT.

    Channel Access does not authenticate clients: with --moves, any client that reaches the address moves axes.
    """
    target.run(lambda client: _serve(client, address, axes, prefix, moves=moves))


async def _serve(
    client: RigClient, address: ListenAddress, axes: tuple[str, ...], prefix: str | None, *, moves: bool
) -> None:
    try:
        from ldcnd.lab.epics.gateway import gateway, serve  # noqa: PLC0415 - needs an optional package
    except ImportError as error:
        raise ConfigError("caproto is not installed", remedy="pip install 'ldcnd[epics]'") from error
    rig = Rig(client, await client.daemon())
    named = f"{rig.name}:" if prefix is None else prefix
    async with gateway(rig, prefix=named, axes=axes, moves=(axes or rig.axes) if moves else ()) as records:
        serving = asyncio.create_task(serve(records, address), name="channel access")
        on_end(lambda: _cancel(serving))
        click.echo(
            f"{'motor records' if moves else 'read-only motor records'} {named}{{{','.join(axes or rig.axes)}}}"
            f" on {address.in_url}:{address.port}"
        )
        try:
            await serving
        except asyncio.CancelledError:
            return
        except OSError as error:
            where = f"{address.in_url}:{address.port}"
            raise ConfigError(f"cannot serve on {where}: {error.strerror}", value=where) from error


def _cancel(task: asyncio.Task[None]) -> None:
    task.cancel()
