"""Finding the bits of the trigger condition word on a drive, by trying words: their figure is lost from the manual.

Two of the sixteen bits enable an edge: with one of them and a level that is never crossed the drive stays armed, with
any other it records at once. With both, any change of what is watched triggers (manual 4 (7)), so the object codes show
by changing one thing at a time: a person turns the shaft by hand with RUN off, and presses RESET. It takes for granted
that one object has the code 0. The registers are working registers; EEPROM is not written, the drive moves nothing.
Source: manual 4, settings 3, 7 and 8.
"""

import asyncio
from collections.abc import Awaitable, Callable, Sequence
from enum import StrEnum
from itertools import combinations

from ldcnd.contract.errors import DataRefused, DriveFault
from ldcnd.drives.smartstep.addresses import OperatingMode, TraceRegister
from ldcnd.drives.smartstep.commands import write_trace_register
from ldcnd.drives.smartstep.modes import enter, execute_mode, leave, require_idle
from ldcnd.drives.smartstep.monitors import INPUT_SIGNALS, InputSignal
from ldcnd.drives.smartstep.profiles import TriggerMap
from ldcnd.drives.smartstep.trace_data import SHORTEST_INTERVAL, DataObject, IoObject, object_word
from ldcnd.drives.smartstep.words import Words

NEVER_CROSSED = 0x3FFF
ARMED_S = 3.0
"""A trace with the shortest interval is over by then unless it waits for a trigger, in seconds."""
EDGES = 2


class Stimulus(StrEnum):
    """The action of a person while the drive waits."""

    TURN = "turn the shaft by hand, RUN off, until the next message"
    PRESS = "press RESET and keep it pressed"
    RELEASE = "let RESET go"


Act = Callable[[Stimulus], Awaitable[None]]
"""Returns when the person does it, or has done it."""


async def find_trigger_map(words: Words, act: Act) -> TriggerMap:
    """Return the bits of a drive; some forty settings of working registers and some minutes.

    Raises:
        DriveFault: the drive does not behave as the manual says; the message says in what.
        BusError: the line failed.
    """
    await require_idle(words)
    search = _Search(words, act)
    try:
        return await search.run()
    finally:
        await leave(words)


class _Search:
    def __init__(self, words: Words, act: Act) -> None:
        self._words = words
        self._act = act

    async def run(self) -> TriggerMap:
        accepted = [bit for bit in (1 << place for place in range(16)) if await self._takes(bit)]
        edges = [bit for bit in accepted if await self._waits(bit, NEVER_CROSSED)]
        if len(edges) != EDGES:
            shown = ", ".join(f"{bit:04X}H" for bit in edges) or "none"
            raise self._odd(f"the edges should be two bits; armed by {shown}")
        both = edges[0] | edges[1]
        others = [bit for bit in accepted if bit not in edges]
        free = [1 << place for place in range(16) if 1 << place not in edges]
        codes = [0, *others, *(first | second for first, second in combinations(free, 2))]
        await self._objects(DataObject.SPEED_FEEDBACK, DataObject.TORQUE_REFERENCE)
        trace1 = await self._code(codes, both, Stimulus.TURN, "the value of trace 1")
        await self._objects(DataObject.TORQUE_REFERENCE, DataObject.SPEED_FEEDBACK)
        left = [code for code in codes if code != trace1]
        trace2 = await self._code(left, both, Stimulus.TURN, "the value of trace 2")
        await self._objects(DataObject.TORQUE_REFERENCE, DataObject.TORQUE_REFERENCE)
        left = [code for code in left if code != trace2]
        io = await self._code(left, both, Stimulus.PRESS, "the signals")
        rising, falling = await self._direction(edges, io)
        return TriggerMap(trace1, trace2, io, rising, falling)

    async def _set(self, register: TraceRegister, value: int) -> None:
        await self._words.ask(write_trace_register(self._words.unit, register, value))

    async def _objects(self, first: DataObject, second: DataObject) -> None:
        await self._set(TraceRegister.TRACE_1_OBJECT, object_word(first, IoObject.RESET))
        await self._set(TraceRegister.TRACE_2_OBJECT, object_word(second, IoObject.RUN))

    async def _takes(self, word: int) -> bool:
        try:
            await self._set(TraceRegister.TRGC1, word)
        except DataRefused:
            return False
        return True

    async def _arm(self, word: int, level: int) -> bool:
        """Start a trace with a trigger word; return False when the drive refuses the word."""
        await self._set(TraceRegister.SMPTMS, SHORTEST_INTERVAL)
        await self._set(TraceRegister.PTRGNO, 0)
        await self._set(TraceRegister.TRGC2, level)
        if not await self._takes(word):
            return False
        await enter(self._words, OperatingMode.DATA_TRACE)
        await execute_mode(self._words, OperatingMode.DATA_TRACE)
        return True

    async def _is_armed(self) -> bool:
        await asyncio.sleep(ARMED_S)
        return await self._words.mode() == OperatingMode.DATA_TRACE

    async def _waits(self, word: int, level: int) -> bool:
        armed = await self._arm(word, level) and await self._is_armed()
        await leave(self._words)
        return armed

    async def _triggers(self, word: int, stimulus: Stimulus) -> bool:
        """Tell whether a drive that waits with this word is triggered by what a person does."""
        if stimulus is Stimulus.PRESS:
            await self._act(Stimulus.RELEASE)
        triggered = False
        if await self._arm(word, 0) and await self._is_armed():
            await self._act(stimulus)
            triggered = not await self._is_armed()
        await leave(self._words)
        return triggered

    async def _code(self, codes: Sequence[int], both: int, stimulus: Stimulus, what: str) -> int:
        for code in codes:
            if await self._triggers(code | both, stimulus):
                return code
        raise self._odd(f"no object code watches {what}")

    async def _direction(self, edges: Sequence[int], io: int) -> tuple[int, int]:
        """Return the rising and the falling edge bit: RESET is pressed, and its level says which way that goes."""
        await self._act(Stimulus.RELEASE)
        before = await self._level()
        first_sees = await self._triggers(io | edges[0], Stimulus.PRESS)
        if before == await self._level():
            raise self._odd("the level of RESET does not change")
        rises = not before
        return (edges[0], edges[1]) if first_sees is rises else (edges[1], edges[0])

    async def _level(self) -> bool:
        return bool(await self._words.read(INPUT_SIGNALS.address) & InputSignal.RESET)

    def _odd(self, what: str) -> DriveFault:
        return DriveFault(
            f"axis {self._words.axis}: {what}; the trigger bits were not found",
            axis=self._words.axis,
            remedy="let the host watch the trigger, as it does without them",
        )
