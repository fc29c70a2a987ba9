"""Rules that hold of the state of an axis whatever befalls it, over random histories of events.

A history has events in any order, also in orders that no daemon and no drive brings about: the step function keeps its
rules by itself.
"""

import math
import random
from collections.abc import Callable
from dataclasses import replace

import pytest

from ldcnd.axis import events, faults, guards
from ldcnd.axis.course import Way
from ldcnd.axis.rest import Settling
from ldcnd.axis.scale import AxisScale
from ldcnd.axis.status import STRENGTH, ActiveCommand, AxisStatus, Completion, LatchedBy, new_faults
from ldcnd.axis.step import step
from ldcnd.contract.commands import Verb
from ldcnd.contract.errors import LdcndError
from ldcnd.contract.events import CommandStatus
from ldcnd.contract.samples import AxisState, FaultEntry, LinkState, Moving, PastFault, Quality
from ldcnd.contract.units import AxisUnits
from ldcnd.drives.driver import AxisReading, Fault, StopMode
from tests.support.axis_bench import AT_REST, put, tracked

STEPS, HISTORIES = 120, 60
SCALE = AxisScale(AxisUnits("mm", {}), -500.0, modulo=360.0)
FAULTS = (
    Fault("overheat", "hot"),
    Fault("wrap", "wrapped", stops=False),
    Fault("encoder", "lost", loses_position=True),
    Fault("missed", "lost", stops=False, loses_position=True),
)
OWN = (faults.JUMPED, faults.DRIVE_CHANGED, faults.DRIVE_RESET)
OF_A_COMMAND = (events.CommandGoesOn, events.MotionStarted, events.CommandFailing, events.CommandOver)
STATES = (AxisState.DISCRETE_MOTION, AxisState.CONTINUOUS_MOTION, AxisState.HOMING, AxisState.STOPPING)
FIRST = PastFault(code="overheat", text="hot", since=5, source="drive")


class History:
    """One axis, and what has befallen it.

    Attributes:
        status: as of now.
        ended: the commands that are over, with how.
    """

    def __init__(self, seed: int, *, commanded: bool = True) -> None:
        self.dice = random.Random(seed)
        self.status = AxisStatus("x", SCALE, commanded=commanded)
        self.ended: list[tuple[str, CommandStatus]] = []
        self.begun: list[str] = []
        self._now_s, self._position, self._number = 1.0, 0, 0
        kinds: list[Callable[[], events.AxisEvent]] = [self._reading] * 30 + [self._missed] * 3 + [self._lost]
        if commanded:
            kinds += [self._begins] * 3 + [self._goes_on] + [self._starts] * 3
            kinds += [
                self._speed, self._failing, self._over, self._power, self._loop, self._override, self._latch,
                self._sent, self._unconfirmed, self._confirmed, self._reset, self._unusable, self._contradicted,
                self._found, self._refused, self._placed, self._unplaced, self._look, self._seen_loop, self._recalled,
                self._named, self._due, self._overdue,
            ]  # fmt: skip
        self._kinds = kinds

    def live_on(self) -> tuple[AxisStatus, events.AxisEvent, AxisStatus]:
        """Let something befall the axis; return the status before, the event, and the status after."""
        self._now_s += self.dice.choice((0.0, 0.002, 0.05, 0.3, 1.0))
        before, event = self.status, self.dice.choice(self._kinds)()
        self.status = step(before, event)
        if (end := self.status.last_end) is not before.last_end:
            assert end is not None
            self.ended.append((end.command.command_id, end.status))
        return before, event, self.status

    @property
    def _now_ns(self) -> int:
        return round(self._now_s * 1e9)

    def _shown(self) -> AxisReading:
        dice = self.dice
        self._position += dice.choice((0, 0, 0, 1, -1, 3, 40))
        return replace(
            AT_REST,
            position_counts=self._position,
            velocity_counts_per_s=dice.choice((0.0, 0.0, 0.0, 10_000.0, -2_000.0)),
            enabled=dice.random() < 0.8,
            profile_done=dice.random() < 0.7,
            faults=tuple(dice.sample(FAULTS, dice.choice((0, 0, 0, 0, 0, 1, 2)))),
            cut_short=dice.choice(("", "", "", "", "a switch")),
            altered=dice.choice(("", "", "", "", "", "a register")),
        )

    def _reading(self) -> events.AxisEvent:
        return events.ReadingTaken(self._shown(), self._now_s - self.dice.choice((0.0, 0.0, 0.01, 0.2)), self._now_ns)

    def _missed(self) -> events.AxisEvent:
        return events.PollMissed(self._now_ns, self.dice.random() < 0.2)

    def _lost(self) -> events.AxisEvent:
        return events.DriveLost(self._now_ns, self.dice.random() < 0.2)

    @property
    def _command_id(self) -> str:
        """The id of the command under way, where there is one, or now and then of one that is over."""
        over = self.ended[-1][0] if self.ended else "never begun"
        command = self.status.command
        return command.command_id if command and self.dice.random() < 0.8 else over

    def _begins(self) -> events.AxisEvent:
        self._number += self.dice.choice((0, 1, 1))
        command = self._command(f"c{self._number}")
        self.begun.append(command.command_id)
        return events.CommandBegun(command)

    def _goes_on(self) -> events.AxisEvent:
        return events.CommandGoesOn(self._command(self._command_id))

    def _command(self, command_id: str) -> ActiveCommand:
        dice = self.dice
        state, completion = dice.choice(STATES), dice.choice(list(Completion))
        settling = way = None
        if completion is Completion.PROFILE and dice.random() < 0.5:
            settling = Settling(self._position, 5.0, 0.05, 0.5, dice.random() < 0.5)
            way = dice.choice((None, Way(self._position, 40.0, 1000.0)))
        return ActiveCommand(
            command_id, dice.choice((Verb.HOME, Verb.MOVE_ABSOLUTE, Verb.HALT)), self._now_ns, state,
            completion, dice.random() < 0.2, dice.choice((None, 4.0)), dice.choice((None, 0.5)), settling, way,
        )  # fmt: skip

    def _starts(self) -> events.AxisEvent:
        return events.MotionStarted(
            self._command_id, self._now_s, self.dice.choice((None, 77)), approached=True, endless=False
        )

    def _speed(self) -> events.AxisEvent:
        target, doubt = self.dice.choice((None, 77, self._position)), self.dice.choice(("", "lost"))
        return events.SpeedChanged(0.7, self._now_s, self._now_ns, target_counts=target, doubt=doubt)

    def _failing(self) -> events.AxisEvent:
        return events.CommandFailing(self.dice.choice((self._command_id, None)), "it failed")

    def _over(self) -> events.AxisEvent:
        return events.CommandOver(self._command_id, self.dice.choice((None, "the line failed")))

    def _power(self) -> events.AxisEvent:
        return events.PowerSwitched(self.dice.random() < 0.5, self._now_s)

    def _loop(self) -> events.AxisEvent:
        return events.LoopSwitched(self.dice.random() < 0.5, self._now_s)

    def _override(self) -> events.AxisEvent:
        return events.SpeedOverridden(self.dice.choice((0.0, 0.5, 1.0)))

    def _latch(self) -> events.AxisEvent:
        return events.StopLatch()

    def _sent(self) -> events.AxisEvent:
        return events.StopSent(self.dice.choice(list(StopMode)))

    def _unconfirmed(self) -> events.AxisEvent:
        return events.StopUnconfirmed(self._now_ns, self.dice.choice(list(StopMode)))

    def _confirmed(self) -> events.AxisEvent:
        return events.StopConfirmed(self.dice.choice(list(StopMode)))

    def _reset(self) -> events.AxisEvent:
        return events.ResetDone(self._now_s)

    def _unusable(self) -> events.AxisEvent:
        return events.ReplyUnusable(self._now_ns)

    def _contradicted(self) -> events.AxisEvent:
        return events.ReadingsContradicted(self._now_ns)

    def _found(self) -> events.AxisEvent:
        return events.FaultFound(self.dice.choice(OWN))

    def _refused(self) -> events.AxisEvent:
        return events.ReferenceRefused("its mark differs")

    def _placed(self) -> events.AxisEvent:
        return events.PlaceKnown(SCALE.with_position(self._position, 12.0), self.dice.random() < 0.5)

    def _unplaced(self) -> events.AxisEvent:
        return events.PlaceUnknown()

    def _look(self) -> events.AxisEvent:
        return events.LookTaken(self._shown())

    def _seen_loop(self) -> events.AxisEvent:
        return events.LoopSeen(self.dice.random() < 0.5)

    def _recalled(self) -> events.AxisEvent:
        dice = self.dice
        again = dice.choice((None, *StopMode))
        return events.LatchRecalled(
            dice.random() < 0.5, again, dice.random() < 0.5, FIRST, self._now_ns, confirmed=dice.random() < 0.5
        )

    def _named(self) -> events.AxisEvent:
        return events.LatchNamed(LatchedBy(self._now_ns, self.dice.choice((None, "panel"))))

    def _due(self) -> events.AxisEvent:
        return events.StopDue(self.dice.choice(list(StopMode)), "sent first")

    def _overdue(self) -> events.AxisEvent:
        return events.StopOverdue(self._now_ns)


@pytest.fixture(params=range(HISTORIES), ids=lambda seed: f"seed {seed}")
def history(request):
    return History(request.param)


def lives(history: History):
    for _ in range(STEPS):
        yield history.live_on()


def refused(status: AxisStatus, verb: Verb) -> bool:
    """Tell whether a command would be refused for the state of its axis."""
    tracker = tracked()
    put(tracker, **{name: getattr(status, name) for name in AxisStatus.__slots__})
    try:
        guards.require(guards.needs(verb).at_packet, tracker)
    except LdcndError:
        return True
    return False


@pytest.mark.sweep(3)
def test_a_latch_outranks_everything_and_only_a_reset_ends_it(history):
    for before, event, after in lives(history):
        if before.stop_latched and not isinstance(event, events.LatchRecalled):
            assert after.stop_latched or isinstance(event, events.ResetDone)
        assert after.stop_latched or after.latched_by is None or isinstance(event, events.LatchRecalled)
        if after.stop_latched or after.stop_due:
            assert all(refused(after, verb) for verb in (Verb.MOVE_ABSOLUTE, Verb.JOG, Verb.POWER))


@pytest.mark.sweep(2)
def test_a_stop_stays_to_be_sent_until_its_drive_confirms_one_as_strong(history):
    for before, event, after in lives(history):
        if before.stop and not isinstance(event, events.StopConfirmed):
            assert after.stop
            assert STRENGTH[after.stop.mode] >= STRENGTH[before.stop.mode]
            assert after.stop_pending or not before.stop_pending
            assert after.stop_due or not before.stop_due
        if before.stop and isinstance(event, events.StopConfirmed):
            assert (after.stop is None) is (STRENGTH[event.mode] >= STRENGTH[before.stop.mode])
        codes = [entry.code for entry in after.active_faults]
        assert codes.count(faults.STOP_UNCONFIRMED.code) == after.stop_pending


@pytest.mark.sweep(2)
def test_each_command_that_has_begun_ends_once(history):
    for _ in lives(history):
        pass

    over = [command_id for command_id, _ in history.ended]
    under_way = [history.status.command.command_id] if history.status.command else []
    assert list(dict.fromkeys(over + under_way)) == list(dict.fromkeys(history.begun))


@pytest.mark.sweep(2)
def test_what_befalls_a_command_that_is_over_changes_nothing(history):
    for before, event, after in lives(history):
        if isinstance(event, OF_A_COMMAND) and not before.is_at(event.command_id):
            assert after is before


@pytest.mark.sweep(2)
def test_what_is_not_seen_is_not_said_to_stand(history):
    for _, event, after in lives(history):
        if after.link is not LinkState.UP:
            assert (after.moving, after.quality is Quality.GOOD) == (Moving.UNKNOWN, False)
        if isinstance(event, events.DriveLost):
            assert (after.link, after.at_rest, after.target) == (LinkState.DOWN, False, None)
        if after.moving is Moving.NO:
            assert after.at_rest
            assert after.command is None or not after.state.is_motion


@pytest.mark.sweep(2)
def test_a_place_is_known_only_as_long_as_nothing_may_have_changed_the_counter(history):
    for before, event, after in lives(history):
        if isinstance(event, events.DriveLost | events.ReadingsContradicted):
            assert not after.referenced
        if isinstance(event, events.ReadingTaken) and any(fault.loses_position for fault in event.reading.faults):
            assert (after.referenced, after.position_lost, after.target) == (False, True, None)
        if after.referenced and not before.referenced:
            assert isinstance(event, events.PlaceKnown)
        if before.referenced and not after.referenced:
            assert after.reference_lost
        assert not (after.referenced and (after.reference_lost or after.refused))
        if after.scale is not before.scale:
            assert isinstance(event, events.PlaceKnown)


@pytest.mark.sweep(2)
def test_an_axis_falls_into_error_stop_without_its_command(history):
    for before, event, after in lives(history):
        if after.state is AxisState.ERROR_STOP and before.state is not AxisState.ERROR_STOP:
            assert after.command is None or isinstance(event, events.LatchRecalled)
        if after.state.is_motion and not before.state.is_motion:
            # without a command it is a motion that was found in a closed loop
            assert after.command or (after.enabled and after.state is AxisState.DISCRETE_MOTION)


@pytest.mark.sweep(6)
def test_an_axis_in_error_takes_no_command_before_its_reset(history):
    for _, _, after in lives(history):
        if after.state is AxisState.ERROR_STOP:
            moving = (
                verb for verb in Verb if guards.needs(verb).at_packet and verb not in (Verb.TRACE, Verb.TRACE_ABORT)
            )
            assert all(refused(after, verb) for verb in moving)


@pytest.mark.sweep(2)
def test_only_a_reset_leads_out_of_error_stop(history):
    for before, event, after in lives(history):
        begins = isinstance(event, events.CommandBegun | events.CommandGoesOn)  # none is let through
        if before.state is AxisState.ERROR_STOP and not begins:
            assert after.state is AxisState.ERROR_STOP or isinstance(event, events.ResetDone)


@pytest.mark.sweep(2)
def test_a_fault_keeps_its_instant_and_the_first_stays_until_reset(history):
    for before, event, after in lives(history):
        stood = {entry.code: entry for entry in before.faults}
        assert all(stood.get(entry.code, entry) is entry for entry in after.faults)
        first = before.first_fault
        if first and first.stops and not isinstance(event, events.ResetDone | events.LatchRecalled):
            assert after.first_fault is before.first_fault
        assert [entry for entry in new_faults(before, after) if entry.code in stood] == []


@pytest.mark.sweep(2)
def test_a_reading_of_before_the_latest_command_ends_nothing(history):
    for before, event, after in lives(history):
        if isinstance(event, events.ReadingTaken) and event.sent_at_s < before.effective_from_s:
            assert (after.command, after.state, after.enabled) == (before.command, before.state, before.enabled)
        if isinstance(event, events.CommandBegun):
            assert math.isinf(after.effective_from_s)
        if after.command is None:
            assert not math.isinf(after.effective_from_s) or before.command is None


@pytest.mark.sweep(2)
def test_a_step_that_changes_nothing_returns_the_same_object(history):
    for _, event, after in lives(history):
        if isinstance(event, events.LookTaken | events.StopConfirmed | events.StopLatch | events.SpeedOverridden):
            assert step(after, event) is after


@pytest.mark.parametrize("seed", range(HISTORIES // 4))
def test_a_drive_that_others_command_has_no_command_target_or_reference_here(seed):
    history = History(seed, commanded=False)
    for before, event, after in lives(history):
        assert (after.command, after.target, after.referenced, after.has_reference) == (None, None, False, False)
        if isinstance(event, events.ReadingTaken):
            trips = any(fault.stops for fault in event.reading.faults)
            assert (after.state is AxisState.ERROR_STOP) is trips  # its drive alone ends it
            assert (after.first_fault is None) is (not after.active_faults)
        else:
            assert after.enabled is before.enabled


def test_what_is_recalled_is_as_it_was_kept():
    status = step(
        AxisStatus("x", SCALE),
        events.LatchRecalled(stopped=True, again=StopMode.ABRUPT, in_error=True, first=FIRST, now_ns=7),
    )

    assert (status.stop_latched, status.stop_pending, status.stop.mode) == (True, True, StopMode.ABRUPT)
    assert (status.state, status.first_fault.past) == (AxisState.ERROR_STOP, FIRST)
    assert isinstance(status.active_faults[0], FaultEntry)
    assert status.active_faults[0].since == 7


def test_a_recalled_stop_that_was_confirmed_is_due_and_no_fault_before_it_is_overdue():
    kept = events.LatchRecalled(
        stopped=True, again=StopMode.SMOOTH, in_error=False, first=None, now_ns=7, confirmed=True
    )
    recalled = step(AxisStatus("x", SCALE), kept)
    overdue = step(recalled, events.StopOverdue(now_ns=9))

    assert (recalled.stop_latched, recalled.stop_due, recalled.stop_pending) == (True, True, False)
    assert recalled.active_faults == ()
    assert [(fault.code, fault.since) for fault in overdue.active_faults] == [("stop_unconfirmed", 9)]
    assert step(overdue, events.StopConfirmed(StopMode.SMOOTH)).stop is None


def test_where_a_closed_loop_comes_to_rest_without_a_command_is_its_target():
    status = AxisStatus("x", SCALE.with_position(1000, 10.0), link=LinkState.UP)
    for number in range(4):
        reading = replace(AT_REST, enabled=True, position_counts=-2000)
        status = step(status, events.ReadingTaken(reading, 1.0 + number, 0))

    assert (status.state, status.target) == (AxisState.STANDSTILL, 16.0)
