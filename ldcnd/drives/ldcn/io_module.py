"""One PIC-I/O of a line: polls its inputs, sets its outputs, and records in a book what cannot be read back.

Set Direction and Set Output write all lines at once. So that a line keeps its state when another one is written, that
state must be known: of an output whose level is not, the level of its pin is read ("should match", data sheet, 2.2);
what is an output cannot be read, and neither can PWM values.

Nothing is written at start-up, after a reset or when the module comes back after a loss of power: its lines are inputs
then and stay so until a request changes them. Source: PIC-I/O data sheet, 2.2, 3.1.
"""

import asyncio
from collections.abc import Callable, Collection, Iterable, Mapping
from contextlib import nullcontext
from dataclasses import replace
from functools import partial

from typing_extensions import override

from ldcnd.contract.errors import BadReply, BusError, LdcndError, OutcomeUnknown, RegisterUnknown, ValueOutOfRange
from ldcnd.contract.meta import Provenance
from ldcnd.contract.samples import IoReading
from ldcnd.drives.ldcn.access import agreed
from ldcnd.drives.ldcn.config import ModuleConfig
from ldcnd.drives.ldcn.packet import check_status
from ldcnd.drives.ldcn.pic_io import (
    ALL_LINES,
    LINES,
    MOST_PWM,
    IoCommand,
    IoItem,
    IoNode,
    IoStatus,
    SetDirection,
    SetOutput,
    SetPwmOutputs,
    SetSynchOutput,
    SetTimerMode,
    SynchOutput,
    read_io_status,
    send_io_command,
    timer_control,
)
from ldcnd.drives.ldcn.profiles import PIC_IO, identify
from ldcnd.drives.ldcn.registers import TAKEN_OVER, Assumed, RegisterBook
from ldcnd.drives.network import IoDriver
from ldcnd.drives.toml import DeviceIdentity
from ldcnd.line.bus import Bus
from ldcnd.line.exchange import Exchange, Poller, ReplyVerdict, Timing, next_on_grid
from ldcnd.line.proof import only_while

CAPTURED = IoItem.CAPTURED_LEVELS | IoItem.CAPTURED_COUNTER
DIRECTIONS = {line: f"direction {line}" for line in range(1, LINES + 1)}
"""By line: whether it is an output."""
LEVELS = {line: f"output {line}" for line in range(1, LINES + 1)}
"""By line: the level that it has, or would have, as an output."""
PWM = ("pwm 1", "pwm 2")
TIMER = "timer"
ITEMS = IoItem.LEVELS | IoItem.ADC1 | IoItem.ADC2 | IoItem.ADC3 | IoItem.COUNTER | IoItem.IDENTITY
TELLING_APART = (IoItem(0), IoItem.CAPTURED_LEVELS, IoItem.CAPTURED_COUNTER, CAPTURED)
"""What the first, second, third and fourth of these modules on a line send besides: it makes the lengths differ."""
IDENTITY_AT = 10
"""Where the identity stands among the bytes of a reply."""


def poll_io(entry: ModuleConfig, nth: int) -> Exchange[IoStatus]:
    """Return the question for all inputs of a PIC-I/O.

    A status packet does not say of whom it is, and inputs may permit motion: so that the reply of a drive or of another
    such module, which comes late, is none of this one, a reply has its identity, and a length of its own.

    Args:
        entry: of the module.
        nth: it is the nth of these modules on its line, from 0.
    """
    exchange = read_io_status(IoNode(entry.address), ITEMS | TELLING_APART[nth % len(TELLING_APART)])
    return replace(exchange, check=partial(_check_is_of, entry.identity))


def _nothing_forbids() -> None:
    """Let packets pass to a module that is known to be this one."""


def _check_is_of(identity: DeviceIdentity | None, data: bytes) -> ReplyVerdict:
    verdict = check_status(data)
    if verdict is not ReplyVerdict.INTACT:
        return verdict
    device_id, version = data[IDENTITY_AT : IDENTITY_AT + 2]
    is_of = identify(device_id, version) is PIC_IO if identity is None else (device_id, version) == identity
    return verdict if is_of else ReplyVerdict.CORRUPT


class IoModule(Poller[IoStatus], IoDriver):
    """One such module.

    Attributes:
        status: the latest status byte; None while it does not answer.
    """

    def __init__(self, bus: Bus, entry: ModuleConfig, nth: int) -> None:
        self.name = entry.name or ""
        self.node = entry.address
        self.inputs, self.outputs = entry.inputs, entry.outputs
        self.status: int | None = None
        self.due_at_s = asyncio.get_running_loop().time()
        self.deadline_at_s = self.due_at_s
        self.observed: Callable[[IoReading, Timing], None] = lambda _reading, _timing: None
        self.lost: Callable[[], None] = lambda: None
        self.gone: Callable[[], None] = lambda: None
        self.proof = bus.proofs.expect(entry.address, f"module {entry.name}")
        self._bus = bus
        self._node = IoNode(entry.address)
        self.period_s = 1.0 / entry.rate
        self._allowed = _mask(each.line for each in entry.outputs.values())
        self._exchange = poll_io(entry, nth)
        names = (*DIRECTIONS.values(), *LEVELS.values(), *PWM, TIMER)
        self._book = RegisterBook(names, lambda: asyncio.get_running_loop().time())
        self.restarted = False
        self._pins_decide = False  # the next reading shows which outputs are as this host has left them

    def may_have_restarted(self) -> None:
        """A reset is about to be sent, which the module may obey or not."""
        self._book.forget("a reset was sent, and whether the module was reset is not known")

    def forget(self) -> None:
        """The module was reset or lost power: all lines are inputs, PWM is 0, the timer is off (data sheet, 2.2)."""
        names = (*DIRECTIONS.values(), *LEVELS.values(), *PWM, TIMER)
        self._book.note(dict.fromkeys(names, 0), Provenance.RESET)
        self.restarted = True

    def adopted(self) -> None:
        """The module was taken over as it is: what is an output cannot be read.

        Outputs that this host had written before are assumed to be as they were, until their pins show whether they
        are: another host may have had the module meanwhile. Lines that are not configured as outputs count as inputs,
        and become that with the first write, which says the direction of all: the configuration says that something
        else drives them.
        """
        held = {line: level for line in _lines(self._allowed) if (level := self.written(line)) is not None}
        self._pins_decide = bool(held)
        self._book.forget(TAKEN_OVER)
        for line, level in held.items():
            self._book.assume({DIRECTIONS[line]: 1, LEVELS[line]: int(level)}, "this host has written it before")
        inputs = [DIRECTIONS[line] for line in DIRECTIONS if not self._allowed & 1 << line - 1]
        self._book.assume(dict.fromkeys(inputs, 0), "the configuration does not list the line as an output")

    # -- polling -----------------------------------------------------------------------------------------------------

    @override
    def next_exchange(self, now_s: float) -> Exchange[IoStatus]:
        self.due_at_s = next_on_grid(self.due_at_s, self.period_s, now_s)
        self.deadline_at_s = self.due_at_s + self.period_s
        return self._exchange

    @override
    def deliver(self, reply: IoStatus, timing: Timing) -> None:
        # no bit of it is defined but that of a checksum error (PIC-I/O data sheet, 3.2)
        self.status = 0
        if self._pins_decide:
            self._compare(reply.levels or 0)
        self.observed(self._reading(reply), timing)

    def _compare(self, levels: int) -> None:
        """Take each output that is assumed to be as it was for known, or for unknown, by the level of its pin."""
        self._pins_decide = False
        for line, name in LEVELS.items():
            if isinstance(held := self._book[name], Assumed):
                if held.value == levels >> line - 1 & 1:
                    self._book.note({DIRECTIONS[line]: 1, name: held.value}, Provenance.READ_BACK)
                else:
                    self._book.forget(TAKEN_OVER, (DIRECTIONS[line], name))

    @override
    def missed(self, error: BusError) -> None:
        self.status = None
        self.lost()

    def _reading(self, status: IoStatus) -> IoReading:
        levels = status.levels or 0
        directions = [self._book.known(DIRECTIONS[line]) for line in _lines(self._allowed)]
        outputs = tuple(line for line, out in zip(_lines(self._allowed), directions, strict=True) if out)
        pwm1, pwm2 = (self._book.known(name) for name in PWM)
        return IoReading(
            levels=tuple(bool(levels & 1 << bit) for bit in range(LINES)),
            outputs=None if None in directions else outputs,
            adc=(status.adc1 or 0, status.adc2 or 0, status.adc3 or 0),
            counter=status.counter or 0,
            pwm=None if pwm1 is None or pwm2 is None else (pwm1 / MOST_PWM, pwm2 / MOST_PWM),
        )

    @override
    def written(self, line: int) -> bool | None:
        level = self._book.known(LEVELS[line]) if self._book.known(DIRECTIONS[line]) else None
        return None if level is None else bool(level)

    @override
    def turning(self, lines: Iterable[int]) -> Mapping[int, bool | None]:
        turning = [line for line in lines if not self._book.known(DIRECTIONS[line])]
        # "0 or the last driven level": the data sheet says neither (3.1)
        return {line: False if self._book.known(LEVELS[line]) == 0 else None for line in turning}

    @override
    def is_output(self, line: int) -> bool | None:
        direction = self._book.known(DIRECTIONS[line])
        return None if direction is None else bool(direction)

    # -- commands ----------------------------------------------------------------------------------------------------

    @override
    async def set_outputs(
        self, levels: Mapping[int, bool], inputs: frozenset[int], pwm: tuple[float | None, float | None]
    ) -> IoReading:
        self._check(levels, inputs)
        pwm_after = self._pwm_after(pwm)
        if levels or inputs:
            directions = dict.fromkeys(levels, 1) | dict.fromkeys(inputs, 0)
            asked = {DIRECTIONS[line]: out for line, out in directions.items()}
            # a set bit makes an input
            turned = None if self._book.holds(asked) else SetDirection(~self._mask_after(asked) & ALL_LINES)
            latch = await self._levels_after(levels, directions)
            # before the levels: Set Output ignores the bits of inputs (data sheet, 3.1)
            if turned:
                with self._book.writing(asked) as sent:
                    await self._tell(turned, sent)
            written = {LEVELS[line]: int(level) for line, level in levels.items()}
            # what has become an output gets its level, whatever has come meanwhile: it has another one until then
            with only_while(_nothing_forbids) if turned else nullcontext():
                if pwm_after:
                    await self._switch_together(latch, pwm_after, written)
                else:
                    with self._book.writing(written) as sent:
                        await self._tell(SetOutput(latch), sent)
        elif pwm_after:
            with self._book.writing(dict(zip(PWM, pwm_after, strict=True))) as sent:
                await self._tell(SetPwmOutputs(*pwm_after), sent)
        return self._reading(await self._bus.execute(self._exchange))

    async def _tell(self, command: IoCommand, sent: Callable[[], None]) -> None:
        """Send a command twice, see `Exchange.unseen`; the second time whatever has come meanwhile: it is carried out.

        Raises:
            OutcomeUnknown: it was acknowledged once, and could not be told again.
            LdcndError: as `Bus.execute`, of the first time.
        """
        exchange = replace(send_io_command(self._node, command), unseen=False)
        await self._bus.execute(exchange, sent=sent)
        try:
            with only_while(_nothing_forbids):
                await self._bus.execute(exchange, sent=sent)
        except LdcndError as error:
            raise OutcomeUnknown(
                f"module {self.name}: acknowledged once, but {error.message}",
                remedy="set the outputs again, and look at what they switch",
            ) from error

    @override
    async def drive(self, levels: Mapping[int, bool]) -> IoReading:
        self._check(levels, frozenset())
        latch = await self._levels_after(levels, dict.fromkeys(levels, 1))
        with self._book.writing({LEVELS[line]: int(level) for line, level in levels.items()}) as sent:
            await self._tell(SetOutput(latch), sent)
        return self._reading(await self._bus.execute(self._exchange))

    @override
    async def levels_to_keep(self, written: Collection[int]) -> Mapping[int, bool]:
        if self._book.holds({DIRECTIONS[line]: 1 for line in written}):
            return {}  # no direction is told, and the pin of a line that is not named says its level
        maybe = [line for line in _lines(self._allowed) if self._book.known(DIRECTIONS[line]) != 0]
        unknown = [line for line in maybe if self.written(line) is None]
        return await self._shown(unknown) if unknown else {}

    def _mask_after(self, asked: Mapping[str, int]) -> int:
        """Return which lines are outputs once these directions are written.

        Raises:
            RegisterUnknown: what another line that may be an output is used as is not known.
        """
        outputs = 0
        for line, name in DIRECTIONS.items():
            out = asked.get(name, self._book.known(name))
            if out is None and self._allowed & 1 << line - 1:
                raise self._unknown(f"whether line {line} is an output", f"name line {line}, too")
            outputs |= bool(out) << line - 1
        return outputs

    async def _levels_after(self, levels: Mapping[int, bool], directions: Mapping[int, int]) -> int:
        """Return the word of Set Output in which every line that is not named keeps the level that its pin has."""
        kept = [line for line in _lines(self._allowed) if line not in directions]
        # an input ignores its bit, and may change all the time; if it may be an output, it keeps what its pin shows
        may_drive = [line for line in kept if self._book.known(DIRECTIONS[line]) != 0]
        unknown = [line for line in may_drive if self._book.known(LEVELS[line]) is None]
        shown: Mapping[int, bool] = await self._shown(unknown) if unknown else {}
        read = {LEVELS[line]: high for line, high in shown.items() if self._book.known(DIRECTIONS[line])}
        self._book.note(read, Provenance.READ_BACK)
        high = {line for line, level in levels.items() if level}
        for line in kept:
            level = self._book.known(LEVELS[line])
            if shown.get(line) if level is None else level:
                high.add(line)
        return _mask(high)

    async def _shown(self, lines: Collection[int]) -> Mapping[int, bool]:
        """Return the levels that pins show, true for high, once two replies agree.

        Raises:
            BadReply: they do not.
        """

        async def read() -> Mapping[int, bool]:
            levels = (await self._bus.execute(self._exchange)).levels or 0
            return {line: bool(levels >> line - 1 & 1) for line in lines}

        shown = await agreed(read)
        if shown is None:
            raise BadReply(
                f"module {self.name}: its replies contradict each other about its outputs; nothing was set",
                value=self.name,
                remedy="check the line for noise, then send it again",
            )
        return shown

    def _unknown(self, what: str, remedy: str) -> RegisterUnknown:
        return RegisterUnknown(f"module {self.name}: {what} is not known", value=self.name, remedy=remedy)

    def _pwm_after(self, pwm: tuple[float | None, float | None]) -> tuple[int, int] | None:
        """Return the new values of both PWM outputs; None when the request leaves them alone.

        Raises:
            RegisterUnknown: the one that the request does not name is not known.
        """
        if pwm == (None, None):
            return None
        values = []
        for name, new in zip(PWM, pwm, strict=True):
            value = self._book.known(name) if new is None else round(new * MOST_PWM)
            if value is None:
                raise self._unknown(f"what {name} is set to", "name both PWM outputs at once")
            values.append(value)
        return values[0], values[1]

    async def _switch_together(self, latch: int, pwm: tuple[int, int], written: Mapping[str, int]) -> None:
        """Let lines and PWM outputs change in the same cycle of the module.

        Only this module is addressed: in a group with servos Synch Output is Start Motion.
        """
        with self._book.writing({**written, **dict(zip(PWM, pwm, strict=True))}) as sent:
            await self._bus.execute(send_io_command(self._node, SetSynchOutput(latch, *pwm)), sent=sent)
            await self._tell(SynchOutput(), sent)

    async def captured(self) -> IoStatus:
        """Return the levels and the count that the latest Synch Input has captured."""
        return await self._bus.execute(read_io_status(self._node, CAPTURED))

    @override
    async def set_timer(self, *, enabled: bool, counts_edges: bool, prescale: int) -> None:
        mode = SetTimerMode(enabled, counts_edges, prescale)
        with self._book.writing({TIMER: timer_control(mode)}) as sent:
            await self._bus.execute(send_io_command(self._node, mode), sent=sent)

    def _check(self, levels: Mapping[int, bool], inputs: frozenset[int]) -> None:
        for line in (*levels, *inputs):
            if not 1 <= line <= LINES or (line in levels and not self._allowed & 1 << line - 1):
                allowed = ", ".join(map(str, _lines(self._allowed))) or "none"
                raise ValueOutOfRange(
                    f"module {self.name}: line {line} is not configured as an output; those are {allowed}",
                    value=line,
                    limit=allowed,
                    remedy="configure it in `outputs` of the module, if nothing else drives it",
                )
        if both := sorted(inputs & levels.keys()):
            raise ValueOutOfRange(f"module {self.name}: line {both[0]} cannot be both", value=both[0])


def _mask(lines: Iterable[int]) -> int:
    return sum(1 << line - 1 for line in set(lines))


def _lines(mask: int) -> tuple[int, ...]:
    return tuple(bit + 1 for bit in range(LINES) if mask & 1 << bit)
