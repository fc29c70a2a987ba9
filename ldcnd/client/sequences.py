"""A sequence at work: its steps one after the other, as a client of the rig that anybody else could be, too."""

import asyncio
from collections.abc import AsyncIterator, Awaitable, Callable, Mapping, Sequence
from contextlib import AsyncExitStack, suppress
from types import MappingProxyType

from ldcnd.client.axis import Axis, at_rest
from ldcnd.client.calmed import until_calmed
from ldcnd.client.motion import Motion, State
from ldcnd.client.rig import Rig
from ldcnd.contract.catalogue import AXIS_COMMANDS
from ldcnd.contract.commands import CommandReply, Effect, Verb
from ldcnd.contract.condition import way_to_rest
from ldcnd.contract.errors import CommandExpired, ConfigError, LdcndError, Remedy, WrongState
from ldcnd.contract.errors import step as remedy_step
from ldcnd.contract.events import CommandEvent, CommandStatus
from ldcnd.contract.meta import AxisInfo
from ldcnd.contract.samples import IoSample, Moving, Quality, StateSample, TelemetryItem
from ldcnd.contract.sequences import NamedPosition, SequenceConfig, SequenceStep, StepReport
from ldcnd.contract.units import POSITION, quantity_text

LEASE_S = 2.0
"""The daemon applies `loss.client` so soon when this program disappears, seconds."""
CALMED_S = 1.0
"""Longest time that a step goes on which the halt of another client has not ended itself, seconds."""
NAMED_S = 4.0
"""Longest wait for who has stopped what a step was refused behind, seconds: an event that was missed is fetched."""
FULL_PERCENT = 100.0


class SequenceRun:
    """One run of a sequence.

    Args:
        rig: the rig.
        sequence: what is done.
        positions: the named positions, by name.
        report: gets what happens to each step; the record is made of it.
        now_ns: UTC in ns since 1970.
        who: the name under which it takes control; that of the sequence when missing. Control that the program has
            under the same name is replaced.
        after_stops: the `stops` of its axes' states when it was asked for; with others it does not begin.

    Attributes:
        going: cleared, the next step waits to begin; a motion under way is not touched.
    """

    def __init__(
        self,
        rig: Rig,
        sequence: SequenceConfig,
        positions: Mapping[str, NamedPosition],
        report: Callable[[StepReport], None],
        now_ns: Callable[[], int],
        who: str | None = None,
        after_stops: Mapping[str, int] = MappingProxyType({}),
    ) -> None:
        self._after_stops = after_stops
        self._who = who or f"sequence {sequence.name}"
        self.going = asyncio.Event()
        self.going.set()
        self._rig = rig
        self._sequence = sequence
        self._positions = positions
        self._report = report
        self._override = FULL_PERCENT  # the least of the step under way, percent
        self._now_ns = now_ns
        self._axes: dict[str, Axis] = {}
        self._calmed: asyncio.Future[WrongState]
        self._watching: list[asyncio.Task[None]] = []
        self._left: dict[str, str] = {}  # commands of motions that go on beside later steps, by axis
        self._group: asyncio.TaskGroup
        self._units: dict[str, AxisInfo] = {}
        self._modules: dict[str, str] = {}  # by the names of their lines

    async def run(self, first: int = 1, *, force: bool = False) -> None:
        """Carry it out under control of its axes, of all axes of the rig if it writes outputs.

        Whatever ends it early halts the axes whose motions have not ended; outputs stay as they are.

        Args:
            first: number of the step with which it begins.
            force: take control from its holder.

        Raises:
            LdcndError: a step was refused or has failed; nothing after it was begun.
        """
        steps = self._sequence.step
        if not 1 <= first <= len(steps):
            raise ConfigError(f"sequence {self._sequence.name} has no step {first}", value=first, limit=len(steps))
        stood = await self._check_stand(steps[first - 1 :])
        axes = () if self._sequence.writes else self.used
        async with AsyncExitStack() as held:
            controlled = await held.enter_async_context(self._rig.controlled(axes, self._who, LEASE_S, force=force))
            self._axes = {axis.name: axis for axis in controlled}
            self._units = {info.axis: info for info in await self._rig.describe()}
            self._modules = await self._lines()
            events = await held.enter_async_context(self._rig.events())
            self._calmed = asyncio.get_running_loop().create_future()
            # a halt that came while control was asked for is in no event from here on
            states = await self._rig.states()
            self._check_not_stopped(states, {axis: stood[axis] for axis in self._axes.keys() & stood.keys()})
            # the daemon refuses all that is sent behind another one, however soon
            for axis in controlled:
                if axis.control and axis.name in states and (count := states[axis.name].stops) is not None:
                    axis.control.after_stops[axis.name] = count
            try:
                async with asyncio.TaskGroup() as self._group:
                    group = self._group
                    stops = [
                        group.create_task(self._see_stop(axis), name=f"stops of {axis.name}")
                        for axis in self._axes.values()
                    ]
                    stops.append(group.create_task(self._see_calm(events), name=f"halts in {self._sequence.name}"))
                    for number in range(first, len(steps) + 1):
                        await self._carry_out(number, steps[number - 1])
                    self._left.clear()
                    for each in (*stops, *self._watching):
                        each.cancel()
            except* LdcndError as errors:
                raise errors.exceptions[0] from None

    async def _see_stop(self, axis: Axis) -> None:
        """End the sequence when one of its axes is stopped, by any client: others would be moved beside it.

        Raises:
            WrongState: it is.
            LeaseExpired: control was lost.
        """
        latched = axis.state.sample.stop_latched
        while True:
            await axis.news(None)
            self._override = min(self._override, axis.state.sample.speed_override)
            before, latched = latched, axis.state.sample.stop_latched
            if latched and not before:
                raise WrongState(
                    f"axis {axis.name} was stopped; sequence {self._sequence.name} ends",
                    axis=axis.name,
                    remedy=Remedy("look why, then {}", remedy_step("reset")),
                )

    async def _see_calm(self, events: AsyncIterator[CommandEvent]) -> None:
        """End the sequence when another client halts an axis, or switches it off: its next step may move another one.

        Raises:
            WrongState: one did.
        """
        calmed = await until_calmed(events, self._axes, self._who, f"sequence {self._sequence.name}")
        self._calmed.set_result(calmed)
        await asyncio.sleep(CALMED_S)  # a step that it has aborted says more
        raise calmed

    async def _check_stand(self, steps: Sequence[SequenceStep]) -> dict[str, int | None]:
        """Refuse to control an axis that another program moves: to give up its control again would halt that motion.

        Returns:
            The stops of the axes that stand. What moves, to be brought to rest by a step, may be halted by the end of
            its holder's control.

        Raises:
            WrongState: it moves.
            CommandExpired: an axis was stopped after the run was asked for.
        """
        states, brought_to_rest = await self._rig.states(), set[str]()
        self._check_not_stopped(states, self._after_stops)
        for step in steps:
            brought_to_rest.update(step.standstill)
            sent = [*self._positions[step.go].axes] if step.go else []
            verb = Verb(step.do) if step.do and step.axis else None
            if verb is Verb.HALT:
                brought_to_rest.add(str(step.axis))
            elif verb and AXIS_COMMANDS[verb].effect is Effect.MOTION:
                sent.append(str(step.axis))
            for axis in sent:
                if axis not in brought_to_rest and axis in states:
                    self._refuse_moving(axis, states[axis])
        others = set(self._rig.axes) - brought_to_rest if self._sequence.writes else set()
        for axis in sorted(others & states.keys()):
            self._refuse_moving(axis, states[axis])
        return {name: state.stops for name, state in states.items() if state.moving is Moving.NO}

    def _check_not_stopped(self, states: Mapping[str, StateSample], stops: Mapping[str, int | None]) -> None:
        for axis in sorted(stops.keys() & states.keys()):
            if states[axis].stops != stops[axis]:
                raise CommandExpired(
                    f"axis {axis}: a stop, halt or power off came after this was asked for; sequence"
                    f" {self._sequence.name} has begun nothing",
                    axis=axis,
                    remedy="look at the axis, then begin it again",
                )

    def _refuse_moving(self, axis: str, state: StateSample) -> None:
        if state.moving is Moving.YES:
            raise WrongState(
                f"axis {axis} is {state.state.words}; sequence {self._sequence.name} has begun nothing",
                axis=axis,
                remedy=way_to_rest(state.state),
            )

    @property
    def used(self) -> tuple[str, ...]:
        """The axes that it moves, or waits for."""
        return self._sequence.used(self._positions)

    async def _lines(self) -> dict[str, str]:
        lines: dict[str, str] = {}
        for module in [each.name for bus in await self._rig.buses() for each in bus.modules if each.name]:
            sample = await self._rig.latest(module, TelemetryItem.IO)
            lines |= dict.fromkeys(sample.named, module) if isinstance(sample, IoSample) else {}
        return lines

    async def _carry_out(self, number: int, step: SequenceStep) -> None:
        loop = asyncio.get_running_loop()

        def report(event: str, took_s: float | None = None, reason: str | None = None) -> None:
            about = {"sequence": self._sequence.name, "step": number, "of": len(self._sequence.step)}
            said = {"title": self._title(step), "event": event, "t": self._now_ns(), "took_s": took_s, "reason": reason}
            self._report(StepReport.model_validate(about | said))

        if not self.going.is_set():
            report("paused")
            await self.going.wait()
        report("begun")
        began_s = loop.time()
        self._override = (
            min(axis.state.sample.speed_override for axis in self._axes.values()) if self._axes else FULL_PERCENT
        )
        try:
            await self._unless_calmed(self._within(number, step))
            await self._stay_uncalmed(step.pause_s)
        except LdcndError as error:
            report("failed", loop.time() - began_s, str(error))
            raise
        except BaseException:
            report("stopped", loop.time() - began_s, "what it moves is halted")
            raise
        slowed = self._moves(step) and self._override < FULL_PERCENT
        report("done", loop.time() - began_s, f"at a speed override of {self._override:g} %" if slowed else None)

    async def _unless_calmed(self, doing: Awaitable[None]) -> None:
        """Carry a step out; if the daemon refuses one of its commands because an axis was stopped, say by which client.

        Raises:
            LdcndError: as it, or as `_see_calm`.
        """
        try:
            await doing
        except CommandExpired:
            await self._stay_uncalmed(NAMED_S)
            raise

    async def _stay_uncalmed(self, seconds: float) -> None:
        """Wait, for no longer than until another client halts an axis; where one has done so before, not at all.

        Raises:
            WrongState: as `_see_calm`, which waits for what a step may say of it.
        """
        with suppress(TimeoutError):
            async with asyncio.timeout(seconds):
                raise await asyncio.shield(self._calmed)

    def _moves(self, step: SequenceStep) -> bool:
        is_motion = step.do and step.axis and AXIS_COMMANDS[Verb(step.do)].effect is Effect.MOTION
        return bool(step.go or is_motion)

    def _title(self, step: SequenceStep) -> str:
        return step.title(self._units, self._positions)

    async def _within(self, number: int, step: SequenceStep) -> None:
        seen: dict[str, bool | None] = dict.fromkeys(step.until)
        try:
            async with asyncio.timeout(step.timeout_s):
                await self._write(step.set)
                await self._command(step)
                for axis in step.standstill:
                    await at_rest(self._axes[axis], None)
                if step.until:
                    await self._come(step, seen)
        except TimeoutError:
            words = [f"{name} is {'not known' if each is None else str(each).lower()}" for name, each in seen.items()]
            words += [f"{axis} moves: {self._axes[axis].state.sample.moving.value}" for axis in step.standstill]
            raise WrongState(
                f"sequence {self._sequence.name}: step {number}, {self._title(step)}, is not over within"
                f" {step.timeout_s:g} s{': ' if words else ''}{', '.join(words)}",
                limit=step.timeout_s,
            ) from None

    async def _write(self, levels: Mapping[str, bool]) -> None:
        """Write outputs, those of one module in one request: after a take-over none is written without the others."""
        of_module: dict[str, dict[int | str, bool]] = {}
        for name, high in levels.items():
            module, _, number = name.partition(".")
            if not number and name not in self._modules:
                raise WrongState(f"output {name}: its module has not been seen", value=name)
            lines = of_module.setdefault(module if number else self._modules[name], {})
            lines[int(number) if number else name] = high
        for module, lines in of_module.items():
            await self._rig.set_io(
                module, high=[each for each in lines if lines[each]], low=[each for each in lines if not lines[each]]
            )

    async def _command(self, step: SequenceStep) -> None:
        for axis in (*(self._positions[step.go].axes if step.go else ()), *([step.axis] if step.axis else ())):
            self._left.pop(axis, None)
        for axis, place in self._positions[step.go].axes.items() if step.go else ():
            self._arrived(axis, await (await self._axes[axis].move_absolute(place)).done())
        if step.do and step.axis:
            done = await getattr(self._axes[step.axis], step.do)(**step.arguments)
            if isinstance(done, Motion) and step.leave_running:
                self._left[step.axis] = done.reply.command_id
                ends = self._see_end(done.reply)
                self._watching.append(
                    self._group.create_task(ends, name=f"end of {step.axis} in {self._sequence.name}")
                )
            elif isinstance(done, Motion):
                self._arrived(step.axis, await done.done())

    async def _see_end(self, reply: CommandReply) -> None:
        """End the sequence when a motion that goes on beside it ends otherwise than it should.

        Raises:
            OutcomeUnknown: as `RigClient.end_of`.
            WrongState: it was ended by something else than a later step.
        """
        _, outcome = await self._rig.client.end_of(reply)
        if self._left.get(reply.axis) == reply.command_id and outcome.status is not CommandStatus.DONE:
            raise WrongState(
                f"axis {reply.axis}: {outcome.reason or outcome.status}; sequence {self._sequence.name} ends",
                axis=reply.axis,
                remedy="look why, then begin it again",
            )

    def _arrived(self, axis: str, end: State) -> None:
        """Go on only from where an axis was sent: the next step may open what relies on it."""
        if end.settled is False and end.following_error is not None:
            off = quantity_text(end.following_error, self._units[axis], POSITION)
            raise WrongState(
                f"axis {axis} has not settled at its target, it is {off} off; sequence {self._sequence.name} ends",
                axis=axis,
                value=end.following_error,
                remedy="look for a jam, at the load, the gains and the encoder",
            )

    async def _come(self, step: SequenceStep, seen: dict[str, bool | None]) -> None:
        """Wait until lines have their values, as read since the step began."""
        async with self._rig.samples(item=TelemetryItem.IO) as samples:
            while seen != dict(step.until):
                _, sample = await anext(samples)
                # what was read before is published again, of another quality, where a module falls silent
                if isinstance(sample, IoSample):
                    good = sample.quality is Quality.GOOD
                    seen |= {name: value if good else None for name, value in sample.named.items() if name in seen}
