"""Permission to move one axis: the gate that makes it and makes it void, and the only way to send a motion.

A `Permit` is made when a command is admitted and travels with it, from its turn in the queue of its axis to its last
step. The rest of the daemon holds a `QuietDrive`, which has no call that can move; those are methods of the permit.
Each of them checks permission directly before its first packet, and the bus checks again when the turn of each such
packet comes. So a move that waited (for its turn, for the motion ahead of it, for the other members of its group, for a
step of a homing, for the line) is judged by the state at its start, not by the state at its arrival.
"""

import asyncio
import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace

from ldcnd.axis.events import Overtaken
from ldcnd.axis.guards import ENERGY, TO_MOVE, TO_POWER, Guard, check, require
from ldcnd.axis.plausibility import PlausibilityGate
from ldcnd.axis.tracker import AxisTracker
from ldcnd.config.interlocks import InterlockKind
from ldcnd.contract.commands import PinMode, Verb, kind_of
from ldcnd.contract.errors import (
    CommandAborted,
    LdcndError,
    Remedy,
    RequestRefused,
    ShuttingDown,
    StopLatched,
    WrongState,
    step,
)
from ldcnd.contract.samples import AxisState
from ldcnd.drives.driver import (
    AnalogMotion,
    CountsMotion,
    Gains,
    HomeCapture,
    Moves,
    PathStatus,
    PwmOutput,
    StopMode,
    cannot,
)
from ldcnd.line.proof import Condition, only_while


def always() -> None:
    """Forbid nothing."""


@dataclass(frozen=True, slots=True)
class Right:
    """Conditions on the sender of a command, besides the state of the axis.

    Attributes:
        holds: checked before every motion of the command: its lease, no other daemon.
        in_time: checked until its first motion has begun: its `not_after`.
    """

    holds: Condition = always
    in_time: Condition = always

    def also(self, condition: Condition) -> "Right":
        """Return this right with one more condition, checked before every motion."""

        def both() -> None:
            self.holds()
            condition()

        return replace(self, holds=both)


UNCONDITIONAL = Right()
"""Right of commands that bring an axis to rest, and of callers inside the daemon."""


class Permit:
    """Permission of one command, with all its steps, to move the drive of its axis; made by `Gate`.

    Attributes:
        command_id: names the command everywhere.
        verb: what it is.
        by_s: latest instant, in loop time, to send a packet of its next motion: it goes on from another one, and later
            it could not turn within the software limits.
        overtakes: it goes on from what was sent before it, which is void once its motion begins, and no sooner: what is
            refused until then ends nothing.
        planned_share: the speed override, 0 to 1, by which a motion is planned that takes long to prepare: it does not
            begin at a lower one. 0 where nothing is asked of it.
        loaded: the motion that it has loaded last, or is about to.
    """

    def __init__(self, gate: "Gate", command_id: str, verb: Verb, right: Right) -> None:
        self.command_id = command_id
        self.verb = verb
        self.by_s = math.inf
        self.overtakes = False
        self.planned_share = 0.0
        self._gate = gate
        self._right = right
        self._number = gate.next_number()
        self.has_begun = False
        self._kind = InterlockKind(kind_of(verb))
        self.loaded: CountsMotion | AnalogMotion | PwmOutput | None = None
        self._counts_per_s = 0.0
        self._planned_by_s = math.inf  # see `CountsMotion.by_s`
        self._slows = False  # what was loaded last is the motion under way, no faster and no farther

    @property
    def most_counts_per_s(self) -> float:
        """The speed of what it has loaded last; infinite where that has none of its own."""
        return self._counts_per_s

    def still_wanted(self) -> None:
        """Raise when the command was overtaken.

        Raises:
            StopLatched, CommandAborted: a stop has come since, or another command.
            ShuttingDown: the daemon ends.
        """
        if self._gate.closed:
            raise self._gate.ending()
        if self.is_void:
            raise self._gate.overtaken(self.verb)

    @property
    def is_void(self) -> bool:
        """Whether the command was overtaken, or the daemon ends."""
        return self._gate.closed or self._number < self._gate.valid_from

    @property
    def number(self) -> int:
        """How many commands of the axis were admitted before."""
        return self._number

    def ask(self) -> None:
        """Raise when the command must not be carried out any more.

        Raises:
            StopLatched, ShuttingDown: see `still_wanted`.
            RequestRefused: its sender has lost the right to it, or it comes too late.
        """
        self._ask(begun=self.has_begun)

    def _ask(self, *, begun: bool) -> None:
        self.still_wanted()
        self._right.holds()
        if not begun:
            self._right.in_time()

    def check_state(self, *, follows: bool = False) -> None:
        """Raise when the state of the axis forbids to begin this command; see `Needs.to_begin`.

        Args:
            follows: it may follow what the axis does, without a standstill in between.
        """
        check(self.verb, self._gate.tracker, follows=follows)

    def ask_to_move(self) -> None:
        """Raise when nothing of this command may move the axis now.

        Raises:
            StopLatched, CommandAborted, ShuttingDown: see `ask`.
            RequestRefused, DriveFault: a stop is not confirmed, the axis is out of reach or in error_stop, the speed
                override is 0 or was lowered since its motion was planned (`planned_share`), an interlock forbids it, or
                it is not known whether this command has begun.
        """
        self.to_move()()

    def to_move(self) -> Condition:
        """Return the condition that `ask_to_move` checks, to be checked again when a packet's turn comes."""
        return self._condition(TO_MOVE, self._kind, begun=self.has_begun)

    def to_go_on(self) -> Condition:
        """Return the condition that `to_move` is of a motion that has begun: it may take as long as it takes."""
        return self._condition(TO_MOVE, self._kind, begun=True)

    def _condition(self, guards: tuple[Guard, ...], kind: InterlockKind, *, begun: bool) -> Condition:
        gate = self._gate

        def condition() -> None:
            self._ask(begun=begun)
            require(guards, gate.tracker)
            self._check_sure()
            self._check_in_time()
            if not begun:
                self._check_not_slower()
            for violation in gate.violations(kind, self._counts_per_s / abs(gate.tracker.status.scale.counts_per_unit)):
                raise violation

        return condition

    def _check_in_time(self) -> None:
        name = self._gate.tracker.name
        if asyncio.get_running_loop().time() > min(self.by_s, self._planned_by_s):
            raise WrongState(
                f"axis {name}: the line was too slow for a {self.verb} during the motion under way",
                axis=name,
                value=self.verb.value,
                remedy="send it again; it begins from rest once the axis stands",
            )

    def _check_not_slower(self) -> None:
        status = self._gate.tracker.status
        if status.speed_share < self.planned_share:
            raise WrongState(
                f"axis {status.name}: the speed override was lowered to {status.speed_override:g} % before the"
                f" {self.verb} began",
                axis=status.name,
                value=status.speed_override,
                limit=100.0 * self.planned_share,
                remedy="send it again",
            )

    def _check_sure(self) -> None:
        status = self._gate.tracker.status
        if status.progress.unsure and status.is_at(self.command_id):
            raise WrongState(
                f"axis {status.name}: nothing of a {self.verb} is started whose start before was not confirmed:"
                f" {status.progress.unsure.why}",
                axis=status.name,
                value=self.verb.value,
                remedy="look where the axis is, then send another motion",
            )

    def _to_slow_down(self) -> None:
        """Raise when the motion of this command is over, or is to end: only then may it not be made slower.

        Raises:
            CommandAborted, ShuttingDown: it is over, or is being stopped; or the daemon ends.
            RequestRefused, DriveFault: see `ENERGY`; or not known to have begun, or too late.
        """
        gate, status = self._gate, self._gate.tracker.status
        if gate.closed:
            raise gate.ending()
        require(ENERGY, gate.tracker)
        if status.stop or not status.is_at(self.command_id):
            raise CommandAborted(f"axis {status.name}: the {self.verb} is over, or being stopped", axis=status.name)
        self._check_sure()
        self._check_in_time()

    def _may_send(self) -> Condition:
        """Return the condition of what it loads, or has loaded, to be checked again when a packet's turn comes."""
        return self._to_slow_down if self._slows else self.to_move()

    def _about_to(self, motion: CountsMotion | AnalogMotion | PwmOutput, *, slower: bool = False) -> None:
        """Take how fast the next motion may become: interlocks may bind only fast ones."""
        self.loaded, self._slows = motion, slower
        in_counts = motion if isinstance(motion, CountsMotion) else CountsMotion(None, math.inf, math.inf)
        self._counts_per_s, self._planned_by_s = abs(in_counts.velocity_counts_per_s), in_counts.by_s

    def ask_to_open_loop(self) -> None:
        """Raise while an interlock forbids to switch a motor off that has voltage: its load would fall.

        Raises:
            InterlockViolated: names the rule.
        """
        # a motor without voltage holds nothing that could fall
        if self._gate.tracker.status.energised:
            for violation in self._gate.violations(InterlockKind.POWER_OFF, 0.0):
                raise violation

    # -- what can move -----------------------------------------------------------------------------------------------

    async def load(
        self,
        motion: CountsMotion | AnalogMotion | PwmOutput,
        *,
        home: HomeCapture | None = None,
        slower: bool = False,
    ) -> None:
        """Prepare a motion; see `Moves.load`. Part of it may start the drive's profile generator.

        Args:
            motion: what to prepare.
            home: the capture on its way.
            slower: it is the motion under way, no faster and no farther: that needs no right, as a halt needs none.
        """
        self._about_to(motion, slower=slower)
        condition = self._may_send()
        condition()
        # before its packets: part of a load may turn the shaft, and readings of that must be believed
        self._gate.plausibility.expect(motion)
        self._gate.tell(self._counts_per_s)
        stands_when_done = self._gate.tracker.status.stands_when_done
        with only_while(condition):
            await self._gate.driver.load(motion, home=home, stands_when_done=stands_when_done)

    async def start(self, *, stays: bool = False) -> None:
        """Start what was loaded; see `Moves.start`.

        Args:
            stays: what was loaded ends where the axis stands, so the motion of the command has yet to begin.
        """
        condition = self._may_send()
        # behind the condition, which so still asks for the first packet whether it comes in time
        if not stays:
            self.begin()
        try:
            with only_while(condition):
                await self._gate.driver.start()
        finally:
            # of this motion alone; the next one begins from what it finds
            self.by_s = self._planned_by_s = math.inf

    async def track(self, position_counts: int, *, stands_when_done: bool) -> None:
        """Go to a position at once; see `Moves.track`, of before the command began."""
        drive = self._gate.driver
        if Verb.TRACK not in drive.capabilities:
            raise cannot(drive.spec, "track")
        # the drive follows without a profile: to judge readings it may be there at once
        motion = CountsMotion(position_counts, math.inf, math.inf)
        self._about_to(motion)
        condition = self.to_move()
        self.begin()
        self._gate.plausibility.expect(motion)
        self._gate.tell(math.inf)
        with only_while(condition):
            await drive.track(position_counts, stands_when_done=stands_when_done)

    async def add_points(self, steps: Sequence[int], goes_on: Condition) -> PathStatus:
        """Fill the drive's buffer of path points; see `Moves.add_points`. A motion begins only with `start_path`.

        Args:
            steps: from point to point, counts.
            goes_on: raises once the path has ended for another member; a drive may keep points behind its stop.
        """
        # how fast points are is not known here: rules for fast motions bind them
        self._counts_per_s = math.inf
        self._gate.tell(math.inf)
        self.ask_to_move()
        may_move = self.to_move()

        def condition() -> None:
            goes_on()
            may_move()

        with only_while(condition):
            return await self._gate.driver.add_points(steps)

    async def power_on(self) -> None:
        """Close the loop; see `Moves.power`. It takes several packets: a stop among them leaves it open.

        Nothing moves: a loop that is closed stays as it is. Closed again, it would hold where the shaft is then, with
        the gains of another kind of motion, and the shaft would turn.
        """
        condition = self._condition(TO_POWER, InterlockKind.POWER_ON, begun=self.has_begun)
        condition()
        if self._gate.tracker.status.enabled:
            return
        try:
            self.begin()
            with only_while(condition):
                await self._gate.driver.power(on=True)
            self.still_wanted()
        except RequestRefused:
            await self._gate.driver.stop(StopMode.OFF)
            raise

    async def set_gains(self, gains: Gains) -> None:
        """Load the registers of the loop, which act at once; see `Moves.set_gains`.

        On a closed loop other gains may move its shaft, however fast: what forbids any motion forbids them.
        """
        self._ask_for_gains()
        with only_while(self._ask_for_gains):
            stands_when_done = self._gate.tracker.status.stands_when_done
            await self._gate.driver.set_gains(gains, stands_when_done=stands_when_done)

    def _ask_for_gains(self) -> None:
        self.ask()
        if self.verb is Verb.SET_GAINS and self._gate.tracker.status.enabled:
            for violation in self._gate.violations(self._kind, math.inf):
                raise violation

    async def set_outputs(self, limit1: PinMode | None, limit2: PinMode | None) -> None:
        """Use limit switch pins as outputs or inputs; see `Moves.set_outputs`."""
        with only_while(self.ask):
            await self._gate.driver.set_outputs(limit1, limit2)

    def announce(self, motion: CountsMotion, *, anywhere: bool = False) -> None:
        """Have readings judged by a motion that the network is about to start; see `PlausibilityGate.expect`."""
        self._about_to(motion)
        self._gate.plausibility.expect(motion, anywhere=anywhere)
        self._gate.tell(self._counts_per_s)

    def begin(self) -> None:
        """Note that the next packet begins the motion: conditions made from now on do not ask `not_after`."""
        if self.overtakes and not self.has_begun:
            self._gate.overtake(self, self.verb)
        self.has_begun = True


Violations = Callable[[InterlockKind, float], Iterable[LdcndError]]
"""Yields what interlocks forbid a kind of motion at a speed with, or to open or to close the loop."""


def _no_interlocks(_kind: InterlockKind, _speed: float) -> Iterable[LdcndError]:
    return ()


@dataclass(frozen=True, slots=True)
class ToldSpeed:
    """How fast a drive may turn its shaft at most, by what it was told.

    Attributes:
        counts_per_s: by the latest motion.
        replaced_counts_per_s: by those before it, down to the last rest: it slows down from there.
        at_s: when it was told the latest, in loop time.
    """

    counts_per_s: float = 0.0
    replaced_counts_per_s: float = 0.0
    at_s: float = -math.inf

    @property
    def most_counts_per_s(self) -> float:
        """Speed that no motion since the last rest exceeds."""
        return max(self.counts_per_s, self.replaced_counts_per_s)


class Gate:
    """The gate of one axis: makes permits, and makes them void.

    Attributes:
        driver: of the drive; nothing but permits and the axis's stops uses it.
        tracker: of its state.
        plausibility: takes each motion that is about to be loaded, and judges readings by it.
        violations: yields which interlocks forbid a kind of motion at a speed in units a second, or a change of power.
        told: what the drive was told last of how fast to turn.
        valid_from: the number of the first permit that is not void.
        closed: the daemon ends; no permit holds.
    """

    def __init__(self, driver: Moves, tracker: AxisTracker, plausibility: PlausibilityGate) -> None:
        self.driver = driver
        self.tracker = tracker
        self.plausibility = plausibility
        self.violations: Violations = _no_interlocks
        self.told = ToldSpeed()
        self.valid_from = 0
        self._made = 0
        self._cause = ""
        self.closed = False

    def tell(self, counts_per_s: float) -> None:
        """Note how fast the motion may have the drive turn that it is about to be told."""
        reading, replaced = self.tracker.reading, 0.0
        if reading and not self.tracker.status.at_rest:
            shown = abs(reading.velocity_counts_per_s) + reading.velocity_resolution_counts_per_s
            replaced = max(self.told.counts_per_s, self.told.replaced_counts_per_s, shown)
        self.told = ToldSpeed(counts_per_s, replaced, asyncio.get_running_loop().time())

    def permit(self, command_id: str, verb: Verb, right: Right = UNCONDITIONAL) -> Permit:
        """Return the permit of a command, valid until the next stop."""
        return Permit(self, command_id, verb, right)

    def next_number(self) -> int:
        """Return the number of a permit that is made now."""
        self._made += 1
        return self._made - 1

    def overtake(self, by: Permit | None, cause: str) -> None:
        """Make all permits void that there are, or that are older than the caller's; their refusals name the cause."""
        self.valid_from = max(self.valid_from, self._made if by is None else by.number)
        self._cause = cause
        if by is None:
            self.tracker.take(Overtaken())

    def close(self) -> None:
        """Make all permits void permanently."""
        self.closed = True

    def ending(self) -> ShuttingDown:
        """Return the refusal of a daemon that ends."""
        name = self.tracker.name
        return ShuttingDown(f"axis {name}: the daemon is stopping", axis=name)

    def overtaken(self, what: str) -> StopLatched | CommandAborted:
        """Return the refusal of a command that a stop has overtaken, or the latest cause that latches nothing."""
        tracker = self.tracker
        if tracker.status.stop_latched:
            return StopLatched(
                f"axis {tracker.name}: {what} was overtaken by a stop",
                axis=tracker.name,
                remedy=Remedy("{}", step("reset")),
            )
        in_error = tracker.status.state is AxisState.ERROR_STOP
        return CommandAborted(
            f"axis {tracker.name}: {what} was overtaken by {self._cause}",
            axis=tracker.name,
            remedy=Remedy("{}", step("reset")) if in_error else "send it again",
        )
