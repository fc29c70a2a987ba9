"""Permission to move one axis: what must hold before a motion starts, the gate that asks, and the only way to send it.

The checks are pure; each refusal says what, which limit, and what to do. A `Permit` is made when a command is admitted
and travels with it, from its turn in the queue of its axis to its last step. The rest of the daemon holds a
`QuietDrive`, which has no call that can move; those are methods of the permit. Each of them checks permission directly
before its first packet, and the bus checks again when the turn of each such packet comes. So a move that waited (for
its turn, for the motion ahead of it, for the other members of its group, for a step of a homing, for the line) is
judged by the state at its start, not by the state at its arrival.
"""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NoReturn, Protocol

from typing_extensions import override

from ldcnd.axis.state import MOTION_STATES, AxisTracker
from ldcnd.contract.catalogue import AXIS_COMMANDS
from ldcnd.contract.commands import Effect, HomeMethod, PinMode, Verb
from ldcnd.contract.errors import (
    AccelerationLimit,
    AxisUnreachable,
    CommandAborted,
    DriveFault,
    LdcndError,
    NotReferenced,
    NotSupported,
    PositionLimit,
    Remedy,
    RequestRefused,
    ShuttingDown,
    StopLatched,
    VelocityLimit,
    WrongState,
    step,
)
from ldcnd.contract.meta import AxisLimits
from ldcnd.contract.samples import AxisState, FaultEntry, LinkState, Moving, TelemetryItem
from ldcnd.drives.driver import (
    NO_CEILING,
    AnalogMotion,
    AxisReading,
    AxisSpec,
    Ceiling,
    CountsMotion,
    Drive,
    Gains,
    HomeCapture,
    Moves,
    PathStatus,
    PwmOutput,
    StopMode,
    cannot,
)
from ldcnd.drives.network import Network
from ldcnd.line.exchange import Exchange
from ldcnd.line.transaction import Condition, only_while


class QuietDrive(Protocol):
    """Calls to a drive that need no permission: none of them can make it move."""

    spec: AxisSpec
    capabilities: frozenset[Verb]
    adc_full_scale: int | None
    retargets: bool
    gains: Gains | None
    holds_gains: bool
    home_methods: frozenset[HomeMethod]
    capture_s: float
    path_period_s: float
    path_packet: int
    path_most_counts: int

    def quantise(self, motion: CountsMotion, most: Ceiling = ...) -> CountsMotion: ...  # noqa: D102 - of `Moves`, as all of these
    def exchanges(self, motion: CountsMotion) -> tuple[Exchange[Any], ...]: ...  # noqa: D102
    def room_counts(self, *, forward: bool) -> int: ...  # noqa: D102
    async def stop(self, mode: StopMode) -> StopMode: ...  # noqa: D102
    async def reset(self) -> None: ...  # noqa: D102
    async def clear_warnings(self) -> None: ...  # noqa: D102
    async def captured_home(self) -> int: ...  # noqa: D102
    def stands_on(self, limit: HomeMethod, reading: AxisReading) -> bool: ...  # noqa: D102
    def check_path(self) -> None: ...  # noqa: D102
    def path_exchanges(self) -> tuple[Exchange[Any], ...]: ...  # noqa: D102
    async def path_status(self) -> PathStatus: ...  # noqa: D102


def check_reachable(axis: AxisTracker) -> None:
    """Refuse when the drive does not answer, or is not known to be the one that is configured."""
    if axis.proof and not axis.proof.holds:
        raise axis.proof.refusal()
    if axis.link is LinkState.DOWN:
        raise AxisUnreachable(
            f"axis {axis.name}: the drive does not answer", axis=axis.name, remedy="check its power and the line"
        )


def check_not_latched(axis: AxisTracker) -> None:
    """Refuse while a stop is latched, or not confirmed by the drive."""
    check_stop_confirmed(axis)
    if axis.stop_latched:
        raise StopLatched(f"axis {axis.name}: a stop is latched", axis=axis.name, remedy=Remedy("{}", step("reset")))


def check_stop_confirmed(axis: AxisTracker) -> None:
    """Refuse while the drive has not confirmed a stop."""
    if axis.stop_pending:
        raise StopLatched(
            f"axis {axis.name}: the drive has not confirmed a stop yet",
            axis=axis.name,
            remedy="wait: it is sent again until the drive confirms it; check the drive and its line",
        )


def check_not_in_error(axis: AxisTracker) -> None:
    """Refuse while a fault, or a command that ended badly, waits to be acknowledged."""
    if axis.state is AxisState.ERROR_STOP:
        raise _faulted(axis)


def check_enabled(axis: AxisTracker) -> None:
    """Refuse a motion while the position loop is open."""
    if axis.state is AxisState.DISABLED:
        raise WrongState(
            f"axis {axis.name} is disabled",
            axis=axis.name,
            value=axis.state,
            remedy=Remedy("{}", step("power", 'send power {"on": true}', on=True)),
        )


def check_stands(axis: AxisTracker) -> None:
    """Refuse while a motion runs: a trapezoid loaded in mid-move is erratic on most drives (PIC-SERVO manual, 4.4)."""
    if axis.state in MOTION_STATES:
        raise WrongState(
            f"axis {axis.name} is in {axis.state}",
            axis=axis.name,
            value=axis.state,
            remedy=Remedy("{} and wait", step("halt")),
        )


def check_does_not_coast(axis: AxisTracker) -> None:
    """Refuse to close the loop while the shaft turns: the drive would hold it where it is, at once.

    A shaft turns when its drive shows a velocity, which is more than a count in a servo cycle: one that creeps, as a
    load that sinks, can be caught.
    """
    if axis.coasts:
        raise WrongState(
            f"axis {axis.name} turns with its motor off: its drive would hold it at once, whatever its speed",
            axis=axis.name,
            remedy=Remedy("wait until it stands, then {}", step("power", 'send power {"on": true}', on=True)),
        )


def check_referenced(axis: AxisTracker) -> None:
    """Refuse an absolute position on an axis that is not referenced."""
    if not axis.referenced:
        kept = f"; what was kept of it was refused: {axis.refused}" if axis.refused else ""
        raise NotReferenced(
            f"axis {axis.name} is not homed: its position is not known{kept}",
            axis=axis.name,
            remedy=Remedy("{} or {}", step("home"), step("set_position", "set_position")),
        )


def check_position_kept(axis: AxisTracker) -> None:
    """Refuse to give the position a meaning while the drive says that it has lost it."""
    if axis.position_lost:
        raise WrongState(
            f"axis {axis.name}: its position is lost: {_said(axis)}",
            axis=axis.name,
            remedy=Remedy("{} first", step("reset")),
        )


def check_position(axis: AxisTracker, limits: AxisLimits, position: float) -> None:
    """Refuse a target outside the software limits, naming the nearest that is inside."""
    if limits.position_min is not None and position < limits.position_min:
        limit, side = limits.position_min, "below"
    elif limits.position_max is not None and position > limits.position_max:
        limit, side = limits.position_max, "above"
    else:
        return
    raise PositionLimit(
        f"axis {axis.name}: target {position:g} {axis.unit} is {side} the limit {limit:g} {axis.unit}",
        axis=axis.name,
        value=position,
        limit=limit,
        nearest=limit,
    )


def check_velocity(axis: AxisTracker, limits: AxisLimits, velocity: float) -> None:
    """Refuse a speed above the limit."""
    if limits.velocity is not None and abs(velocity) > limits.velocity:
        raise VelocityLimit(
            f"axis {axis.name}: velocity {velocity:g} {axis.unit}/s is above the limit"
            f" {limits.velocity:g} {axis.unit}/s",
            axis=axis.name,
            value=velocity,
            limit=limits.velocity,
            nearest=limits.velocity if velocity > 0 else -limits.velocity,
        )


def check_acceleration(axis: AxisTracker, limits: AxisLimits, acceleration: float) -> None:
    """Refuse an acceleration above the limit."""
    if limits.acceleration is not None and acceleration > limits.acceleration:
        raise AccelerationLimit(
            f"axis {axis.name}: acceleration {acceleration:g} {axis.unit}/s2 is above the limit"
            f" {limits.acceleration:g} {axis.unit}/s2",
            axis=axis.name,
            value=acceleration,
            limit=limits.acceleration,
            nearest=limits.acceleration,
        )


def check_speed(axis: AxisTracker) -> None:
    """Refuse a motion while the speed override of the rig is 0."""
    if axis.speed_share <= 0:
        raise WrongState(
            f"axis {axis.name}: the speed override of the rig is 0 %",
            axis=axis.name,
            value=0.0,
            remedy=Remedy("{} above 0 %", step("set_speed_override", "set the speed override")),
        )


def check_not_forced(axis: AxisTracker) -> None:
    """Refuse to reset a faulted axis whose motor has voltage and turns, or may, whatever the state says."""
    if axis.state is AxisState.ERROR_STOP and axis.energised and axis.moving is not Moving.NO:
        raise WrongState(
            f"axis {axis.name} still moves, or may: a reset would switch its motor off at speed",
            axis=axis.name,
            value=axis.moving.value,
            remedy=Remedy("{}, wait until it stands, then {}", step("halt"), step("reset")),
        )


def check_has_gains(drive: QuietDrive) -> None:
    """Refuse to close the loop of a drive that takes gains and has none."""
    if Verb.SET_GAINS in drive.capabilities and drive.gains is None:
        raise WrongState(
            f"axis {drive.spec.name} has no gains: its loop cannot close",
            axis=drive.spec.name,
            remedy=Remedy("configure gains or {}", step("set_gains")),
        )


def fault(axis: str, entry: FaultEntry) -> DriveFault:
    """Return a fault of a drive as what keeps its axis from moving."""
    return DriveFault(
        f"axis {axis}: {entry.text}",
        axis=axis,
        value=entry.code,
        remedy=Remedy("remove the cause, then {}", step("reset")),
    )


def _faulted(axis: AxisTracker) -> WrongState:
    causes = _said(axis) or "a command ended badly"
    return WrongState(
        f"axis {axis.name} is in error_stop: {causes}",
        axis=axis.name,
        value=axis.state,
        remedy=Remedy("remove the cause, then {}", step("reset")),
    )


def _said(axis: AxisTracker) -> str:
    first = (axis.first_fault,) if axis.first_fault else ()
    return "; ".join(fault.text for fault in axis.active_faults or first)


# -- what each command needs -----------------------------------------------------------------------------------------


Guard = Callable[[AxisTracker], None]
"""Raises what a command is refused with while the axis does not hold what it needs."""
ENERGY: tuple[Guard, ...] = (check_reachable, check_not_latched, check_not_in_error)
"""Needed for as long as the motor gets voltage."""
STILL: tuple[Guard, ...] = (*ENERGY, check_enabled, check_stands)
TO_MOVE: tuple[Guard, ...] = (*ENERGY, check_speed)
"""Asked directly before each packet that can move."""
TO_POWER: tuple[Guard, ...] = (*ENERGY, check_does_not_coast)
"""Asked directly before each packet that closes the loop."""


@dataclass(frozen=True, slots=True)
class Needs:
    """What a command needs of the state of its axis, whatever its values.

    Attributes:
        to_begin: asked in this order when its turn has come, before its values.
        at_packet: asked after its values, directly before its packets.
        of_drive: asked of the drive before its first packet.
    """

    to_begin: tuple[Guard, ...] = ()
    at_packet: tuple[Guard, ...] = ()
    of_drive: tuple[Callable[[QuietDrive], None], ...] = ()


BY_VERB: Mapping[Verb, Needs] = {
    Verb.POWER: Needs((*ENERGY, check_stands), TO_POWER, (check_has_gains,)),
    Verb.MOVE_ABSOLUTE: Needs((*STILL, check_referenced), TO_MOVE),
    Verb.TRACK: Needs((*STILL, check_referenced), TO_MOVE),
    Verb.RESET: Needs((check_reachable, check_stop_confirmed, check_stands, check_not_forced)),
    Verb.SET_POSITION: Needs((check_reachable, check_stands, check_position_kept)),
    Verb.SET_GAINS: Needs((check_reachable,)),
    Verb.SET_OUTPUTS: Needs((check_reachable,)),
    Verb.TRACE: Needs(at_packet=(check_reachable,)),
}
"""`power` is to close the loop: to open it needs nothing."""
BY_EFFECT: Mapping[Effect, Needs] = {Effect.MOTION: Needs(STILL, TO_MOVE)}
"""What a command needs that has no entry of its own; nothing where its effect has none either."""


AT_ALL = Needs(ENERGY)
"""What a motion needs that a drive takes over its own inputs."""


def needs(verb: Verb) -> Needs:
    """Return what a command needs."""
    return BY_VERB.get(verb) or BY_EFFECT.get(AXIS_COMMANDS[verb].effect, Needs())


GOES_ON: Mapping[Verb, frozenset[AxisState]] = {
    Verb.MOVE_VELOCITY: frozenset({AxisState.CONTINUOUS_MOTION}),
    Verb.SET_PWM: MOTION_STATES,
    Verb.TRACK: MOTION_STATES,
}
"""Commands that one of their own takes over without a standstill, while the axis is in one of these states."""


def goes_on(verb: Verb, axis: AxisTracker) -> bool:
    """Tell whether a command takes over one of its own that is under way."""
    return axis.command is not None and axis.command.verb is verb and axis.state in GOES_ON.get(verb, ())


def check(verb: Verb, axis: AxisTracker, *, follows: bool = False) -> None:
    """Refuse to begin a command; with `follows` one that need not wait until the axis stands."""
    follows = follows or goes_on(verb, axis)
    for guard in needs(verb).to_begin:
        if not (follows and guard is check_stands):
            guard(axis)


def obstacles(row: Needs, axis: AxisTracker, drive: QuietDrive) -> Iterator[tuple[LdcndError, Guard | None]]:
    """Yield all that a command with these needs would be refused with now, the first first; and which guard says so."""
    for guard in dict.fromkeys(row.to_begin + row.at_packet):
        try:
            guard(axis)
        except LdcndError as error:
            yield error, guard
    for of_drive in row.of_drive:
        try:
            of_drive(drive)
        except LdcndError as error:
            yield error, None


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


def homing(drive: QuietDrive) -> QuietDrive:
    """Return a drive as one that captures its position.

    Raises:
        NotSupported: it does not.
    """
    if drive.home_methods:
        return drive
    raise cannot(drive.spec, "home")


def walking(drive: QuietDrive) -> QuietDrive:
    """Return a drive as one that walks paths.

    Raises:
        NotSupported: it does not.
    """
    if drive.path_period_s:
        return drive
    raise cannot(drive.spec, "walk a path")


class Unmoved(Moves):
    """Stands for the motion of a drive that takes none over its line: everything is refused."""

    def __init__(self, drive: Drive) -> None:
        self.spec = drive.spec
        self.identity = drive.identity
        self.capabilities = drive.capabilities

    @override
    def reading(self, items: frozenset[TelemetryItem]) -> Exchange[AxisReading]:
        self._refuse(f"read {', '.join(sorted(items))} at once")

    @override
    def quantise(self, motion: CountsMotion, most: Ceiling = NO_CEILING) -> CountsMotion:
        self._refuse("move")

    @override
    def exchanges(self, motion: CountsMotion) -> tuple[Exchange[Any], ...]:
        return ()

    @override
    async def power(self, *, on: bool) -> None:
        self._refuse("be enabled" if on else "be disabled")

    @override
    async def load(self, motion: CountsMotion | AnalogMotion | PwmOutput, *, home: HomeCapture | None = None) -> None:
        self._refuse("move")

    @override
    async def start(self) -> None:
        self._refuse("move")

    @override
    async def stop(self, mode: StopMode) -> StopMode:
        self._refuse("be stopped")

    @override
    async def reset(self) -> None:
        self._refuse("be reset")

    def _refuse(self, what: str) -> NoReturn:
        raise NotSupported(
            f"axis {self.spec.name}: {self.spec.model} cannot {what} over its line",
            axis=self.spec.name,
            remedy="use the drive's own inputs",
        )


class Permit:
    """Permission of one command, with all its steps, to move the drive of its axis; made by `Gate`.

    Attributes:
        command_id: names the command everywhere.
        verb: what it is.
    """

    def __init__(self, gate: "Gate", command_id: str, verb: Verb, right: Right) -> None:
        self.command_id = command_id
        self.verb = verb
        self._gate = gate
        self._right = right
        self._epoch = gate.epoch
        self._begun = False

    def still_wanted(self) -> None:
        """Raise when the command was overtaken.

        Raises:
            StopLatched, CommandAborted: a stop has come since, or another command.
            ShuttingDown: the daemon ends.
        """
        if self._gate.closed:
            raise self._gate.ending()
        if self._epoch != self._gate.epoch:
            raise self._gate.overtaken(self.verb)

    def renew(self) -> None:
        """Go on after a stop that this command has requested itself."""
        self._epoch = self._gate.epoch

    def ask(self) -> None:
        """Raise when the command must not be carried out any more.

        Raises:
            StopLatched, ShuttingDown: see `still_wanted`.
            RequestRefused: its sender has lost the right to it, or it comes too late.
        """
        self._ask(begun=self._begun)

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
            CommandAborted,
        DriveFault,
            LdcndError: see `ask`; also a latched or unconfirmed stop, an axis out of reach or in error_stop, and a
                speed override of 0.
        """
        self.to_move()()

    def to_move(self) -> Condition:
        """Return the condition that `ask_to_move` checks, to be checked again when a packet's turn comes."""
        return self._condition(TO_MOVE)

    def _condition(self, guards: tuple[Guard, ...]) -> Condition:
        begun, tracker = self._begun, self._gate.tracker

        def condition() -> None:
            self._ask(begun=begun)
            for guard in guards:
                guard(tracker)

        return condition

    # -- what can move -----------------------------------------------------------------------------------------------

    async def load(self, motion: CountsMotion | AnalogMotion | PwmOutput, *, home: HomeCapture | None = None) -> None:
        """Prepare a motion; see `Moves.load`. Part of it may start the drive's profile generator."""
        self.ask_to_move()
        self._gate.expect(motion)
        with only_while(self.to_move()):
            await self._gate.driver.load(motion, home=home)

    async def start(self, *, stays: bool = False) -> None:
        """Start what was loaded; see `Moves.start`.

        Args:
            stays: what was loaded ends where the axis stands, so the motion of the command has yet to begin.
        """
        condition = self.to_move()
        if not stays:
            self.begin()
        with only_while(condition):
            await self._gate.driver.start()

    async def track(self, position_counts: int) -> None:
        """Go to a position at once; see `Moves.track`."""
        drive = self._gate.driver
        if Verb.TRACK not in drive.capabilities:
            raise cannot(drive.spec, "track")
        condition = self.to_move()
        self.begin()
        self._gate.expect(CountsMotion(position_counts, math.inf, math.inf))
        with only_while(condition):
            await drive.track(position_counts)

    async def add_points(self, steps: Sequence[int]) -> PathStatus:
        """Fill the drive's buffer of path points; see `Moves.add_points`. A motion begins only with `start_path`."""
        self.ask_to_move()
        with only_while(self.to_move()):
            return await self._gate.driver.add_points(steps)

    async def power_on(self) -> None:
        """Close the loop; see `Moves.power`. It takes several packets: a stop among them leaves it open."""
        condition = self._condition(TO_POWER)
        condition()
        was_on = self._gate.tracker.enabled
        try:
            self.begin()
            with only_while(condition):
                await self._gate.driver.power(on=True)
            self.still_wanted()
        except RequestRefused:
            if not was_on:
                await self._gate.driver.stop(StopMode.OFF)
            raise

    async def set_gains(self, gains: Gains) -> None:
        """Load the registers of the loop, which act at once; see `Moves.set_gains`."""
        self.ask()
        with only_while(self.ask):
            await self._gate.driver.set_gains(gains)

    async def set_outputs(self, limit1: PinMode | None, limit2: PinMode | None) -> None:
        """Use limit switch pins as outputs or inputs; see `Moves.set_outputs`."""
        with only_while(self.ask):
            await self._gate.driver.set_outputs(limit1, limit2)

    def announce(self, motion: CountsMotion, *, anywhere: bool = False) -> None:
        """Have readings judged by a motion that the network is about to start; see `PlausibilityGate.expect`."""
        self._gate.expect(motion, anywhere=anywhere)

    def begin(self) -> None:
        """Note that the next packet begins the motion: conditions made from now on do not ask `not_after`."""
        self._begun = True


class Expect(Protocol):
    """See `PlausibilityGate.expect`."""

    def __call__(self, motion: CountsMotion | AnalogMotion | PwmOutput, *, anywhere: bool = False) -> None:
        """Take a motion that is about to be loaded."""


class Gate:
    """The gate of one axis: makes permits, and makes them void.

    Attributes:
        driver: of the drive; nothing but permits and the axis's stops uses it.
        tracker: of its state.
        expect: takes each motion that is about to be loaded.
        epoch: number of stops so far; a permit of an earlier epoch is void.
        closed: the daemon ends; no permit holds.
    """

    def __init__(self, driver: Moves, tracker: AxisTracker, expect: Expect) -> None:
        self.driver = driver
        self.tracker = tracker
        self.expect = expect
        self.epoch = 0
        self._cause = ""
        self.closed = False

    def permit(self, command_id: str, verb: Verb, right: Right = UNCONDITIONAL) -> Permit:
        """Return the permit of a command, valid until the next stop."""
        return Permit(self, command_id, verb, right)

    def overtake(self, by: Permit | None, cause: str) -> None:
        """Make all permits void, except the caller's; the refusals of the others name the cause."""
        self.epoch += 1
        self._cause = cause
        if by is not None:
            by.renew()

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
        if tracker.stop_latched:
            return StopLatched(
                f"axis {tracker.name}: {what} was overtaken by a stop",
                axis=tracker.name,
                remedy=Remedy("{}", step("reset")),
            )
        in_error = tracker.state is AxisState.ERROR_STOP
        return CommandAborted(
            f"axis {tracker.name}: {what} was overtaken by {self._cause}",
            axis=tracker.name,
            remedy=Remedy("{}", step("reset")) if in_error else "send it again",
        )


async def start_path(network: Network, names: frozenset[str], permits: Sequence[Permit]) -> None:
    """Start axes on their paths; every member's permission is checked directly before the packet that starts.

    Raises:
        LdcndError: as `Permit.ask_to_move` of any member, and as `Network.start_path`.
    """
    conditions = [permit.to_move() for permit in permits]

    def ask_all() -> None:
        for condition in conditions:
            condition()

    for permit in permits:
        permit.begin()
    with only_while(ask_all):
        await network.start_path(names, ask_all)


async def start_together(
    network: Network, motions: Mapping[str, CountsMotion], permits: Sequence[Permit], announce: Callable[[], None]
) -> None:
    """Start axes in the same servo cycle; every member's permission is checked directly before the packet that starts.

    Args:
        network: of their line.
        motions: by axis name.
        permits: of all members.
        announce: called between the last check and the first packet.

    Raises:
        LdcndError: as `Permit.ask_to_move` of any member, and as `Network.start_group`.
    """

    def about_to_start() -> None:
        ask_all()
        announce()

    def ask_all() -> None:
        for condition in conditions:
            condition()

    conditions = [permit.to_move() for permit in permits]
    ask_all()
    with only_while(ask_all):
        await network.start_group(motions, about_to_start)
