"""The effect of a changed configuration on a running rig: which changes it takes, which need a restart. Pure.

Taken are changes that affect only later commands and polls: limits, velocities and accelerations that requests omit,
polling rates and priorities. A motion under way keeps the values that it was started with. All the rest says where
drives are, what they are, or how the daemon was built.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from pydantic import BaseModel, ValidationError

from ldcnd.config.axis import AxisConfig
from ldcnd.config.bus import BusConfig
from ldcnd.config.rig import RigConfig
from ldcnd.errors import ConfigError


@dataclass(frozen=True, slots=True)
class Reload:
    """The effect of a changed configuration.

    Attributes:
        config: to run with from now on.
        changed: keys that have another value in it.
        refused: keys that differ in the file and keep their value until the daemon is started again.
    """

    config: RigConfig
    changed: tuple[str, ...]
    refused: tuple[str, ...]


def plan_reload(running: RigConfig, wanted: RigConfig) -> Reload:
    """Decide which changes apply.

    Keys name buses and axes: `bus.line0.axis.x.limits.velocity`; a bus or axis that was added or removed is one key.

    Raises:
        ConfigError: what can be changed contradicts what cannot, such as a velocity limit that the bounds of `track`
            no longer keep.
    """
    wanted_buses = {bus.name: bus for bus in wanted.bus}
    buses = tuple(_bus(bus, wanted_buses.get(bus.name, bus)) for bus in running.bus)
    config = running.model_copy(update={"bus": buses})
    return Reload(config, tuple(_differences(running, config, "")), tuple(_differences(config, wanted, "")))


def _bus(running: BusConfig, wanted: BusConfig) -> BusConfig:
    if running.family != wanted.family:
        return running
    wanted_axes = {axis.name: axis for axis in wanted.axis}
    axes = tuple(_axis(axis, wanted_axes.get(axis.name, axis)) for axis in running.axis)
    return running.model_copy(update={"axis": axes})


def _axis(running: AxisConfig, wanted: AxisConfig) -> AxisConfig:
    """Take the keys over, unless a unit means something else than before: then every number does."""
    if not running.reloadable or (running.unit, running.counts_per_unit, running.direction) != (
        wanted.unit,
        wanted.counts_per_unit,
        wanted.direction,
    ):
        return running
    merged = running.model_copy(update={key: getattr(wanted, key) for key in running.reloadable})
    try:
        return type(running).model_validate(merged.model_dump())
    except ValidationError as error:
        reasons = "; ".join(detail["msg"].removeprefix("Value error, ") for detail in error.errors())
        raise ConfigError(
            f"axis {running.name}: what needs no restart cannot work without what does: {reasons}", axis=running.name
        ) from error


def _differences(one: object, other: object, key: str) -> Iterator[str]:
    """Yield the keys at which two parts of a configuration differ, as deep down as they can be named."""
    if one == other:
        return
    if isinstance(one, BaseModel) and isinstance(other, BaseModel):
        for name in type(one).model_fields:
            yield from _differences(getattr(one, name), getattr(other, name), f"{key}.{name}" if key else name)
        return
    ours, theirs = _by_name(one), _by_name(other)
    if ours is None or theirs is None or list(ours) == list(theirs) == []:
        yield key
        return
    for name in ours | theirs:
        if name in ours and name in theirs:
            yield from _differences(ours[name], theirs[name], f"{key}.{name}")
        else:
            yield f"{key}.{name}"
    if list(ours) != list(theirs) and ours.keys() == theirs.keys():
        yield key  # only their order has changed


def _by_name(items: object) -> dict[str, BaseModel] | None:
    """Return the parts of a list that are known by name, or None for anything else."""
    if not isinstance(items, Sequence) or isinstance(items, str):
        return None
    named = {str(getattr(item, "name", "")): item for item in items if isinstance(item, BaseModel)}
    return named if len(named) == len(items) and "" not in named else None
