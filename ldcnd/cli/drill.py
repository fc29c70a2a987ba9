"""`ldcnd drill`: rehearse a loss and measure it. Moves the axis that is named."""

import asyncio
import json
from collections.abc import Callable

import click

from ldcnd.cli.connection import AXIS, Target, with_target
from ldcnd.cli.typed import Finite
from ldcnd.client.lease import control
from ldcnd.client.rig_client import RigClient
from ldcnd.contract.commands import MoveVelocity, Power
from ldcnd.contract.errors import WrongState
from ldcnd.contract.leases import Acquire
from ldcnd.contract.rig_commands import Rehearse
from ldcnd.contract.samples import AxisState, StateSample, TelemetryItem

RUN_UP_S = 0.5
"""Time in motion before the loss, seconds."""
PATIENCE_S = 30.0


@click.group()
def command() -> None:
    """Rehearse a loss on an axis that may move, and report measured times."""


def _moving(work: Callable[..., None]) -> Callable[..., None]:
    """Give a drill the axis and the velocity at which it is caught."""
    for option in (
        click.confirmation_option("--yes", prompt="The axis will move. Go on?"),
        click.option("--velocity", type=Finite(), required=True, help="Units a second, signed."),
        click.argument("axis", type=AXIS),
    ):
        work = option(work)
    return work


@command.command("client-loss")
@_moving
@click.option("--lease", "lease_s", type=Finite(), default=1.0, show_default=True, help="Length of the lease, seconds.")
@with_target
def client_loss(target: Target, axis: str, velocity: float, lease_s: float) -> None:
    """Take control, jog, and disappear: how long until the axis reacts, and until it is at rest?"""

    async def work(client: RigClient) -> dict[str, float]:
        if client.lease:
            raise WrongState(
                f"axis {axis}: `ldcnd lease hold`, which runs this, goes on renewing its lease: no client is lost",
                axis=axis,
                remedy="run it outside",
            )
        request = Acquire(client="drill", axes=(axis,), lease_s=lease_s)
        lease = await client.ask(request)
        began_s = asyncio.get_running_loop().time()
        await client.command(axis, Power(on=True, lease=lease.lease))
        await client.command(axis, MoveVelocity(velocity=velocity, lease=lease.lease))
        reacted_s, stands_s = await _watch(client, axis)
        return {
            "lease_s": lease_s,
            "reacted_after_lease_s": reacted_s - began_s - lease_s,
            "stands_after_lease_s": stands_s - began_s - lease_s,
        }

    _report(target, axis, "client loss", target.run(work))


@command.command("daemon-stop")
@_moving
@with_target
def daemon_stop(target: Target, axis: str, velocity: float) -> None:
    """Jog, and let the daemon apply `loss.daemon` as at its shutdown; it does not end."""
    _report(target, axis, "daemon stop", target.run(lambda client: _rehearse(client, axis, velocity, "daemon_stop")))


@command.command("bus-loss")
@_moving
@with_target
def bus_loss(target: Target, axis: str, velocity: float) -> None:
    """Jog, and have the daemon drop the line and open it again."""
    _report(target, axis, "bus loss", target.run(lambda client: _rehearse(client, axis, velocity, "bus_loss")))


async def _rehearse(client: RigClient, axis: str, velocity: float, kind: str) -> dict[str, float]:
    """Play a loss under control of the whole rig: a lost line concerns all axes on it."""
    loop = asyncio.get_running_loop()
    async with control(client, "drill", lease_s=PATIENCE_S) as held:
        await held.command(axis, Power(on=True))
        await held.command(axis, MoveVelocity(velocity=velocity))
        await asyncio.sleep(RUN_UP_S)
        began_s = loop.time()
        request = Rehearse.model_validate({"kind": kind, "axis": axis, "lease": held.lease.lease})
        await client.ask(request, timeout_s=PATIENCE_S)
        answered_s = loop.time()
        reacted_s, stands_s = await _watch(client, axis)
    return {
        "carried_out_s": answered_s - began_s,
        "reacted_s": reacted_s - began_s,
        "stands_s": stands_s - began_s,
    }


async def _watch(client: RigClient, axis: str) -> tuple[float, float]:
    """Return when the axis began to come to rest, and when it stood, in loop time."""
    loop = asyncio.get_running_loop()
    reacted_s = None
    async with client.samples(axis, TelemetryItem.STATE) as states, asyncio.timeout(PATIENCE_S):
        async for _, state in states:
            if not isinstance(state, StateSample) or state.state is AxisState.CONTINUOUS_MOTION:
                continue
            reacted_s = reacted_s or loop.time()
            if state.state is not AxisState.STOPPING:
                return reacted_s, loop.time()
    raise WrongState(f"axis {axis}: no state was published any more", axis=axis)


def _report(target: Target, axis: str, what: str, measured: dict[str, float]) -> None:
    if target.as_json:
        print(json.dumps({"axis": axis, "drill": what, **{name: round(value, 4) for name, value in measured.items()}}))
        return
    print(f"{axis}: {what}")
    for name, value in measured.items():
        print(f"  {name.removesuffix('_s').replace('_', ' '):24} {value:8.3f} s")
