"""The contract as a list: every key that a daemon publishes or answers, and what goes over it.

Derived from the same keys, models and verbs that the daemon runs on; `docs/reference/keys.md` is made from it.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from enum import StrEnum

from ldcnd.config.rig import RigConfig
from ldcnd.contract.catalogue import COMMANDS
from ldcnd.contract.commands import About, Stop, StopReply
from ldcnd.contract.events import CommandEvent
from ldcnd.contract.frozen import Frozen, schema_name
from ldcnd.contract.health import BusHealth, DaemonHealth
from ldcnd.contract.history import AxisInstant
from ldcnd.contract.keys import EVENT, RIG_ITSELF, Keys
from ldcnd.contract.meta import AxisInfo, BusInfo, CommandList, DaemonInfo
from ldcnd.contract.plan import RigBudget
from ldcnd.contract.samples import SAMPLE_MODELS, MonitorSample
from ldcnd.contract.traces import TraceChunk, TraceHeader

_NAMES = ("rig", "axis", "bus", "monitor")
_STAND_IN = "the_{}_here"
_KEYS = Keys(_STAND_IN.format("rig"))
_AXIS, _BUS, _MONITOR = (_STAND_IN.format(name) for name in ("axis", "bus", "monitor"))
_CHUNK_INDEX = 0


class Kind(StrEnum):
    """How a channel is used."""

    TELEMETRY = "telemetry"
    """Published; `get` answers the last value."""
    NEWS = "news"
    """Published; there is no last value."""
    HEALTH = "health"
    """Published once a second; `get` answers the last report."""
    DESCRIPTION = "description"
    """Answered; it moves nothing."""
    PAST = "past"
    """Answered for an instant, `_time` of the selector; it is not published."""
    COMMAND = "command"
    """Answered once it was carried out or refused."""
    STOP = "stop"
    """Answered; never refused."""


@dataclass(frozen=True, slots=True)
class Channel:
    """One key, and what goes over it.

    Attributes:
        name: names the channel in documents.
        key: with names in braces, such as `{rig}`.
        kind: how it is used.
        sent: what the daemon sends: samples or replies.
        taken: what a query carries; None for those that carry nothing.
        summary: what it is for.
    """

    name: str
    key: str
    kind: Kind
    sent: type[Frozen]
    taken: type[Frozen] | None
    summary: str

    @property
    def parameters(self) -> tuple[str, ...]:
        """The names in braces."""
        return tuple(name for name in (*_NAMES, "index") if f"{{{name}}}" in self.key)


def channels() -> tuple[Channel, ...]:
    """Return all channels of one rig, in the order in which they are documented."""
    return (*_telemetry(), *_descriptions(), *_commands(), *_stops())


def _telemetry() -> Iterator[Channel]:
    for item, model in SAMPLE_MODELS.items():
        yield _channel(_KEYS.telemetry(_AXIS, item), Kind.TELEMETRY, model)
    yield _channel(_KEYS.monitor(_AXIS, _MONITOR), Kind.TELEMETRY, MonitorSample)
    yield _channel(_KEYS.trace(_AXIS), Kind.TELEMETRY, TraceHeader)
    chunk = _channel(_KEYS.trace_chunk(_AXIS, _CHUNK_INDEX), Kind.TELEMETRY, TraceChunk)
    yield Channel(
        "tele_trace_chunk", chunk.key.removesuffix(str(_CHUNK_INDEX)) + "{index}", chunk.kind, chunk.sent, None,
        chunk.summary,
    )  # fmt: skip
    yield _channel(_KEYS.telemetry(_AXIS, EVENT), Kind.NEWS, CommandEvent)
    yield _channel(_KEYS.at(_AXIS), Kind.PAST, AxisInstant)


def _descriptions() -> Iterator[Channel]:
    for key, model in (
        (_KEYS.daemon, DaemonInfo),
        (_KEYS.commands, CommandList),
        (_KEYS.budget, RigBudget),
        (_KEYS.configuration, RigConfig),
        (_KEYS.axis(_AXIS), AxisInfo),
        (_KEYS.bus(_BUS), BusInfo),
    ):
        yield _channel(key, Kind.DESCRIPTION, model)
    yield _channel(_KEYS.health, Kind.HEALTH, DaemonHealth)
    yield _channel(_KEYS.bus_health(_BUS), Kind.HEALTH, BusHealth)


def _commands() -> Iterator[Channel]:
    for command in COMMANDS:
        key = _KEYS.command(RIG_ITSELF if command.about is About.RIG else _AXIS, command.verb)
        yield _channel(key, Kind.COMMAND, command.reply_model(), command)


def _stops() -> Iterator[Channel]:
    said = "Of the payload, which may be missing or nonsense, `client` is entered into the events."
    yield _channel(_KEYS.stop(), Kind.STOP, StopReply, Stop, f"Stop every axis, and latch. {said}")
    yield _channel(_KEYS.stop(_AXIS), Kind.STOP, StopReply, Stop, "Stop one axis, and latch.")


def _channel(key: str, kind: Kind, sent: type[Frozen], taken: type[Frozen] | None = None, summary: str = "") -> Channel:
    for name in _NAMES:
        key = key.replace(_STAND_IN.format(name), f"{{{name}}}")
    chunks = [chunk.strip("@{}") for chunk in key.split("/")[2:]]
    name = "_".join("rig" if chunk == RIG_ITSELF else chunk for chunk in chunks)
    doc = (taken or sent).__doc__ or ""
    return Channel(name, key, kind, sent, taken, summary or doc.strip().partition("\n")[0])


def keys_table() -> str:
    """Return all channels as a Markdown list; keys below the rig's, payloads that do not follow from the verb."""
    lines = ["Each key below `ldcn/<rig>/`, what a query carries, and what the daemon sends:", ""]
    for channel in channels():
        key = channel.key.replace("{", "<").replace("}", ">").removeprefix("ldcn/<rig>/")
        taken, sent = channel.taken and schema_name(channel.taken), schema_name(channel.sent)
        usual = channel.kind is Kind.COMMAND and taken == f"{key.rpartition('/')[2]}_request"
        carried = "" if usual or not taken else f" carries `{taken}`,"
        answered = "" if channel.kind is Kind.COMMAND and sent == "command_reply" else f" sends `{sent}`"
        lines.append(f"* `{key}`{carried}{answered}: {channel.summary}")
    return "\n".join(lines) + "\n"
