"""The step function of an axis beside the tracker that it replaces, over random histories."""

import math
import random
from dataclasses import replace

import pytest

from ldcnd.axis import events, faults
from ldcnd.axis.rest import Settling
from ldcnd.axis.scale import AxisScale
from ldcnd.axis.status import ActiveCommand, AxisStatus, Completion, new_faults
from ldcnd.axis.step import step
from ldcnd.contract.commands import Verb
from ldcnd.contract.samples import AxisState, LinkState, PastFault
from ldcnd.drives.driver import AxisReading, Fault, StopMode
from ldcnd.line.exchange import Timing
from tests.support import earlier_tracker as earlier
from tests.support.axis_bench import AT_REST

STEPS, HISTORIES = 120, 60
FAULTS = (
    Fault("overheat", "hot"),
    Fault("wrap", "wrapped", stops=False),
    Fault("encoder", "lost", loses_position=True),
    Fault("missed", "lost", stops=False, loses_position=True),
)
STATES = (AxisState.DISCRETE_MOTION, AxisState.CONTINUOUS_MOTION, AxisState.HOMING, AxisState.STOPPING)


class Proof:
    """What stands for the one who answers."""

    holds, is_another = True, False


class Pair:
    """The earlier tracker and a status that live through the same."""

    def __init__(self, seed: int, *, commanded: bool) -> None:
        self.dice = random.Random(seed)
        self.ended: list[object] = []
        self.found: list[object] = []
        self.proof = Proof()
        kind = earlier.AxisTracker if commanded else earlier.ObservedTracker
        self.old = kind("x", "mm", lambda *end: self.ended.append(end), self.proof)
        self.old.found = self.found.append
        self.now = AxisStatus("x", AxisScale("mm"), commanded=commanded)
        self.commanded = commanded
        self.now_s, self.position, self.number = 1.0, 0, 0
        self.story: list[object] = []
        self.new_ended: list[object] = []
        self.new_found: list[object] = []

    @property
    def now_ns(self) -> int:
        return round(self.now_s * 1e9)

    def take(self, event: object) -> None:
        self.story.append(event)
        before = self.now
        self.now = step(before, event)
        if self.now.last_end is not before.last_end:
            end = self.now.last_end
            self.new_ended.append((end.command, end.status, end.reason, end.settled))
        self.new_found += [entry.past for entry in new_faults(before, self.now)]

    def act(self) -> None:
        dice, old = self.dice, self.old
        self.now_s += dice.choice((0.0, 0.002, 0.05, 0.3, 1.0))
        names = ["reading"] * 30 + ["missed"] * 3 + ["disconnected"]
        if self.commanded:
            names += ["begin", "begin", "started", "started", "speed", "failing", "finished", "power", "switched"]
            names += ["override", "latch", "sent", "unconfirmed", "confirmed", "reset", "unusable", "contradicted"]
            names += ["fault", "refused", "placed", "unplaced", "set", "look", "loop"]
        getattr(self, "_" + dice.choice(names))(old, dice)

    @property
    def may_not_settle(self) -> bool:
        """Whether a reading may end the command as not settled: the tracker forgets then what was altered."""
        command = self.old.command
        return command is not None and command.settling is not None and command.settling.faults

    def _shown(self, dice: random.Random) -> AxisReading:
        self.position += dice.choice((0, 0, 0, 1, -1, 3, 40))
        velocity = dice.choice((0.0, 0.0, 0.0, 10_000.0, -2_000.0))
        return replace(
            AT_REST,
            position_counts=self.position,
            velocity_counts_per_s=velocity,
            enabled=dice.random() < 0.8,
            profile_done=dice.random() < 0.7,
            faults=tuple(dice.sample(FAULTS, dice.choice((0, 0, 0, 0, 0, 1, 2)))),
            cut_short=dice.choice(("", "", "", "", "a switch")),
            altered="" if self.may_not_settle else dice.choice(("", "", "", "", "", "a register")),
        )

    def _reading(self, old: earlier.AxisTracker, dice: random.Random) -> None:
        reading, at_s = self._shown(dice), self.now_s - dice.choice((0.0, 0.0, 0.01, 0.2))
        old.observed(reading, Timing(at_s, at_s, at_s, at_s), self.now_ns)
        if old.enabled and old.target is None and old.came_to_rest:  # as telemetry did
            old.target = self.now.scale.shown_at(reading.position_counts)
        self.take(events.ReadingTaken(reading, at_s, self.now_ns))

    def _missed(self, old: earlier.AxisTracker, dice: random.Random) -> None:
        self.proof.is_another = dice.random() < 0.2
        old.missed(self.now_ns)
        self.take(events.PollMissed(self.now_ns, self.proof.is_another))

    def _disconnected(self, old: earlier.AxisTracker, dice: random.Random) -> None:
        self.proof.is_another = dice.random() < 0.2
        old.disconnected(self.now_ns)
        self.take(events.DriveLost(self.now_ns, self.proof.is_another))

    def _begin(self, old: earlier.AxisTracker, dice: random.Random) -> None:
        self.number += dice.choice((0, 1, 1))
        state, completion = dice.choice(STATES), dice.choice(list(Completion))
        settling = Settling(self.position, 5.0, 0.05, 0.5, dice.random() < 0.5) if dice.random() < 0.5 else None
        if completion is not Completion.PROFILE:
            settling = None
        command = ActiveCommand(
            f"c{self.number}", dice.choice((Verb.HOME, Verb.MOVE_ABSOLUTE, Verb.HALT)), self.now_ns, state, completion,
            dice.random() < 0.2, dice.choice((None, 4.0)), dice.choice((None, 0.5)), settling,
        )  # fmt: skip
        old.begin(command, math.inf)
        self.take(events.CommandBegun(command))

    def _started(self, old: earlier.AxisTracker, _dice: random.Random) -> None:
        old.started(self.now_s)
        self.take(events.MotionStarted(self.now_s))

    def _speed(self, old: earlier.AxisTracker, _dice: random.Random) -> None:
        old.ends_after(0.7, self.now_s, self.now_ns)
        self.take(events.SpeedChanged(0.7, self.now_s, self.now_ns))

    def _failing(self, old: earlier.AxisTracker, _dice: random.Random) -> None:
        old.failing("it failed")
        self.take(events.CommandFailing("it failed"))

    def _finished(self, old: earlier.AxisTracker, dice: random.Random) -> None:
        error = dice.choice((None, "the line failed"))
        old.finished(error)
        self.take(events.CommandOver(error))

    def _power(self, old: earlier.AxisTracker, dice: random.Random) -> None:
        on = dice.random() < 0.5
        old.powered(on=on, now_s=self.now_s)
        self.take(events.PowerSwitched(on, self.now_s))

    def _switched(self, old: earlier.AxisTracker, dice: random.Random) -> None:
        on = dice.random() < 0.5
        old.switched(on=on, now_s=self.now_s)
        self.take(events.LoopSwitched(on, self.now_s))

    def _override(self, old: earlier.AxisTracker, dice: random.Random) -> None:
        old.speed_share = dice.choice((0.0, 0.5, 1.0))
        self.take(events.SpeedOverridden(old.speed_share))

    def _latch(self, old: earlier.AxisTracker, _dice: random.Random) -> None:
        old.latch_stop()
        self.take(events.StopLatch())

    def _sent(self, old: earlier.AxisTracker, dice: random.Random) -> None:
        mode = dice.choice(list(StopMode))
        sent = old.stop_sent(mode)
        self.take(events.StopSent(mode))
        assert self.now.stop.mode is sent

    def _unconfirmed(self, old: earlier.AxisTracker, dice: random.Random) -> None:
        mode = dice.choice(list(StopMode))
        old.stop_unconfirmed(self.now_ns, mode)
        self.take(events.StopUnconfirmed(self.now_ns, mode))

    def _confirmed(self, old: earlier.AxisTracker, dice: random.Random) -> None:
        mode = dice.choice(list(StopMode))
        old.stop_confirmed(mode)
        self.take(events.StopConfirmed(mode))

    def _reset(self, old: earlier.AxisTracker, _dice: random.Random) -> None:
        if not old.stop_pending:  # it is refused then
            old.cleared(self.now_s)
            self.take(events.ResetDone(self.now_s))

    def _unusable(self, old: earlier.AxisTracker, _dice: random.Random) -> None:
        before = self.now
        news = old.replied_in_vain(self.now_ns)
        self.take(events.ReplyUnusable(self.now_ns))
        assert news == (self.now.replies_unusable and not before.replies_unusable)

    def _contradicted(self, old: earlier.AxisTracker, _dice: random.Random) -> None:
        before = self.now
        news = old.contradicted(self.now_ns)
        self.take(events.ReadingsContradicted(self.now_ns))
        assert news == (self.now.contradicts and not before.contradicts)

    def _fault(self, old: earlier.AxisTracker, dice: random.Random) -> None:
        fault = dice.choice((faults.JUMPED, faults.DRIVE_CHANGED, faults.DRIVE_RESET))
        old.changed_by_another(fault)
        self.take(events.FaultFound(fault))

    def _refused(self, old: earlier.AxisTracker, _dice: random.Random) -> None:
        if not old.referenced and not old.refused:
            old.refuse_reference("its mark differs")
            self.take(events.ReferenceRefused("its mark differs"))

    def _placed(self, old: earlier.AxisTracker, _dice: random.Random) -> None:
        old.referenced = True
        old._own_now()  # a reading before the next loss did that
        self.take(events.PlaceKnown(self.now.scale))

    def _unplaced(self, old: earlier.AxisTracker, _dice: random.Random) -> None:
        old.referenced = False
        self.take(events.PlaceUnknown())

    def _set(self, old: earlier.AxisTracker, _dice: random.Random) -> None:
        old.referenced, old.target = True, None
        old._own_now()
        self.take(events.PlaceKnown(self.now.scale, resting=True))

    def _look(self, old: earlier.AxisTracker, dice: random.Random) -> None:
        reading = self._shown(dice)
        old.looked_at(reading)
        self.take(events.LookTaken(reading))

    def _loop(self, old: earlier.AxisTracker, dice: random.Random) -> None:
        old.enabled = dice.random() < 0.5
        self.take(events.LoopSeen(old.enabled))

    def check(self) -> None:
        old, now = self.old, self.now
        for name in (
            "state", "enabled", "referenced", "reference_lost", "position_lost", "stop_latched", "stop_pending", "link",
            "command", "last_error", "target", "active_faults", "first_fault", "speed_share", "moving", "at_rest",
            "coasts", "energised", "quality",
        ):  # fmt: skip
            assert getattr(now, name) == getattr(old, name), (name, self.story[-3:])
        assert (now.stop.mode if now.stop else None) == old.unconfirmed
        assert now.failure == old._failure
        assert now.effective_from_s == old._effective_from_s
        assert (old.next_reading_s(self.now_s) or math.inf) == now.next_reading_s(self.now_s)
        assert (self.new_ended, self.new_found) == (self.ended, self.found), self.story[-3:]


@pytest.mark.parametrize("commanded", [True, False])
@pytest.mark.parametrize("seed", range(HISTORIES))
def test_the_step_function_and_the_earlier_tracker_say_the_same(seed, commanded):
    pair = Pair(seed, commanded=commanded)
    for _ in range(STEPS):
        pair.act()
        pair.check()


def test_recalled_latches_are_the_same():
    first = PastFault(code="overheat", text="hot", since=5, source="drive")
    for again in (None, *StopMode):
        for in_error in (True, False):
            pair = Pair(0, commanded=True)
            pair.old.recall(stopped=True, again=again, in_error=in_error, first=first, now_ns=7)
            pair.take(events.LatchRecalled(stopped=True, again=again, in_error=in_error, first=first, now_ns=7))
            pair.check()


def test_a_step_that_changes_nothing_returns_the_same_object():
    status = AxisStatus("x", AxisScale("mm"))
    reading = replace(AT_REST, enabled=True)
    for number in range(9):
        status = step(status, events.ReadingTaken(reading, 1.0 + number, 0))

    assert step(status, events.ReadingTaken(reading, 20.0, 0)) is status
    assert step(status, events.StopConfirmed()) is status
    assert (status.state, status.link) == (AxisState.STANDSTILL, LinkState.UP)
