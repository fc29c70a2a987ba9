"""One rig: whether its daemon is there, what it says about itself, and its values as they come."""

import asyncio
from collections.abc import Callable, Mapping
from contextlib import suppress

import msgpack

from ldcnd.client.network import Publication, SampleKind
from ldcnd.client.rig_client import RigClient
from ldcnd.console.conditions import Conditions
from ldcnd.console.latest_values import LatestValues, as_msgpack
from ldcnd.console.replies import RigReply
from ldcnd.console.sequences import RunnablesReply, read_catalogue
from ldcnd.contract.codec import Encoding, decode_received
from ldcnd.contract.errors import LdcndError, OutcomeUnknown
from ldcnd.contract.health import DaemonHealth
from ldcnd.contract.meta import AxisInfo, CommandList
from ldcnd.contract.plan import RigBudget
from ldcnd.contract.questions import Why
from ldcnd.contract.samples import TelemetryItem
from ldcnd.contract.troubles import daemon_troubles
from ldcnd.log import get_logger

log = get_logger("console")

ASK_AGAIN_S = 0.5
"""Pause before the next query of a daemon that did not answer, seconds; behind a router it may be late at first."""
OBSTACLES_TOPIC = "obstacles"
"""The last chunk of the key under which a page gets what forbids the commands of an axis; no daemon publishes it."""
ASK_WHY_EACH_S = 0.2
"""Shortest time between two rounds of questions for what forbids the commands of axes, seconds."""
ASK_ALL_WHY_S = 5.0
"""Longest time between them: what is not in the state of an axis, as another daemon, forbids commands too."""
STAMPS = frozenset({"t", "t_error_ns", "seq", "holder"})
"""Fields of a sample that differ in each; and who controls the axis: of its own leases the console knows itself, and it
would ask for a page that is about to learn of its lease."""
LINGER_S = 0.016
"""Period in which samples are taken together, seconds; less than a frame at the highest rate."""
DESCRIPTION_AGE_S = 1.0
"""Maximum age of the description of a rig in a reply to pages, seconds, however many request it."""
DESCRIBE_TIME_S = 4.0


class RigWatch:
    """Watches one rig over one session.

    Attributes:
        client: for commands.
        endpoint: through which it is reached, in words.
    """

    def __init__(
        self,
        client: RigClient,
        endpoint: str,
        values: LatestValues,
        lease_of: Callable[[str], str | None] = lambda _axis: None,
    ) -> None:
        self.client = client
        self.endpoint = endpoint
        self._values = values
        self._lease_of = lease_of
        self._why_due: set[str] = set()
        self._said: dict[str, dict[str, object]] = {}
        self._why_wanted = asyncio.Event()
        self._conditions = Conditions(client.rig, values.take, asyncio.get_running_loop().time)
        self._telemetry = client.keys.telemetry_pattern("*", "*").removesuffix("*/*")
        self._instances: set[str] = set()
        self._stirred = asyncio.Event()
        client.watch_rivals(self._stirred.set)
        self._reply = RigReply(
            name=client.rig, endpoint=endpoint, connected=False, problem="its daemon has not been seen yet"
        )
        self._told: Mapping[str, bool | str | None] = {}
        self._described_at_s = -DESCRIPTION_AGE_S
        self._describing = asyncio.Lock()

    @property
    def connected(self) -> bool:
        """Its daemon is there and has answered."""
        return self._reply.connected

    @property
    def instance(self) -> str | None:
        """The run of its daemon that was described last."""
        return self._reply.daemon.instance if self._reply.daemon else None

    @property
    def axes(self) -> frozenset[str]:
        """The names of its axes, as it described itself last."""
        return frozenset(each.axis for each in self._reply.axes)

    def daemon(self, instance: str, *, alive: bool) -> None:
        """Learn that a run of the daemon has come or gone."""
        (self._instances.add if alive else self._instances.discard)(instance)
        self._stirred.set()

    async def run(self) -> None:
        """Watch until cancelled."""
        async with asyncio.TaskGroup() as group:
            group.create_task(self._conditions.run(), name=f"conditions of {self.client.rig}")
            group.create_task(self._follow_obstacles(), name=f"obstacles of {self.client.rig}")
            await self._watch()

    def want_why(self, axis: str) -> None:
        """Ask anew what forbids the commands of an axis: something of it is different, such as the lease of a page."""
        self._why_due.add(axis)
        self._why_wanted.set()

    async def _follow_obstacles(self) -> None:
        """Ask what forbids the commands of each axis, for all open pages at once, whenever its state has changed.

        And of all now and then, whatever another axis does: a door tells no axis that it was shut.
        """
        now_s = asyncio.get_running_loop().time
        all_due_s = now_s() + ASK_ALL_WHY_S
        while True:
            with suppress(TimeoutError):
                async with asyncio.timeout_at(all_due_s):
                    await self._why_wanted.wait()
            if now_s() >= all_due_s:
                self._why_due.update(self.axes)
                all_due_s = now_s() + ASK_ALL_WHY_S
            self._why_wanted.clear()
            due = self._why_due & self.axes
            if self._values.watchers and self.connected:
                self._why_due = set()
                for axis in due:
                    await self._ask_why(axis)
            elif due:
                self._why_wanted.set()  # kept for the next page: it would be shown what forbade them before
            await asyncio.sleep(ASK_WHY_EACH_S)

    async def _ask_why(self, axis: str) -> None:
        """Put what forbids the commands of an axis, to the page that controls it, among the values of pages."""
        key, payload = self.client.keys.telemetry(axis, TelemetryItem.STATE), b""
        key = f"{key.removesuffix(TelemetryItem.STATE)}{OBSTACLES_TOPIC}"
        with suppress(LdcndError):
            reply = await self.client.ask(Why(lease=self._lease_of(axis), each_command=True), axis)
            groups = [(verb, group.causes) for group in reply.commands for verb in group.verbs]
            payload = msgpack.packb({verb: [each.model_dump() for each in causes] for verb, causes in groups})
        kind = SampleKind.PUT if payload else SampleKind.DELETE
        self._values.take(Publication(key, payload, Encoding.MSGPACK, kind, measured_at_ns=None))

    def _take(self, sample: Publication) -> None:
        if sample.kind is SampleKind.DELETE and sample.key.startswith(self._telemetry):
            return  # its daemon ends, which is known otherwise: pages show these as the last known values, not as none
        if sample.key.endswith((f"/{TelemetryItem.STATE}", f"/{TelemetryItem.FAULT}")) and self._is_other(sample):
            self.want_why(sample.key.split("/")[-2])
        self._values.take(sample)
        self._take_condition(sample)

    def _take_condition(self, sample: Publication) -> None:
        self._conditions.take(sample)
        if sample.key == self.client.keys.health and sample.kind is SampleKind.PUT:
            with suppress(LdcndError):  # of a daemon of another version
                health = decode_received(DaemonHealth, sample.payload, sample.encoding)
                self._reply = self._reply.model_copy(update={"attention": "; ".join(daemon_troubles(health))})
                self._tell()

    def _is_other(self, sample: Publication) -> bool:
        """Tell whether a state or fault sample says something else than the one before: most are signs of life only."""
        packed = as_msgpack(sample.payload, sample.encoding)
        fields = msgpack.unpackb(packed) if packed else {}
        said = {name: value for name, value in fields.items() if name not in STAMPS}
        is_other = said != self._said.get(sample.key)
        self._said[sample.key] = said
        return is_other

    async def _watch(self) -> None:
        while True:
            try:
                async with self.client.published(self._take, linger_s=LINGER_S):
                    await self._follow()
            except LdcndError as error:
                self._show(problem=error.message)
                await asyncio.sleep(ASK_AGAIN_S)

    async def described(self) -> RigReply:
        """Return what the rig is now, or what it was when it was last there."""
        async with self._describing:  # concurrent requests take the answer of the first one
            if self.connected and asyncio.get_running_loop().time() >= self._described_at_s + DESCRIPTION_AGE_S:
                try:
                    await self._describe()
                except LdcndError as error:
                    log.debug("rig not described", rig=self.client.rig, reason=error.message)
        return self._reply

    async def _follow(self) -> None:
        """Query the description of the rig whenever its daemon has come."""
        while True:
            self._stirred.clear()
            if not self._instances:
                self._show(problem="daemon offline, last known values")
                await self._stirred.wait()
            elif await self._learn():
                await self._stirred.wait()
            else:
                await self._stirred_within(ASK_AGAIN_S)

    async def _learn(self) -> bool:
        """Bring description and values up to date; tell whether that worked."""
        rig = self.client.rig
        self._values.begin_again(rig)
        try:
            await self._describe()
            published = await self.client.last_published()
            for sample in published:
                self._take_condition(sample)
            self._values.settle(rig, published)
            self._conditions.show_again()
        except LdcndError as error:
            self._show(problem=error.message)
            return False
        several = len(self._instances) > 1
        two = "two daemons serve it; motion is refused until one of them goes"
        self._show(problem=two if several else self.client.rivals, connected=True)
        return True

    async def _describe(self) -> None:
        client = self.client
        try:
            async with asyncio.timeout(DESCRIBE_TIME_S):
                axes = tuple(await client.axes())
                described = {
                    "daemon": await client.daemon(),
                    "axes": axes,
                    "can_run": await self._runnables(axes),
                    "buses": tuple(await client.buses()),
                    "plan": next(iter(await client.read(client.keys.budget, RigBudget)), None),
                    "commands": next(iter(await client.read(client.keys.commands, CommandList)), None),
                }
        except TimeoutError:
            raise OutcomeUnknown(f"rig {client.rig} takes too long to describe itself") from None
        self._reply = self._reply.model_copy(update=described)
        self._described_at_s = asyncio.get_running_loop().time()

    async def _runnables(self, axes: tuple[AxisInfo, ...]) -> RunnablesReply:
        try:
            return (await read_catalogue(self.client, axes)).reply()
        except LdcndError as error:  # of a daemon of another version; all else of it is shown
            return RunnablesReply(problem=error.message)

    async def _stirred_within(self, seconds: float) -> None:
        try:
            async with asyncio.timeout(seconds):
                await self._stirred.wait()
        except TimeoutError:
            return

    def _show(self, *, problem: str | None, connected: bool = False) -> None:
        connected = bool(self._instances) and connected
        self._reply = self._reply.model_copy(update={"connected": connected, "problem": problem})
        self._conditions.silence = "" if connected else problem or "its daemon has not been seen yet"
        self._tell()

    def _tell(self) -> None:
        """Tell pages how the rig itself is, when that is another."""
        now = self._reply
        told = {
            "connected": now.connected,
            "problem": now.problem,
            "attention": now.attention,
            "instance": self.instance,
        }
        if told != self._told:
            self._told = told
            log.info("rig", rig=self.client.rig, **told)
            self._values.tell_of_rig(self.client.rig, told)
