"""Samples of the daemon of a rig, apart from those that other programs publish on the same keys.

Zenoh lets every login that may publish put a value on the key of an axis. A sample names the session that has published
it, as an answer names the one that has answered; the daemon is the one whose description was found.
"""

import asyncio
from collections import deque
from collections.abc import Awaitable, Callable
from contextlib import suppress

from ldcnd.contract.errors import LdcndError, MalformedRequest, PayloadTooLarge
from ldcnd.net.session import OnSample, Publication

HELD_SAMPLES = 4096
"""Maximum number of samples of an unknown session that wait until the daemon is found; the oldest are dropped."""
TRIES, RETRY_S = 4, 0.5
"""Number of queries for the daemon of a rig that does not answer, and the time between them in seconds: one that starts
may publish before it answers."""
RIVAL_S = 1.0
"""Time for which a session that is not the daemon's counts as another one without a further query, in seconds."""
KEPT_RIVALS = 64
"""Maximum number of sessions that are known as others; one that comes back behind so many counts as new."""


def _ignore() -> None:
    pass


class Origin:
    """The session of the daemon of a rig.

    Attributes:
        source: names it; None until the daemon is found, empty where the network does not say.
        rivals: the other sessions, the one that published last behind; at most `KEPT_RIVALS`.
        dropped: number of samples of other sessions that were dropped.
        on_rival: called when a sample of a session that was not known was dropped.
    """

    def __init__(self, find: Callable[[], Awaitable[object]]) -> None:
        self.source: str | None = None
        self.rivals: dict[str, None] = {}
        self.dropped = 0
        self.on_rival: Callable[[], None] = _ignore
        self._find = find
        self._gates: list[OwnSamples] = []

    def drop(self, sample: Publication) -> None:
        """Count a sample that is not the daemon's."""
        self.dropped += 1
        is_new = sample.source not in self.rivals
        self.rivals.pop(sample.source, None)
        self.rivals[sample.source] = None
        if len(self.rivals) > KEPT_RIVALS:
            del self.rivals[next(iter(self.rivals))]
        if is_new:
            self.on_rival()

    def found(self, source: str) -> None:
        """Take this session for the daemon's from now on, also for the samples that wait."""
        self.source = source
        for gate in self._gates:
            gate.release()

    def gate(self, take: OnSample) -> "OwnSamples":
        """Return what hands on the samples of the daemon alone; to be closed."""
        gate = OwnSamples(self, self._find, take)
        self._gates.append(gate)
        return gate

    def forget(self, gate: "OwnSamples") -> None:
        """Leave out a gate that was closed."""
        self._gates.remove(gate)

    def owns(self, sample: Publication) -> bool:
        """Tell whether the daemon has published a sample; every session may have where the network does not say."""
        return self.source in (sample.source, "")


class OwnSamples:
    """Hands on the samples of the daemon, in order; drops and counts the others. Made by `Origin.gate`.

    What cannot be understood, as from a daemon of another version, is left out.
    """

    def __init__(self, origin: Origin, find: Callable[[], Awaitable[object]], take: OnSample) -> None:
        self._origin = origin
        self._find = find
        self._take = take
        self._held: deque[Publication] = deque(maxlen=HELD_SAMPLES)
        self._search: asyncio.Task[None] | None = None
        self._until_s: dict[str, float] = {}  # by session that was not the daemon's, when to ask again

    def admit(self, sample: Publication) -> None:
        """Take a sample of any session."""
        if self._origin.owns(sample):
            self._hand_on(sample)
            return
        loop = asyncio.get_running_loop()
        if loop.time() < self._until_s.get(sample.source, 0.0):
            self._origin.drop(sample)
            return
        self._held.append(sample)
        if self._search is None:
            self._search = loop.create_task(self._look(), name="find the daemon of a sample")

    def release(self) -> None:
        """Hand on what waits and is of the daemon."""
        held = tuple(self._held)
        self._held.clear()
        for sample in held:
            if self._origin.owns(sample):
                self._hand_on(sample)
            else:
                self._held.append(sample)

    def _hand_on(self, sample: Publication) -> None:
        with suppress(MalformedRequest, PayloadTooLarge):
            self._take(sample)

    async def close(self) -> None:
        """End; nothing is handed on any more."""
        self._origin.forget(self)
        if self._search:
            self._search.cancel()
            await asyncio.wait([self._search])

    async def _look(self) -> None:
        """Find out which session is the daemon's now: it may have been restarted."""
        for _ in range(TRIES):
            try:
                await self._find()
                break
            except LdcndError:
                await asyncio.sleep(RETRY_S)
        now_s = asyncio.get_running_loop().time()
        again_s = now_s + RIVAL_S
        self._until_s = {source: until_s for source, until_s in self._until_s.items() if until_s > now_s}
        for sample in self._held:
            self._origin.drop(sample)
            self._until_s[sample.source] = again_s
        self._held.clear()
        self._search = None
