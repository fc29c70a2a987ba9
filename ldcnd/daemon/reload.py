"""Reading the configuration of a running daemon again: what would change, what is taken, what needs a restart.

A reload takes changes that affect only later commands and polls: limits, velocities and accelerations that requests
omit, polling rates and priorities. A motion under way keeps the values that it was started with. All the rest says
where drives are, what they are, or how the daemon was built, and needs a restart.
"""

import asyncio
import hashlib
import json
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import partial
from types import MappingProxyType

from ldcnd.config.plan import require_plan
from ldcnd.config.quantities import ReadQuantity, as_people_read
from ldcnd.config.rig import RigConfig, put_together
from ldcnd.contract.errors import ConfigError, WrongState
from ldcnd.contract.plan import RigBudget
from ldcnd.contract.rig_commands import ConfigChange, Reload, ReloadReply
from ldcnd.contract.sequences import NamedPosition, SequenceConfig
from ldcnd.daemon.daemon import Daemon
from ldcnd.drives.axis_config import AxisConfig
from ldcnd.drives.line_config import BusConfig
from ldcnd.log import get_logger
from ldcnd.own_thread import OwnThread

log = get_logger("reload")

RELOAD_TIME_S = 10.0
"""A configuration that takes longer to be read is given up: TimeoutStartSec= bounds a reload, too."""
LONGEST_VALUE = 120
NOBODY: Mapping[str, str] = MappingProxyType({})
MOST_CHANGES = 100
"""What a reply names; of more changes the rest is in the log."""


class Reloader:
    """Reads the configuration again, for a signal or a client; one at a time.

    Args:
        daemon: which runs with it.
        load: reads the configuration, as it was read at the start.
    """

    def __init__(self, daemon: Daemon, load: Callable[[], RigConfig]) -> None:
        self._daemon = daemon
        self._load = load
        self._one_at_a_time = asyncio.Lock()
        self._reading = OwnThread("configuration")
        self._access = _access_of(daemon.config)  # the session is open: it was read just now

    async def reload(self) -> "ReloadPlan":
        """Apply the changes that need no restart, for a signal: who may send one may change axes that clients control.

        Raises:
            ConfigError: the file cannot be read, or makes no configuration; the running one stays.
        """
        async with self._one_at_a_time:
            reload, budget = await self._read()
            self._take(reload, budget)
            return reload

    async def answer(self, command: Reload, held: Callable[[], Mapping[str, str]]) -> ReloadReply:
        """Answer a client: what a reload would change, or has changed.

        Args:
            command: the request.
            held: returns the axes that other clients control, and who does.

        Raises:
            ConfigError: as `reload`.
            WrongState: the file is another one than the client has seen.
        """
        async with self._one_at_a_time:
            keep = held()
            reload, budget = await self._read(keep)
            # control may change hands while the file is read
            while any(axis in held() for axis in reload.axes):
                keep = held()
                reload, budget = await self._read(keep)
            if not command.dry_run:
                if command.revision not in (None, reload.revision):
                    raise WrongState(
                        "the configuration was changed again since its changes were shown",
                        value=command.revision,
                        limit=reload.revision,
                        remedy="look at the changes again, then reload",
                    )
                self._take(reload, budget)
            return ReloadReply(
                changes=reload.changes[:MOST_CHANGES],
                more=max(0, len(reload.changes) - MOST_CHANGES),
                applied=not command.dry_run and (not reload.changes or any(each.taken for each in reload.changes)),
                revision=reload.revision,
            )

    async def _read(self, held: Mapping[str, str] = NOBODY) -> "tuple[ReloadPlan, RigBudget]":
        """Read and judge the file, beside the loop: lines go on meanwhile."""
        try:
            return await self._reading.run(partial(self._prepare, self._daemon.config, held), RELOAD_TIME_S)
        except TimeoutError:
            raise ConfigError(f"the configuration cannot be read within {RELOAD_TIME_S:g} s") from None

    def _prepare(self, running: RigConfig, held: Mapping[str, str]) -> "tuple[ReloadPlan, RigBudget]":
        reload = plan_reload(running, self._load(), held)
        if _access_of(running) != self._access:
            reload = replace(reload, changes=(*reload.changes, ACCESS_CHANGED))
        # before anything is taken: polls that the line cannot carry are refused whole
        return reload, require_plan(reload.config)

    def _take(self, reload: "ReloadPlan", budget: RigBudget) -> None:
        self._daemon.reconfigure(reload.config, budget)
        log.info("configuration reloaded", changed=reload.changed)
        for axis in reload.axes:
            self._daemon.note_reload(axis, reload.of_axis(axis))
        if reload.refused:
            log.warning("changes need a restart", keys=reload.refused)
        if kept := [each.key for each in reload.changes if each.held_by is not None]:
            log.warning("other clients control axes, which keep their settings", keys=kept)


ACCESS_CHANGED = ConfigChange(
    key="zenoh.config_file", before="as it was at the start", after="with other logins or rules", restart=True
)


def _access_of(config: RigConfig) -> bytes | None:
    """Return what tells one Zenoh configuration, with its logins and access rules, from another; None without one."""
    path = config.zenoh.config_file
    try:
        return hashlib.sha256(path.read_bytes()).digest() if path else None
    except OSError:
        return b""


@dataclass(frozen=True, slots=True)
class ReloadPlan:
    """The effect of a changed configuration.

    Attributes:
        config: to run with from now on.
        changes: every key that differs in the file; those that need a restart, or are of an axis that another client
            controls, keep their value.
        revision: of the file, as it was read.
    """

    config: RigConfig
    changes: tuple[ConfigChange, ...]
    revision: str

    @property
    def changed(self) -> tuple[str, ...]:
        """Keys that have another value from now on."""
        return tuple(each.key for each in self.changes if each.taken)

    @property
    def refused(self) -> tuple[str, ...]:
        """Keys that differ in the file and keep their value until the daemon is started again."""
        return tuple(each.key for each in self.changes if each.restart)

    @property
    def axes(self) -> tuple[str, ...]:
        """Axes that get another value."""
        names = [axis.name for bus in self.config.bus for axis in bus.axis]
        return tuple(name for name in names if any(f".axis.{name}." in key for key in self.changed))

    def of_axis(self, name: str) -> str:
        """Return in words what an axis gets."""
        mark = f".axis.{name}."
        keys = [(each.key.partition(mark)[2], each) for each in self.changes if mark in each.key and each.taken]
        return ", ".join(f"{key} {each.before or 'none'} -> {each.after or 'none'}" for key, each in keys)


def plan_reload(running: RigConfig, wanted: RigConfig, held: Mapping[str, str] = NOBODY) -> ReloadPlan:
    """Decide which changes apply; an axis that another client controls keeps its settings.

    Keys name buses and axes: `bus.line0.axis.x.limits.velocity`; a bus or axis that was added or removed is one key.

    Raises:
        ConfigError: what can be changed contradicts what cannot, such as a velocity limit that the bounds of `track`
            no longer keep, or slower polls of what an interlock must know sooner.
    """
    wanted_buses = {bus.name: bus for bus in wanted.bus}
    buses = tuple(_bus(bus, wanted_buses.get(bus.name, bus)) for bus in running.bus)
    possible = running.model_copy(update={"bus": buses, **_of_clients(running, wanted)})
    axes = {axis.name: axis for bus in running.bus for axis in bus.axis if axis.name in held}
    buses = tuple(
        bus.model_copy(update={"axis": tuple(axes.get(axis.name, axis) for axis in bus.axis)}) for bus in possible.bus
    )
    try:
        config = put_together(possible.model_copy(update={"bus": buses}))
    except ConfigError as error:
        raise ConfigError(f"what needs no restart cannot work without what does: {error.message}") from error
    before, now, could, then = (as_people_read(each) for each in (running, config, possible, wanted))
    changes = (
        *_differences(before, now, "", restart=False),
        *(_of_held(each, held) for each in _differences(now, could, "", restart=False)),
        *_differences(could, then, "", restart=True),
    )
    revision = hashlib.sha256(wanted.model_dump_json().encode()).hexdigest()[:16]
    return ReloadPlan(config, changes, revision)


def _of_clients(running: RigConfig, wanted: RigConfig) -> dict[str, object]:
    """Return positions and sequences, which clients alone use, as the file has them.

    Those that name what is not there before the restart, or means something else until then, stay as they were.
    """
    known, means = (_named_of(rig) for rig in (running, wanted))
    others = {name for name in known | means if known.get(name) != means.get(name)}

    def clear(each: NamedPosition | SequenceConfig, rig: RigConfig) -> bool:
        named = (
            each.axes if isinstance(each, NamedPosition) else each.names({place.name: place for place in rig.position})
        )
        return others.isdisjoint(named)

    taken: dict[str, object] = {}
    for key in ("position", "sequence"):
        before, after = getattr(running, key), getattr(wanted, key)
        unclear = {
            each.name for rig, all_of in ((running, before), (wanted, after)) for each in all_of if not clear(each, rig)
        }
        staying = {each.name: each for each in before if each.name in unclear}
        found = staying | {each.name: each for each in after if each.name not in unclear}
        order = dict.fromkeys(each.name for each in (*after, *before))
        taken[key] = tuple(found[name] for name in order if name in found)
    return taken


def _named_of(rig: RigConfig) -> dict[str, object]:
    """Return what positions and sequences can name, with what each of it means."""
    found: dict[str, object] = {}
    for bus in rig.bus:
        found |= {**dict.fromkeys(bus.names, bus.name), **bus.inputs, **bus.outputs}
        found |= {axis.name: axis.meaning for axis in bus.axis}
    return found


def _of_held(change: ConfigChange, held: Mapping[str, str]) -> ConfigChange:
    axis = next(name for name in held if f".axis.{name}." in change.key)
    return change.model_copy(update={"axis": axis, "held_by": held[axis]})


def _bus(running: BusConfig, wanted: BusConfig) -> BusConfig:
    if running.family != wanted.family:
        return running
    wanted_axes = {axis.name: axis for axis in wanted.axis}
    # an axis that is missing from the file stays as it is until the restart
    axes = tuple(_axis(axis, wanted_axes.get(axis.name, axis)) for axis in running.axis)
    return running.model_copy(update={"axis": axes})


def _axis(running: AxisConfig, wanted: AxisConfig) -> AxisConfig:
    """Take the keys over, unless a unit means something else than before: then every number does."""
    if not running.reloadable or running.meaning != wanted.meaning:
        return running
    return running.model_copy(update={key: getattr(wanted, key) for key in running.reloadable})


def _differences(one: object, other: object, key: str, *, restart: bool) -> Iterator[ConfigChange]:
    """Yield where two parts of a document differ, as deep down as it can be named."""
    if one == other:
        return
    ours, theirs = _by_name(one), _by_name(other)
    if ours is None and theirs is None:
        ours, theirs = _by_place(one), _by_place(other)
        if ours and theirs and ours.keys() != theirs.keys():
            ours = None  # one that was put in would move all that follow
    if ours is None or theirs is None or not (ours or theirs):
        yield _change(key, one, other, restart=restart)
        return
    for name in ours | theirs:
        below = f"{key}.{name}" if key else name
        yield from _differences(ours.get(name), theirs.get(name), below, restart=restart)
    if isinstance(one, list) and list(ours) != list(theirs) and ours.keys() == theirs.keys():
        yield _change(key, list(ours), list(theirs), restart=restart)  # only their order has changed


def _change(key: str, before: object, after: object, *, restart: bool) -> ConfigChange:
    return ConfigChange(key=key, before=_shown(before), after=_shown(after), restart=restart)


def _shown(value: object) -> str | None:
    """Return a value as text; a part with a name is known by that."""
    if value is None:
        return None
    if isinstance(value, ReadQuantity):
        return str(value)
    if isinstance(value, dict):
        value = value.get("name") or value
    text = json.dumps(_as_written(value), default=str, ensure_ascii=False)
    return text if len(text) <= LONGEST_VALUE else f"{text[:LONGEST_VALUE]} ..."


def _as_written(value: object) -> object:
    """Return a value about as its file has it: without what is not set."""
    if isinstance(value, list):
        return [_as_written(each) for each in value]
    if isinstance(value, dict):
        return {key: _as_written(each) for key, each in value.items() if each not in (None, "", [], {})}
    return value


def _by_name(part: object) -> dict[str, object] | None:
    """Return the parts of a table or a list that are known by name, or None for anything else."""
    if isinstance(part, dict):
        return part
    if not isinstance(part, list):
        return None
    named: dict[str, object] = {str(item.get("name") or ""): item for item in part if isinstance(item, dict)}
    return named if len(named) == len(part) and "" not in named else None


def _by_place(part: object) -> dict[str, object] | None:
    """Return the tables of a list by their numbers, the first of which is 1, or None for anything else."""
    if not isinstance(part, list) or not all(isinstance(item, dict) for item in part):
        return None
    return {str(number): item for number, item in enumerate(part, 1)}
