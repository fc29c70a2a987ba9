"""The gains of one axis: those of each kind of motion, and those that a client has lent it while its lease lasts."""

import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, replace

from ldcnd.axis import guards
from ldcnd.axis.motion import AxisMotion
from ldcnd.axis.permit import Permit
from ldcnd.contract.commands import CommandReply, MotionKind, SetGains
from ldcnd.contract.errors import DriveFault, LeaseRequired, Remedy, RequestRefused, ValueOutOfRange, WrongState, step
from ldcnd.drives.driver import Gains

BASE = ""
"""Name of the set that `gains` are: of every kind of motion that names none."""


class AxisGains:
    """The sets of gains: chooses one for each kind of motion, keeps what is set in each, and takes back lent ones.

    The set in force is the one that the drive was last given, or is given at power-on. Unless gains are lent, what the
    drive is to hold is what that set has.
    """

    def __init__(self, motion: AxisMotion) -> None:
        self._motion = motion
        self._name = motion.config.name
        config = motion.config
        self._sets: dict[str, Gains | None] = {name: each.registers for name, each in config.gain_sets.items()}
        self._sets[BASE] = motion.driver.wanted_gains
        # where no kind names a set, none is chosen
        self._of_kinds = {kind: config.gains_for.get(kind, BASE) for kind in MotionKind if config.gains_for}
        self._in_force = BASE
        self._lent = False

    def _of_kind(self, kind: MotionKind) -> str:
        """Return the set of a kind of motion; what was lent serves all kinds."""
        return self._in_force if self._lent else self._of_kinds.get(kind, self._in_force)

    def switches(self, kind: MotionKind) -> bool:
        """Tell whether a kind of motion takes other gains than the drive is to hold now."""
        return self._sets[self._of_kind(kind)] != self._sets[self._in_force]

    @contextmanager
    def of(self, kind: MotionKind) -> Iterator[None]:
        """Have the drive hold the set of a kind of motion, loaded before its first packet, if the axis stands.

        Set Gain acts at once: in mid-motion it would change the force on a shaft that lags behind. A motion that is
        refused before its gains were loaded leaves the set in force.
        """
        before = self._in_force
        if not self.switches(kind) or not self._motion.tracker.status.state.is_motion:
            self._put_in_force(self._of_kind(kind))
        try:
            yield
        except (RequestRefused, DriveFault):
            if self.differ:
                self._put_in_force(before)
            raise

    def loaded_before(self, kind: MotionKind) -> Gains | None:
        """Return the gains that are loaded before a motion of a kind from rest; None where the drive has them."""
        wanted = self._wanted(kind)
        if wanted is None:
            return None
        if self._motion.tracker.status.enabled:
            return None if self._motion.driver.holds(wanted) else wanted
        return None if wanted == self._wanted(MotionKind.POSITION) else wanted  # with those it is switched on

    def _wanted(self, kind: MotionKind) -> Gains | None:
        return self._motion.driver.wanted_gains if self._lent else self._sets[self._of_kind(kind)]

    def _put_in_force(self, name: str) -> None:
        if name != self._in_force:
            self._in_force, self._motion.driver.wanted_gains = name, self._sets[name]

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
        # what is stored begins from what is stored, not from what was lent
        held = self._sets[self._in_force] if self._lent and not request.lent else self._motion.driver.wanted_gains
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
            in_force = self._in_force if request.gain_set is None else request.gain_set
            await permit.set_gains(changed)
            self._lent = False
            # the register book has what the drive is to hold, and took it once it was acknowledged; the set follows it
            self._in_force = in_force
            self._sets[self._in_force] = changed
            return self._motion.reply(permit)
        if request.lease is None:
            raise LeaseRequired(
                f"axis {self._name}: gains are lent for as long as a lease lasts, and the command names none",
                axis=self._name,
                remedy=Remedy("{}", step("acquire", "acquire one first")),
            )
        self._lent = True  # before they are sent: a lost reply leaves open which ones act
        await permit.set_gains(changed)
        return self._motion.reply(permit)

    def _named(self, name: str) -> Gains:
        found = self._sets.get(name) if name != BASE else None
        if found is None:
            known = ", ".join(filter(None, self._sets)) or "none"
            raise ValueOutOfRange(
                f"axis {self._name} has no set of gains {name!r}; it has {known}",
                axis=self._name,
                value=name,
                limit=known,
                remedy="configure it in gain_sets",
            )
        return found

    def take_back(self) -> bool:
        """Have the drive hold the set in force from its next motion on; tell whether other gains were lent to it."""
        lent, self._lent = self._lent, False
        if lent:
            self._motion.driver.wanted_gains = self._sets[self._in_force]
        return lent

    @property
    def differ(self) -> bool:
        """Whether the drive holds other gains than it should, or may."""
        return not self._motion.driver.holds_gains

    @property
    def are_due(self) -> bool:
        """Whether the next motion from rest loads others, as those that were lent to another client."""
        return self.differ and self._motion.driver.wanted_gains is not None

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
