"""The host's record of one drive: what was sent to it, and what it has shown; its registers are in registers.py.

A drive cannot be asked whether its power driver is enabled or what has switched it off: the host remembers what it has
sent and what was acknowledged.
Sources: LS-182AP manual, "Power-up and Reset Conditions", "Set Gain", "Load Trajectory"; PIC-SERVO manual, 4.3 to 4.5.
"""

from dataclasses import dataclass, replace

from ldcnd.contract.commands import HomeMethod
from ldcnd.contract.errors import BadReply
from ldcnd.contract.samples import TelemetryItem
from ldcnd.drives import driver
from ldcnd.drives.driver import AxisReading
from ldcnd.drives.ldcn.faults import AFTER_RESET, FaultCode, Knowledge, LdcnFault, diagnose, servo_on
from ldcnd.drives.ldcn.packet import AuxFlag, StatusFlag, StatusPacket
from ldcnd.drives.ldcn.profiles import Profile
from ldcnd.drives.ldcn.registers import ServoRegisters

BEGUN_COUNTS = 16
"""A counter that was reset reads 0, and a shaft that its loop has let go settles near it."""
OPENED_AND_CLOSED = LdcnFault(FaultCode.LATCHED_FAULT, latched=True)
"""It has switched its motor off, and a stop that holds, sent before that was seen, has closed its loop again."""
FOREIGN_CAPTURE = "a capture is armed that this daemon has not armed"
FOREIGN_POWER = "its motor was off when it was seen last, and others have closed its loop since"
_MOVE_DONE, _POWER_ON, _LIMIT1, _LIMIT2, _HOMING = map(
    int,
    (
        StatusFlag.MOVE_DONE,
        StatusFlag.POWER_ON,
        StatusFlag.LIMIT1,
        StatusFlag.LIMIT2,
        StatusFlag.HOME_IN_PROGRESS,
    ),
)
_SERVO_ON, _MOTION_LOCKED, _INDEX = map(int, (AuxFlag.SERVO_ON, AuxFlag.MOTION_LOCKED, AuxFlag.INDEX))
"""As numbers: arithmetic with flags costs ten times as much, and every reply needs it."""


Levels = tuple[bool, bool, bool, bool, bool | None, bool | None, bool | None, bool | None, bool | None]
"""Armed for homing, motion locked, servo on, profile done, reverse limit, forward limit, index, stop input, Pic_ae."""


@dataclass(frozen=True, slots=True)
class _Shown:
    """What the flags of a status packet say: worked out again only when they, or what is known, have changed."""

    faults: tuple[driver.Fault, ...]
    levels: Levels


NOTHING_SHOWN = _Shown((), (False, False, False, False, None, None, None, None, None))


class DriveState:
    """The record of one drive: what was sent to it, and what it has shown.

    Attributes:
        known: what decides on the meaning of its status.
        homing_armed: a capture was armed and has not been seen to come.
        arming: packets that arm a capture are on their way: what a reading shows of it may be of before.
        awaited: this host has armed a capture, has sent nothing since that disarms it, and has had the drive in sight:
            a flag that goes down tells that the capture has come.
        off_before: the motor was switched off, and nothing shows that what was to close its loop since has done so.
        loop_may_open: the loop is open on purpose (PWM mode), or will be once home is captured: then the position
            error flag, which every open loop shows, is no fault.
        watched_closed: the loop was seen closed with the position error flag clear, and this host has not opened it
            since: a flag that is set then tells that the drive has, even if a stop has closed it again meanwhile.
        runs_open: it is open from the start of the motion, also while a capture is armed that stops it at a switch.
        runs: it was on its way when it was read last.
        motion_locked: the drive refuses motion since it homed on a limit switch.
        guard: the limit switches at which the drive stops the present motion by itself; none without one.
        guard_hit: it has met one of them: it stops there, or has met it before, and then nothing but the host stops it.
        off_unseen: it was off before nobody here could see it for a while: a closed loop is the doing of others then.
        offset_counts: what the position counter lacks of the counts since the reset of the drive: Reset Position has
            set it back by this amount.
        setting_back: where the counter stood when Reset Position was sent to it last, until a reading shows the effect.
        set_back: that packet is over, whatever came of it: the next reading shows whether it had an effect.
        counts: the latest position, in counts since the reset of the drive.
    """

    def __init__(
        self, name: str, profile: Profile, registers: ServoRegisters, *, limit_stop: bool | None = None
    ) -> None:
        self._name = name
        self._limit_stop = limit_stop
        self._profile = profile
        self._registers = registers
        self._question: object = ()  # what flags and faults were worked out from last
        self.runs = False
        self._shown: _Shown = NOTHING_SHOWN
        self.restarted()
        # nothing is known of a drive that this host has not met: it may hold a load, and a stop must not let go of it
        self.known = Knowledge()

    # -- what was commanded ------------------------------------------------------------------------------------------

    @property
    def let_go(self) -> bool:
        """Whether a raw duty has met its limit switch, where its drive switches the motor off: its loop stays open."""
        return self.guard_hit and self.runs_open

    def restarted(self) -> None:
        """The drive was reset or lost power: nothing that was sent before holds any more."""
        self.known = AFTER_RESET
        self.homing_armed = self.arming = self.awaited = self.off_before = self.off_unseen = False
        self.loop_may_open = self.runs_open = self.watched_closed = False
        self.motion_locked = False
        self.guard: tuple[HomeMethod, ...] = ()
        self.guard_hit = False
        self.offset_counts = self.setting_back = self.counts = 0
        self.set_back = False

    def taken_over(self, status: StatusPacket) -> None:
        """The drive is adopted as it is, and this host has never known it; the status packet has the auxiliary byte."""
        self.restarted()
        self.known = Knowledge(closed=servo_on(status))
        self.homing_armed = bool(status.flags & StatusFlag.HOME_IN_PROGRESS)

    def unseen(self) -> None:
        """The drive was out of reach for a while; nothing was sent to it meanwhile, by this host at least.

        A motor that was off counts as off until a reading shows a closed loop: a stop that holds would close it.
        """
        self.off_unseen = self.off_unseen or self.off_before or self.known.pic_ae is False
        self.off_before = self.off_unseen
        self.known = replace(self.known, pic_ae=None, nothing_latched=False, seen=False)
        self.watched_closed = self.awaited = False

    def may_have_restarted(self) -> None:
        """A reset is sent: whether the drive was reset, only a reading shows, by a closed loop or an open one."""
        self.off_before = True
        self.known = Knowledge(seen=False)
        self.watched_closed = False

    def switched_unconfirmed(self, *, pic_ae: bool, closed: bool) -> None:
        """A Stop Motor was sent, or may have been, that was not acknowledged; with `closed` one that opens no loop.

        What it would leave as it is known to be stays known: a motor that was off is off, whether it arrived or not.
        """
        self.off_before = self.off_before or self.known.pic_ae is False
        known = pic_ae if self.known.pic_ae is pic_ae else None
        self.known = replace(self.known, pic_ae=known, nothing_latched=False, closed=closed and self.known.closed)
        self.watched_closed = closed and self.watched_closed

    def switched(self, *, pic_ae: bool, closed: bool) -> None:
        """The drive acknowledged a Stop Motor that closes the loop, or opens it."""
        # spelled out, because `replace` takes three times as long where the answer to a stop waits
        self.known = Knowledge(
            pic_ae=pic_ae, nothing_latched=False, latched=self.known.latched, closed=closed, seen=True, absolute=False
        )
        self.loop_may_open = self.runs_open = self.off_before = self.off_unseen = False
        self.watched_closed = closed and self.watched_closed

    def clearing(self) -> None:
        """Clear Sticky Bits is on its way: a cause that was known may be gone before that is acknowledged."""
        if self.known.latched and self.known.pic_ae is not True:
            loses = self.known.latched.loses_position
            self.known = replace(
                self.known, latched=LdcnFault(FaultCode.LATCHED_FAULT, latched=True, loses_position=loses)
            )

    def cleared(self) -> None:
        """The drive acknowledged Clear Sticky Bits; it discards the cause of a switch-off only with Pic_ae = 0."""
        if self.known.pic_ae is False:
            self.known = replace(self.known, latched=None, nothing_latched=True)

    def loaded(self, *, absolute: bool, runs_open: bool, opens_at_home: bool) -> None:
        """A motion was loaded: to an analog target or not; one that opens the loop on purpose, at once or at home."""
        self.known = replace(self.known, absolute=absolute)
        self.loop_may_open, self.runs_open = runs_open or opens_at_home, runs_open
        self.watched_closed = self.watched_closed and not self.loop_may_open

    # -- what it shows -----------------------------------------------------------------------------------------------

    def reading(self, status: StatusPacket, asked: frozenset[TelemetryItem] = frozenset()) -> AxisReading:
        """Interpret a status packet that was requested for these items.

        Raises:
            BadReply: position, velocity or the auxiliary byte is missing.
        """
        if status.position is None or status.velocity is None or status.aux is None:
            raise BadReply(f"axis {self._name}: the status packet lacks position, velocity or aux")
        faults = self.faults(status)
        homing, locked, enabled, done, reverse, forward, index, stop_input, pic_ae = self._shown.levels
        self.runs = not done or bool(status.velocity)
        counter = status.position
        # it counts from 0 again: nearer to that than to where it was, the command was executed
        if self.setting_back and abs(counter) < abs(self.setting_back) / 2:
            self.offset_counts += self.setting_back
            self.setting_back = 0
        elif self.set_back:
            self.setting_back = 0
        self.counts = counts = counter + self.offset_counts
        captured = self.awaited and not self.arming and not homing
        # "lowered" once "the home position has been found" (manuals, "Set Homing Mode"), and before it is armed
        if not self.arming:
            self.homing_armed = self.homing_armed and homing
            # one that it stood on is not armed; met before the arming it brings no change, so nothing is captured
            if self.guard and (
                captured or any(self.is_at(each, reverse=reverse, forward=forward) for each in self.guard)
            ):
                self.guard_hit = True
        self.motion_locked = locked
        tick_s, uncertain = self._registers.shown_tick
        return AxisReading(
            position_counts=counts,
            following_error_counts=status.position_error,
            velocity_counts_per_s=status.velocity / tick_s,
            velocity_resolution_counts_per_s=1.0 / tick_s,
            adc_counts=status.adc,
            enabled=enabled,
            profile_done=done,
            homing=homing,
            captured=captured,
            faults=faults,
            reverse_limit=reverse,
            forward_limit=forward,
            index=index,
            stop_input=stop_input,
            amplifier_enable=pic_ae,
            asked=asked,
            cut_short=f"the drive stopped at the {_in_words(self.guard)}" if self.guard_hit else "",
            begun_anew=-BEGUN_COUNTS <= counter <= BEGUN_COUNTS,
            altered=self._altered(homing=homing, enabled=enabled),
            velocity_uncertain=uncertain,
        )

    def _altered(self, *, homing: bool, enabled: bool) -> str:
        if enabled and self.off_unseen:
            return FOREIGN_POWER
        return FOREIGN_CAPTURE if homing and not self.homing_armed else ""

    def is_at(self, limit: HomeMethod, *, reverse: bool | None, forward: bool | None) -> bool:
        """Tell by the levels of both whether the axis is at a limit switch that ends its motions."""
        level = forward if limit is HomeMethod.FORWARD_LIMIT else reverse
        return self._limit_stop is not None and level is self._limit_stop

    def faults(self, status: StatusPacket) -> tuple[driver.Fault, ...]:
        """Return the drive's complaints; recomputed only when something that they depend on has changed."""
        adc = status.adc if self.known.absolute is not False else None
        if (status.flags, status.aux, adc, self.known, self.loop_may_open, self.runs_open) != self._question:
            faults = self._diagnose(status)
            self._shown = _Shown(faults, self._levels(int(status.flags), int(status.aux or 0)))
            self._question = (status.flags, status.aux, adc, self.known, self.loop_may_open, self.runs_open)
        return self._shown.faults

    def _levels(self, flags: int, aux: int) -> "Levels":
        """Return what the flags mean now that the faults are known."""
        profile, known = self._profile, self.known
        logosol, powered, closed = profile.pic_ae_diagnostics, flags & _POWER_ON, aux & _SERVO_ON
        # otherwise bits 5 and 6 are part of a code of its cause (LS-182AP manual, "Diagnostic bits")
        shows_limits = not logosol or (bool(known.pic_ae) and bool(powered))
        stop_input = None
        # bit 5 shows it only then (ibid., row "STOP input activated"), and a loop that is closed excludes it
        if logosol and (closed or (known.pic_ae is False and powered)):
            stop_input = not (closed or flags & _LIMIT1)
        reverse, forward = (_LIMIT2, _LIMIT1) if profile.limit1_is_forward else (_LIMIT1, _LIMIT2)
        return (
            bool(flags & _HOMING),
            profile.motion_lock_from is not None and bool(aux & _MOTION_LOCKED),
            bool(closed),
            bool(flags & _MOVE_DONE),
            bool(flags & reverse) if shows_limits else None,
            bool(flags & forward) if shows_limits else None,
            # the bit tells a stop input from a lost encoder then
            None if logosol and not powered else bool(aux & _INDEX) is profile.live_aux,
            stop_input,
            known.pic_ae,
        )

    def _diagnose(self, status: StatusPacket) -> tuple[driver.Fault, ...]:
        self._learn(status)
        waits_for_home = bool(status.flags & StatusFlag.HOME_IN_PROGRESS) and not self.runs_open
        open_on_purpose = self.loop_may_open and not waits_for_home
        found = tuple(
            fault
            for fault in diagnose(self._profile, status, self.known)
            if not (open_on_purpose and fault.code is FaultCode.POSITION_ERROR)
        )
        # "It is also set whenever the position servo is disabled" (LS-182AP manual, status byte, bit 4)
        if self.watched_closed and servo_on(status) and status.flags & StatusFlag.POSITION_ERROR:
            found = (OPENED_AND_CLOSED, *found)
        cause = next((fault for fault in found if fault.latched and fault.stops), None)
        # without this byte the loop counts as open, and every open loop shows the position error flag
        if status.aux is not None:
            self.known = replace(self.known, latched=cause, seen=True)
        return tuple(
            driver.Fault(
                fault.code.value,
                fault.remedy,
                stops=fault.stops,
                loses_position=fault.loses_position,
                hides_motion=fault.hides_motion,
                pushed=fault.code is FaultCode.OVERCURRENT,
            )
            for fault in found
        )

    def _learn(self, status: StatusPacket) -> None:
        """Take from a status what it proves."""
        logosol = self._profile.pic_ae_diagnostics
        if servo_on(status):
            self.off_before = False
            if not (status.flags & StatusFlag.POSITION_ERROR or self.loop_may_open):
                self.watched_closed = True
            # PIC-SERVO closes its loop whatever the amplifier (manual, 5.2), a Logosol drive does not
            pic_ae = True if logosol else self.known.pic_ae
            self.known = replace(self.known, pic_ae=pic_ae, nothing_latched=False, latched=None, closed=True)
            return
        self.off_unseen = False
        # "if there is no more fault condition Power_on will be set to 1" (LS-182AP manual, "Diagnostic bits")
        if logosol and self.known.pic_ae is False and status.flags & StatusFlag.POWER_ON:
            self.known = replace(self.known, nothing_latched=True)


def _in_words(switches: tuple[HomeMethod, ...]) -> str:
    return " or ".join(f"{method.value.replace('_', ' ')} switch" for method in switches)
