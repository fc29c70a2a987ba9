"""What the daemon notices of a drive that another program on its line has reset or changed, and what nothing shows."""

import asyncio
from collections.abc import Callable

import pytest

from ldcnd.contract.commands import MoveAbsolute, MoveRelative, Power
from ldcnd.contract.events import DRIVE_CHANGED, CommandEvent, CommandStatus, ReadEvents, ReadOutcome
from ldcnd.contract.questions import Preview
from ldcnd.contract.samples import AxisState, LinkState, Moving
from ldcnd.drives.driver import Gains
from ldcnd.drives.ldcn.controls import StopControl
from ldcnd.drives.ldcn.packet import CommandCode
from ldcnd.drives.ldcn.profiles import HomingControl
from ldcnd.drives.ldcn.received import LoadTrajectory, ResetPosition, SetGain, SetHomingMode, StopMotor
from ldcnd.drives.ldcn.trajectory import ProfileMode, Trajectory
from ldcnd.sim.ldcn.chain import ChainSpec, ModuleSpec, build_chain
from ldcnd.sim.ldcn.drive import SimulatedDrive
from tests.support.chain_rig import ChainRig, drive, rig_on, simulated_config

Tamper = Callable[[SimulatedDrive], object]
AXES = {"x": 1, "z": 3}
"""An LS-182AP and a PIC-SERVO, by their addresses."""


def reset(module: SimulatedDrive) -> None:
    now_s = asyncio.get_running_loop().time()
    module.power(on=False, at_s=now_s)
    module.power(on=True, at_s=now_s)


def reset_and_address(module: SimulatedDrive) -> None:
    """Between two polls: address, group and rate are what they were."""
    was = module.address, module.group, module.baud, module.address_out
    module.restart()
    module.address, module.group, module.baud, module.address_out = was


def move(module: SimulatedDrive) -> None:
    module.execute(
        LoadTrajectory(
            Trajectory(
                position=module.loop.position + 2000,
                velocity=1 << 14,
                acceleration=100,
                servo=True,
                mode=ProfileMode.TRAPEZOIDAL,
                start_now=True,
            )
        )
    )


async def standing_at(rig: ChainRig, axis: str, position: float, *, on: bool = True) -> None:
    await rig.until(axis, lambda state: state.link is LinkState.UP and state.moving is Moving.NO)
    await rig.client.command(axis, Power(on=True))
    if position:
        reply = await rig.client.command(axis, MoveAbsolute(position=position))
        await rig.client.wait_for_end(axis, reply.command_id)
    if not on:
        await rig.client.command(axis, Power(on=False))
        await rig.until(axis, lambda state: state.moving is Moving.NO)


async def said(rig: ChainRig, axis: str) -> list[CommandEvent]:
    return [event for event in (await rig.client.ask(ReadEvents(axis=axis))).events if event.verb == DRIVE_CHANGED]


def codes(rig: ChainRig, axis: str) -> set[str]:
    service = next(each for each in rig.line.axes if each.config.name == axis)
    return {fault.code for fault in service.tracker.status.active_faults}


def four_drives() -> ChainSpec:
    return ChainSpec(tuple(ModuleSpec(name) for name in ("ls182ap", "ls182ap", "picservo-v4", "picservo-v4")))


@pytest.mark.promise("foreign-program-found")
@pytest.mark.parametrize("axis", AXES)
@pytest.mark.parametrize(
    ("tamper", "on", "code"),
    [
        (reset_and_address, True, "drive_reset"),
        (reset_and_address, False, "drive_reset"),
        (lambda module: module.execute(ResetPosition()), True, "drive_reset"),
        (lambda module: module.execute(ResetPosition()), False, "drive_reset"),
        (move, True, "drive_changed"),
        (lambda module: module.execute(SetHomingMode(HomingControl.INDEX)), True, "drive_changed"),
        (lambda module: module.execute(StopMotor(StopControl.MOTOR_OFF, None)), True, "position_error"),
        (lambda module: setattr(module, "address", 9), True, "link_lost"),
        (lambda module: setattr(module, "baud", 9600), True, "link_lost"),
    ],
)
@pytest.mark.sweep(4)
async def test_what_another_program_does_to_a_drive_is_found_at_the_next_polls(axis, tamper, on, code):
    """Also where a drive was reset within the position error limit, which no jump of the position would show."""
    chain = build_chain(four_drives())
    async with rig_on(chain, simulated_config({"reference": "at_reset"})) as rig:
        await standing_at(rig, axis, 5.0, on=on)
        before = len(rig.sent)

        tamper(drive(chain, AXES[axis]))
        await asyncio.sleep(1.0)
        state, events = await rig.client.state(axis), await said(rig, axis)
        sent = {packet.command for packet in rig.sent[before:]}

    assert code in codes(rig, axis)
    assert state is not None
    assert state.referenced is (code in ("drive_changed", "position_error"))
    assert [event.code for event in events] == ([code] if code in ("drive_reset", "drive_changed") else [])
    assert not sent & {
        CommandCode.SET_GAIN,
        CommandCode.LOAD_TRAJECTORY,
        CommandCode.START_MOTION,
        CommandCode.RESET_POSITION,
    }


@pytest.mark.parametrize("buffered", [False, True])
@pytest.mark.parametrize("how", [StopControl.SMOOTH, StopControl.ABRUPT])
async def test_a_move_that_another_program_stops_has_failed_and_distances_count_from_there(how, buffered):
    chain = build_chain(four_drives())
    async with rig_on(chain, simulated_config({"reference": "at_reset"})) as rig:
        await standing_at(rig, "x", 0.0)
        sent = await rig.client.command("x", MoveAbsolute(position=20.0, velocity=10.0))
        if buffered:
            behind = await rig.client.command("x", MoveAbsolute(position=21.0, buffer_mode="buffered"))
        await asyncio.sleep(0.6)
        drive(chain, 1).execute(StopMotor(StopControl.AMP_ENABLE | how, None))
        await rig.client.wait_for_end("x", sent.command_id)
        ended = await rig.client.ask(ReadOutcome(command_id=sent.command_id))
        await asyncio.sleep(2.0)
        stands = drive(chain, 1).loop.position
        if buffered:
            refused = await rig.client.ask(ReadOutcome(command_id=behind.command_id))
            assert refused.status is not CommandStatus.DONE
        reply = await rig.client.command("x", MoveRelative(distance=1.0))
        await rig.client.wait_for_end("x", reply.command_id)
        counts = drive(chain, 1).loop.position - stands

    assert ended.status is CommandStatus.FAILED
    assert "another program has stopped it" in ended.reason
    assert stands < 15_000
    assert counts == pytest.approx(1000, abs=20)


@pytest.mark.parametrize("axis", AXES)
async def test_a_distance_counts_from_where_another_program_has_moved_the_axis(axis):
    chain = build_chain(four_drives())
    async with rig_on(chain, simulated_config({"reference": "at_reset"})) as rig:
        await standing_at(rig, axis, 5.0)
        move(drive(chain, AXES[axis]))
        await asyncio.sleep(10.0)
        await rig.until(axis, lambda state: state.moving is Moving.NO)
        moved = drive(chain, AXES[axis]).loop.position

        plan = await rig.client.ask(Preview(distance=1.0), axis)
        reply = await rig.client.command(axis, MoveRelative(distance=1.0))
        await rig.client.wait_for_end(axis, reply.command_id)
        units = drive(chain, AXES[axis]).loop.position - moved

    assert plan.position == pytest.approx(reply.position)
    assert units == pytest.approx({"x": 1000, "z": 2000}[axis], abs=20)


@pytest.mark.promise("contradiction-stops")
@pytest.mark.parametrize(("axis", "position", "at"), [("x", 80.0, 30_000), ("z", 45.0, 40_000)])
@pytest.mark.sweep(2)
async def test_a_counter_that_another_program_sets_in_mid_motion_costs_the_reference_and_halts_the_axis(
    axis, position, at
):
    chain = build_chain(four_drives())
    async with rig_on(chain, simulated_config({"reference": "at_reset"})) as rig:
        await standing_at(rig, axis, 0.0)
        await rig.client.command(axis, MoveAbsolute(position=position))
        while drive(chain, AXES[axis]).loop.position < at:
            await asyncio.sleep(0.01)
        drive(chain, AXES[axis]).execute(ResetPosition())
        await asyncio.sleep(0.5)
        state = await rig.client.state(axis)
        await asyncio.sleep(1.0)
        before = drive(chain, AXES[axis]).loop.position
        await asyncio.sleep(0.5)

        assert drive(chain, AXES[axis]).loop.position == pytest.approx(before, abs=3)
    assert state is not None
    assert (state.state, state.referenced, state.link) == (AxisState.ERROR_STOP, False, LinkState.UP)


async def test_a_drive_that_was_reset_is_said_when_it_has_its_address_again():
    chain = build_chain(four_drives())
    async with rig_on(chain, simulated_config({"reference": "at_reset"})) as rig:
        await standing_at(rig, "x", 5.0)
        reset(drive(chain, 1))
        state = await rig.until("x", lambda state: state.link is LinkState.UP and not state.referenced)
        events = await said(rig, "x")

    assert (state.state, state.enabled) == (AxisState.ERROR_STOP, False)
    assert [event.code for event in events] == ["drive_reset"]


@pytest.mark.promise("foreign-program-found")
async def test_gains_that_nothing_shows_are_written_again_before_the_loop_is_closed():
    """A drive near 0 that was reset while disabled, or got other gains, shows nothing of it: no status has gains."""
    chain = build_chain(four_drives())
    async with rig_on(chain, simulated_config({"reference": "at_reset"})) as rig:
        await standing_at(rig, "x", 0.0, on=False)
        drive(chain, 1).execute(SetGain(Gains(0, 0, 0, 0, 0, 0, 0, 1)))
        await asyncio.sleep(1.0)
        silent = codes(rig, "x")
        await standing_at(rig, "x", 2.0)

    assert silent == set()
    assert drive(chain, 1).loop.position == pytest.approx(2000, abs=12)


async def test_what_the_daemon_does_itself_is_no_change_by_another():
    chain = build_chain(four_drives())
    async with rig_on(chain, simulated_config({"reference": "at_reset"})) as rig:
        for axis in AXES:
            await standing_at(rig, axis, 3.0)
            await standing_at(rig, axis, -3.0, on=False)
            await standing_at(rig, axis, 0.0)
        events = [event for axis in AXES for event in await said(rig, axis)]

    assert events == []
