"""Keys: the only place that spells a topic, and how key expressions match.

A key is a path of chunks below `ldcn/<rig>`. Commands and stops are behind the verbatim chunks `@cmd` and `@stop`,
which no wildcard matches: a reader of `ldcn/**` can never move anything.

Source: Zenoh key expressions: `*` is one chunk, `**` any number of chunks, `$*` any part of a chunk; a chunk that
starts with `@` is matched by itself only.
"""

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache

from ldcnd.contract.errors import MalformedRequest, ValueOutOfRange, WildcardRefused

ROOT = "ldcn"

RIG_ITSELF = "_"
"""Stands in the place of an axis in commands that concern the rig as a whole; no axis can have this name."""

EVENT = "event"
"""Stands in the place of an item where the events of an axis are published."""

ALL_READABLE = (f"{ROOT}/*/tele/**", f"{ROOT}/*/meta/**", f"{ROOT}/*/alive/**")
"""Readable keys of every rig; for access control, as `ALL_STOPS`, `ALL_COMMANDS` and `ALL_CLIENTS`."""
ALL_DAEMONS = f"{ROOT}/*/meta/daemon"
"""The description of every daemon, on every rig."""
ALL_RUNS = f"{ROOT}/*/alive/*"
"""The token of every run of a daemon, on every rig."""
ALL_STOPS = f"{ROOT}/*/@stop/**"
ALL_COMMANDS = f"{ROOT}/*/@cmd/**"
ALL_CLIENTS = f"{ROOT}/*/client/**"

_CHUNK = re.compile(r"[a-z0-9_]+")
_ANY_CHUNKS = "**"
_ANY_PART = "$*"
_CHUNK_TOKENS = re.compile(r"\$\*|.", re.DOTALL)


@dataclass(frozen=True, slots=True)
class CommandAddress:
    """Who is to do what; the axis is `RIG_ITSELF` when the rig is meant."""

    axis: str
    verb: str


@dataclass(frozen=True, slots=True)
class TelemetryAddress:
    """One telemetry item of one axis."""

    axis: str
    item: str


@dataclass(frozen=True, slots=True)
class AliveAddress:
    """The subject of a liveliness token: a daemon, or one of its axes."""

    instance: str
    axis: str | None


@dataclass(frozen=True, slots=True)
class Keys:
    """All keys of one rig. Each name in a key is one chunk of lower-case ASCII letters, digits and underscores.

    Raises:
        ValueOutOfRange: the rig's name, or a name given to a method, is no such chunk.
    """

    rig: str

    def __post_init__(self) -> None:
        """Refuse a rig that cannot stand in a key."""
        _chunk("rig", self.rig)

    @property
    def all_telemetry(self) -> str:
        """Every telemetry key."""
        return f"{self._root}/tele/**"

    @property
    def all_meta(self) -> str:
        """Every description."""
        return f"{self._root}/meta/**"

    @property
    def all_commands(self) -> str:
        """Every command key."""
        return f"{self._root}/@cmd/**"

    @property
    def all_stops(self) -> tuple[str, ...]:
        """Every stop key. One expression is enough: `**` also stands for no chunk, so it covers `@stop` itself.

        A second one would offer each stop of the rig to two queryables, and such a stop would be carried out twice.
        """
        return (f"{self._root}/@stop/**",)

    @property
    def all_alive(self) -> str:
        """The tokens of all daemons that serve this rig, and of their axes."""
        return f"{self._root}/alive/**"

    @property
    def daemon(self) -> str:
        """The description of the daemon."""
        return f"{self._root}/meta/daemon"

    @property
    def commands(self) -> str:
        """The description of all commands."""
        return f"{self._root}/meta/commands"

    @property
    def budget(self) -> str:
        """The bus budget of the lines, and the rates that they promise."""
        return f"{self._root}/meta/budget"

    @property
    def configuration(self) -> str:
        """The configuration in use by the daemon."""
        return f"{self._root}/meta/configuration"

    @property
    def description_patterns(self) -> tuple[str, ...]:
        """All descriptions but the schemas; the daemon's health is among them, that of its lines is not."""
        return (f"{self._root}/meta/*", self.axis_pattern, self.bus_pattern)

    @property
    def health(self) -> str:
        """How the daemon is doing; how its lines are is below it."""
        return f"{self._root}/meta/health"

    def bus_health(self, bus: str) -> str:
        """Return the key on which the health of a line and its axes is published; the name may be `*`."""
        return f"{self.health}/{bus if bus == '*' else _chunk('bus', bus)}"

    def axis(self, axis: str) -> str:
        """Return the key of an axis's description."""
        return f"{self._root}/meta/axes/{_chunk('axis', axis)}"

    def bus(self, bus: str) -> str:
        """Return the key of a line's description."""
        return f"{self._root}/meta/buses/{_chunk('bus', bus)}"

    @property
    def axis_pattern(self) -> str:
        """The descriptions of all axes."""
        return f"{self._root}/meta/axes/*"

    @property
    def bus_pattern(self) -> str:
        """The descriptions of all lines."""
        return f"{self._root}/meta/buses/*"

    def telemetry_pattern(self, axis: str, item: str) -> str:
        """Return a telemetry key in which either name may be `*`; an item such as `monitor/speed_feedback` has two."""
        names = "/".join(name if name == "*" else _chunk("item", name) for name in item.split("/"))
        return f"{self._root}/tele/{axis if axis == '*' else _chunk('axis', axis)}/{names}"

    def schema(self, name: str) -> str:
        """Return the key of a model's JSON Schema."""
        return f"{self._root}/meta/schema/{_chunk('schema', name)}"

    def telemetry(self, axis: str, item: str) -> str:
        """Return the key on which an item of an axis is published."""
        return f"{self._root}/tele/{_chunk('axis', axis)}/{_chunk('item', item)}"

    def at(self, axis: str) -> str:
        """Return the key that answers where an axis, or with `*` each, was at an instant, `_time` of the selector."""
        return f"{self._root}/tele/{axis if axis == '*' else _chunk('axis', axis)}/at"

    def monitor(self, axis: str, name: str) -> str:
        """Return the key on which a monitor of an axis is published; the name may be `*`."""
        return f"{self.telemetry(axis, 'monitor')}/{name if name == '*' else _chunk('monitor', name)}"

    def trace(self, axis: str) -> str:
        """Return the key of an axis's last trace, without its samples."""
        return self.telemetry(axis, "trace")

    def trace_chunk(self, axis: str, index: int) -> str:
        """Return the key of some consecutive samples of an axis's last trace."""
        return f"{self.trace(axis)}/{index}"

    def alive(self, instance: str) -> str:
        """Return the liveliness token of one run of the daemon."""
        return f"{self._root}/alive/{_chunk('instance', instance)}"

    def alive_axis(self, instance: str, axis: str) -> str:
        """Return the liveliness token of an axis whose drive answers."""
        return f"{self.alive(instance)}/axis/{_chunk('axis', axis)}"

    def client(self, client: str) -> str:
        """Return the liveliness token of a controlling client."""
        return f"{self._root}/client/{_chunk('client', client)}"

    def command(self, axis: str, verb: str) -> str:
        """Return the key that makes an axis, or `RIG_ITSELF`, do something."""
        return f"{self._root}/@cmd/{_chunk('axis', axis)}/{_chunk('verb', verb)}"

    def stop(self, axis: str | None = None) -> str:
        """Return the key that stops one axis, or the whole rig."""
        whole = f"{self._root}/@stop"
        return whole if axis is None else f"{whole}/{_chunk('axis', axis)}"

    def parse_command(self, key: str) -> CommandAddress:
        """Return whom a command key addresses.

        Raises:
            WildcardRefused: the key has a wildcard; a command names one axis and one verb.
            MalformedRequest: the key is no command key of this rig.
        """
        if "*" in key:
            raise WildcardRefused(
                f"{key}: a command names exactly one axis and one verb, without wildcards",
                value=key,
                remedy="send one command for each axis",
            )
        axis, verb = _chunks_below(key, f"{self._root}/@cmd", "<axis>/<verb>")
        return CommandAddress(axis, verb)

    def parse_stop(self, key: str) -> str | None:
        """Return the axis that a stop key names, or None for the whole rig.

        A stop is never refused for its spelling: whatever below `@stop` cannot be read as one axis, wildcards
        included, means the whole rig.

        Raises:
            MalformedRequest: the key is no stop key of this rig.
        """
        if not any(matches(stop, key) for stop in self.all_stops):
            raise MalformedRequest(f"{key} is not {self.stop()} or {self.stop()}/<axis>", value=key)
        chunks = key.split("/")
        rest = chunks[chunks.index("@stop") + 1 :]
        return rest[0] if len(rest) == 1 and _CHUNK.fullmatch(rest[0]) else None

    def parse_telemetry(self, key: str) -> TelemetryAddress:
        """Return which item of which axis a telemetry key carries.

        Raises:
            MalformedRequest: the key is no telemetry key of this rig.
        """
        axis, item = _chunks_below(key, f"{self._root}/tele", "<axis>/<item>")
        return TelemetryAddress(axis, item)

    def parse_alive(self, key: str) -> AliveAddress:
        """Return what a liveliness token of a daemon stands for.

        Raises:
            MalformedRequest: the key is no such token of this rig.
        """
        base = f"{self._root}/alive"
        if "/axis/" not in key:
            (instance,) = _chunks_below(key, base, "<instance>")
            return AliveAddress(instance, None)
        instance, _, axis = _chunks_below(key, base, "<instance>/axis/<axis>")
        return AliveAddress(instance, axis)

    @classmethod
    def of(cls, key: str) -> "Keys":
        """Return the keys of the rig that a key belongs to.

        Raises:
            MalformedRequest: the key is no key of any rig.
        """
        root, _, below = key.partition("/")
        rig, _, rest = below.partition("/")
        if root != ROOT or not _CHUNK.fullmatch(rig) or not rest:
            raise MalformedRequest(f"{key} is not {ROOT}/<rig>/...", value=key)
        return cls(rig)

    @property
    def _root(self) -> str:
        return f"{ROOT}/{self.rig}"


@lru_cache(maxsize=1024)
def _chunks_below(key: str, base: str, form: str) -> tuple[str, ...]:
    """Return the chunks of a key below `base`, as many as `form` has."""
    prefix, below, rest = key.partition(f"{base}/")
    chunks = tuple(rest.split("/"))
    if prefix or not below or len(chunks) != form.count("/") + 1 or not all(map(_CHUNK.fullmatch, chunks)):
        raise MalformedRequest(
            f"{key} is not {base}/{form}; names are lower-case letters, digits and underscores", value=key
        )
    return chunks


def matches(left: str, right: str) -> bool:
    """Tell whether two key expressions have a key in common, as Zenoh does."""
    if "*" not in left and "*" not in right:
        return left == right
    return _intersect(left.split("/"), right.split("/"), _ANY_CHUNKS, _is_wild, _chunks_meet)


def _is_wild(chunk: str) -> bool:
    return not chunk.startswith("@")


def _chunks_meet(left: str, right: str) -> bool:
    if left == right:
        return True
    if not (_is_wild(left) and _is_wild(right)) or ("*" not in left and "*" not in right):
        return False
    return _intersect(_tokens(left), _tokens(right), _ANY_PART, lambda _: True, str.__eq__)


def _tokens(chunk: str) -> list[str]:
    return [_ANY_PART] if chunk == "*" else _CHUNK_TOKENS.findall(chunk)


def _intersect(
    left: Sequence[str],
    right: Sequence[str],
    many: str,
    swallowed: Callable[[str], bool],
    meet: Callable[[str, str], bool],
) -> bool:
    """Tell whether two patterns have a common reading, in time proportional to the product of their lengths.

    Args:
        left: one pattern.
        right: the other.
        many: the item that stands for any number of items.
        swallowed: may `many` stand for this item?
        meet: have two single items a reading in common?
    """
    # reach[j]: what was read of `left` so far and the first j items of `right` have a common reading
    reach = [True]
    for item in right:
        reach.append(reach[-1] and item == many)
    for item in left:
        before, reach = reach, [reach[0] and item == many]
        for j, other in enumerate(right, 1):
            if item == many:
                reach.append(before[j] or (reach[-1] and swallowed(other)))
            elif other == many:
                reach.append(reach[-1] or (before[j] and swallowed(item)))
            else:
                reach.append(before[j - 1] and meet(item, other))
    return reach[-1]


def _chunk(what: str, name: str) -> str:
    if not _CHUNK.fullmatch(name):
        raise ValueOutOfRange(
            f"{what} {name!r} cannot stand in a key: lower-case letters, digits and underscores only", value=name
        )
    return name
