"""Entering, executing and leaving an operating mode on a line that loses replies.

None of the three commands is repeated blindly: 2000H tells what became of them.
Source: manual 4, settings 1 and 2; 5 (2); 6 (2).
"""

import asyncio
import contextlib

from ldcnd.drivers.smartstep.commands import execute, set_operating_mode
from ldcnd.drivers.smartstep.operating_modes import OperatingMode
from ldcnd.drivers.smartstep.words import Words
from ldcnd.errors import BusyTracing, LdcndError, OutcomeUnknown, ReplyTimeout, WrongState
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
