"""What keeps an axis from a command at present: all of it, in the order in which a person gets it out of the way.

Nothing is permitted here: a permit asks again at the moment of motion.
"""

from collections.abc import Iterator

from ldcnd.axis import guards
from ldcnd.axis.motion import AxisMotion
from ldcnd.axis.permit import Gate
from ldcnd.config.interlocks import InterlockKind
from ldcnd.contract.catalogue import AXIS_COMMANDS
from ldcnd.contract.commands import Effect, Verb, kind_of
from ldcnd.contract.errors import LdcndError, NotReferenced, NotSupported

NO_COMMAND_HELPS = "the drive takes no command for that: use its own inputs and its own tool"

Obstacle = tuple[LdcndError, bool]
"""What a command would be refused with, and whether that ends with the motion under way."""


class Obstacles:
    """What keeps one axis from commands; asking changes nothing."""

    def __init__(self, motion: AxisMotion, gate: Gate) -> None:
        self._motion = motion
        self._gate = gate

    def check_takes(self, verb: Verb) -> None:
        """Raise `NotSupported` for a command that its drive does not take."""
        if verb not in self._motion.driver.capabilities:
            name, model = self._motion.config.name, self._motion.config.model
            raise NotSupported(f"axis {name}: {model} cannot {verb}", axis=name, value=verb.value)

    def to_command(self, verb: Verb) -> list[Obstacle]:
        """Return all that a command would be refused with now, the first first; and whether that ends with a motion."""
        try:
            self.check_takes(verb)
        except NotSupported as error:
            return [(error, False)]
        causes = [(error, guard is guards.check_stands) for error, guard in self._found(verb, guards.needs(verb))]
        return causes + self._violations(verb, None)

    def to_motion(self, verb: Verb, *, speed: float | None = None) -> list[Obstacle]:
        """Return all that keeps the axis from a motion, each cause once: what has stopped its drive one by one.

        Args:
            verb: begins the motion; one by a distance stands for one to a position that the drive does not take.
            speed: of it, in units a second; that of moves which name none when missing.
        """
        able = self._motion.driver.capabilities
        moves = any(command.effect is Effect.MOTION and verb in able for verb, command in AXIS_COMMANDS.items())
        verb = Verb.MOVE_RELATIVE if verb is Verb.MOVE_ABSOLUTE and verb not in able else verb
        found = list(self._found(verb, guards.needs(verb) if moves else guards.AT_ALL))
        name = self._motion.config.name
        first = [error for error, guard in found if guard in (guards.check_reachable, guards.check_not_latched)]
        # a warning keeps nothing from moving
        faults = [each for each in self._motion.tracker.status.active_faults if each.source == "drive" and each.stops]
        causes = [(error, False) for error in (*first, *(guards.fault(self._motion.tracker, each) for each in faults))]
        forbidden = self._violations(verb, speed) if moves else []
        if self._motion.tracker.status.unseen and not self._motion.tracker.status.energised:
            # it is waited for until it stands, which power would begin anew: what rules want comes before that
            causes, forbidden = forbidden + causes, []
        for error, guard in found:
            if guard is guards.check_not_in_error:
                causes.append((guards.error_stop(self._motion.tracker, faults), False))
            elif error not in first:
                if guard is guards.check_enabled:
                    passes = not self._motion.tracker.status.motion_hidden_by
                    causes += [(each, passes) for each in self._while_it_coasts()]
                said = error
                if guard is guards.check_referenced:  # what is in the way of a motion is in the way of homing, too
                    causes, forbidden = causes + forbidden, []
                    if any(not passes for _, passes in causes):
                        behind = "home it, or set its position, once nothing else is in the way"
                        said = NotReferenced(error.message, axis=name, remedy=behind)
                causes.append((said, guard is guards.check_stands))
        causes += forbidden
        if not moves:
            text = f"axis {name}: its drive takes no motion over the line"
            causes.append((NotSupported(text, axis=name, remedy=NO_COMMAND_HELPS), False))
        return causes

    def _violations(self, verb: Verb, speed: float | None) -> list[Obstacle]:
        """Return what interlocks forbid a command with; at the speed of moves that name none when that is left out."""
        if verb is Verb.POWER:
            return [(error, False) for error in self._gate.violations(InterlockKind.POWER_ON, 0.0)]
        if AXIS_COMMANDS[verb].effect is not Effect.MOTION:
            return []
        speed = self._motion.config.velocity if speed is None else abs(speed)
        return [(error, False) for error in self._gate.violations(InterlockKind(kind_of(verb)), speed)]

    def _found(self, verb: Verb, row: guards.Needs) -> Iterator[tuple[LdcndError, guards.Guard | None]]:
        """Yield what guards refuse a command with; one that takes over one of its own need not stand."""
        follows = guards.goes_on(verb, self._motion.tracker)
        for error, guard in guards.obstacles(row, self._motion.tracker, self._motion.driver):
            if not (follows and guard is guards.check_stands):
                yield error, guard

    def _while_it_coasts(self) -> Iterator[LdcndError]:
        """Yield what forbids to close the loop of a shaft that turns with it open, or may."""
        try:
            guards.check_does_not_coast(self._motion.tracker)
        except LdcndError as error:
            yield error
