"""The verbs of an axis as methods; made from the command classes by `make fix`, not edited."""

from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import TypeVar

from ldcnd.client.motion import Motion
from ldcnd.contract.commands import (
    AxisCommand,
    BufferMode,
    Command,
    CommandReply,
    Direction,
    Halt,
    Home,
    HomeMethod,
    HomeStop,
    Jog,
    MoveAbsolute,
    MoveAnalog,
    MoveRelative,
    MoveVelocity,
    PinMode,
    Power,
    Probe,
    ProbeSource,
    ProbeStop,
    QuickStop,
    Reset,
    SetGains,
    SetOutputs,
    SetPosition,
    SetPwm,
    Track,
    Verb,
)
from ldcnd.contract.frozen import Frozen
from ldcnd.contract.parameters import (
    AlarmReport,
    ClearCounter,
    CounterName,
    CounterReply,
    EepromCount,
    ListParameters,
    Memory,
    MonitorReport,
    ParameterDump,
    ParameterList,
    ParameterPlan,
    ParameterReply,
    PlanParameters,
    ReadAlarms,
    ReadAllParameters,
    ReadMonitors,
    ReadParameter,
    RestartEepromCount,
    WriteParameter,
)
from ldcnd.contract.questions import Preview, PreviewReply, ReportShadow, ShadowReply, Why, WhyReply
from ldcnd.contract.samples import MonitorName, ShadowFigure
from ldcnd.contract.traces import AbortTrace, TraceAbortReply

ReplyT = TypeVar("ReplyT", bound=Frozen)
AxisReplyT = TypeVar("AxisReplyT", bound=CommandReply)


class AxisVerbs(ABC):
    """One method for each command; it returns once the drive has acknowledged the command, or raises why not.

    Positions, velocities and accelerations are numbers in the unit of the axis, that a second and that a second
    squared, or texts with a unit that the axis has, such as "3000 rpm".
    """

    @abstractmethod
    async def _send(self, command: type[AxisCommand[AxisReplyT]], **fields: object) -> AxisReplyT:
        """Send a command that ends with its reply."""

    @abstractmethod
    async def _start(self, command: type[AxisCommand[CommandReply]], **fields: object) -> Motion:
        """Send a command that ends later."""

    @abstractmethod
    async def _ask(self, command: type[Command[ReplyT]], /, **fields: object) -> ReplyT:
        """Query the daemon about the axis."""

    async def power(self, *, on: bool) -> CommandReply:
        """Close or open the position loop; nothing moves.

        Args:
            on: True closes the loop at the present position, false opens it and disables the amplifier.
        """
        return await self._send(Power, on=on)

    async def move_absolute(
        self,
        position: float | str,
        *,
        direction: Direction | None = None,
        buffer_mode: BufferMode = BufferMode.REFUSE,
        velocity: float | str | None = None,
        acceleration: float | str | None = None,
    ) -> Motion:
        """Move to a position on a trapezoidal profile.

        Args:
            position: Target in axis units; on an axis with a modulo any turn of it is meant.
            direction: Way to turn, on an axis with a modulo only; the shortest when missing.
            buffer_mode: Effect if the axis moves already.
            velocity: Speed in units a second; the axis default when missing.
            acceleration: Acceleration in units a second squared; the axis default when missing.
        """
        return await self._start(
            MoveAbsolute,
            position=position,
            direction=direction,
            buffer_mode=buffer_mode,
            velocity=velocity,
            acceleration=acceleration,
        )

    async def move_relative(
        self,
        distance: float | str,
        *,
        buffer_mode: BufferMode = BufferMode.REFUSE,
        velocity: float | str | None = None,
        acceleration: float | str | None = None,
    ) -> Motion:
        """Move by a distance from the commanded position; becomes absolute when it is admitted.

        Args:
            distance: Distance in axis units, signed.
            buffer_mode: Effect if the axis moves already.
            velocity: Speed in units a second; the axis default when missing.
            acceleration: Acceleration in units a second squared; the axis default when missing.
        """
        return await self._start(
            MoveRelative, distance=distance, buffer_mode=buffer_mode, velocity=velocity, acceleration=acceleration
        )

    async def move_velocity(
        self,
        velocity: float | str,
        *,
        duration_s: float | None = None,
        buffer_mode: BufferMode = BufferMode.REFUSE,
        acceleration: float | str | None = None,
    ) -> Motion:
        """Move at a constant velocity until the next command, the software limit, or the end of its duration.

        Args:
            velocity: Velocity in units a second, positive forward, not 0.
            duration_s: Duration at the velocity, in seconds, at most the axis's `longest_run_s`; that, or without it
                the software limit ahead or `jog_horizon_s`, when missing. The drive itself ends it with a ramp, also
                when daemon and client are gone: it is a move of so many units.
            buffer_mode: Effect if the axis moves already.
            acceleration: Acceleration in units a second squared; the axis default when missing.
        """
        return await self._start(
            MoveVelocity, velocity=velocity, duration_s=duration_s, buffer_mode=buffer_mode, acceleration=acceleration
        )

    async def jog(
        self,
        velocity: float | str,
        *,
        hold_s: float = 0.4,
        renews: str | None = None,
        buffer_mode: BufferMode = BufferMode.REFUSE,
        acceleration: float | str | None = None,
    ) -> Motion:
        """Run at a velocity for as long as the client renews the hold; ends by itself when no renewal arrives.

        Args:
            velocity: Velocity in units a second, positive forward, not 0.
            hold_s: Longest time between two renewals, in seconds by the clock of the daemon; then it ends the jog.
            renews: The command id of the jog that goes on; without it a new one begins. A renewal leaves no event.
            buffer_mode: Effect if the axis moves already.
            acceleration: Acceleration in units a second squared; the axis default when missing.
        """
        return await self._start(
            Jog, velocity=velocity, hold_s=hold_s, renews=renews, buffer_mode=buffer_mode, acceleration=acceleration
        )

    async def halt(self) -> Motion:
        """Decelerate to standstill; another command may follow."""
        return await self._start(Halt)

    async def quick_stop(self) -> CommandReply:
        """Stop without a ramp, holding position, and latch: nothing moves again before reset."""
        return await self._send(QuickStop)

    async def home(
        self,
        *,
        method: HomeMethod | None = None,
        velocity: float | str | None = None,
        find_velocity: float | str | None = None,
        position: float | str | None = None,
        timeout_s: float | None = None,
        distance: float | str | None = None,
        stop: HomeStop | None = None,
        move_to: float | str | None = None,
        acceleration: float | str | None = None,
    ) -> Motion:
        """Find the reference position; missing values come from the axis's configuration.

        Args:
            method: Signal that marks the reference position.
            velocity: Search velocity in units a second, positive forward, not 0. On the index at most 0.75 of an index
                width in a servo cycle: a faster search is refused with the nearest velocity.
            find_velocity: Speed at which a limit switch is found first, in units a second; the axis then moves off it
                and comes back at `velocity` to take the reference over. A missing one, and any other method, searches
                at `velocity` alone.
            position: Value of the reference position, in axis units.
            timeout_s: Longest search, in seconds; moving off a limit switch first counts as a search of its own.
            distance: Longest search, in axis units; a missing one is as far as the velocity goes in that time.
            stop: How the motor stops there.
            move_to: Position to move to afterwards, in axis units; without one the axis stays where the motor stopped.
            acceleration: Acceleration in units a second squared; the axis default when missing.
        """
        return await self._start(
            Home,
            method=method,
            velocity=velocity,
            find_velocity=find_velocity,
            position=position,
            timeout_s=timeout_s,
            distance=distance,
            stop=stop,
            move_to=move_to,
            acceleration=acceleration,
        )

    async def probe(
        self,
        sources: tuple[ProbeSource, ...],
        *,
        position: float | str | None = None,
        distance: float | str | None = None,
        stop: ProbeStop = ProbeStop.SMOOTH,
        velocity: float | str | None = None,
        acceleration: float | str | None = None,
    ) -> Motion:
        """Move until an input changes and latch the position there; it is published on `latch`, the reference stays.

        Args:
            sources: Signals that latch: any change of a limit switch input, an index pulse, the current limit; the
                first counts. On the index the speed is at most 0.75 of an index width in a servo cycle; the slower, the
                surer is the position.
            position: Position at which the move ends at the latest, in axis units; needs a referenced axis.
            distance: How far it goes at most, in axis units, signed.
            stop: How the motor stops there.
            velocity: Speed in units a second; the axis default when missing.
            acceleration: Acceleration in units a second squared; the axis default when missing.
        """
        return await self._start(
            Probe,
            sources=sources,
            position=position,
            distance=distance,
            stop=stop,
            velocity=velocity,
            acceleration=acceleration,
        )

    async def reset(self, *, faults_only: bool = False) -> CommandReply:
        """Clear the stop latch and the drive's faults; after a drive fault the axis is disabled. Nothing moves.

        Args:
            faults_only: Clear faults, and no latch: refused while a stop is latched. Programs that go on by themselves
                send it so.
        """
        return await self._send(Reset, faults_only=faults_only)

    async def set_position(self, position: float | str) -> CommandReply:
        """Set the position of an axis at standstill; afterwards it is referenced.

        Args:
            position: New value of the present position, in axis units.
        """
        return await self._send(SetPosition, position=position)

    async def set_gains(
        self,
        *,
        gain_set: str | None = None,
        kp: int | None = None,
        kd: int | None = None,
        ki: int | None = None,
        il: int | None = None,
        ol: int | None = None,
        cl: int | None = None,
        el: int | None = None,
        deadband: int | None = None,
        sr: int | None = None,
        lent: bool = False,
    ) -> CommandReply:
        """Change the position loop of a drive; register values as in its manual, the missing ones stay as they are.

        Args:
            gain_set: Configured set of gains to load, at standstill, and to change by the values besides it; a motion
                loads the set of its kind if kinds have sets.
            kp: Position gain.
            kd: Velocity gain.
            ki: Integral gain.
            il: Integration limit.
            ol: Output limit.
            cl: Current limit: 0 is off; odd where the sense voltage rises with the current, even where it falls.
            el: Position error limit, in counts; at most 16383, PIC-SERVO SC 32767.
            deadband: Amplifier deadband compensation.
            sr: Servo rate divisor; it changes the unit of velocities in the drive, so only an axis at standstill
                accepts it.
            lent: The gains are for a trial: when control of the axis ends in any way, its loop is opened at rest, and
                the gains of before are loaded again before it closes. It needs a lease.
        """
        return await self._send(
            SetGains,
            gain_set=gain_set,
            kp=kp,
            kd=kd,
            ki=ki,
            il=il,
            ol=ol,
            cl=cl,
            el=el,
            deadband=deadband,
            sr=sr,
            lent=lent,
        )

    async def list_parameters(self) -> ParameterList:
        """List what is known of the drive's parameters; sends nothing to the drive."""
        return await self._send(ListParameters)

    async def read_parameter(self, parameter: str, *, unlisted: bool = False) -> ParameterReply:
        """Read one parameter from both memories.

        Args:
            parameter: Its number, such as Pn100, or the manual's name in any case.
            unlisted: Allow a number that the manual does not list.
        """
        return await self._send(ReadParameter, parameter=parameter, unlisted=unlisted)

    async def read_all_parameters(self) -> ParameterDump:
        """Read every listed parameter from both memories; takes seconds on a slow line."""
        return await self._send(ReadAllParameters)

    async def write_parameter(
        self,
        parameter: str,
        value: int,
        *,
        memory: Memory = Memory.RAM,
        unlisted: bool = False,
        confirm_unit: int | None = None,
    ) -> ParameterReply:
        """Write one parameter, in RAM unless EEPROM is named; nothing is sent when it has the value already.

        Args:
            parameter: Its number, such as Pn100, or the manual's name in any case.
            value: The new value, a word without sign.
            memory: RAM is lost at power-off; EEPROM endures 10,000 writes and must be requested by name.
            unlisted: Allow a number that the manual does not list.
            confirm_unit: The unit number that the drive will have after its next power-on, when this write changes it.
        """
        return await self._send(
            WriteParameter,
            parameter=parameter,
            value=value,
            memory=memory,
            unlisted=unlisted,
            confirm_unit=confirm_unit,
        )

    async def clear_counter(self, counter: CounterName) -> CounterReply:
        """Set a pulse counter to 0; command pulses must be stopped, and for the feedback counter the motor must stand.

        Args:
            counter: Counter to clear.
        """
        return await self._send(ClearCounter, counter=counter)

    async def restart_eeprom_count(self, *, writes: int = 0) -> EepromCount:
        """Restart the count of EEPROM writes, because the drive was replaced; nothing is sent to it.

        Args:
            writes: Writes that the drive which is there now has taken already; 0 for a new one.
        """
        return await self._send(RestartEepromCount, writes=writes)

    async def read_alarms(self) -> AlarmReport:
        """Read the present alarm and the alarm history."""
        return await self._send(ReadAlarms)

    async def read_monitors(self, *, monitors: tuple[MonitorName, ...] = ()) -> MonitorReport:
        """Read monitors once, published or not.

        Args:
            monitors: Monitors to read; none stands for all.
        """
        return await self._send(ReadMonitors, monitors=monitors)

    async def plan_parameters(
        self,
        values: Mapping[str, int],
        *,
        driver_type: int | None = None,
        any_type: bool = False,
        memory: Memory | None = None,
    ) -> ParameterPlan:
        """List the writes after which a drive holds certain values, and what speaks against them; changes nothing.

        Args:
            values: The wanted words, by number such as Pn100. The unit number in Pn000 is not taken from here.
            driver_type: 8800H of the drive that the values come from; with another type, or none, there is a problem.
            any_type: Take values of another or of an unknown type of drive.
            memory: RAM: for trying out, without what takes effect at power-on; EEPROM: permanent; null: permanent and
                in use at once where that is possible.
        """
        return await self._send(
            PlanParameters, values=values, driver_type=driver_type, any_type=any_type, memory=memory
        )

    async def move_analog(
        self,
        target: int,
        *,
        timeout_s: float | None = None,
        distance: float | str | None = None,
        velocity: float | str | None = None,
        acceleration: float | str | None = None,
    ) -> Motion:
        """Move until the analog position sensor reads a value; the drive finds the direction itself.

        Args:
            target: A/D counts, 0 to full scale; the ends of the range mean a broken sensor and are refused.
            timeout_s: Longest motion, in seconds; the axis's `analog.timeout_s` when missing. The daemon ends it, not
                the drive.
            distance: Longest way from where it begins, in axis units, and the way to stop behind it; the axis's
                `analog.distance` when missing, and without that as far as the velocity goes in the time. The daemon
                ends it, not the drive.
            velocity: Speed in units a second; the axis default when missing.
            acceleration: Acceleration in units a second squared; the axis default when missing.
        """
        return await self._start(
            MoveAnalog,
            target=target,
            timeout_s=timeout_s,
            distance=distance,
            velocity=velocity,
            acceleration=acceleration,
        )

    async def set_pwm(self, duty: float, duration_s: float) -> Motion:
        """Put a raw duty on the motor, with the position loop open, for a limited time; then the axis stops and holds.

        Args:
            duty: Share of the supply voltage, positive forward.
            duration_s: Duration, in seconds.
        """
        return await self._start(SetPwm, duty=duty, duration_s=duration_s)

    async def track(self, position: float | str) -> Motion:
        """Go to a position at once, without a profile: one set-point of a stream.

        Args:
            position: Set-point in axis units.
        """
        return await self._start(Track, position=position)

    async def set_outputs(self, *, limit1: PinMode | None = None, limit2: PinMode | None = None) -> CommandReply:
        """Use limit switch pins as outputs, or as inputs again; a missing pin stays as it is.

        Args:
            limit1: The pin of limit switch 1 (reverse).
            limit2: The pin of limit switch 2 (forward).
        """
        return await self._send(SetOutputs, limit1=limit1, limit2=limit2)

    async def abort_trace(self) -> TraceAbortReply:
        """End the trace that is under way, or one that was left armed in the drive; its samples are lost."""
        return await self._send(AbortTrace)

    async def why(self, *, absolute: bool = True, command: Verb | None = None, each_command: bool = False) -> WhyReply:
        """Report why an axis cannot move.

        Args:
            absolute: Whether the motion would name a position, which needs a referenced axis.
            command: Command that is asked about; any motion, with or without a position, when missing.
            each_command: Whether to say of each command of the axis as well what forbids it.
        """
        return await self._ask(Why, absolute=absolute, command=command, each_command=each_command)

    async def preview(
        self,
        *,
        position: float | str | None = None,
        direction: Direction | None = None,
        distance: float | str | None = None,
        velocity: float | str | None = None,
        acceleration: float | str | None = None,
    ) -> PreviewReply:
        """Compute what a motion would do; exactly one of position, distance and velocity alone selects the motion.

        Args:
            position: A move to this position, in axis units.
            direction: Way to turn to a position on an axis with a modulo.
            distance: A move by this distance, in axis units.
            velocity: Speed of the move; alone: a motion at this velocity, signed. Units a second.
            acceleration: Units a second squared; the axis default when missing.
        """
        return await self._ask(
            Preview,
            position=position,
            direction=direction,
            distance=distance,
            velocity=velocity,
            acceleration=acceleration,
        )

    async def report_shadow(
        self, t: int, judged: int, *, learning: bool, figures: tuple[ShadowFigure, ...] = ()
    ) -> ShadowReply:
        """Publish what an observer has found in the motions of an axis, on `tele/<axis>/shadow`; it stops nothing.

        Args:
            t: Instant of the last position that the observer has seen, UTC in ns since 1970.
            learning: It still learns what is usual.
            judged: Motions that have taught or were judged since the observer began.
            figures: Those of which enough is known.
        """
        return await self._ask(ReportShadow, t=t, learning=learning, judged=judged, figures=figures)
