"""Guards whose loss would move a motor or lose a stop, each tried where nothing else would refuse."""

import asyncio
import contextlib
from dataclasses import replace

import pytest

from ldcnd.client.lease import control
from ldcnd.config.rig import load_config
from ldcnd.contract.commands import (
    BufferMode,
    Halt,
    Home,
    HomeMethod,
    MoveAbsolute,
    MoveRelative,
    MoveVelocity,
    Power,
    SetPosition,
    SetPwm,
    Stop,
    Track,
)
from ldcnd.contract.errors import CommandExpired, ErrorCode, LdcndError, StopLatched, WrongState
from ldcnd.contract.questions import Preview
from ldcnd.contract.samples import AxisState
from ldcnd.drives.driver import StopMode
from tests.support.dialect_rig import AXIS, V4, dialect_rig
from tests.support.rig import SIMULATED, running_rig


def leased():
    return load_config(SIMULATED).model_copy(update={"authority": "leased"})


async def test_a_halt_needs_no_lease():
    async with running_rig(leased()) as rig:
        await rig.until("x", lambda state: state.link == "up")
        async with control(rig.client, "ann", "x") as held:
            await held.command("x", Power(on=True))
            await held.command("x", MoveVelocity(velocity=10.0))
            await rig.client.command("x", Halt())
            await rig.until("x", lambda state: state.state is AxisState.STANDSTILL)


async def test_a_start_that_waits_behind_a_busy_line_is_withdrawn_by_a_stop():
    async with dialect_rig(V4) as rig:
        await rig.power_on()
        axis = rig.rig.daemon.rig.axes[AXIS]
        start_of, stops = axis.driver.start, []

        async def start() -> None:
            for _ in range(20_000):
                if not axis._bus.is_idle:
                    break
                await asyncio.sleep(0.00005)
            starting = asyncio.ensure_future(start_of())
            await asyncio.sleep(0)
            stops.append(asyncio.ensure_future(axis.execute(Stop())))
            await starting

        axis.driver.start = start
        with contextlib.suppress(LdcndError):
            await axis.execute(MoveAbsolute(position=15.0))
        assert stops
        await asyncio.gather(*stops)
        await asyncio.sleep(2.0)
        assert abs(rig.position_mm) < 0.5


@pytest.mark.promise("stop-in-any-state")
@pytest.mark.parametrize("share", [n / 12 for n in range(13)])
@pytest.mark.sweep(3)
async def test_a_stop_on_a_busy_line_wins_at_any_instant_of_a_move(share):
    """The sweep of stops over a move's packets, while polls fill the line."""
    async with dialect_rig(V4, rates={"position": 150, "velocity": 150, "adc": 5, "state": 50}) as rig:
        await rig.power_on()
        await asyncio.sleep(0.05)
        move = asyncio.ensure_future(rig.send(MoveAbsolute(position=15.0)))
        await asyncio.sleep(share * 0.02)
        await rig.rig.client.stop(AXIS)
        with contextlib.suppress(LdcndError):
            await move
        await asyncio.sleep(1.0)
        before = rig.position_mm
        await asyncio.sleep(0.5)
        assert rig.position_mm == pytest.approx(before, abs=0.01)
        assert before < 3.0


async def test_an_axis_is_not_given_a_position_in_mid_move():
    async with dialect_rig(V4) as rig:
        await rig.power_on()
        await rig.send(MoveVelocity(velocity=5.0))
        with pytest.raises(WrongState):
            await rig.send(SetPosition(position=0.0))


@pytest.mark.parametrize("between", [Halt(), Power(on=False)])
async def test_a_relative_move_counts_from_where_the_axis_was_stopped(between):
    async with dialect_rig(V4) as rig:
        await rig.power_on()
        await rig.send(MoveAbsolute(position=15.0))
        await asyncio.sleep(0.3)
        if isinstance(between, Halt):
            await rig.done(between)
        else:
            await rig.send(between)
            await asyncio.sleep(1.0)
            await rig.send(Power(on=True))
        here = rig.position_mm
        assert here < 14.0
        await rig.done(MoveRelative(distance=1.0))
        assert rig.position_mm == pytest.approx(here + 1.0, abs=0.1)


TRACKING = {"step": 0.4, "rate": 50.0}


async def test_a_set_point_needs_a_closed_loop_at_rest():
    async with dialect_rig(V4, tracking=TRACKING) as rig:
        await rig.until(lambda state: state.state is AxisState.DISABLED)
        with pytest.raises(WrongState):
            await rig.send(Track(position=0.1))
        await rig.power_on()
        await rig.send(MoveAbsolute(position=15.0))
        await asyncio.sleep(0.1)
        with pytest.raises(WrongState):
            await rig.send(Track(position=rig.position_mm))


async def test_a_duty_that_replaces_another_is_refused_during_a_stop():
    async with dialect_rig(V4, pwm={"duty": 0.5, "duration_s": 5.0}, acceleration=2000) as rig:
        await rig.power_on()
        await rig.send(SetPwm(duty=0.05, duration_s=3.0))
        axis = rig.rig.daemon.rig.axes[AXIS]
        async with asyncio.TaskGroup() as group:
            group.create_task(axis.execute(Stop()))
            await asyncio.sleep(0)
            with pytest.raises(StopLatched):
                await axis.execute(SetPwm(duty=0.05, duration_s=3.0))


async def test_a_target_that_the_drive_would_wrap_is_refused():
    async with dialect_rig(V4) as rig:
        await rig.power_on()
        await asyncio.sleep(1.5)  # it is polled meanwhile
        axis = rig.rig.daemon.rig.axes[AXIS]
        axis.tracker.reading = replace(axis.tracker.latest(), position_counts=-0x70000000)
        refusal = axis.preview(Preview(position=0x60000000 / 1000), ()).refusal
        assert refusal.code == ErrorCode.VALUE_OUT_OF_RANGE


async def test_a_buffered_move_does_not_start_after_a_loss_policy_has_stopped_the_axis():
    async with dialect_rig(V4) as rig:
        await rig.power_on()
        await rig.send(MoveAbsolute(position=10.0, velocity=5.0))
        request = MoveAbsolute(position=15.0, buffer_mode=BufferMode.BUFFERED)
        waiting = asyncio.create_task(rig.rig.client.command(AXIS, request, 30.0))
        await asyncio.sleep(0.3)
        axis = rig.rig.daemon.rig.axes[AXIS]
        await axis.stops.bring_to_rest(StopMode.SMOOTH)
        assert await rig.rig.refusal(await waiting) == "aborted"
        await asyncio.sleep(1.0)
        assert rig.position_mm < 9.0


async def test_a_lease_that_ran_out_while_the_daemon_was_frozen_ends_with_its_policy():
    """The first query afterwards is another client's acquire."""
    async with running_rig(leased()) as rig:
        await rig.until("x", lambda state: state.link == "up")
        async with control(rig.client, "ann", "x", lease_s=60.0) as held:
            await held.command("x", Power(on=True))
            await held.command("x", MoveVelocity(velocity=5.0))
            authority = rig.daemon._dispatcher.authority
            token, lease = next(iter(authority._leases.items()))
            authority._leases[token] = replace(lease, ends_at_s=asyncio.get_running_loop().time() - 1.0)
            async with control(rig.client, "bob", "x", lease_s=60.0):
                await rig.until("x", lambda state: state.state is AxisState.STANDSTILL, within_s=3.0)


async def test_a_stop_while_a_home_position_is_taken_over_sets_no_reference():
    async with dialect_rig(V4) as rig:
        await rig.power_on()
        axis = rig.rig.daemon.rig.axes[AXIS]
        captured_of, stops = axis.driver.captured_home, []

        async def captured() -> int:
            counts = await captured_of()
            stops.append(asyncio.ensure_future(axis.execute(Stop())))
            await asyncio.sleep(0)
            return counts

        axis.driver.captured_home = captured
        await rig.send(Home(method=HomeMethod.INDEX, velocity=0.2, position=100.0))
        state = await rig.until(lambda state: state.stop_latched)
        await asyncio.gather(*stops)
        state = await rig.until(lambda state: state.state is AxisState.STANDSTILL)
        assert not state.referenced
        assert abs((await rig.rig.client.last(AXIS, "position")).value) < 50.0


async def test_a_command_past_its_time_is_refused_at_once():
    async with dialect_rig(V4) as rig:
        await rig.power_on()
        with pytest.raises(CommandExpired):
            await rig.send(MoveAbsolute(position=1.0, not_after=1))
