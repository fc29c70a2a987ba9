"""The gains that an axis had before it was tuned: a file on this host until they are back, or others were accepted."""

import asyncio
import os
from functools import partial
from pathlib import Path
from urllib import parse

import pydantic

from ldcnd import durable
from ldcnd.client.axis import Axis
from ldcnd.client.rig import Rig
from ldcnd.errors import ConfigError, WrongState
from ldcnd.model.frozen import Frozen
from ldcnd.model.meta import AxisInfo
from ldcnd.model.samples import Moving

quote = partial(parse.quote, safe="")
"""A rig and an axis are called as they like; a file is not."""
NAMES = ("kp", "kd", "ki", "il", "ol", "cl", "el", "sr", "deadband")
NEEDED = frozenset(NAMES) - {"cl", "deadband"}
"""Registers that every drive with gains has."""
LEASE_S = 5.0
"""So soon the daemon applies `loss.client` of the axis when this program disappears, seconds: no trial lasts longer."""
STAND_S = 5.0
"""Longest time that an axis takes to come to rest with its loop open, seconds."""
LOOK_S = 0.05


class KeptGains(Frozen):
    """Gains that are to be put back."""

    rig: str
    """The rig."""
    axis: str
    """The axis."""
    gains: dict[str, int]
    """Registers of Set Gain, by the names of `set_gains`."""


def file_of(rig: str, axis: str) -> Path:
    """Return where the gains of an axis are kept: below $XDG_STATE_HOME, or ~/.local/state."""
    state = os.environ.get("XDG_STATE_HOME")
    return (
        (Path(state) if state else Path.home() / ".local" / "state")
        / "ldcnd"
        / "tuning"
        / f"{quote(rig)}@{quote(axis)}.json"
    )


def keep(kept: KeptGains) -> None:
    """Write them down, so that they outlive this program and this host.

    Raises:
        ConfigError: the file cannot be written; nothing has been changed then.
    """
    path = file_of(kept.rig, kept.axis)
    try:
        durable.replace(path, kept.model_dump_json(indent=1))
    except OSError as error:
        raise ConfigError(f"{path}: cannot be written: {error.strerror}", remedy="set XDG_STATE_HOME") from error


def kept_for(rig: str, axis: str) -> KeptGains | None:
    """Return what is kept for an axis; None without a file.

    Raises:
        ConfigError: the file cannot be read.
    """
    path = file_of(rig, axis)
    try:
        return KeptGains.model_validate_json(path.read_bytes())
    except FileNotFoundError:
        return None
    except (OSError, pydantic.ValidationError) as error:
        raise ConfigError(f"{path}: cannot be read: {error}", remedy="set the gains by hand, and remove it") from error


def forget(kept: KeptGains) -> None:
    """Remove the file: its gains are back, or others were accepted.

    Raises:
        ConfigError: it cannot be removed.
    """
    path = file_of(kept.rig, kept.axis)
    try:
        durable.remove(path)
    except OSError as error:
        raise ConfigError(f"{path}: cannot be removed: {error.strerror}", remedy="remove it by hand") from error


def gains_in(info: AxisInfo) -> dict[str, int]:
    """Return the gains that a drive has, as its daemon knows them.

    Raises:
        WrongState: it does not know them all.
    """
    known = {each.name: each.value for each in info.registers if each.name in NAMES and each.value is not None}
    if not known.keys() >= NEEDED or not known["kp"]:
        raise WrongState(
            f"axis {info.axis}: the gains that it has are not known, so they could not be put back",
            axis=info.axis,
            remedy=f"give it `gains` in the configuration, or type: ldcnd axis gains {info.axis} --kp KP --el EL",
        )
    return known


async def load(axis: Axis, gains: dict[str, int]) -> None:
    """Open the loop, wait for standstill, and load gains: a closed loop would turn any position error into a jump.

    Raises:
        LdcndError: as the daemon refused it.
        WrongState: it does not come to rest.
    """
    await axis.power(on=False)
    await at_rest(axis)
    await axis.set_gains(**gains)


async def at_rest(axis: Axis) -> None:
    """Wait until an axis stands.

    Raises:
        WrongState: it does not come to rest.
    """
    try:
        async with asyncio.timeout(STAND_S):
            while axis.state.moving is not Moving.NO:
                await axis.news(LOOK_S)
    except TimeoutError:
        raise WrongState(
            f"axis {axis.name} does not come to rest within {STAND_S:g} s with its loop open", axis=axis.name
        ) from None


async def put_back(rig: Rig, kept: KeptGains) -> None:
    """Put the gains of an axis back; the axis is off afterwards.

    Raises:
        LdcndError: as the daemon refused it; they are still kept.
    """
    async with rig.control(kept.axis, client="ldcnd tune", lease_s=LEASE_S) as axis:
        await load(axis, kept.gains)
    forget(kept)
