"""One PIC-I/O of a line: polls its inputs, sets its outputs, and records them, as they cannot be read back.

Nothing is written at start-up, after a reset or when the module comes back after a loss of power: its lines are inputs
then and stay so until a request changes them. Source: PIC-I/O data sheet, 2.2, 3.1.
"""

import asyncio
from collections.abc import Callable, Iterable, Mapping

from typing_extensions import override

from ldcnd.bus.bus import Bus
from ldcnd.bus.poller import Poller, next_on_grid
from ldcnd.drivers.ldcn.pic_io import (
    ALL_LINES,
    LINES,
    MOST_PWM,
    IoItem,
    IoNode,
    IoStatus,
    SetDirection,
    SetOutput,
    SetPwm,
    SetSynchOutput,
    SetTimerMode,
    SynchOutput,
    read_io_status,
    send_io_command,
)
from ldcnd.drivers.network import IoDriver, IoReading, ModuleEntry
from ldcnd.errors import BusError, ValueOutOfRange, WrongState
from ldcnd.exchange import Exchange, Timing

CAPTURED = IoItem.CAPTURED_LEVELS | IoItem.CAPTURED_COUNTER
ITEMS = IoItem.LEVELS | IoItem.ADC1 | IoItem.ADC2 | IoItem.ADC3 | IoItem.COUNTER


def poll_io(address: int) -> Exchange[IoStatus]:
    """Return the question for all inputs of a PIC-I/O."""
    return read_io_status(IoNode(address), ITEMS)


class IoModule(Poller[IoStatus], IoDriver):
    """One such module.

    Attributes:
        status: the latest status byte; None while it does not answer.
    """

    def __init__(self, bus: Bus, entry: ModuleEntry) -> None:
        self.name = entry.name
        self.node = entry.address
        self.status: int | None = None
        self.due_at_s = asyncio.get_running_loop().time()
        self.deadline_at_s = self.due_at_s
        self.observed: Callable[[IoReading, Timing], None] = lambda _reading, _timing: None
        self.lost: Callable[[], None] = lambda: None
        self.proof = bus.proofs.expect(entry.address, f"module {entry.name}")
        self._bus = bus
        self._node = IoNode(entry.address)
        self._period_s = 1.0 / entry.rate_hz
        self._allowed = _mask(entry.outputs)
        self._exchange = poll_io(entry.address)
        self._outputs: int | None = 0
        self._latch = 0
        self._pwm: tuple[int, int] | None = (0, 0)

    def forget(self) -> None:
        """The module was reset or lost power: all lines are inputs, PWM is 0."""
        self._outputs, self._latch, self._pwm = 0, 0, (0, 0)

    def adopted(self) -> None:
        """The module was taken over as it is: what is an output cannot be read."""
        self._outputs, self._latch, self._pwm = None, 0, None

    # -- polling -----------------------------------------------------------------------------------------------------

    @override
    def next_exchange(self, now_s: float) -> Exchange[IoStatus]:
        self.due_at_s = next_on_grid(self.due_at_s, self._period_s, now_s)
        self.deadline_at_s = self.due_at_s + self._period_s
        return self._exchange

    @override
    def deliver(self, reply: IoStatus, timing: Timing) -> None:
        self.status = 0
        self.observed(self._reading(reply), timing)

    @override
    def missed(self, error: BusError) -> None:
        self.status = None
        self.lost()

    def _reading(self, status: IoStatus) -> IoReading:
        levels = status.levels or 0
        pwm = self._pwm
        return IoReading(
            levels=tuple(bool(levels & 1 << bit) for bit in range(LINES)),
            outputs=None if self._outputs is None else _lines(self._outputs),
            adc=(status.adc1 or 0, status.adc2 or 0, status.adc3 or 0),
            counter=status.counter or 0,
            pwm=None if pwm is None else (pwm[0] / MOST_PWM, pwm[1] / MOST_PWM),
        )

    # -- commands ----------------------------------------------------------------------------------------------------

    @override
    async def set_outputs(
        self, levels: Mapping[int, bool], inputs: frozenset[int], pwm: tuple[float | None, float | None]
    ) -> IoReading:
        self._check(levels, inputs)
        before = self._outputs
        told = _mask(levels) | _mask(inputs)
        if before is None and (told & self._allowed != self._allowed or None in pwm):
            raise WrongState(
                f"module {self.name} was taken over as it is: what its outputs are is not known",
                value=self.name,
                remedy=f"name its lines {', '.join(map(str, _lines(self._allowed)))} and both PWM outputs at once",
            )
        pwm_after = self._pwm_after(pwm)
        if levels or inputs:
            outputs = ((before or 0) | _mask(levels)) & ~_mask(inputs)
            high = _mask(line for line, level in levels.items() if level)
            latch = (self._latch & ~_mask(levels) | high) & outputs
            if outputs != before:
                self._outputs = None  # not known until the module has acknowledged it
                await self._bus.execute(send_io_command(self._node, SetDirection(~outputs & ALL_LINES)))
                self._outputs = outputs
            if pwm_after:
                await self._switch_together(latch, *pwm_after)
            else:
                await self._bus.execute(send_io_command(self._node, SetOutput(latch)))
            self._latch = latch
        elif pwm_after:
            self._pwm = None
            await self._bus.execute(send_io_command(self._node, SetPwm(*pwm_after)))
        self._pwm = pwm_after or self._pwm
        return self._reading(await self._bus.execute(self._exchange))

    def _pwm_after(self, pwm: tuple[float | None, float | None]) -> tuple[int, int] | None:
        """Return the new values of both PWM outputs; None when the request leaves them alone."""
        if pwm == (None, None):
            return None
        known = self._pwm or (0, 0)
        pwm1, pwm2 = (old if new is None else round(new * MOST_PWM) for new, old in zip(pwm, known, strict=True))
        return pwm1, pwm2

    async def _switch_together(self, latch: int, pwm1: int, pwm2: int) -> None:
        """Let lines and PWM outputs change in the same cycle of the module.

        Only this module is addressed: in a group with servos Synch Output is Start Motion.
        """
        self._pwm = None
        await self._bus.execute(send_io_command(self._node, SetSynchOutput(latch, pwm1, pwm2)))
        await self._bus.execute(send_io_command(self._node, SynchOutput()))

    async def captured(self) -> IoStatus:
        """Return the levels and the count that the latest Synch Input has captured."""
        return await self._bus.execute(read_io_status(self._node, CAPTURED))

    @override
    async def set_timer(self, *, enabled: bool, counts_edges: bool, prescale: int) -> None:
        await self._bus.execute(send_io_command(self._node, SetTimerMode(enabled, counts_edges, prescale)))

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
