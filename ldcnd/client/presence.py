"""Presence of daemons: reports each that comes and each that goes, without queries."""

from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager

from ldcnd.messaging.keys import ALL_RUNS, Keys
from ldcnd.messaging.session import Session

OnDaemon = Callable[[str, str, bool], None]
"""Learns that of a rig a run of the daemon has appeared (True) or vanished (False)."""


@asynccontextmanager
async def daemons(session: Session, on_daemon: OnDaemon) -> AsyncIterator[None]:
    """Tell of every daemon that can be reached, first of those that are there, for the time of the context."""

    def changed(key: str, alive: bool) -> None:  # noqa: FBT001 - a callback of the session
        keys = Keys.of(key)
        on_daemon(keys.rig, keys.parse_alive(key).instance, alive)

    declaration = await session.watch_tokens(ALL_RUNS, changed)
    try:
        yield
    finally:
        await declaration.close()
