"""A network that loses some commands of a client, or their answers on the way back."""

import asyncio
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from typing import Any

from ldcnd.contract.errors import OutcomeUnknown
from ldcnd.net.hand_over import Answer
from ldcnd.net.session import QUERY_TIMEOUT_S
from ldcnd.testing.memory_session import MemorySession


@contextmanager
def losing(session: MemorySession, *, answers: Collection[str] = (), commands: Collection[str] = ()) -> Iterator[None]:
    """Lose what a session asks, by the verb, until the context ends; what is under way then stays lost.

    Args:
        session: of the client.
        answers: verbs of commands that arrive and are carried out, and whose answers are lost.
        commands: verbs of commands that do not arrive.
    """
    ask = session.query

    async def query(key: str, payload: bytes = b"", *, timeout_s: float = QUERY_TIMEOUT_S, **how: Any) -> list[Answer]:
        loop, verb = asyncio.get_running_loop(), key.rpartition("/")[2]
        until_s = loop.time() + timeout_s
        if verb not in commands:
            answered = await ask(key, payload, timeout_s=timeout_s, **how)
            if verb not in answers:
                return answered
        await asyncio.sleep(until_s - loop.time())
        raise OutcomeUnknown(f"{key}: no answer within {timeout_s:g} s; it may be carried out all the same")

    vars(session)["query"] = query
    try:
        yield
    finally:
        del vars(session)["query"]
