"""The gains of one axis: those that it has, and those that a client has lent it for as long as its lease lasts."""

import math
from dataclasses import replace

from ldcnd.axis import guards
from ldcnd.axis.motion import AxisMotion
from ldcnd.axis.permit import Permit
from ldcnd.contract.commands import CommandReply, SetGains
from ldcnd.contract.errors import LeaseRequired, Remedy, ValueOutOfRange, WrongState, step
from ldcnd.drives.driver import Gains


class AxisGains:
    """Loads gains, and takes back those that were lent."""

    def __init__(self, motion: AxisMotion) -> None:
        self._motion = motion
        self._name = motion.config.name
        self._own: Gains | None = None  # of the axis while a client has lent it others

    async def set(self, permit: Permit, request: SetGains) -> CommandReply:
        """Load gains: those that the request names, the others as they are; they act at once.

        Raises:
            WrongState: the axis has none yet and the request lacks some, or the servo rate would change in motion.
            ValueOutOfRange: the position error limit is not above a tracking step.
            LeaseRequired: gains are to be lent, and the request names no lease.
        """
        permit.check_state()
        asked = {name: value for name in Gains.__slots__ if (value := getattr(request, name, None)) is not None}
        held = self._motion.driver.gains
        if held is None and not {"kp", "el"} <= asked.keys():
            raise WrongState(
                f"axis {self._name} has no gains yet",
                axis=self._name,
                remedy=Remedy("{}", step("set_gains", "send at least kp and el")),
            )
        gains = held or Gains(kp=0, kd=0, ki=0, il=0, ol=250, cl=0, el=0, sr=1, deadband=0)
        changed = replace(gains, **asked)
        if changed.sr != gains.sr:
            guards.check_stands(self._motion.tracker)
        self._check_tracking_step(changed)
        if not request.lent:
            await permit.set_gains(changed)
            self._own = None
            return self._motion.reply(permit)
        if request.lease is None:
            raise LeaseRequired(
                f"axis {self._name}: gains are lent for as long as a lease lasts, and the command names none",
                axis=self._name,
                remedy=Remedy("{}", step("acquire", "acquire one first")),
            )
        self._own = self._own or gains  # before they are sent: a lost reply leaves open which ones act
        await permit.set_gains(changed)
        return self._motion.reply(permit)

    def take_back(self) -> bool:
        """Have the drive hold the gains of the axis from its next motion on; tell whether others were lent to it."""
        own, self._own = self._own, None
        if own is None:
            return False
        self._motion.driver.gains = own
        return True

    @property
    def differ(self) -> bool:
        """Whether the drive holds other gains than it should, or may."""
        return not self._motion.driver.holds_gains

    def _check_tracking_step(self, gains: Gains) -> None:
        """Refuse a position error limit that the next set-point of `track` could exceed.

        Raises:
            ValueOutOfRange: names the lowest `el`.
        """
        config = self._motion.config
        if config.tracking is None:
            return
        step_counts = math.ceil(config.tracking.step * abs(self._motion.scale.counts_per_unit))
        if gains.el <= step_counts:
            raise ValueOutOfRange(
                f"axis {config.name}: el {gains.el} is not above a tracking step of {step_counts} counts",
                axis=config.name,
                value=gains.el,
                limit=step_counts,
                nearest=step_counts + 1,
                remedy="configure a shorter tracking step",
            )
