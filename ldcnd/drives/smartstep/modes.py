"""Entering, executing and leaving an operating mode on a line that loses replies; clearing a pulse counter by one.

None of the three commands is repeated blindly. Entering and leaving are known by reading 2000H. A lost execute cannot
be distinguished from a lost reply while a trace waits for its trigger, so the mode is left, entered again and executed
again: what ran before has ended then, and nothing is executed twice in one stay.
Source: manual 2.1 (resending), 4, settings 1 and 2; 5 and 6.
"""

import asyncio
import contextlib

from ldcnd.contract.errors import (
    BadReply,
    BusyTracing,
    LdcndError,
    OutcomeUnknown,
    Remedy,
    ReplyTimeout,
    WrongState,
    step,
)
from ldcnd.drives.parameter_access import ClearedCounter
from ldcnd.drives.smartstep.addresses import OperatingMode
from ldcnd.drives.smartstep.commands import execute, read_monitor, set_operating_mode
from ldcnd.drives.smartstep.monitors import (
    REFERENCE_PULSE_SPEED,
    SPEED_FEEDBACK,
    Counter,
    CounterReading,
    CounterValue,
)
from ldcnd.drives.smartstep.words import Words
from ldcnd.log import get_logger

log = get_logger("smartstep")

LEAVE_S = 5.0
"""Leaving a mode takes no longer, whatever the line does."""
ENTER_ATTEMPTS = 3
EXECUTE_ATTEMPTS = 5
CLEAR_CHECK_PERIOD_S = 0.05
CLEAR_S = 2.0
"""Longest time for a counter clear after its execute, in seconds; the manual gives none."""
CLEAR_MODES = (OperatingMode.COMMAND_COUNTER_CLEAR, OperatingMode.FEEDBACK_COUNTER_CLEAR)


async def require_idle(words: Words) -> None:
    """Make sure that the drive is in its normal mode; a counter clear that a dead host left behind is left.

    Raises:
        BusyTracing: it traces, or was left in Data Trace Mode.
        WrongState: it is in a mode that the manual does not list.
    """
    mode = await words.mode()
    if mode == OperatingMode.DATA_TRACE:
        raise BusyTracing(
            f"axis {words.axis}: busy tracing",
            axis=words.axis,
            remedy=Remedy("wait for the end of the trace, or {}", step("trace_abort")),
        )
    if mode in CLEAR_MODES:
        # Leaving clears nothing (manual 5 (2), 6 (2)), and the axis carries out one command at a time: it is not ours.
        log.warning("counter clear left behind is left", axis=words.axis, mode=f"{mode:04X}H")
        await enter(words, OperatingMode.NORMAL)
    elif mode != OperatingMode.NORMAL:
        raise WrongState(
            f"axis {words.axis}: operating mode {mode:04X}H, which the manual does not list, is under way",
            axis=words.axis,
            value=f"{mode:04X}H",
            remedy="end what another program does with the drive, or switch the drive off and on",
        )


async def end_mode(words: Words) -> OperatingMode | None:
    """Leave the mode that was left behind; return it, or None when the drive was in its normal mode.

    Raises:
        WrongState: it is in a mode that the manual does not list.
        BusError: the line failed.
    """
    mode = await words.mode()
    if mode == OperatingMode.NORMAL:
        return None
    if not isinstance(mode, OperatingMode):
        await require_idle(words)
        return None
    await enter(words, OperatingMode.NORMAL)
    return mode


async def enter(words: Words, mode: OperatingMode) -> None:
    """Enter a mode; when the reply is lost the mode itself tells whether it was entered.

    Raises:
        OutcomeUnknown: the mode does not show.
    """
    for _ in range(ENTER_ATTEMPTS):
        try:
            await words.ask(set_operating_mode(words.unit, mode))
        except OutcomeUnknown:
            # the reply was lost, not the setting
            if await words.mode() == mode:
                return
        else:
            return
    raise OutcomeUnknown(f"axis {words.axis}: operating mode {mode:04X}H could not be entered", axis=words.axis)


async def execute_mode(words: Words, mode: OperatingMode) -> tuple[float, float]:
    """Execute a mode that was entered; when the reply is lost, leave it, enter it again and execute it again.

    Returns:
        Between which instants it was executed, in loop time.

    Raises:
        OutcomeUnknown: every attempt got lost; the caller leaves the mode.
    """
    loop = asyncio.get_running_loop()
    for _ in range(EXECUTE_ATTEMPTS):
        sent_s = loop.time()
        try:
            await words.ask(execute(words.unit))
        except OutcomeUnknown:
            log.warning("reply to execute lost", axis=words.axis, mode=mode.name.lower())
            await enter(words, OperatingMode.NORMAL)
            await enter(words, mode)
        else:
            return sent_s, loop.time()
    raise OutcomeUnknown(
        f"axis {words.axis}: no reply to {EXECUTE_ATTEMPTS} attempts to execute operating mode {mode:04X}H",
        axis=words.axis,
        remedy="find the cause of the line's losses before trying again",
    )


async def leave(words: Words) -> None:
    """Go back to the normal mode, so that nothing is left armed; bounded, whatever the line does."""
    with contextlib.suppress(TimeoutError):
        async with asyncio.timeout(LEAVE_S):
            while True:
                try:
                    await enter(words, OperatingMode.NORMAL)
                # a line that loses packets is no reason to leave it armed, `LEAVE_S` is
                except (ReplyTimeout, OutcomeUnknown):
                    continue
                except LdcndError as error:
                    log.error("operating mode not left", axis=words.axis, reason=error.message)
                return
    log.error("operating mode not left in time", axis=words.axis)


# -- counters --------------------------------------------------------------------------------------------------------


async def read_counter(words: Words, counter: Counter) -> CounterValue:
    """Read a counter whose halves no latch holds together.

    Raises:
        BadReply: it moves too fast to be read, or was cleared meanwhile.
        BusError: the line failed.
    """
    loop = asyncio.get_running_loop()
    cleared, reading = words.clears.over, CounterReading(counter)
    while reading.wanted:
        reading.take(await words.read(reading.wanted.address), loop.time())
    if cleared is None or cleared != words.clears.over:
        raise BadReply(
            f"axis {words.axis}: the {counter.name.lower()} counter was cleared while it was read",
            axis=words.axis,
            remedy="read it again",
        )
    if reading.value is None:
        raise BadReply(f"axis {words.axis}: the {counter.name.lower()} counter moves too fast to be read")
    return reading.value


async def clear_counter(words: Words, counter: Counter) -> ClearedCounter:
    """Clear a counter, and read it.

    Raises:
        WrongState: command pulses come in, the motor turns, or another operation is under way.
        BusyTracing: the drive traces.
        OutcomeUnknown: the drive did not come back to its normal mode; it was put back.
        BusError: the line failed.
    """
    await _require_rest(words, counter)
    await require_idle(words)
    with words.clears.clearing():
        try:
            await enter(words, counter.clear_mode)
            await execute_mode(words, counter.clear_mode)
            await _wait_until_done(words)
        # on cancellation, too: nothing else ends a mode that was entered and not executed
        except BaseException:
            await leave(words)
            raise
    value = (await read_counter(words, counter)).signed
    log.info("counter cleared", axis=words.axis, counter=counter.name.lower(), value=value)
    if value == 0:
        return ClearedCounter(value)
    remark = f"the counter reads {value} after its clear: pulses came in, or the shaft moved, since then"
    return ClearedCounter(value, (remark,))


async def _require_rest(words: Words, counter: Counter) -> None:
    """Require that command pulses are stopped, as the notes of manual 5 and 6 want, and a motor that stands.

    The display of the pulse speed may round slow pulses to 0, so the low half of the input counter is read twice.
    """
    low = Counter.COMMAND.low.address
    before = await words.read(low)
    pulses_rpm = await words.ask(read_monitor(words.unit, REFERENCE_PULSE_SPEED))
    if pulses_rpm or await words.read(low) != before:
        raise WrongState(
            f"axis {words.axis}: command pulses come in ({pulses_rpm} r/min); a counter is cleared without them",
            axis=words.axis,
            value=pulses_rpm,
            limit=0,
            remedy="stop the pulses first",
        )
    speed = await words.ask(read_monitor(words.unit, SPEED_FEEDBACK)) if counter is Counter.FEEDBACK else 0
    if speed:
        raise WrongState(
            f"axis {words.axis}: the feedback counter is cleared at standstill only; the motor turns at {speed} r/min",
            axis=words.axis,
            value=speed,
            limit=0,
            remedy="wait until the motor stands",
        )


async def _wait_until_done(words: Words) -> None:
    loop = asyncio.get_running_loop()
    give_up_at_s = loop.time() + CLEAR_S
    # "when the clear process is completed the mode returns to Normal Mode" (manual 5 (2), 6 (2))
    while await words.mode() != OperatingMode.NORMAL:
        if loop.time() > give_up_at_s:
            raise OutcomeUnknown(
                f"axis {words.axis}: the counter was not cleared within {CLEAR_S:g} s",
                axis=words.axis,
                remedy=Remedy("{} again", step("clear_counter")),
            )
        await asyncio.sleep(CLEAR_CHECK_PERIOD_S)
