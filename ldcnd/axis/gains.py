"""The gains of one axis: those of each kind of motion, and those that a client has lent it while its lease lasts."""

import math
from dataclasses import asdict, replace

from ldcnd.axis import guards
from ldcnd.axis.motion import AxisMotion
from ldcnd.axis.permit import Permit
from ldcnd.contract.commands import CommandReply, MotionKind, SetGains
from ldcnd.contract.errors import LeaseRequired, Remedy, ValueOutOfRange, WrongState, step
from ldcnd.drives.driver import Gains


class AxisGains:
    """Loads gains, chooses those of each kind of motion, and takes back those that were lent."""

    def __init__(self, motion: AxisMotion) -> None:
        self._motion = motion
        self._name = motion.config.name
        self._own: Gains | None = None  # of the axis while a client has lent it others
        config = motion.config
        self._sets = {name: each.registers for name, each in config.gain_sets.items()}
        self._of_kinds = {kind: self._sets[name] for kind, name in config.gains_for.items()}
        self._of_others = motion.driver.wanted_gains if self._of_kinds else None

    def _wanted(self, kind: MotionKind) -> Gains | None:
        """Return the gains for a kind of motion; None where it makes no difference."""
        return self._of_kinds.get(kind, self._of_others) if self._of_kinds and self._own is None else None

    def switches(self, kind: MotionKind) -> bool:
        """Tell whether a kind of motion takes other gains than the drive is to hold now."""
        return self._wanted(kind) not in (None, self._motion.driver.wanted_gains)

    def choose(self, kind: MotionKind) -> None:
        """Have the drive hold the gains of a kind of motion, loaded before its first packet, if the axis stands.

        Set Gain acts at once: in mid-motion it would change the force on a shaft that lags behind.
        """
        wanted = self._wanted(kind)
        if wanted is not None and not self._motion.tracker.status.state.is_motion:
            self._motion.driver.wanted_gains = wanted

    async def set(self, permit: Permit, request: SetGains) -> CommandReply:
        """Load gains: those that the request names, the others as they are; they act at once.

        Raises:
            WrongState: the axis has none yet and the request lacks some, or the servo rate or the set would change in
                motion.
            ValueOutOfRange: there is no such set, or the position error limit is not above a tracking step.
            LeaseRequired: gains are to be lent, and the request names no lease.
        """
        permit.check_state()
        asked = {name: value for name in Gains.__slots__ if (value := getattr(request, name, None)) is not None}
        if request.gain_set is not None:
            guards.check_stands(self._motion.tracker)
            asked = asdict(self._named(request.gain_set)) | asked
        held = self._motion.driver.wanted_gains
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
            # what is set counts for all motions that have no gains of their own
            self._of_others = self._of_others and replace(self._of_others, **asked)
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

    def _named(self, name: str) -> Gains:
        if name not in self._sets:
            known = ", ".join(self._sets) or "none"
            raise ValueOutOfRange(
                f"axis {self._name} has no set of gains {name!r}; it has {known}",
                axis=self._name,
                value=name,
                limit=known,
                remedy="configure it in gain_sets",
            )
        return self._sets[name]

    def take_back(self) -> bool:
        """Have the drive hold the gains of the axis from its next motion on; tell whether others were lent to it."""
        own, self._own = self._own, None
        if own is None:
            return False
        self._motion.driver.wanted_gains = own
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
