"""Whether any daemon is heard over a session, for programs that serve others for weeks: they say it, and why not."""

import asyncio
from collections.abc import Callable, Collection

from ldcnd.client.rig_client import daemons
from ldcnd.contract.errors import ConfigError, SessionError
from ldcnd.net.session import Session
from ldcnd.net.zenoh_session import open_zenoh_session
from ldcnd.net.zenoh_settings import ZenohSettings

ABSENT_S = 3.0
"""A daemon that is away for a shorter time is being restarted, seconds."""
LOOK_AGAIN_S = 30.0
"""Period of looking again for what keeps it away, seconds."""


async def tell_absence(
    session: Session, settings: ZenohSettings, say: Callable[[str | None], None], rigs: Collection[str] = ()
) -> None:
    """Say why no daemon is heard, and None once one is again; until cancelled.

    Zenoh reports no reason for a link that it cannot open again; opening a second session gives one.

    Args:
        session: over which daemons are heard.
        settings: of that session.
        say: called with the problem when it changes, and with None when a daemon answers again.
        rigs: whose daemons count; those of any rig when empty.
    """
    present: set[tuple[str, str]] = set()
    stirred = asyncio.Event()

    def told(rig: str, instance: str, alive: bool) -> None:  # noqa: FBT001 - called by the client
        if not rigs or rig in rigs:
            (present.add if alive else present.discard)((rig, instance))
            stirred.set()

    async with daemons(session, told):
        said: str | None = None
        while True:
            if not present:
                if await _stirred_within(stirred, ABSENT_S):
                    continue
                problem = await _why(settings, rigs)
                while not present:
                    if problem != said:
                        say(problem)
                        said = problem
                    if not await _stirred_within(stirred, LOOK_AGAIN_S):
                        problem = await _why(settings, rigs)
            if said:
                say(None)
                said = None
            await _stirred_within(stirred, None)


async def _stirred_within(stirred: asyncio.Event, time_s: float | None) -> bool:
    stirred.clear()
    try:
        async with asyncio.timeout(time_s):
            await stirred.wait()
    except TimeoutError:
        return False
    return True


async def _why(settings: ZenohSettings, rigs: Collection[str]) -> str:
    what = f"no daemon of rig {', '.join(sorted(rigs))} is heard" if rigs else "no daemon is heard"
    try:
        async with open_zenoh_session(settings):
            return what
    except (SessionError, ConfigError) as error:
        return f"{what}: {error.message}"
