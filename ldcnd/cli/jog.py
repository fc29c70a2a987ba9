"""`ldcnd axis jog`: run an axis for a time, or for as long as a key is held; then it is halted, whatever happens."""

import asyncio
import sys
from functools import partial

import click

from ldcnd.cli.connection import AXIS, Target, of_options, with_target
from ldcnd.cli.ending import end_as_interrupted
from ldcnd.cli.keyboard import keys, repetitions
from ldcnd.cli.output import show_lines
from ldcnd.cli.quantities import rounded
from ldcnd.cli.sending import NAME, halted, halting
from ldcnd.cli.typed import Finite, axis_of
from ldcnd.client.jog import Jogging
from ldcnd.client.lease import Control, control
from ldcnd.client.rig_client import RigClient
from ldcnd.contract.commands import LONGEST_HOLD_S, Jog
from ldcnd.contract.errors import ConfigError, LeaseExpired
from ldcnd.contract.meta import AxisInfo

LEASE_S = 1.0
"""The daemon applies `loss.client` so soon when this program disappears."""
HOLD_S = 0.4
"""Longest time between two repetitions of the key that reach the daemon; then it ends the jog."""
RENEW_EACH_S = 0.1


@click.command(context_settings={"ignore_unknown_options": True})
@click.argument("axis", type=AXIS)
@click.argument("velocity", type=Finite())
@click.option("--for", "for_s", type=Finite(0, 3600, min_open=True), help="Duration, seconds.")
@click.option("--acceleration", type=Finite(), help="Units a second squared; the axis default when missing.")
@click.option("--force", is_flag=True, help="Take control from its holder.")
@with_target
def jog(
    target: Target, axis: str, velocity: float, for_s: float | None, acceleration: float | None, *, force: bool
) -> None:
    """Run AXIS at VELOCITY (units a second, signed) while the space bar is held, or with --for for a time.

    The axis is under control of this command meanwhile. It is halted when the key is released, when the time is over,
    at Ctrl-C and when the terminal goes; if this program dies, the daemon ends the jog within half a second.
    """
    command = of_options(Jog, velocity=velocity, acceleration=acceleration, hold_s=HOLD_S)
    if for_s is None and not sys.stdin.isatty():
        raise ConfigError("there is no keyboard here", remedy="say how long to run with --for SECONDS")

    async def work(client: RigClient) -> str:
        info = await axis_of(client, axis)
        async with (
            control(client, f"{NAME} jog", axis, lease_s=LEASE_S, force=force) as held,
            halting(client, info),
        ):
            if for_s is None:
                await _while_pressed(client, info, held, command)
            else:
                await _for_a_time(info, held, command, for_s)
            return await halted(client, info)

    end_as_interrupted()
    show_lines(target.run(work))


async def _for_a_time(info: AxisInfo, held: Control, command: Jog, for_s: float) -> None:
    """Run the axis for a time, in seconds, or until its software limit."""
    jog = Jogging(partial(held.command, info.axis), command)
    reply = await jog.begin()
    show_lines(f"{info.axis}: runs at {rounded(reply.velocity or command.velocity)} {info.unit}/s for {for_s:g} s")
    try:
        async with asyncio.timeout(for_s):
            while True:
                await jog.held()
    except TimeoutError:
        return
    except LeaseExpired:
        if held.lost:
            raise


async def _while_pressed(client: RigClient, info: AxisInfo, held: Control, command: Jog) -> None:
    """Run the axis whenever the space bar is held, until another key is pressed."""
    first = command.model_copy(update={"hold_s": LONGEST_HOLD_S})
    with keys() as pressed:
        show_lines("hold the space bar to run, any other key ends", err=True)
        while await pressed.get() == " ":
            jog = Jogging(partial(held.command, info.axis), first)
            await jog.begin()
            try:
                await _renewed_until_released(pressed, jog)
            except LeaseExpired:
                if held.lost:
                    raise
            show_lines(await halted(client, info), err=True)


async def _renewed_until_released(pressed: "asyncio.Queue[str]", jog: Jogging) -> None:
    """Keep a jog alive with the repetitions of the key; return when it is not repeated any more."""
    loop = asyncio.get_running_loop()
    due_s = loop.time()
    async for _ in repetitions(pressed, " "):
        if loop.time() >= due_s:
            due_s = loop.time() + RENEW_EACH_S
            await jog.renew(hold_s=HOLD_S)
