"""`ldcnd ros2`: joint states and diagnostics for ROS 2 nodes that use rmw_zenoh, from a process of its own."""

import asyncio

import click

from ldcnd.cli.connection import Target, with_target
from ldcnd.cli.ending import on_end
from ldcnd.cli.typed import Whole
from ldcnd.client.rig import Rig
from ldcnd.client.rig_client import RigClient
from ldcnd.contract.errors import UnknownAxis

HIGHEST_DOMAIN = 232


@click.command()
@click.argument("axes", nargs=-1)
@click.option("--router", required=True, help="Zenoh endpoint of the ROS graph's router, such as tcp/127.0.0.1:7447.")
@click.option("--domain", type=Whole(0, HIGHEST_DOMAIN), default=0, show_default=True, envvar="ROS_DOMAIN_ID")
@with_target
def command(target: Target, axes: tuple[str, ...], router: str, domain: int) -> None:
    """Publish AXES (all of them by default) on /joint_states and /diagnostics until SIGTERM or SIGINT; read-only."""
    target.run(lambda client: _serve(client, axes, router, domain))


async def _serve(client: RigClient, axes: tuple[str, ...], router: str, domain: int) -> None:
    from ldcnd.lab.ros2.bridge import run_bridge  # noqa: PLC0415
    from ldcnd.net.zenoh_session import open_zenoh_session  # noqa: PLC0415 - loads Zenoh
    from ldcnd.net.zenoh_settings import ZenohSettings  # noqa: PLC0415

    rig = Rig(client, await client.daemon())
    for axis in axes:
        if axis not in rig.axes:
            raise UnknownAxis(
                f"rig {rig.name} has no axis {axis!r}; it has {', '.join(rig.axes)}", axis=axis, value=axis
            )
    endpoint = router if "/" in router else f"tcp/{router}"
    async with open_zenoh_session(ZenohSettings(mode="client", connect=(endpoint,))) as session:
        running = asyncio.create_task(run_bridge(rig, session, axes, domain), name="bridge")
        on_end(lambda: _cancel(running))
        click.echo(f"rig {rig.name} in ROS domain {domain} through {endpoint}")
        try:
            await running
        except asyncio.CancelledError:
            return


def _cancel(task: asyncio.Task[None]) -> None:
    task.cancel()
