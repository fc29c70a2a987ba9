"""Entering, executing and leaving an operating mode on a line that loses replies; clearing a pulse counter by one.

None of the three commands is repeated blindly: 2000H tells what became of them.
Source: manual 4, settings 1 and 2; 5 and 6.
"""

import asyncio
import contextlib

from ldcnd.drivers.smartstep.addresses import OperatingMode
from ldcnd.drivers.smartstep.commands import execute, read_monitor, set_operating_mode
from ldcnd.drivers.smartstep.monitors import SPEED_FEEDBACK, Counter, CounterReading, CounterValue
from ldcnd.drivers.smartstep.words import Words
from ldcnd.errors import BadReply, BusyTracing, LdcndError, OutcomeUnknown, ReplyTimeout, WrongState
from ldcnd.log import get_logger

log = get_logger("smartstep")

LEAVE_S = 5.0
"""Leaving a mode takes no longer, whatever the line does."""
ENTER_ATTEMPTS = 3


async def require_idle(words: Words) -> None:
    """Look whether the drive is in its normal mode.

    Raises:
        BusyTracing: it traces, or was left in Data Trace Mode.
        WrongState: another operation is under way.
    """
    mode = await words.mode()
    if mode == OperatingMode.DATA_TRACE:
        raise BusyTracing(
            f"axis {words.axis}: busy tracing",
            axis=words.axis,
            remedy="wait for the end of the trace, or send trace_abort",
        )
    if mode != OperatingMode.NORMAL:
        raise WrongState(
            f"axis {words.axis}: operating mode {mode:04X}H is under way",
            axis=words.axis,
            value=f"{mode:04X}H",
            remedy="switch the drive off and on, unless somebody else is at work on it",
        )


async def enter(words: Words, mode: OperatingMode) -> None:
    """Enter a mode; when the reply is lost the mode itself tells whether it was entered.

    Raises:
        OutcomeUnknown: the mode does not show.
    """
    for _ in range(ENTER_ATTEMPTS):
        try:
            await words.ask(set_operating_mode(words.unit, mode))
        except OutcomeUnknown:
            if await words.mode() == mode:
                return
        else:
            return
    raise OutcomeUnknown(f"axis {words.axis}: operating mode {mode:04X}H could not be entered", axis=words.axis)


async def execute_once(words: Words) -> None:
    """Execute the mode; a lost reply is no reason to repeat it, as the mode will tell."""
    try:
        await words.ask(execute(words.unit))
    except OutcomeUnknown:
        log.warning("reply to execute lost", axis=words.axis)


async def leave(words: Words) -> None:
    """Go back to the normal mode, so that nothing is left armed; bounded, whatever the line does."""
    with contextlib.suppress(TimeoutError):
        async with asyncio.timeout(LEAVE_S):
            while True:
                try:
                    await enter(words, OperatingMode.NORMAL)
                except (ReplyTimeout, OutcomeUnknown):
                    continue
                except LdcndError as error:
                    log.error("operating mode not left", axis=words.axis, reason=error.message)
                return
    log.error("operating mode not left in time", axis=words.axis)


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
