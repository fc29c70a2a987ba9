"""One LDCN or NMC servo drive as a `Drive`: which packets a command takes.

What is known of it is in record.py, what its motions are to it in trajectory.py, its captures are in homing.py and its
gains in access.py.

Positions are counts since the drive was reset, whatever its 32-bit counter says: where a motion would leave the range
of the counter, Reset Position sets it back beforehand, at standstill, and the host adds what it has set back.
Sources: LS-182AP manual, "Initializing procedure", "System status", "Absolute positioning mode"; PIC-SERVO manual, 4.1,
4.5, 5.2.
"""

import asyncio
import contextlib
from collections.abc import Sequence
from dataclasses import asdict, replace
from typing import Any

from typing_extensions import override

from ldcnd.contract.catalogue import verbs_for
from ldcnd.contract.commands import Capability, HomeMethod, PinMode, Verb
from ldcnd.contract.errors import (
    BadReply,
    BusError,
    DriveFault,
    NotSupported,
    OutcomeUnknown,
    PacketRejected,
    Remedy,
    ValueOutOfRange,
    WrongState,
    step,
)
from ldcnd.contract.meta import RegisterInfo
from ldcnd.contract.samples import TelemetryItem
from ldcnd.drives.driver import (
    LARGEST_COUNT,
    NO_CEILING,
    AnalogMotion,
    AxisReading,
    AxisSpec,
    Ceiling,
    CountsMotion,
    Evidence,
    Gains,
    HomeCapture,
    Moves,
    PathStatus,
    PwmOutput,
    StopMode,
    sensed_counts,
)
from ldcnd.drives.ldcn import commands
from ldcnd.drives.ldcn.access import STATE_ITEMS, ServoAccess
from ldcnd.drives.ldcn.commands import Node
from ldcnd.drives.ldcn.controls import LimitPins, StopControl, pin_bits
from ldcnd.drives.ldcn.faults import FaultCode, sensor_lost, servo_on
from ldcnd.drives.ldcn.homing import Homing, home_methods, opens_loop
from ldcnd.drives.ldcn.packet import AuxFlag, StatusFlag, StatusItem, StatusPacket, status_decoder
from ldcnd.drives.ldcn.profiles import Profile
from ldcnd.drives.ldcn.record import DriveState
from ldcnd.drives.ldcn.registers import FAST_PATH, FRACTION, LIMIT_PINS, TRAJECTORY_CONTROL, ServoRegisters
from ldcnd.drives.ldcn.trajectory import (
    MOST_POINTS_PER_PACKET,
    PathPoint,
    ProfileMode,
    Trajectory,
    TrajectoryControl,
    acceleration_counts_per_s2,
    most_step,
    quantised,
    quantised_output,
    trajectory_of,
    trajectory_values,
)
from ldcnd.line.bus import Bus
from ldcnd.line.exchange import Exchange, Lane
from ldcnd.log import get_logger

LEAST_SET_BACK = 1000
"""A counter so near to 0 is not set back: whether Reset Position was executed must show in it."""
log = get_logger("ldcn")


def _shifted(motion: CountsMotion, offset_counts: int) -> CountsMotion:
    """Return a motion in terms of a position counter that lacks so many counts."""
    if motion.target_counts is None or not offset_counts:
        return motion
    return replace(motion, target_counts=motion.target_counts - offset_counts)


REACHED_COUNTS = 16
"""So close to its target a finished profile counts as having run."""
PATH_CYCLES = 64
"""Servo cycles of a path point: the longer period, which leaves most of the line to others."""
PATH_MOST_COUNTS = most_step(PATH_CYCLES)
PATH_ITEMS = StatusItem.POSITION | StatusItem.POSITION_ERROR | StatusItem.AUX | StatusItem.BIT7
EVIDENCE_ITEMS = STATE_ITEMS | StatusItem.HOME

_AMP_ENABLE, _MOTOR_OFF = map(int, (StopControl.AMP_ENABLE, StopControl.MOTOR_OFF))
"""As numbers, because arithmetic with flags costs ten times as much."""
STOP_CONTROLS = {
    StopMode.SMOOTH: StopControl.AMP_ENABLE | StopControl.SMOOTH,
    StopMode.ABRUPT: StopControl.AMP_ENABLE | StopControl.ABRUPT,
    StopMode.OFF: StopControl.MOTOR_OFF,
}


def reading_items(profile: Profile, items: frozenset[TelemetryItem]) -> StatusItem:
    """Return the status items that a drive must send for these telemetry items."""
    # the auxiliary byte alone tells whether the loop is closed: the position error bit is set for other reasons, too
    mask = STATE_ITEMS
    if TelemetryItem.ADC in items:
        mask |= StatusItem.ADC
    if TelemetryItem.POSITION in items and profile.position_error_bytes:
        mask |= StatusItem.POSITION_ERROR
    return mask


class LdcnAxis(Moves):
    """A drive at one address, in the dialect of its profile."""

    shows_inputs = True
    keeps_mark = True

    def __init__(self, spec: AxisSpec, profile: Profile, bus: Bus) -> None:
        self.spec = spec
        self.profile = profile
        self.identity: str | None = None
        self.capabilities = _capabilities(profile)
        self.adc_full_scale = (1 << profile.adc_bits) - 1
        self.home_methods = home_methods(profile)
        self.retargets = profile.sc_extensions
        self._book = ServoRegisters(profile, spec.gains, lambda: asyncio.get_running_loop().time())
        self.state = DriveState(spec.name, profile, self._book, limit_stop=spec.limit_stop)
        self._bus = bus
        self._node = Node(spec.address, profile)
        self._of = ServoAccess(spec, profile, bus, self._node, self._book, self.state)
        self._homing = Homing(self._of)
        self._initialised = False
        self.path_period_s = PATH_CYCLES * profile.servo_cycle_s
        self.path_packet = MOST_POINTS_PER_PACKET
        self.path_most_counts = PATH_MOST_COUNTS
        self._switching_off = 0
        self.restarts = 0  # how often the drive was seen to have been reset or to have lost power
        self._readings: dict[tuple[frozenset[TelemetryItem], bool], Exchange[AxisReading]] = {}
        self._stops: dict[int, Exchange[StatusPacket]] = {}

    def may_have_restarted(self) -> None:
        """Note that a reset is about to be sent, which the drive may obey or not."""
        self.state.may_have_restarted()
        self._book.forget("a reset was sent, and whether the module was reset is not known")
        self._initialised = False

    def unseen(self) -> None:
        """Note that another host may have had the drive, or its power may have failed: nothing proves its registers."""
        self.state.unseen()
        self._book.taken_over(known=True)

    def forget(self) -> None:
        """Note that the drive was reset or lost power: nothing that was sent before holds any more."""
        self.state.restarted()
        self._book.reset()
        self._initialised = False
        self.restarts += 1

    def adopted(self, status: StatusPacket, *, known: bool) -> None:
        """The drive was taken over as it is, with this status; its gains are assumed to be the configured ones.

        Args:
            status: flags and auxiliary byte.
            known: this host had the line before, so its counts go on; who has had the drive since is not known.
        """
        if known:
            self.unseen()
        else:
            self.state.taken_over(status)
            self._book.taken_over()
        # a closed loop proves that another host has done what the manual wants after a reset
        self._initialised = status.aux is not None and bool(status.aux & AuxFlag.SERVO_ON)

    @property
    def capture_s(self) -> float:  # type: ignore[override]
        """One servo cycle (LS-182AP manual, "Encoder Input")."""
        return self.profile.servo_cycle_s * (self._book.next_divisor or 1)

    @property
    def deceleration_counts_per_s2(self) -> float | None:  # type: ignore[override]
        """See `Moves`. It is that of the last profile (PIC-SERVO manual, 5.2, "Stop Motor"); the lowest of several."""
        rates, divisor = self._book.rates, self._book.divisor
        if not rates or divisor is None:
            return None
        return acceleration_counts_per_s2(min(rates), divisor, self.profile)

    def started(self) -> None:
        """Note that the drive has started what was loaded."""
        self._book.started()

    @property
    def wanted_gains(self) -> Gains | None:
        """See `Moves`."""
        return self._book.wanted_gains

    @wanted_gains.setter
    def wanted_gains(self, gains: Gains | None) -> None:
        self._book.wanted_gains = gains

    @property
    def holds_gains(self) -> bool:  # type: ignore[override]
        """See `Moves`."""
        return self._book.loaded

    @override
    def registers(self) -> tuple[RegisterInfo, ...]:
        return self._book.published()

    # -- reading -----------------------------------------------------------------------------------------------------

    def reading(self, items: frozenset[TelemetryItem]) -> Exchange[AxisReading]:
        """See `Readable`. The loss of the analog sensor shows only in its value."""
        # not known counts as yes: only a value shows that the sensor is lost
        senses = self.profile.analog_target and self.state.known.absolute is not False
        prepared = self._readings.get((items, senses))
        if prepared is None:
            mask = reading_items(self.profile, items)
            if senses:
                mask |= StatusItem.ADC
            prepared = self._readings[items, senses] = self._prepare_reading(mask, items)
        return prepared

    def _prepare_reading(self, mask: StatusItem, items: frozenset[TelemetryItem]) -> Exchange[AxisReading]:
        exchange = commands.read_status(self._node, mask)
        status_of = status_decoder(self.profile, mask)

        def decode(data: bytes) -> AxisReading:
            return self.state.reading(status_of(data), items)

        return Exchange(
            node=exchange.node,
            request=exchange.request,
            reply_bytes=exchange.reply_bytes,
            check=exchange.check,
            decode=decode,
            response_s=exchange.response_s,
            repeatable=exchange.repeatable,
            effect=exchange.effect,
        )

    # -- power -------------------------------------------------------------------------------------------------------

    @override
    def exchanges(
        self, legs: Sequence[CountsMotion], here: AxisReading, gains: Gains | None
    ) -> tuple[Exchange[Any], ...]:
        found: list[Exchange[Any]] = [commands.set_gain(self._node, gains)] if gains else []
        offset, armed, locked = self.state.offset_counts, self.state.homing_armed, self.state.motion_locked
        for motion in legs:
            target = motion.target_counts
            # the goal "should not differ from the current position by more" than 0x7FFFFFFF (PIC-SERVO manual, 5.2)
            if target is not None and abs(target - offset) > LARGEST_COUNT:
                found.append(commands.reset_position(self._node))
                offset = here.position_counts
            divisor = motion.servo_divisor or self._of.next_divisor()
            trajectory = trajectory_of(_shifted(motion, offset), divisor, self.profile)
            if locked:
                found.append(self._unlocking())
            guard, _ = self._homing.guard(motion, here)
            if guard or armed:
                found.append(commands.set_homing(self._node, guard))
            found += (commands.load_trajectory(self._node, trajectory), commands.start_motion(self._node))
            armed, locked = bool(guard), False
            place = here.position_counts if target is None else target
            # at its end it stands, and no switch is known yet
            here = replace(
                here, position_counts=place, velocity_counts_per_s=0.0, reverse_limit=None, forward_limit=None
            )
        return tuple(found)

    @override
    def holds(self, gains: Gains) -> bool:
        return self._book.holds(asdict(gains))

    def _unlocking(self) -> Exchange[StatusPacket]:
        # LS-182AP from version 22 on locks motion when a capture on a limit switch has stopped it
        return commands.stop_motor(self._node, StopControl.AMP_ENABLE | StopControl.LOCK_DISABLE)

    async def power(self, *, on: bool) -> None:
        """See `Moves`. Closing the loop is verified; it takes effect at the present position.

        Raises:
            DriveFault: the drive did not close its loop, or holds a fault that only a reset clears.
        """
        if not on:
            await self.stop(StopMode.OFF)
            return
        # it may have been reset unseen, and then "all gain parameters and limit values are set to zero"
        if self._book.wanted_gains and not (self.state.known.closed and self._book.loaded):
            await self.set_gains(self._book.wanted_gains)
        if self.profile.pic_ae_diagnostics and self.state.known.pic_ae is not False:
            await self._check_without_power_driver()
        # "the Stop Motor command must be issued initially to set amp_en before other motion commands" (PIC-SERVO
        # manual, 5.2)
        if self.profile.pic_ae_diagnostics and not self._initialised:
            await self._initialise_registers()
        self._initialised = True
        await self._switch(commands.close_loop(self._node), Lane.COMMAND, pic_ae=True, closed=True)
        # pos_error is set while the loop is open, and sticky
        await self._clear_sticky_bits()
        status = await self._of.read(StatusItem.AUX)
        faults = self.state.faults(status)
        if status.aux is None or not status.aux & AuxFlag.SERVO_ON:
            causes = "; ".join(fault.text for fault in faults) or "it does not say why"
            raise DriveFault(
                f"axis {self.spec.name}: the drive did not close its loop: {causes}",
                axis=self.spec.name,
                remedy=Remedy("remove the cause, then {}", step("reset")),
            )

    async def _check_without_power_driver(self) -> None:
        """Switch the power driver off first where it may be on, so that the drive says what is wrong at present."""
        status = await self._of.read(StatusItem.AUX)
        if status.aux is not None and status.aux & AuxFlag.SERVO_ON:
            return
        await self.stop(StopMode.OFF)
        await self._refuse_faults("not switched on, the drive reports")

    async def _refuse_faults(self, refusal: str, again: str = "") -> None:
        """Read the drive.

        Raises:
            DriveFault: it has a fault that keeps the motor off.
        """
        status = await self._of.read(STATE_ITEMS)
        standing = [fault for fault in self.state.faults(status) if fault.stops]
        if standing:
            raise DriveFault(
                f"axis {self.spec.name}: {refusal} {'; '.join(fault.text for fault in standing)}",
                axis=self.spec.name,
                value=standing[0].code,
                remedy=Remedy(f"remove the cause, then {{}}{again}", step("reset")),
            )

    async def _stop_motor(self, control: StopControl) -> None:
        """Stop, before anything else that waits."""
        bits = int(control)
        exchange = self._stops.get(bits)
        if exchange is None:  # made once: a stop, and a command that stops first, wait for it
            exchange = self._stops[bits] = commands.stop_motor(self._node, control)
        await self._switch(exchange, Lane.STOP, pic_ae=bool(bits & _AMP_ENABLE), closed=not bits & _MOTOR_OFF)

    async def _switch(self, exchange: Exchange[StatusPacket], lane: Lane, *, pic_ae: bool, closed: bool) -> None:
        """Send Stop Motor, and take note of what became of power driver and loop."""
        try:
            await self._bus.execute(exchange, lane)
        # cancelled or lost: it may have been executed, so nothing is believed of loop and power driver
        except BaseException:
            self.state.switched_unconfirmed(pic_ae=pic_ae, closed=closed)
            raise
        self.state.switched(pic_ae=pic_ae, closed=closed)

    async def _clear_sticky_bits(self) -> None:
        self.state.clearing()
        await self._bus.execute(commands.clear_sticky_bits(self._node))
        self.state.cleared()

    async def _initialise_registers(self) -> None:
        """Do what the LS-182AP manual requires once after a reset: amplifier off, no distance to go."""
        status = await self._of.read(StatusItem.POSITION | StatusItem.AUX)
        if status.aux is None or status.aux & AuxFlag.SERVO_ON:
            return  # taken over with its loop closed: initialised long ago
        trajectory = Trajectory(
            position=status.position,
            velocity=0,
            acceleration=1,
            pwm_or_target=0,
            servo=True,
            mode=ProfileMode.TRAPEZOIDAL,
            reverse=False,
            start_now=True,
        )
        await self._load(trajectory)

    @property
    def switched_off(self) -> bool:
        """Whether its motor was switched off, by a packet that may be on its way or at a limit switch.

        Also where it is not known whether it was switched on since, as when that was refused, or its reply was lost.
        """
        return self._told_off or self.state.let_go

    @property
    def _told_off(self) -> bool:
        return self._switching_off > 0 or self.state.known.pic_ae is False or self.state.off_before

    async def stop(self, mode: StopMode) -> StopMode:
        """See `Moves`."""
        mode = await self._bring_to_rest(mode)
        await self._homing.disarm()
        return mode

    async def _bring_to_rest(self, mode: StopMode) -> StopMode:
        """Stop; return how. Some firmware clears the velocity register, so it counts as unknown afterwards."""
        # a stop that holds would close the loop of a motor that was switched off
        if self.switched_off:
            mode = StopMode.OFF
        # "the goal velocity will be set to 0" (manuals, "Stop Motor"): in some firmware that is the register
        self._book.forget("some firmware clears it with a stop", ("velocity",))
        off = mode is StopMode.OFF
        shows_nothing = self.state.loop_may_open and not self._told_off
        # counted before it is sent: a stop that holds, queued meanwhile, would close the loop behind it
        self._switching_off += off
        if off:
            for bits, holding in self._stops.items():
                if not bits & _MOTOR_OFF:  # nor may one of before that is not answered be sent again behind it
                    self._bus.outrank(holding)
        try:
            await self._stop_motor(STOP_CONTROLS[mode])
            # with its loop open no reading tells whether it has heard it: see `Exchange.unseen`
            if shows_nothing and (off or not self.switched_off):
                await self._stop_motor(STOP_CONTROLS[mode])
        except BusError:
            if off or not self.switched_off:
                raise
            return await self._bring_to_rest(StopMode.OFF)  # what has outranked it is what has to arrive
        finally:
            self._switching_off -= off
        return mode

    async def reset(self) -> None:
        """See `Moves`: power driver off, sticky bits cleared (LS-182AP manual, "To restore the normal operation").

        Raises:
            DriveFault: the cause still stands.
        """
        await self.stop(StopMode.OFF)
        await self._clear_sticky_bits()
        await self._refuse_faults("still", " again")

    async def clear_warnings(self) -> None:
        """See `Moves`: Clear Sticky Bits, nothing else."""
        await self._clear_sticky_bits()

    # -- motion ------------------------------------------------------------------------------------------------------

    @override
    def quantise(self, motion: CountsMotion, most: Ceiling = NO_CEILING, *, in_motion: bool = False) -> CountsMotion:
        return quantised(motion, self._of.next_divisor(in_motion=in_motion), self.profile, most)

    @override
    def quantise_output(self, output: PwmOutput, most: Ceiling = NO_CEILING) -> PwmOutput:
        return quantised_output(output, self._of.next_divisor(), self.profile, most)

    async def load(
        self,
        motion: CountsMotion | AnalogMotion | PwmOutput,
        *,
        home: HomeCapture | None = None,
        stands_when_done: bool = True,
    ) -> None:
        """See `Moves`. A motion lock, set by homing on a limit switch, is lifted: the command is to move on.

        Raises:
            NotSupported: an analog target on a drive without absolute positioning.
            WrongState: the limit switch pin that would be homed on is an output; or the target is beyond the counter,
                and the axis does not stand; or see `ServoAccess.check_planned`.
            DriveFault: the analog sensor is out of its range.
            RegisterUnknown: see `ServoAccess.ensure_gains`.
        """
        divisor = await self._of.ensure_gains(stands_when_done=stands_when_done)
        self._of.check_planned(motion.servo_divisor, divisor)
        if isinstance(motion, CountsMotion):
            target = motion.target_counts
            if target is not None and abs(target - self.state.offset_counts) > LARGEST_COUNT:
                await self._set_counter_back(target)
            in_counter: CountsMotion | AnalogMotion | PwmOutput = _shifted(motion, self.state.offset_counts)
        else:
            in_counter = motion
        trajectory = trajectory_of(in_counter, divisor, self.profile)
        if isinstance(motion, AnalogMotion):
            await self._check_sensor()
        if isinstance(motion, PwmOutput) and not self.state.loop_may_open:
            await self._put_acceleration_in_force(trajectory)
        if self.state.motion_locked:
            await self._bus.execute(self._unlocking())
        await self._homing.arm(motion, home)
        await self._load(trajectory)
        self.state.loaded(
            absolute=isinstance(motion, AnalogMotion),
            runs_open=isinstance(motion, PwmOutput),
            opens_at_home=home is not None and opens_loop(self.profile, home),
        )

    async def _set_counter_back(self, target_counts: int) -> None:
        """Set the position counter to 0 by Reset Position, which is forbidden during a trapezoidal move (manuals).

        The host adds what the counter has lost. It takes that from the status before, so each time can cost the counts
        by which the loop hunts at rest. A lost reply is no harm: the next position tells whether it was executed.

        Raises:
            ValueOutOfRange: the target is farther away than the counter reaches.
            WrongState: the axis does not stand, or the counter is at 0 already.
            OutcomeUnknown: the counter is as it was.
        """
        status = await self._of.read(STATE_ITEMS)
        before = status.position or 0
        if not status.flags & StatusFlag.MOVE_DONE or status.velocity:
            raise WrongState(
                f"axis {self.spec.name}: the target is beyond the drive's 32-bit counter",
                axis=self.spec.name,
                remedy=Remedy("{} first: at standstill the counter is set back", step("halt")),
            )
        away = abs(target_counts - self.state.offset_counts - before)
        if away > LARGEST_COUNT:
            raise ValueOutOfRange(
                f"axis {self.spec.name}: {away} counts do not fit the drive's 32-bit counter",
                axis=self.spec.name,
                value=away,
                limit=LARGEST_COUNT,
                nearest=LARGEST_COUNT,
            )
        if abs(before) < LEAST_SET_BACK:
            raise WrongState(
                f"axis {self.spec.name}: a motion of more than {LARGEST_COUNT} counts does not fit the drive's counter",
                axis=self.spec.name,
                remedy="move in two parts",
            )
        await self.about_to_renumber()
        self.state.setting_back, self.state.set_back = before, False
        counted = self.state.offset_counts
        self._book.forget("the position counter was set back", ("position",))
        try:
            with contextlib.suppress(OutcomeUnknown):
                await self._bus.execute(commands.reset_position(self._node))
        finally:
            self.state.set_back = True
        self.state.reading(await self._of.read(STATE_ITEMS))
        # `reading` has not seen it begin anew
        if self.state.offset_counts == counted:
            raise OutcomeUnknown(
                f"axis {self.spec.name}: the drive did not set its position counter back",
                axis=self.spec.name,
                remedy="send the motion again",
            )
        log.info("position counter set back", axis=self.spec.name, counts=before)

    @override
    def room_counts(self, *, forward: bool) -> int:
        counter = self.state.counts - self.state.offset_counts
        return LARGEST_COUNT + (-counter if forward else counter)

    @override
    def stands_on(self, limit: HomeMethod, reading: AxisReading) -> bool:
        return self._homing.stands_on(limit, reading)

    async def _load(self, trajectory: Trajectory) -> None:
        exchange = commands.load_trajectory(self._node, trajectory)
        self._book.loads()
        with self._book.writing(trajectory_values(trajectory)) as sent:
            await self._bus.execute(exchange, sent=sent)
        if trajectory.start_now:
            self.started()

    async def _put_acceleration_in_force(self, trajectory: Trajectory) -> None:
        """Start a profile from standstill to standstill before a raw duty.

        The manuals let a smooth stop use "the current acceleration rate" and do not say whether loading makes a rate
        current or only a start does; after a reset the difference is a motor that is never slowed down.
        """
        standing = Trajectory(velocity=0, acceleration=trajectory.acceleration, mode=ProfileMode.VELOCITY)
        await self._load(standing)
        await self._bus.execute(commands.start_motion(self._node))
        self.started()

    async def _check_sensor(self) -> None:
        """Refuse an analog motion while the sensor reads like a broken one (manual, "Analog positioning sensor")."""
        status = await self._of.read(StatusItem.ADC)
        if sensor_lost(self.profile, status.adc):
            raise DriveFault(
                f"axis {self.spec.name}: the analog sensor reads {status.adc}: {FaultCode.SENSOR_FAULT.remedy}",
                axis=self.spec.name,
                value=FaultCode.SENSOR_FAULT.value,
                remedy="check the sensor's cable",
            )

    async def start(self) -> None:
        """See `Moves`.

        A drive clears move_done as it starts. An acknowledgement that shows it set is looked into, because a reply to
        something older that came late looks just like that.

        Raises:
            OutcomeUnknown: acknowledged, but nothing shows that it has started; or it has met its limit switch before,
                and is not known to have stopped.
            PacketRejected: the drive received it damaged, and nothing shows that it has started; it is not sent again.
        """
        ran = self.state.runs
        try:
            # sent twice, it could begin a motion again that has ended or was stopped meanwhile
            flags = (await self._bus.execute(commands.start_motion(self._node), once=True)).flags
        except PacketRejected:
            seen = await self._has_started(ran=ran)
            if seen is None:
                raise self._start_unknown("the start was damaged on its way, or its reply was") from None
            if not seen:
                raise
            flags = StatusFlag(0)  # it was the reply that was damaged
            self.started()
        if await self._was_stopped(flags):
            return
        if flags & StatusFlag.MOVE_DONE and await self._has_started(ran=ran) is False:
            raise self._start_unknown("the start was acknowledged, but the drive shows no sign of it")
        self.started()

    def _start_unknown(self, why: str) -> OutcomeUnknown:
        return OutcomeUnknown(
            f"axis {self.spec.name}: {why}",
            axis=self.spec.name,
            remedy="read the axis state before anything else",
        )

    async def _was_stopped(self, started: StatusFlag) -> bool:
        """Stop a motion that was started behind its limit switch; tell whether it was. Its readings say so, too."""
        try:
            if not await self._homing.was_met(started):
                return False
            await self._bring_to_rest(StopMode.SMOOTH)
        except BusError as error:
            raise self._start_unknown(f"it was started, perhaps behind its limit switch: {error.message}") from error
        return True

    async def _has_started(self, *, ran: bool) -> bool | None:
        """Look for a witness that what was loaded runs or is over; None where the drive shows nothing of it.

        Args:
            ran: it was on its way before: that it is now tells nothing.
        """
        absolute, items = self.state.known.absolute, STATE_ITEMS
        if absolute:
            items |= StatusItem.ADC
        if self.profile.position_error_bytes:
            items |= StatusItem.POSITION_ERROR
        status = await self._of.read(items)
        control, velocity = self._book.known(TRAJECTORY_CONTROL), self._book.known("velocity")
        if control is None:
            return None
        if not control & TrajectoryControl.SERVO:
            # an open loop says nothing more: it may be that of the duty before
            return False if servo_on(status) else None
        # "clear when in the middle of a trapezoidal profile move" (PIC-SERVO manual, 5.3): this drive runs
        if not status.flags & StatusFlag.MOVE_DONE:
            return None if ran else True
        # it is clear until the sensor has reached its target (LS-182AP manual, "Absolute positioning mode")
        if absolute:
            target, value = self._book.known("pwm_or_target"), status.adc
            within = sensed_counts(self.adc_full_scale or 0)
            return target is not None and value is not None and abs(value - target) <= within
        target = None if control & TrajectoryControl.VELOCITY_MODE else self._book.known("position")
        if target is not None and status.position is not None:
            # a shaft may stand beside its commanded place, held by a load
            return abs(status.position + (status.position_error or 0) - target) <= REACHED_COUNTS
        if velocity is not None and velocity < FRACTION:  # shows in no status
            return None
        return (None if ran else True) if status.velocity else False

    async def track(self, position_counts: int, *, stands_when_done: bool = True) -> None:
        """See `Moves`: "stop here", the manuals' way to follow a string of positions.

        Raises:
            NotSupported: PIC-SERVO version 1.
            ValueOutOfRange: beyond the drive's 32-bit counter.
            OutcomeUnknown: the reply was lost.
        """
        await self._of.ensure_gains(stands_when_done=stands_when_done)
        control = StopControl.AMP_ENABLE | StopControl.HERE
        counter = position_counts - self.state.offset_counts
        # "if the stopping position is too far from the current position, a position error will be generated" (ibid.,
        # 5.2)
        if abs(counter) > LARGEST_COUNT:
            raise ValueOutOfRange(
                f"axis {self.spec.name}: set-point {position_counts} is beyond the drive's 32-bit counter",
                axis=self.spec.name,
                value=position_counts,
                limit=LARGEST_COUNT,
                remedy=Remedy("{}, a small distance: it sets the counter back", step("move_relative")),
            )
        exchange = commands.stop_motor(self._node, control, counter)
        # what was armed for the motion before would stop this one, and what that has met would be its failure
        await self._homing.disarm(Lane.COMMAND)
        self.state.loaded(absolute=False, runs_open=False, opens_at_home=False)
        # harmless to repeat by itself, but a repetition could come after the stop that has overtaken it
        told = replace(exchange, repeatable=False)
        await self._bus.execute(told)
        # a late reply can stand for its own (`Exchange.unseen`): had it been lost, the next step would be twice as far
        await self._bus.execute(told)

    # -- path mode ---------------------------------------------------------------------------------------------------

    @override
    def check_path(self) -> None:
        if not (self.profile.path_points and self.profile.sc_extensions):
            raise NotSupported(
                f"axis {self.spec.name}: {self.profile.title} has no path mode", axis=self.spec.name, value="path"
            )
        if self._book.known(FAST_PATH) != 0:  # a fast path, left by another host, would run at twice the speed
            raise self._of.unknown(FAST_PATH, 'restart the daemon with start = "reset"')

    @override
    def path_exchanges(self) -> tuple[Exchange[Any], ...]:
        points = [PathPoint(0, PATH_CYCLES)] * MOST_POINTS_PER_PACKET
        return commands.add_path_points(self._node, points), commands.read_status(self._node, PATH_ITEMS)

    @override
    async def path_status(self) -> PathStatus:
        status, timing = await self._bus.execute_timed(commands.read_status(self._node, PATH_ITEMS))
        position, error, aux, points = status.position, status.position_error, status.aux, status.bit7
        if position is None or error is None or aux is None or points is None:
            raise BadReply(f"axis {self.spec.name}: the status packet lacks what shows a path")
        return PathStatus(
            commanded_counts=position + error + self.state.offset_counts,
            points=points,
            running=bool(aux & AuxFlag.PATH_MODE),
            enabled=bool(aux & AuxFlag.SERVO_ON),
            timing=timing,
        )

    @override
    async def add_points(self, steps: Sequence[int]) -> PathStatus:
        """See `Moves`. A reply that is lost leaves open whether they were taken: they are never sent again.

        Raises:
            OutcomeUnknown: the reply was lost.
        """
        points = [PathPoint(counts, PATH_CYCLES) for counts in steps]
        self.state.loaded(absolute=False, runs_open=False, opens_at_home=False)
        await self._bus.execute(commands.add_path_points(self._node, points))
        return await self.path_status()

    @override
    async def captured_home(self) -> int:
        return await self._homing.captured()

    # -- what proves that its counter goes on ------------------------------------------------------------------------

    @override
    async def evidence(self) -> Evidence:
        """See `Moves`: the mark is in the home register."""
        status = await self._bus.execute(commands.read_status(self._node, EVIDENCE_ITEMS), Lane.BACKGROUND)
        if status.home is None or status.position is None:
            raise BadReply(f"axis {self.spec.name}: the status packet lacks position or home")
        reading = self.state.reading(status)
        return Evidence(
            counts=reading.position_counts,
            counter=status.position,
            mark=status.home,
            enabled=reading.enabled,
            position_lost=any(fault.loses_position for fault in reading.faults),
        )

    @override
    async def leave_mark(self) -> None:
        await self._bus.execute(commands.save_home(self._node), Lane.BACKGROUND)

    # -- registers ---------------------------------------------------------------------------------------------------

    @override
    async def set_gains(self, gains: Gains, *, stands_when_done: bool = True) -> None:
        await self._of.load_gains(gains, stands_when_done=stands_when_done)

    async def set_outputs(self, limit1: PinMode | None, limit2: PinMode | None) -> None:
        """See `Moves`; PIC-SERVO version 4 only."""
        if not self.profile.limit_outputs:
            raise NotSupported(f"{self.profile.title} has no limit pins that can be outputs", axis=self.spec.name)
        # "sets the output values" of both pins in one byte (PIC-SERVO manual, 5.2): one cannot be left out
        values = {FAST_PATH: 0}  # of PIC-SERVO CMC, in the same byte
        for (name, bits), mode in zip(LIMIT_PINS.items(), (limit1, limit2), strict=True):
            value = self._book.known(name) if mode is None else pin_bits(mode, *bits)
            if value is None:
                raise self._of.unknown(
                    name, Remedy("{}", step("set_outputs", "send set_outputs with both limit1 and limit2"))
                )
            values[name] = int(value)
        exchange = commands.io_control(self._node, LimitPins(sum(values.values())))
        with self._book.writing(values) as sent:
            await self._bus.execute(exchange, sent=sent)


def _capabilities(profile: Profile) -> frozenset[Verb]:
    """Return what a device of this profile can do."""
    lacking = {
        Verb.MOVE_ANALOG: not profile.analog_target,
        Verb.TRACK: not profile.stop_here,
        Verb.SET_OUTPUTS: not profile.limit_outputs,
    }
    able = frozenset(capability for capability in Verb if not lacking.get(capability, False))
    return able - verbs_for(Capability.PARAMETERS)
