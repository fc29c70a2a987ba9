"""A stream of set-points that an axis follows, on the jumping clock."""

import asyncio
from collections import Counter

import pytest

from ldcnd.contract.commands import MoveAbsolute, MoveRelative, Power, SetGains, Track
from ldcnd.contract.errors import (
    NotReferenced,
    NotSupported,
    OutcomeUnknown,
    PositionLimit,
    TooManyRequests,
    ValueOutOfRange,
)
from ldcnd.contract.events import CommandStatus, ReadOutcome
from ldcnd.contract.samples import AxisState
from ldcnd.sim.faults import FaultKind, FaultPlan, LineFault
from ldcnd.sim.ldcn.drive import SimulatedDrive
from tests.support.dialect_rig import (
    AXIS,
    COUNTS_PER_MM,
    LS_173AP,
    LS_182AP,
    LS_182AP_22,
    SC,
    V1,
    V2,
    V3,
    V4,
    dialect_rig,
)

TRACKING = {"step": 0.5, "rate": 50.0}


def named(dialects):
    return pytest.mark.parametrize("dialect", dialects, ids=lambda dialect: dialect.name)


@named((V2, V3, V4, SC, LS_173AP, LS_182AP, LS_182AP_22))
@pytest.mark.sweep(2)
async def test_an_axis_follows_a_stream_of_set_points(dialect):
    async with dialect_rig(dialect, tracking=TRACKING) as rig:
        await rig.power_on()

        for step in range(1, 26):
            await rig.send(Track(position=step * 0.1))
            await asyncio.sleep(0.02)
        following = await rig.rig.client.state(AXIS)
        state = await rig.until(lambda state: state.command is None)

        assert (following.state, following.command.verb) == (AxisState.CONTINUOUS_MOTION, "track")
        assert (state.state, state.last_error) == (AxisState.STANDSTILL, None)
        assert rig.position_mm == pytest.approx(2.5, abs=0.02)


@pytest.mark.parametrize("phase_s", [0.0, 0.2, 0.4, 0.6, 0.8])
@pytest.mark.sweep(2)
async def test_a_stream_that_ends_at_its_last_set_point_is_done_however_seldom_its_axis_is_read(phase_s):
    """It was judged by a reading of before that set-point."""
    rates = {"position": 1, "velocity": 1, "adc": 0, "state": 1}
    async with dialect_rig(V4, tracking={"step": 0.5, "rate": 20.0}, rates=rates) as rig:
        await rig.power_on()
        await asyncio.sleep(phase_s)
        for step in range(1, 31):
            last = await rig.send(Track(position=step * 0.4))
            await asyncio.sleep(0.05)
        await rig.until(lambda state: state.command is None)
        ended = await rig.rig.client.ask(ReadOutcome(command_id=last.command_id))

        assert (ended.status, ended.reason) == (CommandStatus.DONE, None)


async def test_tracking_needs_a_drive_that_knows_it():
    async with dialect_rig(V1, tracking=TRACKING) as rig:
        await rig.power_on()

        with pytest.raises(NotSupported, match="cannot track"):
            await rig.send(Track(position=0.1))


async def test_a_set_point_too_far_from_the_last_one_is_refused():
    async with dialect_rig(V4, tracking=TRACKING) as rig:
        await rig.power_on()
        await rig.send(Track(position=0.5))
        await asyncio.sleep(0.02)

        with pytest.raises(ValueOutOfRange, match=r"0\.6 from the last one, the limit is 0\.5") as refusal:
            await rig.send(Track(position=1.1))

        assert refusal.value.nearest == pytest.approx(1.0)
        assert (await rig.rig.client.state(AXIS)).command.verb == "track"


async def test_the_first_set_point_counts_from_where_the_shaft_is_and_not_from_where_it_was_read():
    async with dialect_rig(LS_182AP, tracking=TRACKING, rates={"position": 0.2, "velocity": 0.2, "state": 0.2}) as rig:
        await rig.until(lambda state: state.link == "up")
        seen = await rig.rig.client.last(AXIS, "position")
        while (now := await rig.rig.client.last(AXIS, "position")).t == seen.t:
            await asyncio.sleep(0.01)
        rig.drive.shaft.position_counts += 2 * COUNTS_PER_MM  # by hand
        await rig.send(Power(on=True))

        with pytest.raises(ValueOutOfRange, match="from the last one"):
            await rig.send(Track(position=now.value))


async def test_a_position_error_limit_below_the_step_is_refused():
    async with dialect_rig(LS_182AP, tracking={"step": 0.5, "rate": 50}) as rig:
        await rig.power_on()

        with pytest.raises(ValueOutOfRange, match="is not above a tracking step of 500 counts") as refusal:
            await rig.send(SetGains(el=500))

        assert refusal.value.nearest == 501
        await rig.send(SetGains(el=501))


async def test_set_points_faster_than_the_rate_are_refused():
    async with dialect_rig(V4, tracking=TRACKING | {"rate": 5.0}) as rig:
        await rig.power_on()
        await rig.send(Track(position=0.1))

        with pytest.raises(TooManyRequests, match="more than 5 set-points a second"):
            await rig.send(Track(position=0.2))

        await asyncio.sleep(0.2)
        await rig.send(Track(position=0.2))


@pytest.mark.long
async def test_the_mean_rate_is_kept_although_single_set_points_may_come_early():
    async with dialect_rig(V4, tracking=TRACKING | {"rate": 10.0}) as rig:
        await rig.power_on()
        taken = 0
        loop = asyncio.get_running_loop()
        began_s = loop.time()

        while loop.time() < began_s + 3.0:
            try:
                await rig.send(Track(position=(taken + 1) * 0.01))
                taken += 1
            except TooManyRequests:
                pass
            await asyncio.sleep(0.013)

        assert 28 <= taken <= 32


async def test_a_set_point_keeps_to_reference_and_software_limits():
    async with dialect_rig(V4, tracking=TRACKING, limits={"position_max": 0.3}) as rig:
        await rig.power_on()
        with pytest.raises(PositionLimit):
            await rig.send(Track(position=0.31))
    async with dialect_rig(V4, tracking=TRACKING, reference="required") as rig:
        await rig.power_on()
        with pytest.raises(NotReferenced):
            await rig.send(Track(position=0.1))


@pytest.mark.long
async def test_a_set_point_without_a_reply_is_not_sent_again_and_the_stream_goes_on():
    no_replies = FaultPlan((LineFault(FaultKind.REPLY_LOST, from_s=10.0, until_s=10.05),))
    async with dialect_rig(V4, faults=no_replies, tracking=TRACKING) as rig:
        await rig.power_on()
        await rig.send(Track(position=0.1))
        loop = asyncio.get_running_loop()
        await asyncio.sleep(9.9 - loop.time())
        await rig.send(Track(position=0.2))
        await asyncio.sleep(10.0001 - loop.time())

        with pytest.raises(OutcomeUnknown):
            await rig.send(Track(position=0.3))
        state = await rig.rig.client.state(AXIS)
        await asyncio.sleep(0.1)
        await rig.send(Track(position=0.4))

        records = rig.rig.daemon.rig.buses[0].bus.wire_log.records()
        sent = Counter(record.data for record in records if record.data[2:4] == b"\x57\x11")
        assert sorted(sent.values()) == [1, 2, 2, 2]  # what is answered is told twice
        assert state.state is AxisState.CONTINUOUS_MOTION


async def test_a_stop_ends_a_stream():
    async with dialect_rig(V4, tracking=TRACKING) as rig:
        await rig.power_on()
        await rig.send(Track(position=0.1))

        await rig.rig.client.stop(AXIS)
        await asyncio.sleep(0.1)

        with pytest.raises(Exception, match="a stop is latched"):
            await rig.send(Track(position=0.2))


@named((V4, LS_182AP, LS_182AP_22))
async def test_set_points_away_from_a_limit_switch_that_has_ended_a_move_fail_by_it_no_more(dialect):
    async with dialect_rig(dialect, tracking=TRACKING, limit_switches="stop") as rig:
        await rig.power_on()
        ended = await rig.done(MoveAbsolute(position=30.0, velocity=10.0))
        stands = round(rig.position_mm, 3)
        for step in range(1, 26):
            await rig.send(Track(position=stands - step * 0.1))
            await asyncio.sleep(0.02)
        state = await rig.until(lambda state: state.command is None)

        assert ended.last_error == "move_absolute: the drive stopped at the forward limit switch"
        assert (state.state, state.last_error) == (AxisState.STANDSTILL, None)
        assert rig.position_mm == pytest.approx(stands - 2.5, abs=0.05)


async def test_what_a_move_has_armed_stops_no_stream_of_set_points():
    """A stream asks no limit switch, and each set-point was told to have failed by the one that it passed."""
    async with dialect_rig(V4, tracking=TRACKING, start_counts=18_000.0, limit_switches="stop") as rig:
        await rig.power_on()
        await rig.done(MoveRelative(distance=1.0, velocity=10.0))
        for step in range(1, 26):
            await rig.send(Track(position=1.0 + step * 0.1))
            await asyncio.sleep(0.02)
        state = await rig.until(lambda state: state.command is None)

        assert (state.state, state.last_error) == (AxisState.STANDSTILL, None)


@pytest.mark.promise("told-twice")
@pytest.mark.parametrize("deaf_to", [1, 2])
async def test_a_set_point_that_was_confirmed_and_not_taken(deaf_to, monkeypatch):
    """A late reply can stand for that to a packet that was lost: once, nothing is missing; twice, its end says so."""
    deaf, stopping = [True] * deaf_to, SimulatedDrive._stop

    def stop(self, *args):
        if deaf:
            deaf.pop()
        else:
            stopping(self, *args)

    async with dialect_rig(SC, tracking=TRACKING) as rig:
        await rig.power_on()
        began_at = rig.position_mm
        monkeypatch.setattr(SimulatedDrive, "_stop", stop)
        sent = await rig.send(Track(position=0.4))
        await rig.until(lambda state: state.command is None)
        ended = await rig.rig.client.ask(ReadOutcome(command_id=sent.command_id))

        assert not deaf
        assert rig.position_mm - began_at == pytest.approx(0.4 if deaf_to == 1 else 0.0, abs=0.02)
        assert (ended.reason is None) is (deaf_to == 1)
