"""A capture played to a daemon: the same drivers and services as ever, on a line that is a recording.

The daemon gets the configuration, the name, the clock and the commands of the one that was recorded, so it publishes
what that one published. No port is opened, no network is joined, nothing is written but what the caller writes.
"""

import asyncio
import json
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import pairwise

from ldcnd.config.rig import RigConfig
from ldcnd.contract.codec import Encoding, as_json
from ldcnd.contract.errors import MalformedRequest
from ldcnd.contract.keys import RIG_ITSELF, Keys
from ldcnd.contract.leases import Acquire
from ldcnd.daemon.assembly import build_daemon
from ldcnd.daemon.journal import STOP
from ldcnd.daemon.leases import random_token
from ldcnd.line.capture import Capture
from ldcnd.line.flight_recorder import WireEvent, WireRecord
from ldcnd.line.port_url import SOCKET
from ldcnd.net.session import Publication
from ldcnd.testing.jumping_loop import JumpingLoop
from ldcnd.testing.memory_session import MemoryBroker, MemorySession
from tests.support.recorded_line import Replay, ReplayDeviation

Take = Callable[[Publication], None]
"""Gets every sample, event and report as it is published."""


@dataclass(frozen=True, slots=True)
class Played:
    """How a replay went.

    Attributes:
        packets: how many packets of the daemon were answered as then; all of them.
        commands: how many commands and stops of clients were given again.
        late_s: by how much a packet was latest; 0 on the jumping clock for a capture that was made on one.
    """

    packets: int
    commands: int
    late_s: float


def published_line(sample: Publication) -> str:
    """Return what was published as one line of JSON: key, when it was true, value."""
    value = as_json(sample.payload, sample.encoding).decode()
    return (
        f'{{"key": {json.dumps(sample.key)}, "measured_at_ns": {json.dumps(sample.measured_at_ns)}, "value": {value}}}'
    )


def awake_at_s(capture: Capture) -> tuple[float, ...]:
    """Return when the process that was recorded is known to have been awake, on the records' clock.

    Empty for a process in virtual time: it is never late. There a packet follows a reply in no time at all.
    """
    virtual = any(
        before.event is WireEvent.RECEIVED and after.event is WireEvent.SENT and before.at_s == after.at_s
        for before, after in pairwise(capture.records)
    )
    return () if virtual else tuple(record.at_s for record in capture.records)


def virtual_time(capture: Capture) -> JumpingLoop:
    """Return an event loop on which a capture is played in no time, as awake as the host was then."""
    return JumpingLoop(capture.header.started_s, awake_at_s(capture))


async def play(capture: Capture, config: RigConfig, take: Take) -> Played:
    """Play a capture from its first packet to its end, on the running event loop.

    Args:
        capture: complete since its daemon was started.
        config: see `config_of`.
        take: gets what the daemon publishes until the capture ends.

    Raises:
        MalformedRequest: the beginning of the line is not in the capture.
        ReplayDeviation: the daemon does something else than then; the message names the packet.
    """
    header = capture.header
    if header.first_record:
        raise MalformedRequest(
            f"the capture begins with record {header.first_record}: how the line came up is not in it",
            remedy="make captures reach back to the start: see `recorder.seconds` of the bus",
        )
    loop = asyncio.get_running_loop()
    shift_s = loop.time() - header.started_s
    broker, keys = MemoryBroker(), Keys(config.rig)

    def now_ns() -> int:
        return header.zero_ns + round((loop.time() - shift_s) * 1e9)

    def overhear(sample: Publication) -> None:
        if not replay.ended.done():
            take(sample)

    async with (
        broker.session() as clients,
        broker.session(overhear=overhear) as session,
        asyncio.TaskGroup() as group,
    ):
        asking: list[asyncio.Task[None]] = []

        def ask(text: str) -> None:
            key, payload = _query(keys, text)
            asking.append(group.create_task(_ask(clients, key, payload), name=f"ask {key}"))

        replay = Replay(
            capture.records,
            header.until_s,
            ask,
            shift_s=shift_s,
            fixed_baud=header.port.startswith(SOCKET),
            slow_host=bool(awake_at_s(capture)),
            arrive_at=loop.arrive_at if isinstance(loop, JumpingLoop) else None,
        )
        tokens = _tokens(capture.records)
        daemon = build_daemon(
            config,
            session,
            now_ns,
            header.instance,
            openers={header.bus: replay.open},
            next_token=lambda: next(tokens, None) or random_token(),
        )
        running = group.create_task(daemon.run(), name="daemon")
        deviation = None
        try:
            await replay.ended
        except ReplayDeviation as error:
            deviation = error
        finally:
            replay.close()
            running.cancel()
            for task in asking:
                task.cancel()
    if deviation:
        raise deviation
    return Played(replay.packets, len(asking), replay.late_s)


async def _ask(clients: MemorySession, key: str, payload: bytes) -> None:
    """Repeat a client's request; the capture does not contain the reply it got."""
    await clients.query(key, payload, encoding=Encoding.JSON, timeout_s=3600.0)


def _query(keys: Keys, text: str) -> tuple[str, bytes]:
    """Return the key and the payload of a line of the journal."""
    name, _, payload = text.partition(" ")
    axis, _, verb = name.partition("/")
    if axis == STOP:
        return keys.stop(verb or None), b""
    fields = json.loads(payload)
    if (axis, verb) == (RIG_ITSELF, Acquire.verb):
        fields.pop("lease", None)  # that was the answer
    return keys.command(axis, verb), json.dumps(fields).encode()


def _tokens(records: tuple[WireRecord, ...]) -> Iterator[str | None]:
    """Yield what the leases that were given are known by in the capture."""
    for record in records:
        name, _, payload = record.data.decode(errors="replace").partition(" ")
        if record.event is WireEvent.COMMAND and name == f"{RIG_ITSELF}/{Acquire.verb}":
            yield json.loads(payload).get("lease")
