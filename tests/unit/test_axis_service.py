"""Stops, successors, pending stops and readings of one axis, on a drive that only records what it is told."""

import asyncio
import contextlib
from dataclasses import replace

import pytest

from ldcnd.axis.permit import Right
from ldcnd.axis.plausibility import ROUNDS
from ldcnd.axis.stopping import STOP_ROUNDS
from ldcnd.contract.commands import (
    BufferMode,
    Halt,
    MoveAbsolute,
    MoveRelative,
    MoveVelocity,
    Power,
    QuickStop,
    Reset,
    SetPosition,
    Stop,
    Verb,
)
from ldcnd.contract.errors import (
    AxisUnreachable,
    BadReply,
    BusDown,
    CommandAborted,
    CommandExpired,
    LdcndError,
    LeaseExpired,
    NotSupported,
    OutcomeUnknown,
    PacketRejected,
    PositionLimit,
    ReplyTimeout,
    ShuttingDown,
    StopLatched,
    WrongState,
)
from ldcnd.contract.events import CommandStatus
from ldcnd.contract.samples import AxisState, LinkState, Moving, Quality, TelemetryItem
from ldcnd.drives.driver import CountsMotion, Fault, StopMode
from ldcnd.drives.network import BringUpReport
from ldcnd.line.exchange import Timing
from tests.support.axis_bench import RUNNING, STANDING, AxisBench, axis_bench, put, raising

THERE = MoveAbsolute(position=10.0)
LOST = ReplyTimeout("no reply")


async def moving(bench: AxisBench) -> None:
    await bench.send(THERE, "first")
    await bench.pass_s(0.1, **RUNNING)
    bench.drive.told.clear()


def now() -> Timing:
    now_s = asyncio.get_running_loop().time()
    return Timing(now_s, now_s, now_s, now_s)


# -- stops -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("command", "mode"), [(Stop(), StopMode.SMOOTH), (QuickStop(), StopMode.ABRUPT)])
async def test_a_stop_is_the_only_thing_that_is_sent_and_ends_the_motion(command, mode):
    async with axis_bench() as bench:
        await moving(bench)

        reply = await bench.axis.execute(command)

        assert bench.drive.told == [("stop", mode)]
        assert (reply.axis, reply.verb) == ("x", command.verb)
        assert (bench.tracker.status.state, bench.tracker.status.stop_latched) == (AxisState.STOPPING, True)
        assert [node for node, _ in bench.bus.withdrawn] == [1]
        assert ("first", CommandStatus.ABORTED) in {ended[:2] for ended in bench.ended}
        await bench.settled()
        assert (bench.tracker.status.state, bench.tracker.status.command) == (AxisState.STANDSTILL, None)


async def test_a_stop_refuses_what_waits_and_what_is_under_way():
    async with axis_bench() as bench:
        released = asyncio.Event()
        bench.drive.during["load"] = released.wait
        async with asyncio.TaskGroup() as group:
            first = group.create_task(outcome(bench.send(THERE)), name="first")
            await asyncio.sleep(0)
            waiting = group.create_task(outcome(bench.send(MoveRelative(distance=1.0))), name="waiting")
            await asyncio.sleep(0)
            await bench.stop()
            assert isinstance(await waiting, StopLatched)
            released.set()

        assert isinstance(first.result(), StopLatched)
        assert bench.drive.calls == ["load", "stop"]


async def test_what_waits_when_the_daemon_ends_is_refused():
    async with axis_bench() as bench:
        bench.drive.during["load"] = asyncio.Event().wait
        first = asyncio.create_task(outcome(bench.send(THERE)), name="first")
        await asyncio.sleep(0)
        waiting = [asyncio.create_task(outcome(bench.send(Reset())), name="waiting") for _ in range(3)]
        await asyncio.sleep(0)
    await asyncio.wait(waiting, timeout=1.0)

    assert [type(task.result()) for task in waiting] == [ShuttingDown] * 3
    first.cancel()
    await asyncio.wait([first])


async def test_a_stop_of_a_disabled_axis_leaves_its_loop_open():
    async with axis_bench(powered=False) as bench:
        await bench.settled()

        await bench.stop()

        assert bench.drive.told == [("stop", StopMode.OFF)]
        assert (bench.tracker.status.state, bench.tracker.status.stop_latched) == (AxisState.DISABLED, True)


async def test_a_stop_is_sent_a_few_times_and_then_stays_pending_until_the_drive_confirms_it():
    async with axis_bench() as bench:
        await moving(bench)
        sent = []

        async def lost(mode):
            sent.append(mode)
            raise LOST

        stop, bench.drive.stop = bench.drive.stop, lost
        assert not (await bench.axis.stops.stop(StopMode.ABRUPT)).confirmed
        assert sent == [StopMode.ABRUPT] * STOP_ROUNDS
        assert bench.tracker.status.stop_pending
        assert bench.axis.stops.wanted.is_set()
        assert [fault.code for fault in bench.tracker.status.active_faults] == ["stop_unconfirmed"]

        await bench.axis.stops.bring_to_rest(StopMode.SMOOTH)
        await bench.axis.send_pending_stop()
        assert sent[-1] is StopMode.ABRUPT  # the stronger one is still owed
        assert len(sent) == 2 * STOP_ROUNDS + 1
        assert bench.tracker.status.stop_pending

        bench.drive.stop = stop
        await bench.axis.send_pending_stop()
        assert bench.drive.told == [("stop", StopMode.ABRUPT)]
        assert not bench.tracker.status.stop_pending
        assert bench.tracker.status.active_faults == ()
        late = "confirmed late, when the drive answered again"
        assert bench.notes == [(verb, CommandStatus.DONE, late) for verb in (Verb.STOP, Verb.HALT)]

        await bench.axis.send_pending_stop()
        assert bench.drive.calls == ["stop"]  # nothing is owed any more


async def test_of_two_stops_the_stronger_one_is_sent_while_it_is_owed():
    async with axis_bench() as bench:
        await moving(bench)
        bench.bus.is_open = False
        bench.drive.during["stop"] = raising(BusDown("the port is gone"))
        assert not (await bench.axis.stops.stop(StopMode.OFF)).confirmed
        assert bench.drive.calls == ["stop"]  # no further round on a closed line

        bench.bus.is_open = True
        # it may be off already: a weaker one would close it
        assert (await bench.axis.stops.bring_to_rest(StopMode.SMOOTH)).confirmed

        assert bench.drive.told[-1] == ("stop", StopMode.OFF)
        assert bench.tracker.status.state is AxisState.DISABLED
        assert not bench.tracker.status.stop_pending


async def test_a_drive_that_was_switched_off_instead_is_disabled():
    async def switched_off(mode: StopMode) -> StopMode:
        assert mode is StopMode.SMOOTH
        return StopMode.OFF

    async with axis_bench() as bench:
        await moving(bench)
        bench.drive.stop = switched_off

        assert (await bench.axis.stops.stop(StopMode.SMOOTH)).confirmed

        assert (bench.tracker.status.state, bench.tracker.status.enabled) == (AxisState.DISABLED, False)
        assert not bench.tracker.status.stop_pending


async def test_a_motion_that_a_halt_has_ended_whose_reply_was_lost_was_ended_by_nobody_else():
    async def lost(_mode: StopMode) -> StopMode:
        raise LOST

    async with axis_bench(settle={"window": 0.1}) as bench:
        await moving(bench)
        bench.drive.stop = lost
        with pytest.raises(OutcomeUnknown):
            await bench.send(Halt(), "halt")
        for _ in range(3):
            await bench.pass_s(1.0, position_counts=1000, following_error_counts=0, **STANDING)

        said = "ended by a halt that its drive has not confirmed yet"
        assert bench.ended == [("first", CommandStatus.FAILED, said)]


async def test_a_stop_while_the_line_is_down_is_not_sent_and_waits_for_it():
    async with axis_bench() as bench:
        await moving(bench)
        bench.axis.stops.line_up = False

        assert not (await bench.axis.stops.stop(StopMode.SMOOTH)).confirmed

        assert bench.drive.calls == []
        assert bench.bus.withdrawn == []
        assert bench.tracker.status.stop_pending
        bench.axis.stops.note_power_loss()  # it had no power
        assert not bench.tracker.status.stop_pending
        assert not bench.tracker.status.stop_pending


async def test_an_axis_that_was_never_seen_is_read_before_a_pending_stop_is_sent():
    async with axis_bench(powered=False) as bench:
        bench.axis.stops.line_up = False
        await bench.axis.stops.stop(StopMode.SMOOTH)
        bench.axis.stops.line_up = True
        bench.bus.during = raising(LOST)

        await bench.axis.send_pending_stop()
        assert bench.drive.calls == []  # how it was left is not known: a smooth stop would close an open loop
        assert bench.tracker.status.stop_pending

        await bench.axis.send_pending_stop()
        assert bench.drive.told == [("stop", StopMode.OFF)]
        assert not bench.tracker.status.stop_pending


async def test_a_motor_that_was_taken_over_with_a_closed_loop_is_not_switched_off_by_a_stop_before_its_first_reading():
    async with axis_bench(powered=False) as bench:
        bench.axis.brought_up(reset=False, is_open=False)

        await bench.stop()

        assert bench.drive.told == [("stop", StopMode.SMOOTH)]


async def test_a_line_that_is_taken_over_again_changes_nothing_that_was_seen():
    async with axis_bench(powered=False) as bench:
        await bench.settled()
        bench.axis.brought_up(reset=False, is_open=False)

        await bench.stop()

        assert bench.drive.told == [("stop", StopMode.OFF)]


async def test_a_motor_that_must_be_off_first_is_switched_off():
    async with axis_bench() as bench:
        bench.axis.stops.switch_off()
        status = bench.tracker.status
        assert (status.stop_due, status.stop_pending) == (True, False)  # nobody has asked for it in vain

        await bench.axis.send_pending_stop()

        assert bench.drive.told == [("stop", StopMode.OFF)]
        assert bench.tracker.status.state is AxisState.DISABLED


async def test_a_reading_from_a_drive_that_owes_a_confirmation_calls_for_the_stop():
    async with axis_bench() as bench:
        bench.axis.readings.judge(bench.drive.shown, frozenset(), now())
        bench.axis.stops.switch_off()
        bench.axis.stops.wanted.clear()

        assert bench.axis.readings.judge(
            _reading(bench, position_counts=60_000), frozenset(), now()
        )  # not believed yet

        assert bench.axis.stops.wanted.is_set()


async def test_a_drive_that_takes_no_stop_over_its_line_is_neither_latched_nor_told_anything():
    async with axis_bench() as bench:
        bench.axis.stops.possible = False

        assert not (await bench.axis.stops.stop(StopMode.SMOOTH)).confirmed
        assert not (await bench.axis.stops.bring_to_rest(StopMode.SMOOTH)).confirmed
        bench.axis.stops.switch_off()

        assert (bench.tracker.status.stop_latched, bench.tracker.status.stop_pending, bench.drive.calls) == (
            False,
            False,
            [],
        )


# -- successors --------------------------------------------------------------------------------------------------------


async def in_turn(bench: AxisBench, move, right: Right = Right(), command_id: str = "next"):  # noqa: B008 - immutable
    permit = bench.axis.permit(command_id, move.verb, right)
    return await bench.axis.succession.carry_out(move, permit, lambda: bench.axis.execute(move, permit))


def buffered(position: float = 20.0, mode: BufferMode = BufferMode.BUFFERED) -> MoveAbsolute:
    return MoveAbsolute(position=position, buffer_mode=mode)


async def test_a_buffered_move_begins_when_the_one_before_it_has_ended():
    async with axis_bench() as bench:
        await moving(bench)
        async with asyncio.TaskGroup() as group:
            waiting = group.create_task(in_turn(bench, buffered()), name="next")
            await bench.pass_s(0.1)
            assert bench.drive.calls == []
            await bench.pass_s(0.1, **STANDING)
            await waiting

        assert bench.drive.calls == ["load", "start"]
        assert bench.tracker.status.command.command_id == "next"


async def test_a_buffered_move_does_not_begin_after_a_policy_has_brought_the_axis_to_rest():
    async with axis_bench() as bench:
        await moving(bench)
        async with asyncio.TaskGroup() as group:
            waiting = group.create_task(outcome(in_turn(bench, buffered())), name="next")
            await asyncio.sleep(0.1)
            await bench.axis.stops.bring_to_rest(StopMode.SMOOTH)
            await asyncio.sleep(0.001)
            assert isinstance(waiting.result(), CommandAborted)  # at once, not when the axis stands
            await bench.settled()

        assert bench.drive.calls == ["stop"]


async def test_a_buffered_move_whose_sender_has_lost_the_axis_is_refused_when_its_turn_comes():
    def lost():
        raise LeaseExpired("the lease has ended")

    async with axis_bench() as bench:
        await moving(bench)
        async with asyncio.TaskGroup() as group:
            waiting = group.create_task(outcome(in_turn(bench, buffered(), Right(holds=lost))), name="next")
            await bench.pass_s(0.1, **STANDING)

        assert isinstance(waiting.result(), LeaseExpired)
        assert bench.drive.calls == []


async def test_a_buffered_move_that_waits_when_the_daemon_ends_is_refused():
    async with axis_bench() as bench:
        await moving(bench)
        waiting = asyncio.create_task(outcome(in_turn(bench, buffered())), name="next")
        await asyncio.sleep(0.1)
    assert isinstance(await waiting, ShuttingDown)


async def test_buffered_moves_follow_each_other_in_the_order_in_which_they_came():
    async with axis_bench() as bench:
        await moving(bench)
        async with asyncio.TaskGroup() as group:
            for position in (11.0, 12.0):
                group.create_task(in_turn(bench, buffered(position), command_id=f"to {position}"), name="next")
                await asyncio.sleep(0)
            await bench.pass_s(0.1, **STANDING)
            assert bench.tracker.status.command.command_id == "to 11.0"
            await bench.pass_s(0.1, **RUNNING)
            await bench.pass_s(0.1, **STANDING)

        assert bench.tracker.status.command.command_id == "to 12.0"


async def test_an_aborting_move_halts_what_runs_and_then_begins():
    async with axis_bench() as bench:
        await moving(bench)
        async with asyncio.TaskGroup() as group:
            group.create_task(in_turn(bench, buffered(mode=BufferMode.ABORTING)), name="next")
            await bench.pass_s(0.1)
            assert bench.drive.told == [("stop", StopMode.SMOOTH)]
            await bench.settled()

        assert bench.drive.calls == ["stop", "load", "start"]


async def test_an_aborting_move_on_an_axis_that_stands_halts_nothing():
    async with axis_bench() as bench:
        await in_turn(bench, buffered(mode=BufferMode.ABORTING))

        assert bench.drive.calls == ["load", "start"]


@pytest.mark.parametrize(
    ("move", "refusal"),
    [
        (buffered(200.0, BufferMode.ABORTING), PositionLimit),
        (MoveRelative(distance=200.0, buffer_mode=BufferMode.ABORTING), PositionLimit),
        (MoveVelocity(velocity=0.0, buffer_mode=BufferMode.ABORTING), Exception),
    ],
)
async def test_an_aborting_move_that_would_be_refused_halts_nothing(move, refusal):
    async with axis_bench(limits={"position_max": 100.0}) as bench:
        await moving(bench)

        with pytest.raises(refusal):
            await in_turn(bench, move)

        assert bench.drive.calls == []


BELOW = {"direction": "positive", "distance": 0.5}


@pytest.mark.promise("refused-abort-halts-nothing")
async def test_an_approach_goes_on_to_its_goal_that_a_move_was_to_take_over_whose_packet_was_lost():
    async with axis_bench(approach=BELOW) as bench:
        bench.drive.retargets = True
        await bench.send(MoveAbsolute(position=-10.0), "first")
        await bench.pass_s(0.1, position_counts=-500, profile_done=False, velocity_counts_per_s=-10_000.0)
        bench.drive.during["load"] = raising(LOST)
        before = bench.axis.permit("before", Verb.HOME)
        with pytest.raises(ReplyTimeout):
            await in_turn(bench, buffered(-5.0, BufferMode.ABORTING))
        assert not before.is_void
        bench.drive.told.clear()
        await bench.settled(position_counts=-10_500)
        await bench.settled(position_counts=-10_000)

        assert bench.drive.told == [("load", CountsMotion(-10_000, 20_000.0, 200_000.0)), ("start", None)]
        assert bench.ended == [("first", CommandStatus.DONE, None)]


@pytest.mark.promise("refused-abort-halts-nothing")
async def test_what_a_move_has_taken_over_begins_nothing_any_more():
    async with axis_bench(approach=BELOW) as bench:
        bench.drive.retargets = True
        await bench.send(MoveAbsolute(position=-10.0), "first")
        await bench.pass_s(0.1, position_counts=-500, profile_done=False, velocity_counts_per_s=-10_000.0)
        before = bench.axis.permit("before", Verb.HOME)
        await in_turn(bench, MoveVelocity(velocity=-5.0, buffer_mode=BufferMode.ABORTING))
        assert before.is_void
        bench.drive.told.clear()
        await bench.settled(position_counts=-10_500)

        assert bench.drive.told == []
        assert [ended[:2] for ended in bench.ended] == [("first", CommandStatus.ABORTED), ("next", CommandStatus.DONE)]


async def test_an_aborting_move_whose_sender_has_no_right_halts_nothing():
    def late():
        raise CommandExpired("too late")

    async with axis_bench() as bench:
        await moving(bench)

        with pytest.raises(CommandExpired):
            await in_turn(bench, buffered(mode=BufferMode.ABORTING), Right(in_time=late))

        assert bench.drive.calls == []


# -- admission ---------------------------------------------------------------------------------------------------------


async def test_what_the_drive_cannot_do_is_refused_before_anything_is_sent():
    async with axis_bench() as bench:
        bench.drive.capabilities = frozenset({Verb.STOP})

        with pytest.raises(NotSupported):
            await bench.send(THERE)

        assert bench.drive.calls == []


async def test_a_right_is_asked_before_the_turn_comes_and_again_before_the_packet():
    asked = []
    async with axis_bench() as bench:
        await bench.send(THERE, right=Right(holds=lambda: asked.append(list(bench.drive.calls))))

    assert asked[0] == []
    assert ["load"] in asked  # directly before the start


async def test_a_command_is_late_only_until_its_motion_has_begun():
    asked = []
    async with axis_bench() as bench:
        await bench.send(THERE, right=Right(in_time=lambda: asked.append(list(bench.drive.calls))))

    assert asked[-1] == ["load"]
    assert ["load", "start"] not in asked


# -- readings ----------------------------------------------------------------------------------------------------------


async def test_a_drive_that_answers_again_after_it_was_away_is_reported_once():
    async with axis_bench() as bench:
        returned = []
        bench.axis.readings.returned = lambda: returned.append(bench.tracker.status.link)
        bench.show()
        bench.axis.disconnected()
        bench.show()
        bench.show()

    assert returned == [LinkState.UP]


async def test_the_first_reading_of_an_axis_is_no_return():
    async with axis_bench(powered=False) as bench:
        returned = []
        bench.axis.readings.returned = lambda: returned.append("returned")
        bench.show()

    assert returned == []


async def test_a_jump_without_a_command_is_a_fault_and_takes_the_reference_away():
    async with axis_bench() as bench:
        for counts in (0, 0, *[500_000] * ROUNDS):
            asks_again = bench.axis.readings.judge(_reading(bench, position_counts=counts), frozenset(), now())
            await asyncio.sleep(0.05)

        assert not asks_again
        assert bench.tracker.status.state is AxisState.ERROR_STOP
        assert not bench.tracker.status.referenced


async def test_a_jump_during_a_command_ends_it_costs_the_reference_and_has_the_motor_stopped():
    async with axis_bench() as bench:
        await moving(bench)
        for counts in (0, 0, *[500_000] * ROUNDS):
            slow = _reading(bench, position_counts=counts, velocity_counts_per_s=0.0)
            bench.axis.readings.judge(slow, frozenset(), now())
            await asyncio.sleep(0.05)

        assert bench.tracker.status.state is AxisState.ERROR_STOP
        assert not bench.tracker.status.referenced
        assert bench.tracker.status.quality is Quality.UNCERTAIN
        assert bench.tracker.status.stop_pending


@pytest.mark.parametrize("gap", ["disconnected", "missed"])
async def test_a_drive_that_was_moved_while_it_was_out_of_reach_has_not_jumped(gap):
    async with axis_bench() as bench:
        for _ in range(2):
            bench.axis.readings.judge(bench.drive.shown, frozenset(), now())
            await asyncio.sleep(0.05)
        if gap == "disconnected":
            bench.axis.disconnected()
        else:
            for _ in range(3):
                bench.axis.readings.miss(LOST)
        for counts in [500_000] * ROUNDS:
            bench.axis.readings.judge(_reading(bench, position_counts=counts), frozenset(), now())
            await asyncio.sleep(0.05)

        assert "position_jump" not in [fault.code for fault in bench.tracker.status.active_faults]


@pytest.mark.promise("contradiction-stops")
async def test_a_reading_that_contradicts_the_one_before_is_asked_again_and_in_the_end_has_the_motor_stopped():
    async with axis_bench() as bench:
        verdicts = [
            bench.axis.readings.judge(_reading(bench, position_counts=90_000 * step), frozenset(), now())
            for step in range(5)
        ]

        assert verdicts == [False, True, True, True, False]
        assert bench.bus.distrusted == 4
        assert (bench.tracker.status.link, bench.tracker.status.quality) == (LinkState.UP, Quality.UNCERTAIN)
        assert [fault.code for fault in bench.tracker.status.active_faults] == [
            "readings_contradict",
            "stop_unconfirmed",
        ]
        assert bench.tracker.status.moving is not Moving.NO
        assert not bench.tracker.status.referenced
        assert bench.tracker.status.stop_pending
        await bench.axis.send_pending_stop()
        assert bench.drive.told[-1] == ("stop", StopMode.SMOOTH)
        await bench.send(Power(on=False))
        assert bench.drive.told[-1] == ("stop", StopMode.OFF)


@pytest.mark.parametrize("command", [MoveRelative(distance=1.0), SetPosition(position=0.0)])
async def test_nothing_is_planned_from_two_readings_that_agree_where_no_motion_can_have_led(command):
    async with axis_bench() as bench:
        for _ in range(2):
            bench.axis.readings.judge(bench.drive.shown, frozenset(), now())
        origin = bench.tracker.status.scale.origin_counts
        bench.drive.shown = _reading(bench, position_counts=60_000)

        with pytest.raises(BadReply, match="no motion can have led") as refusal:
            await bench.send(command)

        assert refusal.value.value == bench.tracker.status.scale.position(60_000)
        assert bench.drive.told == []
        assert bench.tracker.status.scale.origin_counts == origin
        assert bench.bus.distrusted == 1


async def test_a_shaft_that_is_turned_by_hand_is_believed_where_its_velocity_leads():
    async with axis_bench() as bench:
        bench.axis.readings.judge(bench.drive.shown, frozenset(), now())
        verdicts = []
        for counts in (100, 300, 500):
            await asyncio.sleep(0.01)
            turned = _reading(bench, velocity_counts_per_s=20_000.0, position_counts=counts)
            verdicts.append(bench.axis.readings.judge(turned, frozenset(), now()))

        assert (bench.tracker.status.command, bench.tracker.status.at_rest) == (None, False)
        assert verdicts == [True, False, False]  # so sudden a velocity is asked for again, once


async def test_what_only_the_first_of_two_readings_was_asked_for_is_published_as_well():
    both = frozenset({TelemetryItem.POSITION, TelemetryItem.VELOCITY})
    async with axis_bench() as bench:
        bench.axis.readings.judge(bench.drive.shown, frozenset(), now())
        changed = _reading(bench, profile_done=False, asked=both)
        assert bench.axis.readings.judge(changed, both, now())
        assert bench.published(TelemetryItem.VELOCITY) is None
        assert not bench.axis.readings.judge(changed, frozenset({TelemetryItem.POSITION}), now())

        assert bench.published(TelemetryItem.VELOCITY)
        assert bench.published(TelemetryItem.POSITION).seq == 0


@pytest.mark.promise("contradiction-stops")
@pytest.mark.parametrize("error", [PacketRejected("damaged"), BadReply("lacks its position")])
async def test_a_drive_that_replies_with_nothing_that_can_be_used_is_not_silent_and_is_stopped(error):
    async with axis_bench() as bench:
        await moving(bench)
        for _ in range(2):
            bench.axis.readings.miss(error)
        assert (bench.tracker.status.link, bench.tracker.status.stop_pending) == (LinkState.DEGRADED, False)

        for _ in range(8):
            bench.axis.readings.miss(error)

        assert (bench.tracker.status.link, bench.tracker.status.moving) == (LinkState.DEGRADED, Moving.UNKNOWN)
        assert bench.tracker.status.quality is Quality.UNCERTAIN
        assert "replies_unusable" in [fault.code for fault in bench.tracker.status.active_faults]
        assert bench.tracker.status.state is AxisState.ERROR_STOP
        assert bench.tracker.status.stop_pending
        await bench.axis.send_pending_stop()
        assert bench.drive.told[-1] == ("stop", StopMode.SMOOTH)
        bench.show()
        assert (bench.tracker.status.link, bench.tracker.status.referenced) == (LinkState.UP, True)


async def test_a_stop_is_counted_in_the_state_before_its_drive_has_confirmed_it():
    shown = []
    async with axis_bench() as bench:

        async def late() -> None:
            await asyncio.sleep(0.01)
            shown.append(bench.published(TelemetryItem.STATE).stops)

        bench.drive.during["stop"] = late
        reply = await bench.send(Halt())

    assert shown == [reply.stops] == [1]


@pytest.mark.parametrize(
    ("command", "cause", "remedy"),
    [
        (Halt(), "halt", "send it again"),
        (Power(on=False), "power off", "send it again"),
        (Stop(), "a stop", "send reset"),
    ],
)
async def test_what_was_overtaken_says_by_what_and_which_way_out_is_true(command, cause, remedy):
    async with axis_bench() as bench:
        await moving(bench)
        async with asyncio.TaskGroup() as group:
            waiting = group.create_task(bench_refusal(bench), name="next")
            await asyncio.sleep(0.01)
            await bench.send(command)
        refusal = waiting.result()

        assert f"was overtaken by {cause}" in refusal.message
        assert refusal.remedy == remedy
        if "again" in remedy and command.verb is Verb.HALT:
            await bench.pass_s(1.0, **STANDING)
            await bench.send(THERE, "again")
            assert bench.drive.calls[-1] == "start"


async def bench_refusal(bench: AxisBench) -> LdcndError:
    with pytest.raises((StopLatched, CommandAborted)) as refusal:
        await in_turn(bench, buffered())
    return refusal.value


async def test_misses_take_an_axis_down_only_in_a_row():
    async with axis_bench() as bench:
        for _ in range(10):
            bench.axis.readings.miss(LOST)
            bench.axis.readings.miss(LOST)
            bench.show()
        assert bench.tracker.status.link is LinkState.UP
        assert bench.tracker.status.referenced

        for _ in range(3):
            bench.axis.readings.miss(LOST)
        assert bench.tracker.status.link is LinkState.DOWN
        assert not bench.tracker.status.referenced


async def test_an_axis_is_at_work_while_it_has_a_command_or_may_move():
    async with axis_bench() as bench:
        assert not bench.axis.at_work
        await moving(bench)
        assert bench.axis.at_work
        await bench.settled()
        assert not bench.axis.at_work
        bench.axis.disconnected()
        assert (bench.tracker.status.command, bench.tracker.status.moving) == (None, Moving.UNKNOWN)
        assert bench.axis.at_work


async def test_a_referenced_line_counts_from_the_drives_zero_again():
    async with axis_bench() as bench:
        put(bench.tracker, scale=replace(bench.tracker.status.scale, origin_counts=77.0))
        bench.axis.connected(placed=False)
        assert (bench.tracker.status.referenced, bench.tracker.status.scale.origin_counts) == (False, 77.0)

        bench.axis.connected(placed=True)
        assert (bench.tracker.status.referenced, bench.tracker.status.scale.origin_counts) == (True, 0.0)


@pytest.mark.promise("energy-out-always-sent")
async def test_of_an_axis_out_of_reach_only_what_takes_energy_out_is_sent():
    async with axis_bench() as bench:
        bench.axis.disconnected()
        for command in (Reset(), Power(on=True), THERE):
            with pytest.raises(AxisUnreachable):
                await bench.send(command)
        assert bench.drive.calls == []

        for command in (Halt(), Power(on=False)):
            await bench.send(command)

    assert bench.drive.told == [("stop", StopMode.SMOOTH), ("stop", StopMode.OFF)]


@pytest.mark.promise("energy-out-always-sent")
@pytest.mark.parametrize("command", [Halt(), Power(on=False)])
async def test_what_a_silent_drive_has_not_confirmed_is_said_to_be_so_and_waits_to_be_sent_again(command):
    async with axis_bench() as bench:

        async def lose() -> None:
            bench.drive.during["stop"] = lose
            raise LOST

        bench.drive.during["stop"] = lose
        with pytest.raises(OutcomeUnknown, match="has not confirmed"):
            await bench.send(command)

        assert set(bench.drive.calls) == {"stop"}
        assert bench.tracker.status.stop_pending
        assert bench.tracker.status.stop_pending


async def test_a_fault_during_a_motion_ends_it_and_nothing_follows():
    async with axis_bench() as bench:
        await moving(bench)
        bench.show(enabled=False, faults=(Fault("position_error", "stuck"),), **STANDING)

        assert bench.tracker.status.state is AxisState.ERROR_STOP
        with pytest.raises(WrongState):
            await bench.send(THERE)
        assert bench.drive.calls == []


async def test_a_start_with_an_unknown_outcome_is_left_to_the_readings():
    async with axis_bench() as bench:
        bench.drive.during["start"] = raising(OutcomeUnknown("no reply"))
        with pytest.raises(OutcomeUnknown):
            await bench.send(THERE, "first")

        assert bench.tracker.status.command.command_id == "first"
        await bench.pass_s(0.1, **RUNNING)
        assert bench.tracker.status.state is AxisState.DISCRETE_MOTION
        await bench.pass_s(0.1, **STANDING)
        assert bench.ended[-1] == ("first", CommandStatus.DONE, None)


async def test_a_start_that_was_not_taken_ends_the_command_at_once():
    async with axis_bench() as bench:

        async def lost() -> None:
            await asyncio.sleep(0.01)
            raise LOST

        bench.drive.during["start"] = lost
        with contextlib.suppress(ReplyTimeout):
            await bench.send(THERE, "first")

        assert (bench.tracker.status.command, bench.tracker.status.state) == (None, AxisState.STANDSTILL)
        assert bench.ended[-1] == ("first", CommandStatus.FAILED, "no reply")
        await asyncio.sleep(0)
        assert bench.published(TelemetryItem.STATE).state is AxisState.STANDSTILL


@pytest.mark.parametrize(
    ("reset", "restarted", "interrupted"),
    [
        (False, {"x", "y"}, "its drive had lost power"),
        (False, {"y"}, ""),
        (False, set(), ""),
        (True, set(), "its line was reset"),
    ],
)
async def test_a_kept_reference_is_recalled_with_what_has_reset_the_drive(monkeypatch, reset, restarted, interrupted):
    told = []

    async def recall(baud: int, identity: str, why: str) -> tuple[None, str]:
        told.append((baud, identity, why))
        return None, ""

    async with axis_bench() as bench:
        monkeypatch.setattr(bench.axis.reference, "recall", recall)
        await bench.axis.recall(BringUpReport(19200, {"x": "a drive"}, reset=reset, restarted=frozenset(restarted)))

    assert told == [(19200, "a drive", interrupted)]


async def test_a_kept_reference_is_in_force_once_the_line_is_up_and_not_the_next_time(monkeypatch):
    async def recall(*_proof: object) -> tuple[float, str]:
        return 1500.0, ""

    async with axis_bench() as bench:
        monkeypatch.setattr(bench.axis.reference, "recall", recall)
        await bench.axis.recall(BringUpReport(19200, {}, reset=False))
        bench.axis.connected(placed=False)
        assert (bench.tracker.status.referenced, bench.tracker.status.scale.position(2500)) == (True, 1.0)
        bench.axis.connected(placed=False)
        assert not bench.tracker.status.referenced


def _reading(bench: AxisBench, **changes):
    return replace(bench.drive.shown, **changes)


async def outcome(call):
    try:
        return await call
    except LdcndError as error:
        return error
