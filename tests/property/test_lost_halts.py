"""A cable that is cut for a moment, at every instant of a group's start: no member runs on alone."""

import asyncio

import pytest

from ldcnd.config.rig import load_config
from ldcnd.contract.commands import Jog, Power, QuickStop, Reset, SetPosition, SetPwm, Stop
from ldcnd.contract.errors import LdcndError, StopLatched
from ldcnd.contract.rig_commands import AxisMove, LinePath, MoveTogether
from ldcnd.drives.axis_config import PwmConfig
from ldcnd.testing import run, simulated_rig
from tests.support.rig import SIMULATED


def gantry():
    """Return two drives on one line that move together."""
    config = load_config(SIMULATED)
    (bus,), (line,) = config.bus, config.sim
    rates = {"position": 20, "velocity": 20, "adc": 0, "state": 20}
    changes = {"pwm": PwmConfig(duty=0.2, duration_s=5.0), "rates": type(bus.axis[0].rates).model_validate(rates)}
    axes = tuple(axis.model_copy(update=changes) for axis in bus.axis[:2])
    bus = bus.model_copy(update={"axis": axes, "group": bus.group[:1], "margin_ms": 5})
    line = line.model_copy(update={"module": line.module[:2]})
    return config.model_copy(update={"bus": (bus,), "sim": (line,)})


async def cut_at(instant_s, cut_s, path):
    async with simulated_rig(gantry()) as rig:
        client = rig.client.client
        for name in "xy":
            await client.command(name, Power(on=True))
            await client.command(name, SetPosition(position=0.0))
        await asyncio.sleep(0.3)
        moves = tuple(AxisMove(axis=name, position=20.0) for name in "xy")

        async def move():
            try:
                await client.ask(MoveTogether(moves=moves, path=path), timeout_s=10)
            except LdcndError as error:
                return error
            return None

        moving = asyncio.create_task(move())
        await asyncio.sleep(instant_s)
        rig.faults.cable_cut("y", for_s=cut_s)
        error = await moving
        await asyncio.sleep(6)
        return error, rig.truth("x").position, rig.truth("y").position


@pytest.mark.parametrize("path", LinePath)
@pytest.mark.parametrize("cut_s", [0.05, 0.1, 0.3, 1.0])
@pytest.mark.sweep(8)
def test_a_halt_of_a_group_that_one_member_does_not_hear_is_sent_until_it_has(path, cut_s):
    apart = []
    for instant_ms in range(3, 15):
        error, x, y = run(cut_at(instant_ms / 1000, cut_s, path))
        # on its way when it is cut off, a member goes on until the cable is whole and a little more
        if error is not None and abs(x - y) > 20.0 * (cut_s + 0.2) + 0.5:
            apart.append((instant_ms, error.message, x, y))
    assert not apart


async def stopped_at(instant_s, verb):
    async with simulated_rig(gantry()) as rig:
        client = rig.client.client
        for name in "xy":
            await client.command(name, Power(on=True))
            await client.command(name, SetPosition(position=0.0))
        await asyncio.sleep(0.3)
        moves = tuple(AxisMove(axis=name, position=20.0) for name in "xy")
        asked = client.ask(MoveTogether(moves=moves, path=LinePath.LINEAR), timeout_s=10)
        moving = asyncio.create_task(asked)
        await asyncio.sleep(instant_s)
        at_stop_done = moving.done()
        await client.command("y", verb())
        await asyncio.wait((moving,))
        await asyncio.sleep(4)
        return at_stop_done, moving.exception() is None, rig.truth("x").position


@pytest.mark.parametrize("verb", [Stop, QuickStop])
@pytest.mark.sweep(2)
def test_a_line_that_loses_a_member_before_it_is_answered_is_walked_by_none(verb):
    for instant_ms in range(2, 20):
        answered_before, accepted, x = run(stopped_at(instant_ms / 1000, verb))
        assert answered_before or (not accepted and abs(x) < 1.0), (instant_ms, accepted, x)


async def reset_within(gap_s, verb, lose):
    async with simulated_rig(gantry()) as rig:
        client = rig.client.client
        await client.command("x", Power(on=True))
        await asyncio.sleep(0.5)
        if lose:
            rig.faults.lost_replies(1.0, for_s=0.03)
        stopping = asyncio.create_task(client.command("x", verb()))
        await asyncio.sleep(gap_s)
        before = stopping.done()
        refused = None
        try:
            await client.command("x", Reset())
        except LdcndError as error:
            refused = error
        await asyncio.wait((stopping,))
        return before, refused, (await client.state("x")).stop_latched


@pytest.mark.parametrize("verb", [Stop, QuickStop])
@pytest.mark.parametrize("lose", [False, True], ids=["clear", "replies lost"])
@pytest.mark.sweep(3)
def test_a_reset_that_comes_in_the_middle_of_a_stop_leaves_it_latched(verb, lose):
    for gap_ms in (0.1, 0.3, 0.5, 1, 3, 10, 20):
        before, refused, latched = run(reset_within(gap_ms / 1000, verb, lose))
        assert before or (isinstance(refused, StopLatched) and latched), (gap_ms, refused, latched)


async def ends_after(command, begins_s):
    async with simulated_rig(gantry()) as rig:
        client = rig.client.client
        await client.command("x", Power(on=True))
        began_s = rig.now_s
        await client.command("x", command)
        await asyncio.sleep(began_s + begins_s - rig.now_s)
        rig.faults.cable_cut("x", for_s=0.1)
        await asyncio.sleep(0.11)
        await rig.at_rest("x")
        return rig.now_s - began_s


ENDING = [Jog(velocity=8.0, hold_s=0.6), SetPwm(duty=0.1, duration_s=0.6)]


@pytest.mark.parametrize("command", ENDING, ids=["jog", "set_pwm"])
@pytest.mark.sweep(2)
def test_an_end_that_falls_into_a_cut_comes_as_soon_as_the_drive_answers(command):
    """The cable is whole again after 0.7 s at the latest; a poll of the rig's rates and the ramp follow."""
    assert max(run(ends_after(command, 0.5 + step / 100)) for step in range(11)) < 1.1
