"""Captures of an LDCN or NMC servo drive: its home position, and limit switches that stop its motions.

Versions 1 and 2 of PIC-SERVO do not stop on home by themselves: the host stops them.
Sources: PIC-SERVO manual, 5.2, "Set Homing Mode"; LS-182AP manual, "System status".
"""

import contextlib
from types import MappingProxyType

from ldcnd.contract.commands import HomeMethod
from ldcnd.contract.errors import BadReply, DriveFault, Remedy, RequestRefused, WrongState, step
from ldcnd.drives.driver import AnalogMotion, AxisReading, CountsMotion, HomeCapture, PwmOutput, StopMode
from ldcnd.drives.ldcn import commands
from ldcnd.drives.ldcn.access import STATE_ITEMS, ServoAccess, agreed
from ldcnd.drives.ldcn.controls import blocking_pin
from ldcnd.drives.ldcn.packet import StatusFlag, StatusItem
from ldcnd.drives.ldcn.profiles import HomingControl, Profile
from ldcnd.drives.ldcn.registers import LIMIT_PINS, Unknown
from ldcnd.line.exchange import Lane

ANY_LIMIT = HomingControl.LIMIT1 | HomingControl.LIMIT2
SOURCES = MappingProxyType(
    {
        HomeMethod.REVERSE_LIMIT: HomingControl.LIMIT1,
        HomeMethod.FORWARD_LIMIT: HomingControl.LIMIT2,
        HomeMethod.INDEX: HomingControl.INDEX,
        HomeMethod.POSITION_ERROR: HomingControl.POSITION_ERROR,
        HomeMethod.CURRENT: HomingControl.CURRENT,
    }
)
OPPOSITE_LIMITS = MappingProxyType(
    {HomeMethod.REVERSE_LIMIT: HomeMethod.FORWARD_LIMIT, HomeMethod.FORWARD_LIMIT: HomeMethod.REVERSE_LIMIT}
)
STOPS = MappingProxyType(
    {
        StopMode.SMOOTH: HomingControl.STOP_SMOOTH,
        StopMode.ABRUPT: HomingControl.STOP_ABRUPT,
        StopMode.OFF: HomingControl.MOTOR_OFF,
    }
)


def homing_source(profile: Profile, method: HomeMethod) -> HomingControl:
    """Return the input or event that a method watches on this device."""
    if profile.limit1_is_forward:
        method = OPPOSITE_LIMITS.get(method, method)
    return SOURCES[method]


def home_methods(profile: Profile) -> frozenset[HomeMethod]:
    """Return what can capture the home position of this device."""
    return frozenset(method for method in SOURCES if homing_source(profile, method) & profile.homing_sources)


def homing_control(profile: Profile, capture: HomeCapture) -> HomingControl:
    """Return the control byte that arms a capture.

    An excess position error opens the loop by itself, so no way to stop goes with it.
    """
    control = homing_source(profile, capture.method)
    for method in capture.also:
        control |= homing_source(profile, method)
    if profile.stops_on_home and capture.method is not HomeMethod.POSITION_ERROR:
        control |= STOPS[capture.stop]
    return control


def opens_loop(profile: Profile, capture: HomeCapture) -> bool:
    """Tell whether the drive opens its loop by itself when it has captured."""
    if capture.method is HomeMethod.POSITION_ERROR:
        return True
    return profile.stops_on_home and capture.stop is StopMode.OFF


def limits_ahead(motion: CountsMotion | AnalogMotion | PwmOutput, here_counts: int) -> tuple[HomeMethod, ...]:
    """Return the limit switches that a motion may run onto; both where the drive finds the direction itself."""
    match motion:
        case AnalogMotion():
            return (HomeMethod.FORWARD_LIMIT, HomeMethod.REVERSE_LIMIT)
        case PwmOutput():
            way = motion.duty
        case CountsMotion(None):
            way = motion.velocity_counts_per_s
        case CountsMotion():
            way = (motion.target_counts or 0) - here_counts
    if way == 0:
        return ()
    return (HomeMethod.FORWARD_LIMIT if way > 0 else HomeMethod.REVERSE_LIMIT,)


class Homing:
    """Arms and disarms the captures of one drive; only its home register changes, the reference is the host's."""

    def __init__(self, of: ServoAccess) -> None:
        self._of = of

    async def arm(self, motion: CountsMotion | AnalogMotion | PwmOutput, home: HomeCapture | None) -> None:
        """Arm the requested capture, or the one that stops the motion at the limit switch ahead, or none.

        It "can also be used as a safety shutoff" (PIC-SERVO manual, 5.2, "Set Homing Mode").
        """
        control = HomingControl(0)
        guard: tuple[HomeMethod, ...] = ()
        if home is not None:
            for method in (home.method, *home.also):
                self._check_pin(method)
            control = homing_control(self._of.profile, home)
            if home.guarded and self._of.spec.limit_stop is not None:
                control |= self.guard(motion, await self._here())[0] & ANY_LIMIT
                if home.method is HomeMethod.POSITION_ERROR:
                    control |= HomingControl.MOTOR_OFF  # its loop opens anyway; another stop might close it again
        elif self._of.spec.limit_stop is not None:
            control, guard = self.guard(motion, await self._here())
        if control or self._of.state.homing_armed:
            state = self._of.state
            state.homing_armed = state.arming = True  # before it is, so that a stop in between disarms it
            state.awaited = bool(control)
            try:
                await self._of.bus.execute(commands.set_homing(self._of.node, control))
            finally:
                state.arming = False
        if control:
            await self._check_armed()
        self._of.state.homing_armed = bool(control)
        # only now: before, what has stopped the motion under way is what was armed for that
        self._of.state.guard, self._of.state.guard_hit = guard, False

    async def was_met(self, started: StatusFlag) -> bool:
        """Tell whether a motion was started although its limit switch was met before: nothing stops it there any more.

        Args:
            started: what the drive has answered to the start; a reply to something older may look like that, so what it
                leaves open is read.

        Raises:
            BusError: the line failed.
        """
        state, pins = self._of.state, StatusFlag.LIMIT1 | StatusFlag.LIMIT2
        actuated = started & pins if self._of.spec.limit_stop else ~started & pins
        if not state.guard or (started & StatusFlag.HOME_IN_PROGRESS and not actuated):
            return False
        state.reading(await self._of.read(STATE_ITEMS))
        return state.guard_hit

    def stands_on(self, limit: HomeMethod, reading: AxisReading) -> bool:
        """Tell whether a reading shows the axis on a limit switch that ends its motions."""
        return self._of.state.is_at(limit, reverse=reading.reverse_limit, forward=reading.forward_limit)

    async def _check_armed(self) -> None:
        """Refuse a motion that its drive would not end: what was captured before would pass for its home.

        Raises:
            WrongState: the drive does not show that it looks for its home.
        """
        # "the home_in_progress bit in the status byte is set when this command is issued" (PIC-SERVO manual, 5.2)
        status = await self._of.read(STATE_ITEMS)
        if not status.flags & StatusFlag.HOME_IN_PROGRESS:
            raise WrongState(
                f"axis {self._of.spec.name}: the drive has acknowledged that it looks for its home, and does not show"
                " it; nothing was started",
                axis=self._of.spec.name,
                remedy="send it again; if that repeats, look whether the signal changes while the axis stands",
            )

    async def _here(self) -> AxisReading:
        return self._of.state.reading(await self._of.read(STATE_ITEMS))

    def guard(
        self, motion: CountsMotion | AnalogMotion | PwmOutput, reading: AxisReading
    ) -> tuple[HomingControl, tuple[HomeMethod, ...]]:
        """Return what stops a motion at the limit switches that it may run onto, and which these are.

        Only switches ahead are armed, and none that the axis stands on: a capture comes with every change, also with
        that of leaving a switch. A drive that turns round in mid-move has the other one ahead until it has.

        Args:
            motion: that is about to be loaded.
            reading: of the drive before.

        Raises:
            WrongState: the axis stands on the switch ahead, or its drive is stopping at one; or its pin is an output.
        """
        active = self._of.spec.limit_stop
        # by how far the shaft lags behind its place one that stays would seem to move
        if active is None or (isinstance(motion, CountsMotion) and motion.stays):
            return HomingControl(0), ()
        if reading.cut_short and not reading.profile_done:
            raise WrongState(
                f"axis {self._of.spec.name} is coming to rest: {reading.cut_short}",
                axis=self._of.spec.name,
                remedy="wait until it stands",
            )
        ahead = limits_ahead(motion, reading.position_counts)
        onward = limits_ahead(CountsMotion(None, reading.velocity_counts_per_s, 1.0), reading.position_counts)
        control = HomingControl(0)
        for method in ahead:
            self._check_pin(method)
            if len(ahead) == 1 and self.stands_on(method, reading):
                raise WrongState(
                    f"axis {self._of.spec.name} stands on its {method.value.replace('_', ' ')} switch",
                    axis=self._of.spec.name,
                    value=method.value,
                    remedy="move the other way",
                )
        guard = tuple(method for method in dict.fromkeys(ahead + onward) if not self.stands_on(method, reading))
        # a smooth stop would close the loop that a raw duty has open
        stop = StopMode.OFF if isinstance(motion, PwmOutput) else StopMode.SMOOTH
        for method in guard:
            control |= homing_control(self._of.profile, HomeCapture(method, stop))
        return control, guard

    def _check_pin(self, method: HomeMethod) -> None:
        pin = blocking_pin(method)
        if pin not in LIMIT_PINS:
            return
        is_input, holding = LIMIT_PINS[pin][0], self._of.book[pin]
        if isinstance(holding, Unknown) and set(holding.among) - {is_input}:
            remedy = step("set_outputs", 'send set_outputs with "input"', limit1="input", limit2="input")
            raise self._of.unknown(pin, Remedy("{}", remedy))
        if self._of.book.known(pin) not in (None, is_input):
            raise WrongState(
                f"axis {self._of.spec.name}: the {method} pin is an output",
                axis=self._of.spec.name,
                value=method.value,
                remedy=Remedy(
                    "{}", step("set_outputs", 'send set_outputs with "input"', limit1="input", limit2="input")
                ),
            )

    async def disarm(self, lane: Lane = Lane.STOP) -> None:
        """Disarm what is armed, behind a stop or before a set-point, so that it stops no later motion."""
        # an armed capture would stop a later motion, and end it as if it had found its home
        if self._of.state.homing_armed:
            self._of.state.awaited = False  # before it is sent: the flag goes down although its reply may be lost
            with contextlib.suppress(RequestRefused):  # not known to be this drive: the next motion disarms it
                await self._of.bus.execute(commands.set_homing(self._of.node, HomingControl(0)), lane)
                self._of.state.homing_armed = False
        self._of.state.guard, self._of.state.guard_hit = (), False

    async def captured(self) -> int:
        """Return the captured home position, in counts, once two replies agree.

        Raises:
            DriveFault: they do not.
        """
        home = await agreed(self._home)
        if home is None:
            raise DriveFault(
                f"axis {self._of.spec.name}: the drive's replies contradict each other about the position that it has"
                " captured",
                axis=self._of.spec.name,
                remedy="check the line for noise, then send it again",
            )
        return home + self._of.state.offset_counts

    async def _home(self) -> int:
        status = await self._of.read(StatusItem.HOME)
        if status.home is None:
            raise BadReply(f"axis {self._of.spec.name}: the status packet lacks the home position")
        return status.home
