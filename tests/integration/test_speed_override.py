"""The speed override of a rig: motions that begin, motions under way, and nothing at 0."""

import asyncio
import itertools
from contextlib import asynccontextmanager

import pytest

from ldcnd.config.rig import RigConfig
from ldcnd.contract.commands import Home, Jog, MoveAbsolute, MoveRelative, MoveVelocity, Power, SetPwm, Track
from ldcnd.contract.errors import CommandAborted, LdcndError, LeaseHeld, OutcomeUnknown, WrongState
from ldcnd.contract.events import CommandStatus, ReadEvents, ReadOutcome
from ldcnd.contract.leases import Acquire, Release
from ldcnd.contract.questions import Preview
from ldcnd.contract.rig_commands import SetSpeedOverride
from ldcnd.contract.samples import AxisState, LinkState
from ldcnd.drives.ldcn.packet import CommandCode
from ldcnd.sim.ldcn.chain import ChainSpec, ModuleSpec, build_chain
from ldcnd.sim.ldcn.drive import SimulatedDrive
from ldcnd.sim.plant import MotorPlant
from tests.integration.test_unconfirmed_start import lose_next
from tests.support.dialect_rig import AXIS, GAINS, LS_182AP, SC, V4, dialect_rig
from tests.support.rig import running_rig

dialects = pytest.mark.parametrize("dialect", [V4, SC, LS_182AP], ids=lambda dialect: dialect.name)
LOSSES = [(code, heard) for code in (CommandCode.LOAD_TRAJECTORY, CommandCode.START_MOTION) for heard in (False, True)]
"""Each packet of a change of speed, and whether the drive has heard it."""
WIDE = MotorPlant(stop_margin_counts=400_000, reverse_limit_counts=-400_000, forward_limit_counts=400_000)
PWM = {"duty": 0.1, "duration_s": 5.0}
TRACKING = {"step": 0.5, "rate": 50}
MOTIONS = [
    MoveAbsolute(position=1.0),
    MoveRelative(distance=1.0),
    MoveVelocity(velocity=1.0),
    Jog(velocity=1.0),
    Home(method="index", velocity=1.0),
    SetPwm(duty=0.05, duration_s=1.0),
]


async def override(rig, percent, **more):
    return await rig.rig.client.ask(SetSpeedOverride(percent=percent, **more))


async def told(rig, percent):
    """Change the override, and see what became of it a while later."""
    said = await override(rig, percent)
    await asyncio.sleep(0.3)
    return said


@asynccontextmanager
async def under_way(dialect, command, percent=100, **axis):
    """Run a rig whose axis has been on its way by a command for a while, at this speed override."""
    async with dialect_rig(dialect, **axis) as rig:
        await rig.power_on()
        await override(rig, percent)
        sent = await rig.send(command)
        await asyncio.sleep(0.3)
        yield rig, sent


def place(rig):
    """Return where the shaft is by now, mm."""
    rig.drive.catch_up(asyncio.get_running_loop().time())
    return rig.position_mm


async def speed(rig, over_s=0.1):
    """Return how fast the shaft turns, mm/s."""
    before = place(rig)
    await asyncio.sleep(over_s)
    return (place(rig) - before) / over_s


async def refused(call):
    """Return what a command was refused with."""
    with pytest.raises(LdcndError) as caught:
        await call
    return caught.value


@dialects
@pytest.mark.sweep(2)
async def test_motions_that_begin_have_their_share_of_the_velocity_and_say_so(dialect):
    async with dialect_rig(dialect) as rig:
        await rig.power_on()
        await override(rig, 25)
        said = await rig.rig.client.ask(Preview(position=10.0, velocity=8.0), AXIS)
        reply = await rig.send(MoveAbsolute(position=10.0, velocity=8.0))
        await asyncio.sleep(0.5)
        measured = await speed(rig)
        state = await rig.rig.client.state(AXIS)
        await rig.until(lambda state: state.command is None)

        assert (reply.velocity, said.velocity) == (pytest.approx(2.0, abs=0.01),) * 2
        assert measured == pytest.approx(2.0, abs=0.1)
        assert state.speed_override == 25.0
        assert rig.position_mm == pytest.approx(10.0, abs=0.02)


@pytest.mark.parametrize(("dialect", "goes_on_at"), [(SC, 2.0), (V4, 8.0), (LS_182AP, 8.0)], ids=str)
@pytest.mark.sweep(2)
async def test_a_move_under_way_changes_its_speed_where_the_drive_takes_it_and_ends_at_its_goal(dialect, goes_on_at):
    async with under_way(dialect, MoveAbsolute(position=15.0, velocity=8.0)) as (rig, sent):
        said = await told(rig, 25)
        measured = await speed(rig)
        state = await rig.rig.client.wait_for_end(AXIS, sent.command_id)

        assert measured == pytest.approx(goes_on_at, abs=0.2)
        assert said.changed == ((AXIS,) if dialect is SC else ())
        assert said.unchanged == (() if dialect is SC else (AXIS,))
        assert (state.state, state.last_error) == (AxisState.STANDSTILL, None)
        assert rig.position_mm == pytest.approx(15.0, abs=0.02)


@pytest.mark.parametrize("before", [None, MoveVelocity(velocity=20.0)], ids=["from rest", "aborting"])
@pytest.mark.parametrize(
    ("shares", "reply"), [((10, 100), "comes"), ((50, 10, 100), "comes"), ((50, 10, 100), "lost")], ids=str
)
async def test_a_motion_that_is_slowed_down_before_it_is_first_read_goes_on_once_it_may(
    shares, before, reply, monkeypatch
):
    """At another speed it ends sooner, in its time: what it goes on to then is on its way all the same."""
    far = {"limits": {"position_min": -100.0, "position_max": 100.0}, "rates": {"position": 10}}
    async with dialect_rig(SC, MotorPlant(), **far) as rig:
        await rig.power_on()
        if before:
            await rig.send(before)
            await asyncio.sleep(0.3)
        sent = await rig.send(MoveVelocity(velocity=-40.0, acceleration=300.0, buffer_mode="aborting"))
        await asyncio.sleep(0.03)
        if reply == "lost":
            lose_next(rig, monkeypatch, heard=True)
        for percent in shares[:-1]:
            await override(rig, percent)
            await asyncio.sleep(0.01)
        await asyncio.sleep(1.0)
        await override(rig, shares[-1])
        state = await rig.rig.client.wait_for_end(AXIS, sent.command_id)

        assert (state.state, state.last_error) == (AxisState.STANDSTILL, None)
        assert place(rig) < -50.0


async def test_a_move_that_was_slowed_down_goes_on_as_fast_as_was_asked_for_once_it_may():
    slow = MoveAbsolute(position=1.0, velocity=0.0045)
    async with under_way(SC, slow, percent=1) as (rig, _):  # a register step and a half
        await override(rig, 100)
        await asyncio.sleep(1.0)

        assert await speed(rig, over_s=40.0) == pytest.approx(0.0045, rel=0.05)


def reload_limits(rig, **limits):
    """Have the axis take other limits, as a reload of the configuration does."""
    axis = rig.rig.daemon.rig.axes[AXIS]
    axis.reconfigure(axis.config.model_copy(update={"limits": axis.config.limits.model_copy(update=limits)}))


@pytest.mark.parametrize("command", [MoveAbsolute(position=15.0, velocity=8.0), MoveVelocity(velocity=8.0)])
async def test_a_move_is_not_made_faster_than_a_limit_that_was_lowered_since(command):
    async with under_way(SC, command, percent=25) as (rig, _):
        reload_limits(rig, velocity=5.0)

        assert (await told(rig, 100)).changed == (AXIS,)
        assert 4.5 < await speed(rig) <= 5.05


@pytest.mark.parametrize("limits", [{"position_max": 10.0}, {"acceleration": 0.6}], ids=str)
async def test_a_move_that_limits_forbid_by_now_is_made_slower_and_never_faster(limits):
    """It keeps the acceleration that it was begun with: with a lower one it would run past its goal."""
    move = MoveAbsolute(position=15.0, velocity=8.0)
    async with under_way(SC, move, percent=25, limits={"position_max": 16.0}) as (rig, sent):
        reload_limits(rig, **limits)
        faster = await told(rig, 100)
        kept = await speed(rig)
        slower = await told(rig, 10)
        slowed = await speed(rig)
        await rig.rig.client.wait_for_end(AXIS, sent.command_id)

        assert (faster.changed, faster.unchanged) == ((), (AXIS,))
        assert kept == pytest.approx(2.0, abs=0.1)
        assert slower.changed == (AXIS,)
        assert slowed == pytest.approx(0.8, abs=0.1)
        assert rig.position_mm == pytest.approx(15.0, abs=0.02)


async def test_a_move_to_a_limit_itself_goes_on_faster():
    move = MoveAbsolute(position=14.99999, velocity=8.0)
    async with under_way(SC, move, percent=25, limits={"position_max": 14.99999}) as (rig, _):
        assert (await override(rig, 100)).changed == (AXIS,)


async def test_a_jog_under_way_changes_its_speed_with_any_drive():
    for dialect in (SC, LS_182AP):
        async with dialect_rig(dialect) as rig:
            await rig.power_on()
            jog = await rig.send(Jog(velocity=8.0, hold_s=1.0))
            await override(rig, 50)
            for _ in range(4):
                await asyncio.sleep(0.2)
                await rig.send(Jog(velocity=8.0, hold_s=1.0, renews=jog.command_id))
            assert await speed(rig) == pytest.approx(4.0, abs=0.3)


@pytest.mark.parametrize(
    ("holder", "before", "after", "changed", "goes_on_at"),
    [("nobody", 100, 10, (AXIS,), 0.4), ("bob", 100, 10, (AXIS,), 0.4), ("nobody", 25, 100, (), 1.0)],
)
async def test_a_move_whose_sender_has_lost_control_is_slowed_down_by_anyone_and_made_no_faster(
    holder, before, after, changed, goes_on_at
):
    async with dialect_rig(SC) as rig:
        await rig.power_on()
        held = await rig.rig.client.ask(Acquire(client="ann", axes=(AXIS,), lease_s=60))
        await override(rig, before, leases=(held.lease,))
        await rig.send(MoveAbsolute(position=18.0, velocity=4.0, lease=held.lease))
        await asyncio.sleep(0.3)
        await rig.rig.client.ask(Release(lease=held.lease, leave_running=True))
        if holder == "bob":
            await rig.rig.client.ask(Acquire(client="bob", axes=(AXIS,), lease_s=60))
        said = await told(rig, after)

        assert (said.changed, said.unchanged) == (changed, () if changed else (AXIS,))
        assert await speed(rig) == pytest.approx(goes_on_at, abs=0.05)


async def test_a_move_under_way_is_slowed_down_behind_one_that_did_not_come_to_replace_it(monkeypatch):
    async with under_way(SC, MoveAbsolute(position=15.0, velocity=8.0)) as (rig, sent):
        lose_next(rig, monkeypatch, CommandCode.LOAD_TRAJECTORY, heard=False)
        with pytest.raises(OutcomeUnknown):
            await rig.send(MoveAbsolute(position=-5.0, buffer_mode="aborting"))
        said = await told(rig, 25)
        measured = await speed(rig)
        state = await rig.rig.client.wait_for_end(AXIS, sent.command_id)

        assert said.changed == (AXIS,)
        assert measured == pytest.approx(2.0, abs=0.2)
        assert (state.state, state.last_error) == (AxisState.STANDSTILL, None)
        assert rig.position_mm == pytest.approx(15.0, abs=0.02)


@pytest.mark.promise("as-slow-as-told")
@pytest.mark.parametrize("code", [CommandCode.LOAD_TRAJECTORY, CommandCode.START_MOTION])
async def test_a_move_whose_drive_has_not_heard_that_it_is_to_be_slower_is_stopped(code, monkeypatch):
    async with under_way(SC, MoveAbsolute(position=18.0, velocity=8.0)) as (rig, _):
        lose_next(rig, monkeypatch, code, heard=False)
        await override(rig, 10)
        state = await rig.until(lambda state: state.command is None)
        await asyncio.sleep(0.5)

        assert state.state is AxisState.ERROR_STOP
        assert "faster than 0.8 mm/s" in state.last_error
        assert "the reply was lost" in state.last_error
        assert place(rig) < 10.0


@pytest.mark.parametrize(
    "command", [MoveAbsolute(position=10.0, velocity=8.0), MoveVelocity(velocity=8.0, duration_s=1)]
)
async def test_a_motion_whose_drive_has_heard_that_it_is_to_be_slower_ends_as_it_was_asked_for(command, monkeypatch):
    async with under_way(SC, command) as (rig, sent):
        lose_next(rig, monkeypatch, heard=True)
        await told(rig, 25)
        measured = await speed(rig)
        state = await rig.rig.client.wait_for_end(AXIS, sent.command_id)

        assert measured == pytest.approx(2.0, abs=0.2)
        assert (state.state, state.last_error) == (AxisState.STANDSTILL, None)


async def outcome(rig, sent):
    """Wait for the end of a command; return how it ended, and why."""
    await rig.rig.client.wait_for_end(AXIS, sent.command_id)
    ended = await rig.rig.client.ask(ReadOutcome(command_id=sent.command_id))
    return ended.status, ended.reason


@pytest.mark.parametrize(
    "command", [MoveAbsolute(position=15.0, velocity=8.0), MoveVelocity(velocity=8.0, duration_s=1.5)]
)
@pytest.mark.parametrize("raised", [None, *LOSSES], ids=str)
@pytest.mark.parametrize("lowered", [None, *LOSSES], ids=str)
@pytest.mark.sweep(3)
async def test_whatever_is_lost_of_a_change_of_speed_a_motion_ends_as_asked_for_or_says_what_was_lost(
    lowered, raised, command, monkeypatch
):
    now_s = asyncio.get_running_loop().time
    async with under_way(SC, command) as (rig, sent):
        seen_at_s = now_s()
        for percent, lost in ((50, lowered), (100, raised)):
            if lost:
                lose_next(rig, monkeypatch, lost[0], heard=lost[1])
            await told(rig, percent)
        measured = await speed(rig)
        status, reason = await outcome(rig, sent)

        if raised in (None, (CommandCode.START_MOTION, True)):
            assert measured == pytest.approx(8.0, abs=0.3)
        if status is CommandStatus.DONE and isinstance(command, MoveAbsolute):
            assert place(rig) == pytest.approx(15.0, abs=0.02)
        elif status is CommandStatus.DONE:
            assert 1.1 < now_s() - seen_at_s < 1.7
        else:
            assert status is CommandStatus.FAILED
            assert "the reply was lost" in reason
            assert "another program" not in reason


@pytest.mark.parametrize("percents", [(92,), (96, 92)], ids=str)
async def test_small_slowings_that_were_not_heard_let_a_motion_end_where_it_was_to_before_and_say_so(
    percents, monkeypatch
):
    """Too small a change to be seen on its way: only its end tells."""
    async with under_way(SC, MoveVelocity(velocity=8.0, duration_s=1.5)) as (rig, sent):
        for percent in percents:
            lose_next(rig, monkeypatch, heard=False)
            await override(rig, percent)
        status, reason = await outcome(rig, sent)

        assert status is CommandStatus.FAILED
        assert "was to end before its speed was changed" in reason
        assert "the reply was lost" in reason


async def test_a_motion_that_goes_on_slowly_behind_a_start_that_a_late_reply_has_confirmed_is_not_done(monkeypatch):
    async with under_way(SC, MoveVelocity(velocity=8.0, duration_s=1.5)) as (rig, sent):
        await told(rig, 50)
        monkeypatch.setattr(SimulatedDrive, "_start", lambda *_: None)
        await override(rig, 100)
        status, reason = await outcome(rig, sent)

        assert status is CommandStatus.FAILED
        assert "was to end before its speed was changed" in reason


async def test_behind_a_slowing_that_was_not_confirmed_who_has_lost_control_is_made_no_faster(monkeypatch):
    async with dialect_rig(SC) as rig:
        await rig.power_on()
        held = await rig.rig.client.ask(Acquire(client="ann", axes=(AXIS,), lease_s=60))
        await rig.send(MoveAbsolute(position=18.0, velocity=4.0, lease=held.lease))
        await asyncio.sleep(0.3)
        await rig.rig.client.ask(Release(lease=held.lease, leave_running=True))
        lose_next(rig, monkeypatch, heard=True)
        await told(rig, 10)
        said = await told(rig, 50)

        assert said.unchanged == (AXIS,)
        assert await speed(rig) == pytest.approx(0.4, abs=0.05)


def stands_still(rig, monkeypatch, packets, for_s=1.0):
    """Have the machine stand still behind each of these packets from now on, by their number, while its drives run."""
    bus, loop = rig.rig.daemon.rig.buses[0].bus, asyncio.get_running_loop()
    execute, number = bus.execute, itertools.count()

    async def execute_late(exchange, *lanes, **options):
        reply = await execute(exchange, *lanes, **options)
        if next(number) in packets:
            loop.hold_up(for_s)
        return reply

    monkeypatch.setattr(bus, "execute", execute_late)


async def places(rig, for_s):
    """Return where the shaft is, mm, each 10 ms."""
    found = []
    for _ in range(round(for_s / 0.01)):
        await asyncio.sleep(0.01)
        found.append(place(rig))
    return found


FAR = {"limits": {"position_min": -500.0, "position_max": 500.0}}


@pytest.mark.promise("as-slow-as-told")
@pytest.mark.parametrize("late", range(6))
@pytest.mark.parametrize("percents", [(100, 1), (100, 10), (10, 12)], ids=str)
@pytest.mark.parametrize("switches", ["ignore", "stop"])
@pytest.mark.sweep(6)
async def test_a_change_of_speed_that_comes_late_never_turns_a_motion_round(switches, percents, late, monkeypatch):
    """Its end followed from where the axis was before the machine stood still, and lay behind it by then."""
    command = MoveVelocity(velocity=40.0, acceleration=300.0, duration_s=3.0)
    async with under_way(SC, command, percents[0], plant=WIDE, limit_switches=switches, **FAR) as (rig, sent):
        stands_still(rig, monkeypatch, {late})
        said = await override(rig, percents[1])
        found = await places(rig, 3.0)
        status, _ = await outcome(rig, sent)

        assert said.changed == (AXIS,)
        assert all(after >= before - 0.05 for before, after in itertools.pairwise(found))
        assert found[50] - found[49] == pytest.approx(0.4 * percents[1] / 100, rel=0.5, abs=0.004)
        assert status is CommandStatus.DONE


@pytest.mark.promise("as-slow-as-told")
@pytest.mark.parametrize("after_s", [1.2, 1.5, 1.7, 1.8, 1.9])
@pytest.mark.parametrize("percents", [(100, 60), (100, 10), (60, 100)], ids=str)
@pytest.mark.sweep(4)
async def test_a_motion_that_is_slower_than_is_shown_is_not_turned_round_near_its_end(percents, after_s, monkeypatch):
    """Less than a count a tick is shown as 0: by the time it is told where to end, the shaft has gone on."""
    command = MoveVelocity(velocity=1.9, acceleration=300.0, duration_s=2.0)
    async with under_way(SC, command, percents[0], plant=WIDE, **FAR) as (rig, sent):
        await asyncio.sleep(after_s - 0.3)
        stands_still(rig, monkeypatch, {1}, for_s=0.15)
        await override(rig, percents[1])
        found = await places(rig, 2.0)
        status, _ = await outcome(rig, sent)

        assert all(after >= before - 0.005 for before, after in itertools.pairwise(found))
        assert status is CommandStatus.DONE


@pytest.mark.promise("as-slow-as-told")
async def test_a_motion_whose_drive_cannot_be_told_in_time_to_be_slower_is_halted(monkeypatch):
    command = MoveVelocity(velocity=40.0, acceleration=300.0, duration_s=6.0)
    async with under_way(SC, command, plant=WIDE, **FAR) as (rig, sent):
        stands_still(rig, monkeypatch, {2, 5, 8}, for_s=0.3)  # each Load Trajectory, behind two readings
        said = await override(rig, 1)
        status, reason = await outcome(rig, sent)

        assert (said.changed, said.halted, said.confirmed) == ((), (AXIS,), (AXIS,))
        assert status is CommandStatus.FAILED
        assert "the line was too slow" in reason


@pytest.mark.promise("as-slow-as-told")
async def test_a_motion_that_is_halted_instead_is_said_to_be_though_its_stop_is_not_answered(monkeypatch):
    command = MoveVelocity(velocity=40.0, acceleration=300.0, duration_s=6.0)
    async with under_way(SC, command, plant=WIDE, **FAR) as (rig, sent):
        stands_still(rig, monkeypatch, {2, 5, 8}, for_s=0.3)
        lose_next(rig, monkeypatch, CommandCode.STOP_MOTOR, heard=False)
        said = await override(rig, 1)
        status, _ = await outcome(rig, sent)

        assert (said.changed, said.unchanged, said.halted, said.confirmed) == ((), (), (AXIS,), ())
        assert f"NOT confirmed by {AXIS}" in said.shortfall
        assert status is not CommandStatus.DONE


@pytest.mark.promise("as-slow-as-told")
@pytest.mark.parametrize("switches", ["ignore", "stop"])
async def test_all_axes_of_a_slow_line_are_told_another_speed_in_time(switches):
    names = tuple("abcdef")
    axis = {"model": "pic-servo-sc", "unit": "mm", "counts_per_unit": 1000, "velocity": 20, "acceleration": 200}
    axis |= {"gains": GAINS, "reference": "at_reset", "limit_switches": switches} | FAR
    axes = [axis | {"name": name, "address": address} for address, name in enumerate(names, 1)]
    config = {"rig": "sim", "bus": [{"name": "line", "port": "sim:line", "axis": axes}]}
    config["sim"] = [{"name": "line", "module": [{"model": "picservo-sc"}] * len(names)}]
    chain = build_chain(ChainSpec((ModuleSpec("picservo-sc", WIDE),) * len(names)))
    async with running_rig(RigConfig.model_validate(config), {"line": chain}) as rig:
        for name in names:
            await rig.until(name, lambda state: state.link is LinkState.UP)
            await rig.client.command(name, Power(on=True))
            await rig.client.command(name, MoveVelocity(velocity=5.0, duration_s=10.0))
        for percent in (50, 100):
            said = await rig.client.ask(SetSpeedOverride(percent=percent))

            assert (said.changed, said.unchanged, said.halted) == (names, (), ())


@pytest.mark.promise("override-0")
@dialects
async def test_at_0_percent_what_moves_halts_nothing_begins_and_nothing_goes_on_by_itself(dialect):
    move = MoveAbsolute(position=15.0, velocity=8.0)
    async with under_way(dialect, move, pwm=PWM, tracking=TRACKING) as (rig, sent):
        said = await override(rig, 0)
        state = await rig.rig.client.wait_for_end(AXIS, sent.command_id)
        await rig.until(lambda state: state.command is None)
        here = round((await rig.rig.client.position(AXIS)).value, 3)
        for motion in (*MOTIONS, Track(position=here)):
            with pytest.raises(WrongState, match="0 %"):
                await rig.send(motion)
        stood = place(rig)
        await override(rig, 100)
        await asyncio.sleep(2.0)

        assert said.halted == (AXIS,)
        assert state.speed_override == 0.0
        assert stood < 5.0
        assert place(rig) == pytest.approx(stood, abs=0.02)


async def test_at_0_percent_the_loop_may_be_closed():
    async with dialect_rig(LS_182AP) as rig:
        await rig.until(lambda state: state.state is AxisState.DISABLED)
        await override(rig, 0)
        await rig.send(Power(on=True))
        assert (await rig.until(lambda state: state.enabled)).state is AxisState.STANDSTILL


@pytest.mark.promise("override-0")
async def test_a_move_that_waits_is_not_begun_at_0_percent():
    async with dialect_rig(LS_182AP) as rig:
        await rig.power_on()
        await rig.send(MoveAbsolute(position=5.0, velocity=5.0))
        waiting = await rig.send(MoveAbsolute(position=10.0, buffer_mode="buffered"))
        await asyncio.sleep(0.2)
        await override(rig, 0)
        assert await rig.rig.refusal(waiting) is not None


@pytest.mark.promise("override-0")
@dialects
async def test_a_motion_whose_packets_were_under_way_at_0_percent_does_not_begin_once_that_is_raised(dialect):
    async with dialect_rig(dialect) as rig:
        await rig.power_on()
        async with asyncio.TaskGroup() as group:
            move = group.create_task(refused(rig.send(MoveAbsolute(position=5.0))), name="move")
            await asyncio.sleep(0.003)
            await override(rig, 0)
            await override(rig, 100)
        await asyncio.sleep(1.0)

        assert isinstance(move.result(), CommandAborted)
        assert place(rig) == pytest.approx(0.0, abs=0.02)


@pytest.mark.promise("override-0")
async def test_anyone_may_lower_it_and_raising_it_needs_control():
    async with dialect_rig(LS_182AP) as rig:
        held = await rig.rig.client.ask(Acquire(client="ann", axes=(AXIS,), lease_s=60))
        await override(rig, 10)
        with pytest.raises(LeaseHeld):
            await override(rig, 50)
        assert (await override(rig, 50, leases=(held.lease,))).percent == 50


async def test_who_may_not_raise_it_learns_all_axes_of_which_control_is_missing():
    async with running_rig() as rig:
        held = await rig.client.ask(Acquire(client="ann", axes=("x", "z"), lease_s=60))
        await rig.client.ask(SetSpeedOverride(percent=10))
        with pytest.raises(LeaseHeld, match="needs control of x, z: axis x is controlled by ann"):
            await rig.client.ask(SetSpeedOverride(percent=50))
        assert (await rig.client.ask(SetSpeedOverride(percent=50, leases=(held.lease,)))).percent == 50


async def test_the_expected_end_follows_the_speed_of_a_move_under_way():
    async with under_way(SC, MoveAbsolute(position=15.0, velocity=8.0)) as (rig, sent):
        before = (await rig.rig.client.state(AXIS)).command.expected_end
        await override(rig, 25)
        after = (await rig.until(lambda state: state.command.expected_end != before)).command.expected_end
        await rig.rig.client.wait_for_end(AXIS, sent.command_id)
        events = (await rig.rig.client.ask(ReadEvents(axis=AXIS))).events
        (ended,) = [each for each in events if each.command_id == sent.command_id and each.status == "done"]

        assert after > before + 3e9
        assert 0 <= (ended.t - after) / 1e9 < 0.3


async def test_who_has_changed_the_speed_is_in_the_events():
    async with dialect_rig(SC) as rig:
        await override(rig, 50, client="ann")
        await override(rig, 50, client="bob")  # it changes nothing
        page = await rig.rig.client.ask(ReadEvents(axis=AXIS, count=100))
        told = [(each.client, each.reason) for each in page.events if each.verb == "set_speed_override"]
        assert told == [("ann", "speed override 50 %")]
