"""Interlocks at work: asked before a motion, a power-off or an output, watched while motion lasts, lifted for a time.

Whoever is about to change something notes that first and asks afterwards: an axis has a command, an output counts as
unknown. So of a motion and an output that forbid each other, two requests at one instant never both pass, on whatever
lines they are.
"""

import asyncio
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import chain
from types import MappingProxyType

from ldcnd.axis import guards
from ldcnd.axis.axis import AxisService
from ldcnd.axis.events import CommandFailing
from ldcnd.axis.status import AxisStatus
from ldcnd.config.interlocks import LOOKS, MOTIONS, InterlockConfig, InterlockKind, Requirement
from ldcnd.contract.commands import Verb, kind_of
from ldcnd.contract.errors import InterlockViolated, LdcndError, Remedy, ValueOutOfRange
from ldcnd.contract.events import INTERLOCK, CommandStatus
from ldcnd.contract.rig_commands import OverrideInterlock, OverrideReply
from ldcnd.contract.samples import AxisState, LinkState
from ldcnd.daemon.leases import STOP_MODES, Authority
from ldcnd.daemon.ledger import EventLog
from ldcnd.daemon.modules import ModuleService, setting
from ldcnd.daemon.requirements import (
    NOW,
    WATCHED,
    Asked,
    Lack,
    in_words,
    is_commanded,
    lack_of_axis,
    lack_of_line,
    lack_of_module,
    speed_of,
)
from ldcnd.daemon.rig import OwnedRig
from ldcnd.drives.axis_config import LossPolicy
from ldcnd.log import get_logger

log = get_logger("interlocks")

Obstacle = Callable[[Asked], Lack | None]
"""Returns how a requirement does not hold, or is not known to; None when it does."""


@dataclass(slots=True)
class Override:
    """A rule that does not bind for a time.

    Attributes:
        until_s: when it ends at the latest, in loop time.
        lease: under which it was asked for; it ends with that.
        client: the holder.
    """

    until_s: float
    lease: str
    client: str


@dataclass(slots=True)
class BoundRule:
    """One rule.

    Attributes:
        config: of it.
        axis: what it binds; None for an output.
        holders: axes whose lease an override needs.
        kinds: what it forbids.
        requires: its requirements.
        modules: whose lines it requires; empty where it requires something of an axis, too.
        version: of the lines, at which its requirements held.
        until_s: until when they do, in loop time, if that version stays.
        override: the one in force.
        reacted: the motion under way is being ended because of it.
    """

    config: InterlockConfig
    axis: AxisService | None
    holders: tuple[str, ...]
    kinds: tuple[InterlockKind, ...]
    requires: tuple[Obstacle, ...]
    modules: tuple[ModuleService, ...]
    version: int = -1
    until_s: float = 0.0
    override: Override | None = None
    reacted: bool = False


@dataclass(slots=True)
class AxisRules:
    """The rules that bind one axis.

    Attributes:
        axis: which.
        rules: of it.
        version: of the lines, at which all of them held.
        until_s: until when they do, in loop time, if that version stays.
        moved: it moved, or was about to, when its drive was heard last.
    """

    axis: AxisService
    rules: tuple[BoundRule, ...]
    version: int = -1
    until_s: float = 0.0
    moved: bool = False

    def hold(self, version: int, now_s: float) -> bool:
        """Tell whether all of them are proven to hold, by lines that have not changed since."""
        if self.version == version and self.until_s >= now_s:
            return True
        if any(rule.version != version or rule.until_s < now_s for rule in self.rules):
            return False
        self.version, self.until_s = version, min(rule.until_s for rule in self.rules)
        return True


class Interlocks:
    """The rules of one rig."""

    def __init__(
        self, rules: tuple[InterlockConfig, ...], rig: OwnedRig, authority: Authority, events: EventLog
    ) -> None:
        self._rig = rig
        self._authority = authority
        self._events = events
        self._now_s = asyncio.get_running_loop().time
        self._modules = {name: module for module in rig.modules.values() for name in module.names}
        self._rules = {config.name: self._rule(config) for config in rules}
        self._of_axes: list[AxisRules] = []
        self._changed = asyncio.Event()
        self._version = 0
        for name, axis in rig.axes.items():
            if own := tuple(rule for rule in self._rules.values() if rule.axis is axis):
                self._of_axes.append(bound := AxisRules(axis, own))
                axis.gate.violations = partial(self._violations_of_axis, f"axis {name}", bound)
        periods_s = [rule.config.within_ms / 1e3 / LOOKS for each in self._of_axes for rule in each.rules]
        self._period_s = min(periods_s, default=math.inf)
        for module in rig.modules.values():
            module.check = partial(self._check_outputs, module)
            module.changed = self._note_change

    def _rule(self, config: InterlockConfig) -> BoundRule:
        # a look may come `within_ms / LOOKS` late, so what is read must be younger than the bound by that
        age_s = config.within_ms / 1e3 * (1 - 1 / LOOKS)
        axis = dict(self._rig.axes).get(config.of)
        holders = (config.of,) if axis else self._modules[config.of].axes
        requires = tuple(self._requirement(each, age_s) for each in config.requires)
        modules = [
            self._rig.modules[each.module] if each.module else self._modules[each.input or each.output or ""]
            for each in config.requires
            if each.axis is None
        ]
        alone = len(modules) == len(requires)
        kinds = config.kinds(output=axis is None)
        return BoundRule(config, axis, holders, kinds, requires, tuple(dict.fromkeys(modules)) if alone else ())

    def _note_change(self) -> None:
        self._version += 1
        self._changed.set()

    def _lacks(self, rule: BoundRule, asked: Asked = NOW) -> tuple[Lack, ...]:
        """Return why a rule forbids what it binds; nothing when it does not."""
        if rule.override is not None and self._goes_on(rule, rule.override):
            return ()
        if lacks := tuple(lack for requirement in rule.requires if (lack := requirement(asked))):
            return lacks
        # not while an output is being written: then it may hold for those who only watch
        if rule.modules and not asked.levels and not any(module.unread for module in rule.modules):
            age_s = rule.config.within_ms / 1e3 * (1 - 1 / LOOKS)
            rule.version, rule.until_s = self._version, min(map(self._proven_at_s, rule.config.requires)) + age_s
        return ()

    # -- what must hold ----------------------------------------------------------------------------------------------

    def _requirement(self, each: Requirement, age_s: float) -> Obstacle:
        if each.axis is not None:
            axis = self._rig.axes[each.axis]
            return lambda _: lack_of_axis(axis, each, self._now_s(), age_s, self._may_home)
        if each.module is not None:
            required = self._rig.modules[each.module]
            return lambda _: lack_of_module(required, self._now_s(), age_s)
        module = self._modules[each.input or each.output or ""]
        return lambda asked: lack_of_line(module, each, self._now_s(), age_s, asked)

    def _proven_at_s(self, each: Requirement) -> float:
        """Return when what is required of a line or a module was read last, in loop time."""
        name = each.input or each.output
        return (self._modules[name] if name else self._rig.modules[each.module or ""]).proven_at_s(name)

    # -- the way out -------------------------------------------------------------------------------------------------

    def _violation(
        self,
        rule: BoundRule,
        what: str,
        lacks: Sequence[Lack],
        levels: Mapping[str, bool | None] = MappingProxyType({}),
    ) -> InterlockViolated:
        """Return the refusal of what a rule binds, with the steps that lead out: none of them is refused as the first.

        Args:
            rule: of which requirements do not hold.
            what: is refused.
            lacks: those requirements.
            levels: of the outputs that were to be written.
        """
        name = rule.config.name
        axis = rule.axis.config.name if rule.axis else self._axis_in_the_way(self._modules[rule.config.of], lacks)
        wanted = {output: level for output, level in levels.items() if level is not None}
        if unknown := [each for each in lacks if each.because]:
            stages = self._to_wait(unknown)  # what else is to be done only what is known tells
        elif wanted and wanted.keys() == levels.keys():
            stages = self._to_set(self._modules[rule.config.of], wanted, axis)
        else:
            stages = self._to_hold(lacks, axis, waits=False)
            led = [each for each in lacks if each.sets or (each.axis == axis and each.way)]
            if len(led) < len(lacks):
                stages.append(Remedy(f"see to it that {'the rest' if stages else 'this'} holds"))
        error = InterlockViolated(
            f"{what}: interlock {name}: {in_words(lacks)}",
            axis=axis,
            value=name,
            remedy=Remedy.of(
                f"{', then '.join(stages)}; for service override_interlock lifts {name} for a time",
                tuple(step for stage in stages for step in stage.steps),
            ),
        )
        error.may_wait = all(each.is_unknown for each in lacks)
        return error

    def _axis_in_the_way(self, module: ModuleService, lacks: Sequence[Lack]) -> str | None:
        """Return the axis of which commands lead out where outputs of a module are refused, also those to be set first.

        None where no command of an axis does.
        """
        others = (rule for rule in self._rules.values() if self._modules.get(rule.config.of) is module)
        every = chain(lacks, *(self._lacks(rule) for rule in others))
        return next((each.axis for each in every if each.way), None)

    def _to_hold(self, lacks: Sequence[Lack], axis: str | None, *, waits: bool = True) -> list[Remedy]:
        """Return in stages what has requirements hold.

        Args:
            lacks: those that do not.
            axis: of which commands may be named.
            waits: what no command leads to is waited for.
        """
        stages = list({str(each.way): each.way for each in lacks if each.way and each.axis == axis}.values())
        levels: dict[ModuleService, dict[str, bool]] = {}
        for each in lacks:
            if each.sets:
                levels.setdefault(each.sets[0], {}).update(each.sets[1])
        for module, wanted in levels.items():
            stages += self._to_set(module, wanted, axis)
        return stages + (self._to_wait(lacks) if waits else [])

    def _to_wait(self, lacks: Sequence[Lack]) -> list[Remedy]:
        """Return what is to be waited for, of what no output has hold."""
        awaited = [*dict.fromkeys(each.wanted for each in lacks if not each.sets)]
        if not awaited:
            return []
        *others, last = awaited
        return [Remedy(f"wait until {', '.join(others)}{' and ' if others else ''}{last}")]

    def _to_set(self, module: ModuleService, wanted: Mapping[str, bool], axis: str | None) -> list[Remedy]:
        """Return in stages how outputs of a module get their levels, and what else of it that takes.

        What only the machine can bring about, such as a door that is to fall shut, another output may have to bring
        about first: an output that waits for an input is written behind all others.
        """
        if unknown := [each for each in self._forbidden(module, wanted) if each.because]:
            return self._to_wait(unknown)
        levels = dict(wanted)
        for _ in self._rules:  # what one rule wants another may bind
            more = {
                name: level
                for lack in self._forbidden(module, levels)
                if lack.sets and lack.sets[0] is module
                for name, level in lack.sets[1].items()
                if name not in levels
            }
            if not more:
                break
            levels |= more
        levels = dict(module.levels_to_set(levels))
        later = {
            name: level
            for name, level in levels.items()
            if any(
                lack.axis is None and not lack.sets
                for rule, asked, becomes in self._bound(module, levels)
                if rule.config.of == name and not becomes  # before it is an output nothing is written
                for lack in self._lacks(rule, asked)
            )
        }
        # an output of which nothing is known is written, too: only so it comes to be known
        first = {
            name: level is not (name in later)
            for name, level in levels.items()
            if name not in later or module.is_unwritten(name)
        }
        stages: list[Remedy] = []
        for part, names in ((first, tuple(first)), (first | later, tuple(later))):
            if names:
                lacks = self._forbidden(module, part, *names)
                ways = {str(each.way): each.way for each in lacks if each.way and each.axis == axis}
                stages += [*ways.values(), *self._to_wait(lacks)]
                stages.append(Remedy("{}", setting(module.name, {name: part[name] for name in names})))
        return stages

    def _forbidden(self, module: ModuleService, levels: Mapping[str, bool], *names: str) -> tuple[Lack, ...]:
        """Return what keeps outputs from being written to their levels, all or some of those in one request."""
        return tuple(
            lack
            for rule, asked, _ in self._bound(module, levels)
            if rule.config.of in (names or levels)
            for lack in self._lacks(rule, asked)
        )

    def _may_home(self, axis: AxisService) -> bool:
        """Tell whether a search for the reference would begin now."""
        try:
            guards.check(Verb.HOME, axis.tracker)
        except LdcndError:
            return False
        rules = (rule for rule in self._rules.values() if rule.axis is axis and InterlockKind.HOME in rule.kinds)
        return Verb.HOME in axis.driver.capabilities and not any(self._lacks(rule) for rule in rules)

    # -- asked -------------------------------------------------------------------------------------------------------

    def _violations_of_axis(
        self, what: str, own: AxisRules, kind: InterlockKind, speed: float
    ) -> Iterator[InterlockViolated]:
        """Yield what forbids a motion of an axis at a speed, or to open or close its loop."""
        if own.hold(self._version, self._now_s()):
            return
        for rule in own.rules:
            above = rule.config.above
            if kind in rule.kinds and (above is None or speed > above) and (lacks := self._lacks(rule)):
                yield self._violation(rule, what, lacks)

    def _check_outputs(
        self, module: ModuleService, levels: Mapping[str, bool | None], kept: frozenset[str] | None
    ) -> None:
        """Refuse to write outputs; see `ModuleService.check`."""
        for rule, asked, becomes in self._bound(module, levels, kept):
            if lacks := self._lacks(rule, asked):
                what = f"output {rule.config.of}{', as it becomes one' if becomes else ''}"
                error = self._violation(rule, what, lacks, levels)
                error.may_wait |= becomes  # until then it stays as it is: its level may wait
                raise error

    def _bound(
        self, module: ModuleService, levels: Mapping[str, bool | None], kept: frozenset[str] | None = None
    ) -> Iterator[tuple[BoundRule, Asked, bool]]:
        """Yield the rules that bind outputs to be written, the levels to judge each by, and whether these come first.

        A line that becomes an output by the write has another level first. What only keeps its level is not judged.
        """
        at_first = module.levels_at_first(levels, kept)
        passes = ((Asked(at_first), at_first.keys(), True), (Asked(levels), levels.keys() - (kept or ()), False))
        for asked, bound, becomes in passes:
            for rule in self._rules.values():
                if rule.axis is None and rule.config.of in bound:
                    level = asked.levels[rule.config.of]
                    # an output that is let go of may become anything, so every rule of it binds
                    kind = None if level is None else InterlockKind.HIGH if level else InterlockKind.LOW
                    if kind in (None, *rule.kinds):
                        yield rule, asked, becomes

    # -- watched -----------------------------------------------------------------------------------------------------

    async def run(self) -> None:
        """Look at the motions under way, at each change of an input and often enough, until cancelled."""
        if not self._rules:
            return
        async with asyncio.TaskGroup() as group:
            while True:
                try:
                    # once a second even where only outputs are bound: overrides end by time
                    async with asyncio.timeout(min(self._period_s, 1.0)):
                        await self._changed.wait()
                except TimeoutError:
                    pass
                self._changed.clear()
                for rule in self._rules.values():
                    if rule.override:
                        self._goes_on(rule, rule.override)
                for own in self._of_axes:
                    self._look(own, group)

    def _look(self, own: AxisRules, group: asyncio.TaskGroup) -> None:
        """End the motion of an axis where one of its rules does not hold; each rule reacts once for a motion."""
        axis = own.axis
        status = axis.tracker.status
        # one that is not heard any more may hear, and goes on with what it did
        if status.link is not LinkState.DOWN:
            own.moved = status.rest.rests is False or is_commanded(status)
        moves = status.energised and own.moved
        moves = moves and not own.hold(self._version, self._now_s())
        for rule in own.rules:
            lacks = self._lacks(rule, WATCHED) if moves and self._binds(rule, axis, status) else ()
            if lacks and not rule.reacted:
                self._react(axis, rule, lacks, group)
            rule.reacted = bool(lacks)

    def _react(self, axis: AxisService, rule: BoundRule, lacks: Sequence[Lack], group: asyncio.TaskGroup) -> None:
        name, reaction = axis.config.name, LossPolicy(rule.config.reaction)
        text = in_words(lacks)
        log.warning("interlock violated", axis=name, interlock=rule.config.name, reason=text, reaction=reaction.value)
        error = self._violation(rule, f"axis {name}", lacks)
        reason = f"{error.message}; reaction: {reaction.value}"
        self._events.note(name, INTERLOCK, CommandStatus.ABORTED, reason, code=error.code.value)
        status = axis.tracker.status
        if status.link is not LinkState.DOWN:  # else it has no command any more
            own = status.command.command_id if status.command else None
            # the end of the command gives this as its reason
            axis.tracker.take(CommandFailing(own, error.message, f"{rule.config.name}: {text}"))
        group.create_task(axis.stops.bring_to_rest(STOP_MODES[reaction]), name=f"interlock {rule.config.name}")

    def _binds(self, rule: BoundRule, axis: AxisService, status: AxisStatus) -> bool:
        """Tell whether a rule is to end the motion under way; one without a command is of any kind."""
        if rule.config.reaction == "none":
            return False
        kinds, command = rule.kinds, status.command
        if command is None or status.state is AxisState.STOPPING:
            if not any(kind in MOTIONS for kind in kinds):
                return False
        elif InterlockKind(kind_of(command.verb)) not in kinds:
            return False
        return rule.config.above is None or speed_of(axis) > rule.config.above

    # -- overridden --------------------------------------------------------------------------------------------------

    def override(self, command: OverrideInterlock) -> OverrideReply:
        """Lift a rule for a time, under a lease.

        Raises:
            ValueOutOfRange: there is no such rule.
            LdcndError: as `Authority.admit`: the lease does not cover what it binds.
        """
        rule = self._rules.get(command.interlock)
        if rule is None:
            known = ", ".join(self._rules) or "none"
            raise ValueOutOfRange(
                f"there is no interlock {command.interlock!r}; there are: {known}", value=command.interlock, limit=known
            )
        client = ""
        for holder in rule.holders:
            client = self._authority.admit(holder, command.lease, None, self._now_s()) or client
        if command.seconds > 0:
            rule.override = Override(self._now_s() + command.seconds, command.lease, client)
            self._say(rule, CommandStatus.EXECUTING, f"overridden for {command.seconds:g} s: {command.reason}", client)
        elif rule.override:
            self._end_override(rule, rule.override, "taken back")
        return OverrideReply(interlock=command.interlock, seconds=command.seconds, client=client)

    def overrides(self, axis: str) -> tuple[str, ...]:
        """Return in words which rules are overridden that bind an axis or an output of its line."""
        now_s = self._now_s()
        return tuple(
            f"interlock {rule.config.name} is overridden by {rule.override.client or 'somebody'}"
            f" for {max(1, math.ceil(rule.override.until_s - now_s))} s still"
            for rule in self._rules.values()
            if rule.override and axis in rule.holders
        )

    def _goes_on(self, rule: BoundRule, override: Override) -> bool:
        """Tell whether an override is still in force; one that is not is ended."""
        now_s = self._now_s()
        if override.until_s <= now_s:
            self._end_override(rule, override, "its time is over")
            return False
        try:
            for holder in rule.holders:
                self._authority.check_held(holder, override.lease, now_s)
        except LdcndError:
            self._end_override(rule, override, "the lease of its client has ended")
            return False
        return True

    def _end_override(self, rule: BoundRule, override: Override, cause: str) -> None:
        rule.override = None
        self._say(rule, CommandStatus.DONE, f"binds again: {cause}", override.client)

    def _say(self, rule: BoundRule, status: CommandStatus, reason: str, client: str) -> None:
        log.warning("interlock override", interlock=rule.config.name, reason=reason, client=client)
        reason = f"interlock {rule.config.name} {reason}"
        self._events.note(rule.holders[0], OverrideInterlock.verb, status, reason, client=client)
