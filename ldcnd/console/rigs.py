"""All rigs that the console shows, over one session for each endpoint."""

import asyncio
from collections.abc import Callable, Collection
from dataclasses import dataclass
from functools import partial

from ldcnd.certificate import watch_certificate
from ldcnd.client.network import Session, ZenohSettings, open_session
from ldcnd.client.presence import tell_absence
from ldcnd.client.rig_client import RigClient, daemons
from ldcnd.console.latest_values import RUN_TOPIC, LatestValues
from ldcnd.console.replies import EndpointReply, RigReply
from ldcnd.console.rig_watch import RigWatch
from ldcnd.contract.errors import ConfigError, SessionError, UnknownAxis
from ldcnd.contract.frozen import Frozen
from ldcnd.log import get_logger

log = get_logger("console")

OPEN_AGAIN_S = 1.0
"""An endpoint that cannot be reached is tried again so soon; once it was reached, Zenoh itself keeps trying."""
MOST_RIGS = 64


@dataclass(frozen=True, slots=True)
class Endpoint:
    """One session of the console.

    Attributes:
        name: in words.
        settings: of its session.
    """

    name: str
    settings: ZenohSettings


class Rigs:
    """The rigs by name. A name belongs to the endpoint that showed it first: no command reaches a namesake.

    Args:
        values: takes what they publish.
        wanted: these only; none means all.
        lacks: called with the reason why an endpoint cannot be shown, and with None once it can.
        remarks: called with what is to be seen to of the console's login, and with None once it is done.

    Attributes:
        lease_of: gives the lease under which a page controls an axis of a rig, or None.
    """

    def __init__(
        self,
        values: LatestValues,
        wanted: Collection[str] = (),
        lacks: Callable[[str | None], None] = lambda _: None,
        remarks: Callable[[str | None], None] = lambda _: None,
    ) -> None:
        self._values = values
        self._lacks = lacks
        self._remarks = remarks
        self._wanted = frozenset(wanted)
        self.lease_of: Callable[[str, str], str | None] = lambda _rig, _axis: None
        self._watches: dict[str, RigWatch] = {}
        self._endpoints: dict[str, EndpointReply] = {}

    @property
    def names(self) -> tuple[str, ...]:
        """Of all rigs that were ever there."""
        return tuple(sorted(self._watches))

    @property
    def endpoints(self) -> tuple[EndpointReply, ...]:
        """How the sessions are."""
        return tuple(self._endpoints.values())

    def client(self, rig: str) -> RigClient:
        """Return what commands a rig.

        Raises:
            UnknownAxis: there was never such a rig.
        """
        return self._watch(rig).client

    def instance(self, rig: str) -> str | None:
        """Return the run of a rig's daemon that the console shows, or None before it was there."""
        return self._watch(rig).instance

    def control_changed(self, rig: str, axis: str) -> None:
        """Learn that a page has another lease on an axis, or none any more."""
        self._watch(rig).want_why(axis)

    def show_run(self, rig: str, progress: Frozen) -> None:
        """Tell pages how far a sequence is."""
        self._values.tell_of_rig(rig, progress.model_dump(mode="json"), RUN_TOPIC)

    def axes(self, rig: str) -> frozenset[str]:
        """Return the names of a rig's axes, as it described itself last."""
        return self._watch(rig).axes

    async def described(self) -> tuple[RigReply, ...]:
        """Return what the rigs are, by name; a wanted one that was never there too."""
        async with asyncio.TaskGroup() as group:
            asked = [group.create_task(self._watches[rig].described(), name=f"describe {rig}") for rig in self.names]
        unseen = [
            RigReply(name=rig, endpoint="", connected=False, problem="it was not seen yet")
            for rig in self._wanted - self._watches.keys()
        ]
        return tuple(sorted((*(task.result() for task in asked), *unseen), key=lambda rig: rig.name))

    async def run(self, endpoint: Endpoint) -> None:
        """Watch what is behind an endpoint until cancelled."""
        self._endpoints[endpoint.name] = EndpointReply(
            endpoint=endpoint.name, connected=False, problem="not connected yet"
        )
        while True:
            try:
                async with open_session(endpoint.settings) as session, asyncio.TaskGroup() as group:
                    group.create_task(self._follow_absence(session, endpoint), name=f"daemons at {endpoint.name}")
                    group.create_task(
                        watch_certificate(session.certificate, self._remarks), name=f"certificate for {endpoint.name}"
                    )
                    await self.watch(session, endpoint)
            except (SessionError, ConfigError) as error:
                self._note(endpoint, problem=error.message)
                await asyncio.sleep(OPEN_AGAIN_S)

    async def watch(self, session: Session, endpoint: Endpoint) -> None:
        """Watch the rigs of a session until cancelled."""
        self._note(endpoint, problem=None)
        async with asyncio.TaskGroup() as group:

            def told(rig: str, instance: str, alive: bool) -> None:  # noqa: FBT001 - called by the client
                if self._wanted and rig not in self._wanted:
                    return
                watch = self._watches.get(rig)
                if watch is None:
                    if len(self._watches) >= MOST_RIGS:
                        self._note(endpoint, problem=f"rig {rig} is left out: there are {MOST_RIGS} already")
                        return
                    watch = self._watches[rig] = RigWatch(
                        RigClient(session, rig), endpoint.name, self._values, partial(self._lease, rig)
                    )
                    group.create_task(watch.run(), name=f"rig {rig}")
                if watch.endpoint != endpoint.name:
                    self._note(endpoint, problem=f"rig {rig} is shown as {watch.endpoint} has it; its namesake is not")
                    return
                watch.daemon(instance, alive=alive)

            while True:
                try:
                    async with daemons(session, told):
                        await asyncio.Event().wait()
                except SessionError as error:
                    self._note(endpoint, problem=error.message)
                    await asyncio.sleep(OPEN_AGAIN_S)

    async def _follow_absence(self, session: Session, endpoint: Endpoint) -> None:
        while True:
            try:
                await tell_absence(
                    session, endpoint.settings, lambda problem: self._note(endpoint, problem=problem), self._wanted
                )
            except SessionError:
                await asyncio.sleep(OPEN_AGAIN_S)

    def _lease(self, rig: str, axis: str) -> str | None:
        return self.lease_of(rig, axis)

    def _watch(self, rig: str) -> RigWatch:
        if rig not in self._watches:
            known = ", ".join(self.names) or "none"
            raise UnknownAxis(f"no rig {rig[:64]} was seen", value=rig, remedy=f"there are: {known}")
        return self._watches[rig]

    def _note(self, endpoint: Endpoint, *, problem: str | None) -> None:
        before = self._endpoints.get(endpoint.name)
        opened = problem is None or (before is not None and before.connected)
        now = EndpointReply(endpoint=endpoint.name, connected=opened, problem=problem)
        if now != before:
            (log.warning if problem else log.info)("endpoint", endpoint=endpoint.name, problem=problem)
            self._endpoints[endpoint.name] = now
            self._lacks(next((each.problem for each in self._endpoints.values() if each.problem), None))
