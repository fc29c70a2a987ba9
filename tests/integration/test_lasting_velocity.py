"""Motions at a velocity that last as long as they are asked to, end with a ramp, and are bounded in the drive."""

import asyncio

import pytest

from ldcnd.config.rig import load_config
from ldcnd.contract.commands import BufferMode, Halt, Jog, MoveRelative, MoveVelocity, Power, SetPosition
from ldcnd.contract.errors import PositionLimit, ValueOutOfRange
from ldcnd.contract.events import CommandStatus, ReadOutcome
from ldcnd.contract.questions import Preview
from ldcnd.contract.rig_commands import SetSpeedOverride
from ldcnd.contract.samples import AxisState, Moving
from ldcnd.testing import simulated_rig
from tests.support.chain_rig import rig_on
from tests.support.machine_rig import COUNTS, chain_of_machine, machine, running_machine
from tests.support.rig import SIMULATED

LONG = {"longest_run_s": 3600, "jog_horizon_s": 5}
SPIN = MoveVelocity(velocity=5.0, duration_s=20.0)


@pytest.mark.long
async def test_a_motion_lasts_as_long_as_it_is_asked_to_and_ends_with_a_ramp():
    async with running_machine(machine(axis=LONG)) as rig:
        await rig.client.command("rotor", Power(on=True))
        reply = await rig.client.command("rotor", SPIN)
        await asyncio.sleep(0.3)
        assert rig.speed() == pytest.approx(5.0, rel=0.05)
        await asyncio.sleep(19.9)
        assert rig.speed() == pytest.approx(5.0, rel=0.05)  # for 20 s at its velocity
        await asyncio.sleep(0.2)
        assert 0.2 < rig.speed() < 4.9  # it ramps down
        await rig.until("rotor", lambda state: state.state is AxisState.STANDSTILL, within_s=2.0)
        assert (reply.duration_s, reply.position) == (pytest.approx(20.5, rel=1e-3), pytest.approx(101.25, rel=1e-3))


@pytest.mark.long
@pytest.mark.parametrize("percent", [0.5, 2, 10])
@pytest.mark.parametrize("kind", ["move", "jog", "velocity"])
@pytest.mark.sweep(3)
async def test_a_healthy_axis_that_is_slowed_down_in_mid_motion_has_no_fault(kind, percent):
    unsettled = {"settle": {"window": 0.01, "unsettled": "fault"}}
    async with running_machine(machine(axis=LONG | unsettled)) as rig:
        await rig.client.command("rotor", Power(on=True))
        commands = {
            "move": MoveRelative(distance=1.2, velocity=1.0),
            "jog": Jog(velocity=1.0, hold_s=1.0),
            "velocity": MoveVelocity(velocity=1.0, duration_s=3.0),
        }
        await rig.client.command("rotor", commands[kind])
        await asyncio.sleep(0.8)
        await rig.client.ask(SetSpeedOverride(percent=percent))
        await asyncio.sleep(3)
        await rig.client.command("rotor", Halt())
        state = await rig.until("rotor", lambda state: state.command is None)
        await asyncio.sleep(2)
        later = await rig.client.state("rotor")

    assert (state.state, later.state, later.moving) == (AxisState.STANDSTILL, AxisState.STANDSTILL, Moving.NO)


@pytest.mark.parametrize(
    ("acceleration", "changes"),
    [
        (10.0, [(5, 50)]),
        (10.0, [(5, 25), (10, 100)]),
        (10.0, [(5, 50), (10, 75)]),
        (1.0, [(2, 10), (4, 100)]),
        (1.0, [(0.5, 50), (8, 100)]),
        (2.0, [(1, 10), (3, 100), (6, 20), (14, 100)]),
        (1.0, [(7, 3), (12, 100)]),
        (1.0, [(16, 60)]),
    ],
)
@pytest.mark.sweep(3)
async def test_a_motion_ends_in_its_time_at_whatever_speed_override(acceleration, changes):
    async with running_machine(machine(axis=LONG)) as rig:
        await rig.client.command("rotor", Power(on=True))
        begun_s = asyncio.get_running_loop().time()
        await rig.client.command("rotor", SPIN.model_copy(update={"acceleration": acceleration}))
        for at_s, percent in changes:
            await asyncio.sleep(begun_s + at_s - asyncio.get_running_loop().time())
            await rig.client.ask(SetSpeedOverride(percent=percent))
        await asyncio.sleep(begun_s + 19.0 - asyncio.get_running_loop().time())
        speed = rig.speed()
        state = await rig.until("rotor", lambda state: state.command is None)
        took_s = asyncio.get_running_loop().time() - begun_s

    assert speed == pytest.approx(5.0 * changes[-1][1] / 100, rel=0.2)
    assert took_s == pytest.approx(20.0 + 2 * 5.0 / acceleration, abs=2.0)  # speeds are read in coarse steps
    assert (state.last_error, state.state) == (None, AxisState.STANDSTILL)


@pytest.mark.long
async def test_the_same_motion_sent_again_lasts_from_then_on():
    async with running_machine(machine(axis=LONG)) as rig:
        await rig.client.command("rotor", Power(on=True))
        for _ in range(4):
            await rig.client.command("rotor", SPIN.model_copy(update={"duration_s": 5.5}))
            await asyncio.sleep(4.0)
            assert rig.speed() == pytest.approx(5.0, rel=0.05)
        await asyncio.sleep(4.0)
        assert rig.speed() == 0


async def test_the_drive_ends_it_when_the_daemon_is_killed():
    chain = chain_of_machine()
    async with rig_on(chain, machine(axis=LONG)) as rig:
        await rig.until("rotor", lambda state: state.link == "up")
        await rig.client.command("rotor", Power(on=True))
        await rig.client.command("rotor", SPIN)
        await asyncio.sleep(1.0)
        await rig.kill()
        drive = chain.modules[0]
        for after_s, speed in ((15.0, 5.0), (6.0, 0.0)):
            await asyncio.sleep(after_s)
            drive.catch_up(asyncio.get_running_loop().time())
            shown = abs(drive.shaft.velocity_counts) / drive.profile.servo_cycle_s / COUNTS
            assert shown == pytest.approx(speed, abs=0.1)


@pytest.mark.parametrize(
    ("longest_s", "asked_s", "velocity", "said"),
    [
        (None, 61.0, 5.0, "lasts at most 60 s, not 61 s"),
        (600, 601.0, 5.0, "lasts at most 600 s"),
        (86_400, 86_400.0, 50.0, "lasts at most 42520.2 s"),  # the counter has 32 bits
    ],
)
async def test_a_longer_one_than_configuration_or_counter_allow_is_refused(longest_s, asked_s, velocity, said):
    axis = {} if longest_s is None else {"longest_run_s": longest_s}
    async with running_machine(machine(axis=axis)) as rig:
        await rig.client.command("rotor", Power(on=True))
        with pytest.raises(ValueOutOfRange, match=said):
            await rig.client.command("rotor", MoveVelocity(velocity=velocity, duration_s=asked_s))
        with pytest.raises(ValueOutOfRange, match=said):
            await rig.client.command(
                "rotor", MoveVelocity(velocity=velocity, duration_s=asked_s, buffer_mode=BufferMode.ABORTING)
            )
        assert rig.speed() == 0


@pytest.mark.parametrize("name", ["x", "y", "z", "c"])
@pytest.mark.parametrize("velocity", [8.0, -8.0])
@pytest.mark.parametrize("mode", BufferMode)
@pytest.mark.sweep(7)
async def test_software_limits_ahead_do_not_make_it_longer(name, velocity, mode):
    async with simulated_rig(load_config(SIMULATED)) as rig:
        client = rig.client.client
        await client.command(name, Power(on=True))
        await client.command(name, SetPosition(position=0.0))
        spin = MoveVelocity(velocity=velocity, duration_s=1.5, buffer_mode=mode)
        reply = await client.command(name, spin)
        await asyncio.sleep(4.0)
        way = velocity * (1.5 + abs(velocity) / reply.acceleration)
        assert reply.position == pytest.approx(way, rel=1e-3)
        assert rig.truth(name).position == pytest.approx(way, abs=0.1)
        assert rig.truth(name).at_rest


@pytest.mark.parametrize("side", [1, -1])
async def test_a_limit_that_was_passed_is_not_returned_to(side):
    async with simulated_rig(load_config(SIMULATED)) as rig:
        client = rig.client.client
        await client.command("x", Power(on=True))
        await client.command("x", SetPosition(position=side * 101.0))
        before = rig.truth("x").position
        with pytest.raises(PositionLimit):
            await client.command("x", MoveVelocity(velocity=side * 8.0))
        await asyncio.sleep(1.0)
        assert rig.truth("x").position == pytest.approx(before, abs=0.05)


@pytest.mark.parametrize(
    ("axis", "lasts_s"),
    [
        ({"longest_run_s": 15, "jog_horizon_s": 5}, 15),
        ({"longest_run_s": 3, "jog_horizon_s": 60}, 3),
        ({"jog_horizon_s": 4}, 4),
    ],
)
@pytest.mark.parametrize("on_the_fly", [False, True])
@pytest.mark.sweep(5)
async def test_one_that_asks_for_no_duration_says_when_it_will_end_and_that_it_has_ended_by_that(
    axis, lasts_s, on_the_fly
):
    async with running_machine(machine(axis=axis)) as rig:
        await rig.client.command("rotor", Power(on=True))
        planned = await rig.client.ask(Preview(velocity=5.0), "rotor")
        if on_the_fly:
            await rig.client.command("rotor", MoveVelocity(velocity=2.0))
            await asyncio.sleep(1.0)
        reply = await rig.client.command("rotor", MoveVelocity(velocity=5.0, buffer_mode=BufferMode.ABORTING))
        await asyncio.sleep(lasts_s - 0.2)
        assert rig.speed() == pytest.approx(5.0, rel=0.05)
        await rig.until("rotor", lambda state: state.state is AxisState.STANDSTILL, within_s=3.0)
        ended = await rig.client.ask(ReadOutcome(command_id=reply.command_id))

    said = f"runs until it is stopped, for at most {lasts_s} s unless it is sent again"
    assert (planned.ends, reply.ends) == (said, said)
    assert (ended.status, ended.reason) == (CommandStatus.DONE, f"came to its own end: it {said}")


async def test_one_with_a_limit_ahead_says_where_it_will_end():
    async with simulated_rig(load_config(SIMULATED)) as rig:
        client = rig.client.client
        await client.command("x", Power(on=True))
        await client.command("x", SetPosition(position=90.0))
        planned = await client.ask(Preview(velocity=8.0), "x")
        reply = await client.command("x", MoveVelocity(velocity=8.0))
        await asyncio.sleep(4.0)
        ended = await client.ask(ReadOutcome(command_id=reply.command_id))

    assert planned.ends == reply.ends == "runs until it is stopped, at most to its software limit 100 mm"
    assert ended.reason == f"came to its own end: it {reply.ends}"


async def test_one_that_is_halted_does_not_claim_that_it_ended_by_itself():
    async with running_machine(machine(axis=LONG)) as rig:
        await rig.client.command("rotor", Power(on=True))
        reply = await rig.client.command("rotor", MoveVelocity(velocity=5.0))
        await asyncio.sleep(1.0)
        await rig.client.command("rotor", Halt())
        await rig.until("rotor", lambda state: state.state is AxisState.STANDSTILL, within_s=3.0)
        ended = await rig.client.ask(ReadOutcome(command_id=reply.command_id))

    assert "own end" not in (ended.reason or "")
