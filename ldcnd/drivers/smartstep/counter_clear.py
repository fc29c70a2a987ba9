"""Clearing a pulse counter: enter its mode, execute, wait for the normal mode, look.

Nothing moves. The motor must stand all the same: a counter cannot be read rightly while it runs.
Source: manual 5 and 6.
"""

import asyncio

from ldcnd.drivers.smartstep.commands import read_monitor
from ldcnd.drivers.smartstep.counters import Counter, CounterReading, CounterValue
from ldcnd.drivers.smartstep.mode_switch import enter, execute_once, leave, require_idle
from ldcnd.drivers.smartstep.operating_modes import OperatingMode
from ldcnd.drivers.smartstep.status import SPEED_FEEDBACK
from ldcnd.drivers.smartstep.words import Words
from ldcnd.errors import BadReply, OutcomeUnknown, WrongState
from ldcnd.log import get_logger

log = get_logger("smartstep")

LOOK_S = 0.05
GIVE_UP_S = 2.0


async def read_counter(words: Words, counter: Counter) -> CounterValue:
    """Read a counter whose halves no latch holds together.

    Raises:
        BadReply: it moves too fast to be read.
        BusError: the line failed.
    """
    reading = CounterReading(counter)
    while reading.wanted:
        reading.take(await words.read(reading.wanted.address))
    if reading.value is None:
        raise BadReply(f"axis {words.axis}: the {counter.name.lower()} counter moves too fast to be read")
    return reading.value


async def clear_counter(words: Words, counter: Counter) -> int:
    """Clear a counter and return what it counts then.

    Raises:
        WrongState: the motor turns, or another operation is under way.
        BusyTracing: the drive traces.
        OutcomeUnknown: the drive did not come back to its normal mode; it was told to.
        BusError: the line failed.
    """
    await _require_standstill(words)
    await require_idle(words)
    try:
        await enter(words, counter.clear_mode)
        await execute_once(words)
        await _wait_until_done(words)
    except BaseException:
        await leave(words)
        raise
    value = await read_counter(words, counter)
    log.info("counter cleared", axis=words.axis, counter=counter.name.lower(), value=value.signed)
    return value.signed


async def _require_standstill(words: Words) -> None:
    speed = await words.ask(read_monitor(words.unit, SPEED_FEEDBACK))
    if speed:
        raise WrongState(
            f"axis {words.axis}: a counter is cleared at standstill only; the motor turns at {speed} r/min",
            axis=words.axis,
            value=speed,
            limit=0,
            remedy="stop the pulses first",
        )


async def _wait_until_done(words: Words) -> None:
    loop = asyncio.get_running_loop()
    give_up_at_s = loop.time() + GIVE_UP_S
    while await words.mode() != OperatingMode.NORMAL:
        if loop.time() > give_up_at_s:
            raise OutcomeUnknown(
                f"axis {words.axis}: the counter was not cleared within {GIVE_UP_S:g} s",
                axis=words.axis,
                remedy="send clear_counter again",
            )
        await asyncio.sleep(LOOK_S)
