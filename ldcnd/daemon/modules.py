"""I/O modules under their names: named inputs, debounced, and outputs with a level for each situation, read back."""

import asyncio
import math
from collections.abc import AsyncIterator, Callable, Iterable, Mapping, Sequence
from contextlib import asynccontextmanager, suppress
from dataclasses import dataclass, replace
from enum import StrEnum
from itertools import count

from ldcnd.axis.clock import Clock
from ldcnd.axis.permit import Right, always
from ldcnd.contract.errors import (
    BusError,
    CommandAborted,
    InterlockViolated,
    LdcndError,
    MalformedRequest,
    RegisterUnknown,
    Remedy,
    RemedyCommand,
    RequestRefused,
    ShuttingDown,
    ValueOutOfRange,
    step,
)
from ldcnd.contract.events import CommandStatus
from ldcnd.contract.health import ModuleHealth
from ldcnd.contract.rig_commands import IoReply, IoTimer, SetIo, SetIoTimer
from ldcnd.contract.samples import IoReading, LinkState, Quality, TelemetryItem
from ldcnd.daemon.link_events import LinkEvents, Note
from ldcnd.drives.line_config import InputConfig, OutputConfig, OutputLevel
from ldcnd.drives.network import IoDriver
from ldcnd.line.exchange import Timing
from ldcnd.line.proof import MISSES_UNTIL_LOST, Condition, only_while
from ldcnd.log import get_logger
from ldcnd.net.publisher import Publisher

FULL_SCALE_V = 5.0
FULL_SCALE_COUNTS = 255
DIFFERS_AFTER = 2
"""Readings in a row in which a pin shows another level than was written, until that is said; it is unknown at once."""
KNOWN_WITHIN_S = 10.0
"""Longest time for which a level of a situation waits until what its interlocks require is known, seconds."""
APPLIED_AGAIN_S = 0.5
"""Pause before outputs are written again whose packets were lost, seconds."""
READ_AGAIN_S = 1.0
"""Longest wait of a request for the reading of an output that was written before and that it requires, seconds."""
log = get_logger("io")


class Situation(StrEnum):
    """What has happened to a module or its clients, for the levels that its outputs have then."""

    START = "start"
    RESET = "reset"
    CLIENT = "loss.client"
    BUS = "loss.bus"
    DAEMON = "loss.daemon"

    def level_of(self, output: OutputConfig) -> bool | None:
        """Return the level of an output; None to keep it."""
        group, _, key = self.value.rpartition(".")
        level: OutputLevel = getattr(output.loss if group else output, key)
        return None if level == "keep" else level == "high"


@dataclass(frozen=True, slots=True)
class WantedLevel:
    """A level that an output is to have by a situation.

    Attributes:
        level: true for high.
        situation: that calls for it.
        word: its number among all that was said of the outputs of its module: the highest is the newest.
    """

    level: bool
    situation: Situation
    word: int


@dataclass(frozen=True, slots=True)
class Unread:
    """An output that is being written, or that was and has not been read since.

    Attributes:
        before: the value that it had; None where that was not known.
        read_at_s: when that was read, in loop time.
        until_s: only what is requested from then on tells its level, in loop time; infinite while it is being written,
            since any reply may be to a request from before.
    """

    before: bool | None
    read_at_s: float
    until_s: float = math.inf


class NamedInput:
    """An input by its name, from the levels that are read.

    Attributes:
        value: true or false once its level has stayed for its time; None before, and while it changes for too long.
        proven_at_s: when a level that had stayed for that time was read last, in loop time; a value that is kept while
            the level changes is as old as that.
    """

    def __init__(self, config: InputConfig, period_s: float) -> None:
        self.line = config.line
        self.value: bool | None = None
        self._inverted = config.inverted
        self._debounce_s = config.debounce_ms / 1e3
        self._unsettled_s = 2 * (self._debounce_s + period_s) + period_s  # from the reading before the first other one
        self.forget()

    def forget(self) -> None:
        """The module is out of reach."""
        self.value = None
        self.proven_at_s = -math.inf
        self._level: bool | None = None
        self._since_s = 0.0

    def take(self, level: bool, at_s: float) -> bool | None:  # noqa: FBT001 - a level
        """Take the level of a reading; return the value."""
        level = level is not self._inverted
        if level is not self._level:
            self._level, self._since_s = level, at_s
        if at_s - self._since_s >= self._debounce_s:
            self.value, self.proven_at_s = level, at_s
        elif at_s - self.proven_at_s > self._unsettled_s:
            self.value = None
        return self.value


class ModuleService:
    """One module under its name.

    Attributes:
        name: as configured.
        axes: on its line, whose leases cover it.
        read_at_s: when the latest reading was requested, in loop time; minus infinity while it is out of reach.
        values: of the named inputs, and the levels of the outputs; None while one is not known.
        unread: outputs of which it is not known what has become of what was written.
        check: raises what forbids to write outputs, each true for high, false for low and None to let go of it; and
            which of them only keep a level, see `levels_at_first`; the interlocks of the rig set it.
        changed: called when one of the values has changed; likewise.
    """

    def __init__(
        self,
        driver: IoDriver,
        publisher: Publisher,
        clock: Clock,
        axes: tuple[str, ...],
        note: Note,
    ) -> None:
        inputs, outputs = driver.inputs, driver.outputs
        self.name = driver.name
        self.axes = axes
        self.read_at_s = -math.inf
        self.check: Callable[[Mapping[str, bool | None], frozenset[str] | None], None] = lambda _levels, _kept: None
        self.changed: Callable[[], None] = lambda: None
        self._note = note
        self._link_events = LinkEvents(note, "the module", "link_lost")
        self._driver = driver
        self._inputs = {name: NamedInput(config, driver.period_s) for name, config in inputs.items()}
        self._outputs = outputs
        self._names = {config.line: name for name, config in outputs.items()}
        self._lines = {name: each.line for name, each in inputs.items()}
        self._lines |= {name: each.line for name, each in outputs.items()}
        self.values: dict[str, bool | None] = dict.fromkeys(self._lines)
        self.unread: dict[str, Unread] = {}
        self._differs = dict.fromkeys(outputs, 0)
        self._known = asyncio.Event()  # what was written was read again, or is out of reach
        self._set: dict[str, bool] = {}  # levels of outputs that were written, until the module loses its power
        self._floating: dict[str, bool] = {}  # those that it has lost so, until they are written again
        self._reading: IoReading | None = None
        self._clock = clock
        self._topic = publisher.item(driver.name, TelemetryItem.IO)
        self._misses = 0
        self._refused: dict[str, tuple[WantedLevel, float]] = {}  # what was told not to be set, and since when
        self._wanted: dict[str, WantedLevel] = {}  # of outputs by name what is yet to be written, the newest last
        self._called_for: dict[str, WantedLevel] = {}  # what a situation has called for last, written or not
        self._words = count(1)
        self._applying = asyncio.Lock()
        self._due = asyncio.Event()
        self._seen = self._ending = False
        self._writes = asyncio.Lock()
        driver.observed, driver.lost, driver.gone = self._observed, self._lost, self._gone

    # -- what is known -----------------------------------------------------------------------------------------------

    @property
    def names(self) -> tuple[str, ...]:
        """Names of its inputs and outputs."""
        return tuple(self._lines)

    @property
    def health(self) -> ModuleHealth:
        """Whether it answers, and what it has lost."""
        link = LinkState.DEGRADED if self._misses else LinkState.UP
        return ModuleHealth(
            module=self.name, link=link if self._reading else LinkState.DOWN, floating=tuple(self._floating)
        )

    def proven_at_s(self, name: str | None) -> float:
        """Return when the value of a line was read last, in loop time; without a name, when the module answered last.

        An input that changes keeps a value of before for a while: it is older than the latest reading.
        """
        own = self._inputs.get(name or "")
        return min(self.read_at_s, own.proven_at_s) if own else self.read_at_s

    def _level(self, name: str, line: int, reading: IoReading) -> bool | None:
        """Return the level of an output: that of its pin, if it is known to be driven and the pin shows that.

        The pin of a line that floats is pulled up: high is no proof that it is driven.
        """
        written, shown = self._driver.written(line), reading.levels[line - 1]
        self._tell_difference(name, written=written, shown=shown)
        return shown if written is shown and name not in self.unread else None

    def _take(self, values: dict[str, bool | None]) -> None:
        if values != self.values:
            self.values = values
            self.changed()

    def _observed(self, reading: IoReading, timing: Timing) -> None:
        # from its address, but perhaps from another module
        if not self._driver.proof.holds:
            self._lost()
            return
        if self._reading is None or self._driver.restarted:
            self._returned()
        # a reply to a request from before the write tells the level of before
        for name in [name for name, each in self.unread.items() if timing.sent_at_s >= each.until_s]:
            del self.unread[name]
        if not self.unread:
            self._known.set()
        # when it was asked for, since the level may have changed directly behind that
        self._misses, self._reading, self.read_at_s = 0, reading, timing.sent_at_s
        values = {
            name: each.take(reading.levels[each.line - 1], timing.true_from_s) for name, each in self._inputs.items()
        }
        for name, config in self._outputs.items():
            values[name] = self._level(name, config.line, reading)
        self._take(values)
        t, t_error_ns = self._clock.stamp(timing)
        self._topic.publish(
            {
                "t": t,
                "t_error_ns": t_error_ns,
                "seq": 0,
                "quality": Quality.GOOD,
                **dict(reading),
                "volts": tuple(value / FULL_SCALE_COUNTS * FULL_SCALE_V for value in reading.adc),
                "named": {name: value for name, value in values.items() if not name.isdigit()},
            }
        )

    def _tell_difference(self, name: str, *, written: bool | None, shown: bool) -> None:
        """Say once that the pin of an output differs from what was written, by the reading that completes the row."""
        before = self._differs[name]
        self._differs[name] = 0 if written in {None, shown} else min(before + 1, DIFFERS_AFTER)
        if written is None or (before, self._differs[name]) != (DIFFERS_AFTER - 1, DIFFERS_AFTER):
            return
        reason = (
            f"output {name} was set {level_word(written)} and its pin shows {level_word(shown)}: check what it drives"
        )
        log.error("output differs", module=self.name, output=name, reason=reason)
        self._note("output_differs", CommandStatus.FAILED, reason, None)

    def _lost(self) -> None:
        self._misses += 1
        if self._misses == MISSES_UNTIL_LOST:
            self._gone()
        self._topic.publish_again(Quality.BAD if self._misses >= MISSES_UNTIL_LOST else Quality.UNCERTAIN)

    def _gone(self) -> None:
        """It is out of reach: nothing is known of its lines."""
        # one that has never answered was not lost
        if self._seen:
            self._link_events.lost()
        self._reading, self.read_at_s = None, -math.inf
        self._known.set()
        for each in self._inputs.values():
            each.forget()
        self._take(dict.fromkeys(self._lines))

    def why_unknown(self, output: str) -> str:
        """Return why the level of an output is not known though the module answers; empty where none was written."""
        if output in self.unread:
            return "it is being written"
        written = self._driver.written(self._outputs[output].line)
        return (
            "" if written is None else f"it was set {level_word(written)} and its pin shows {level_word(not written)}"
        )

    def is_unwritten(self, output: str) -> bool:
        """Tell whether no level of an output is known to be written, as after a take-over or a loss of power."""
        return self._driver.written(self._outputs[output].line) is None

    def levels_to_set(self, wanted: Mapping[str, bool]) -> Mapping[str, bool]:
        """Return the levels that one `set_io` is to name for outputs to get those that are wanted.

        After a take-over none is set without the others: they are named with the levels of their pins, and keep them.
        """
        if (reading := self._reading) is None:
            return wanted
        kept = (name for name in self._outputs if self.is_unwritten(name))
        return {name: reading.levels[self._outputs[name].line - 1] for name in kept} | dict(wanted)

    def levels_at_first(
        self, levels: Mapping[str, bool | None], kept: frozenset[str] | None = None
    ) -> Mapping[str, bool | None]:
        """Return the levels that outputs have before these are written to them, of those that become outputs by that.

        By name; None where it may be either level. Left out is what is no change: the level that the pin has. Left out
        of a request by a person is also each output whose level is not known, which could not be written otherwise.

        Args:
            levels: that are to be written, by name.
            kept: those of them that nobody has asked for, so that they keep the levels of their pins; None where all
                were asked for by a person.
        """
        names = {self._outputs[name].line: name for name, level in levels.items() if level is not None}
        shown = {line: self._reading.levels[line - 1] for line in names} if self._reading else {}
        found: dict[str, bool | None] = {}
        for line, first in self._driver.turning(names).items():
            name, pin = names[line], shown.get(line)
            either = first is None and self._driver.is_output(line) is None
            # first is not known: it has the level of its pin, or the one it is to have. The second is judged with the
            # request, but for what only keeps its level (kept)
            harmless = (kept is None or levels[name] is not pin) if either else first is pin
            if pin is None or not harmless:
                found[name] = first
        return found

    # -- commands ----------------------------------------------------------------------------------------------------

    async def set_io(self, command: SetIo, right: Right) -> IoReply:
        """Set outputs, if the sender still may and the interlocks allow it when their packets are sent.

        Args:
            command: the request.
            right: of the sender, in time until the first packet of it is sent.

        Raises:
            MalformedRequest: a line is named twice.
            ValueOutOfRange: there is no such name.
            CommandAborted: a situation has called for another level of one of them since this was asked for.
            LdcndError: as `IoDriver.set_outputs`, as the right, or as an interlock.
        """
        high, low, inputs = (self._numbers(lines) for lines in (command.high, command.low, command.inputs))
        levels: dict[int, bool] = dict.fromkeys(high, True) | dict.fromkeys(low, False)
        if twice := sorted(set(high) & set(low)):
            raise MalformedRequest(f"module {self.name}: line {twice[0]} cannot be high and low", value=twice[0])
        word = next(self._words)
        named = [self._names[line] for line in (*levels, *inputs) if line in self._names]

        def still_wanted() -> None:
            self._check_open()
            right.holds()
            self._check_seen(named)
            for name in named:
                self._check_newest(name, word)

        wanted_by = Right(still_wanted, right.in_time)
        reading = await self._write(levels, frozenset(inputs), (command.pwm1, command.pwm2), wanted_by)
        for name in named:
            if (wanted := self._wanted.get(name)) and wanted.word < word:
                del self._wanted[name]
                log.info("level not written", module=self.name, output=name, of=wanted.situation.value, why="set since")
        return self._replied(reading)

    def _check_seen(self, names: Iterable[str]) -> None:
        """Refuse outputs of a module that was not read since it came back, if that will call for a level of them.

        Raises:
            CommandAborted: it will.
        """
        if (situation := self._comes_back_as) is None:
            return
        for name in names:
            if situation.level_of(self._outputs[name]) is not None:
                was = "has restarted" if self._driver.restarted else "was out of reach"
                raise CommandAborted(
                    f"module {self.name} {was}: its output {name} gets its level of {situation} first",
                    value=name,
                    remedy="set it again if it is still wanted",
                )

    @property
    def _comes_back_as(self) -> Situation | None:
        """The situation that the next reading finds; None where it finds none."""
        if self._driver.restarted:
            return Situation.RESET if self._seen else Situation.START
        return Situation.BUS if self._seen and self._reading is None else None

    def _check_newest(self, name: str, word: int) -> None:
        """Refuse what was asked of an output before a situation has called for a level of it.

        Raises:
            CommandAborted: it has.
        """
        newer = self._called_for.get(name)
        if newer and newer.word > word:
            raise CommandAborted(
                f"module {self.name}: since this was asked for, {newer.situation.value} has called for output {name}"
                f" {level_word(newer.level)}",
                value=name,
                remedy="set it again if it is still wanted",
            )

    def _replied(self, reading: IoReading) -> IoReply:
        names = {name: line for name, line in self._lines.items() if not name.isdigit()}
        return IoReply(module=self.name, levels=reading.levels, outputs=reading.outputs, names=names)

    def in_words(self, command: SetIo) -> str:
        """Return what a request sets, by the names of the lines where they have one; empty where it only reads."""
        parts = []
        for lines, level in ((command.high, "high"), (command.low, "low"), (command.inputs, "input")):
            names = [self._names.get(each, f"line {each}") if isinstance(each, int) else each for each in lines]
            parts += [f"{name} {level}" for name in names]
        for number, duty in ((1, command.pwm1), (2, command.pwm2)):
            parts += [] if duty is None else [f"PWM output {number} {duty:.1%}"]
        return ", ".join(parts)

    def _numbers(self, lines: Sequence[int | str]) -> tuple[int, ...]:
        for line in lines:
            if isinstance(line, str) and line not in self._lines:
                known = ", ".join(self._lines) or "none"
                raise ValueOutOfRange(
                    f"module {self.name}: there is no line {line!r}; its names are {known}", value=line, limit=known
                )
        return tuple(self._lines[line] if isinstance(line, str) else line for line in lines)

    async def _write(
        self,
        levels: Mapping[int, bool],
        inputs: frozenset[int],
        pwm: tuple[float | None, float | None],
        right: Right,
        *,
        of_situation: bool = False,
    ) -> IoReading:
        """Write outputs, if right and interlocks allow it when the packets are sent.

        With of_situation, outputs of which nothing is known are named too, with the levels of their pins, which are
        known from then on. A client must name them itself.
        """
        async with self._writes:
            self._check(right.holds)
            right.in_time()
            kept: Mapping[int, bool] = await self._driver.levels_to_keep(levels) if of_situation else {}
            names = frozenset(self._names[line] for line in kept.keys() - levels) if of_situation else None
            levels = {**kept, **levels}
            asked: dict[str, bool | None] = {self._names[line]: None for line in inputs if line in self._names}
            asked |= {self._names[line]: level for line, level in levels.items() if line in self._names}

            async with self._writing(asked, right, names):
                try:
                    reading = await self._driver.set_outputs(levels, inputs, pwm)
                except RegisterUnknown as error:
                    raise (pwm == (None, None) and self._left_out(asked)) or error from None
            for name, level in asked.items():
                self._floating.pop(name, None)
                self._set.pop(name, None)
                if level is not None:
                    self._set[name] = level
            if names:
                log.info("outputs taken up", module=self.name, outputs=sorted(names))
            return reading

    @asynccontextmanager
    async def _writing(
        self, asked: Mapping[str, bool | None], right: Right, kept: frozenset[str] | None
    ) -> AsyncIterator[None]:
        """Note that outputs are written, and have the packets of the body sent only while that is allowed.

        Motions ask for these outputs, as this asks for motions, so it is noted first of all: never do both pass. Behind
        the body outputs are known by a reading that is requested from then on.

        Args:
            asked: the levels, as of `check`.
            right: of who asks for them.
            kept: as of `check`.

        Raises:
            LdcndError: what forbids it before anything is sent; then nothing is noted any more.
        """
        in_time = right.in_time

        def permitted() -> None:
            right.holds()
            self.check(asked, kept)

        def may_go() -> None:
            nonlocal in_time
            in_time()
            permitted()
            in_time = always  # what has begun is brought to its end, however late

        while True:
            self._check(right.holds)
            values = self.values
            changes = [name for name, level in asked.items() if level is None or level is not values[name]]
            self._take(values | dict.fromkeys(changes))
            try:
                permitted()
                break
            except LdcndError as error:
                self._take(values)
                # it may require an output that was written directly before
                if not (isinstance(error, InterlockViolated) and await self._come_to_be_known()):
                    raise
        unread = {name: self.unread.get(name) or Unread(values[name], self.read_at_s) for name in changes}
        self.unread |= {name: replace(each, until_s=math.inf) for name, each in unread.items()}
        try:
            with only_while(may_go):
                yield
        finally:
            # also after an error: which of the packets have arrived is not known
            self._known.clear()
            now_s = asyncio.get_running_loop().time()
            self.unread |= {name: replace(each, until_s=now_s) for name, each in unread.items()}

    def _left_out(self, asked: Mapping[str, bool | None]) -> RegisterUnknown | None:
        """Return the refusal of a request that leaves out outputs of which nothing is known; None if it names all."""
        unknown = [name for name in self._outputs if self.is_unwritten(name) and name not in asked]
        if not unknown:
            return None
        lines = ", ".join(
            f"line {name}" if name.isdigit() else f"{name} (line {self._lines[name]})" for name in unknown
        )
        levels = self.levels_to_set({name: level for name, level in asked.items() if level is not None})
        remedy = Remedy("{}, with the levels that their pins have", setting(self.name, levels))
        axis: str | None = None
        try:
            self.check(levels, None)
        except InterlockViolated as error:  # what would refuse that, too, is to be led out of first
            remedy, axis = error.remedy or remedy, error.axis
        return RegisterUnknown(
            f"module {self.name}: what was written to outputs {lines} is not known; one request is to name all of them",
            axis=axis,
            value=self.name,
            remedy=remedy,
        )

    async def _come_to_be_known(self) -> bool:
        """Wait until outputs that were written are read again; return False if none was, or they are not in time."""
        if not self.unread:
            return False
        with suppress(TimeoutError):
            async with asyncio.timeout(READ_AGAIN_S):
                await self._known.wait()
        return not self.unread

    async def set_timer(self, command: SetIoTimer, condition: Condition) -> IoReply:
        """Choose what is counted, if the sender still may when the packet is sent.

        Raises:
            LdcndError: as `IoDriver.set_timer`, or as the condition.
        """
        self._check_open()
        self._check(condition)
        enabled, edges = command.mode is not IoTimer.OFF, command.mode is IoTimer.COUNTER
        with only_while(condition):
            await self._driver.set_timer(enabled=enabled, counts_edges=edges, prescale=command.prescale)
        # sets nothing: only its last packet is sent, which reads
        reading = await self._driver.set_outputs({}, frozenset(), (None, None))
        return self._replied(reading)

    def close(self) -> None:
        """Take no level any more but that of the end of the daemon: nobody would be left to take another one back."""
        self._ending = True

    def _check_open(self) -> None:
        if self._ending:
            raise ShuttingDown(f"module {self.name}: the daemon is stopping", value=self.name)

    def _check(self, condition: Condition) -> None:
        """Refuse before anything is noted of outputs: the line asks both again when the turn of a packet has come."""
        if not self._driver.proof.holds:
            raise self._driver.proof.refusal()
        condition()

    # -- situations --------------------------------------------------------------------------------------------------

    def _returned(self) -> None:
        """The module answers for the first time, or again after it was out of reach."""
        situation = self._comes_back_as
        for name, level in self._set.items():
            if self._seen and self.is_unwritten(name) and not self._driver.restarted:
                self._link_events.add(f"output {name}, which was {level_word(level)}, may have another level by now")
        if self._driver.restarted:
            self._floating, self._set = self._floating | self._set, {}
            for name, level in self._floating.items():
                if Situation.RESET.level_of(self._outputs[name]) is None:
                    self._link_events.add(f"output {name}, which was {level_word(level)}, floats until it is set")
        if situation:
            self.enter(situation)
        self._driver.restarted, self._seen = False, True
        self._due.set()  # also for what has happened while nothing could be written
        self._link_events.back()

    def enter(self, situation: Situation) -> None:
        """Have the outputs written that have a level in a situation, once the module is within reach.

        What an earlier situation has called for, and what clients have asked for before, is not written any more.
        """
        if self._ending and situation is not Situation.DAEMON:
            return
        word = next(self._words)
        for name, output in self._outputs.items():
            level = situation.level_of(output)
            if level is not None:
                self._wanted.pop(name, None)
                self._wanted[name] = self._called_for[name] = WantedLevel(level, situation, word)
                self._due.set()

    async def run(self) -> None:
        """Write what situations call for, until cancelled."""
        while True:
            await self._due.wait()
            self._due.clear()
            while self._wanted and self._reading is not None:
                if not await self._write_wanted():
                    await asyncio.sleep(APPLIED_AGAIN_S)

    async def apply(self, situation: Situation) -> None:
        """Write the outputs that have a level in a situation, again until it is known what has become of each."""
        self.enter(situation)
        while True:
            if await self._write_wanted():
                return
            await asyncio.sleep(APPLIED_AGAIN_S)

    async def _write_wanted(self) -> bool:
        """Write what is still wanted when its turn comes, in one request; one that may not be written stays as it is.

        Returns False when packets were lost, the module is out of reach, or what is required is soon known. Where the
        request is refused each level is written by itself: one that is forbidden keeps no other from its output.
        """
        async with self._applying:
            wanted = dict(self._wanted)
            error = await self._write_levels(wanted) if wanted else None
            failures = dict.fromkeys(wanted, error)
            if len(wanted) > 1 and isinstance(error, RequestRefused):
                failures = {name: await self._write_levels({name: level}) for name, level in wanted.items()}
        settled = [self._take_outcome(name, wanted[name], failure) for name, failure in failures.items()]
        return all(settled)

    async def _write_levels(self, wanted: Mapping[str, WantedLevel]) -> LdcndError | None:
        """Write levels in one request; return what has forbidden it, or befallen it."""

        def still_wanted() -> None:
            for name, level in wanted.items():
                if self._wanted.get(name) is not level:
                    raise CommandAborted(f"output {name} is to have another level since", value=name)

        levels = {self._outputs[name].line: each.level for name, each in wanted.items()}
        try:
            await self._write(levels, frozenset(), (None, None), Right(still_wanted), of_situation=True)
        except InterlockViolated as error:
            return await self._drive(levels, still_wanted, error)
        except LdcndError as error:
            return error
        return None

    async def _drive(
        self, levels: Mapping[int, bool], condition: Condition, forbidden: InterlockViolated
    ) -> LdcndError | None:
        """Set levels without making outputs of lines, where a rule forbids no more than that; return what is wrong.

        What was taken over as an output takes its level so, and a line that is none is no brake or lock that waits.
        """
        asked = {self._names[line]: level for line, level in levels.items()}
        try:
            async with self._writes, self._writing(asked, Right(condition), frozenset()):
                reading = await self._driver.drive(levels)
        except LdcndError as error:
            return error
        return None if all(reading.levels[line - 1] is level for line, level in levels.items()) else forbidden

    def _take_outcome(self, name: str, wanted: WantedLevel, error: LdcndError | None) -> bool:
        """Take note of what has become of a level; return False while it is still to be written."""
        said = f"output {name} {level_word(wanted.level)}, its level of {wanted.situation.value}"
        if error is None:
            self._note(wanted.situation.value, CommandStatus.DONE, said, None)
        elif self._wanted.get(name) is wanted:
            now_s = asyncio.get_running_loop().time()
            told, since_s = self._refused.get(name, (None, now_s))
            since_s = since_s if told is wanted else now_s
            # a debounced input is soon known; a level of long ago is not written when something comes back
            waits = _may_wait(error) and now_s - since_s < KNOWN_WITHIN_S
            if not waits or told is not wanted:
                log.warning("output not set", module=self.name, output=name, reason=error.message)
                self._note(
                    wanted.situation.value, CommandStatus.REFUSED, f"not set: {said}: {error.message}", error.code.value
                )
            self._refused[name] = wanted, since_s
            if waits or not self._driver.proof.holds or isinstance(error, BusError):
                return False
        if self._wanted.get(name) is wanted:
            del self._wanted[name]
        return True


def _may_wait(error: LdcndError) -> bool:
    """Tell whether a level that was refused is tried again: what forbids it may pass without anybody's doing."""
    return isinstance(error, RegisterUnknown) or (isinstance(error, InterlockViolated) and error.may_wait)


def setting(module: str, levels: Mapping[str, bool]) -> RemedyCommand:
    """Return the one request that gives outputs of a module their levels, true for high."""
    *others, last = (f"output {name} {level_word(level)}" for name, level in levels.items())
    said = f"set {', '.join(others)} and {last} at once" if others else f"set {last}"
    named = {level_word(at): tuple(name for name, level in levels.items() if level is at) for at in (True, False)}
    return step("set_io", said, module=module, **{word: names for word, names in named.items() if names})


def level_word(level: bool) -> str:  # noqa: FBT001 - a level
    """Return the word for a level of an output."""
    return "high" if level else "low"
