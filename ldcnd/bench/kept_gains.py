"""The gains that an axis had before a program lent it others: a file on this host until they are back.

Tuning and commissioning load gains of their own for some moves. One file for both says what has to come back, so that
neither takes the gains of the other for those of the machine.
"""

import asyncio
from contextlib import suppress
from pathlib import Path

from ldcnd import durable
from ldcnd.client.axis import Axis, at_rest, seen
from ldcnd.client.rig import Rig
from ldcnd.contract.errors import ConfigError, Remedy, RemedyCommand, StopLatched, WrongState, step
from ldcnd.contract.frozen import Frozen
from ldcnd.contract.meta import AxisInfo
from ldcnd.contract.samples import AxisState

NAMES = ("kp", "kd", "ki", "il", "ol", "cl", "el", "sr", "deadband")
NEEDED = frozenset(NAMES) - {"cl", "deadband"}
"""Registers that every drive with gains has."""
LEASE_S = 5.0
"""So soon the daemon applies `loss.client` of the axis when this program disappears, seconds: no trial lasts longer."""

PUT_BACK_S = 15.0
"""Longest time that the gains may take to come back, seconds."""


class KeptGains(Frozen):
    """Gains that are to be put back."""

    rig: str
    """The rig."""
    axis: str
    """The axis."""
    gains: dict[str, int]
    """Registers of Set Gain, by the names of `set_gains`."""
    model: str = ""
    """The drive model; empty in a file of an earlier version."""


def file_of(rig: str, axis: str) -> Path:
    """Return where the gains of an axis are kept."""
    return durable.state_file("gains", rig, axis)


def keep(kept: KeptGains) -> None:
    """Write them down, so that they outlive this program and this host.

    Raises:
        WrongState: others are kept already: what the drive has now was lent to it.
        ConfigError: the file cannot be written, or what is there cannot be read; nothing has been changed then.
    """
    path = file_of(kept.rig, kept.axis)
    if kept_for(kept.rig, kept.axis):
        raise WrongState(
            f"axis {kept.axis}: its gains are still to be put back ({path})",
            axis=kept.axis,
            remedy=put_back_by_hand(kept.axis),
        )
    try:
        durable.replace(path, kept.model_dump_json(indent=1))
    except OSError as error:
        raise ConfigError(f"{path}: cannot be written: {error.strerror}", remedy="set XDG_STATE_HOME") from error


def kept_for(rig: str, axis: str) -> KeptGains | None:
    """Return what is kept for an axis; None without a file.

    Raises:
        ConfigError: the file cannot be read, or is about another axis.
    """
    path, by_hand = file_of(rig, axis), "set the gains by hand, and remove it"
    try:
        kept = durable.read(path, KeptGains.model_validate_json)
    except durable.DamagedFile as error:
        raise ConfigError(f"the gains kept of axis {axis} cannot be read: {error}", remedy=by_hand) from error
    if kept is None:
        return None
    if (kept.rig, kept.axis) != (rig, axis):
        raise ConfigError(f"{path} is about axis {kept.axis} of rig {kept.rig}", remedy=by_hand)
    return kept


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


def putting_back(axis: str) -> RemedyCommand:
    """Return the command by which a person has gains put back."""
    return step("put_back_gains", f"ldcnd tune {axis} --put-back")


def put_back_by_hand(axis: str) -> Remedy:
    """Return what a person does to have gains put back."""
    return Remedy("{}", putting_back(axis))


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
            remedy=Remedy(
                "give it `gains` in the configuration, or {}",
                step("set_gains", f"ldcnd axis gains {info.axis} --kp KP --el EL"),
            ),
        )
    return known


async def open_loop(axis: Axis) -> None:
    """Open the loop and wait for standstill; clear the trip of a drive that has opened it by itself, never a latch.

    Raises:
        LdcndError: as the daemon refused it.
        WrongState: it does not come to rest.
    """
    state = (await seen(axis)).state
    if axis.control and axis.control.lost:
        raise axis.control.lost  # the daemon sees to it, and another client may move the axis
    if state.state is AxisState.ERROR_STOP and not state.stop_latched:
        await at_rest(axis, watched=True)
        with suppress(StopLatched):  # a stop has come meanwhile: only a person clears its latch
            await axis.reset(faults_only=True)
    await axis.power(on=False)
    await at_rest(axis, watched=True)


async def load(axis: Axis, gains: dict[str, int]) -> None:
    """Open the loop and load gains to stay: a closed one would turn any position error into a jump.

    Raises:
        LdcndError: as the daemon refused it.
        WrongState: it does not come to rest.
    """
    await open_loop(axis)
    await axis.set_gains(gain_set=None, **gains, lent=False)


async def restore(axis: Axis, kept: KeptGains) -> None:
    """Put gains back with the loop open.

    Raises:
        LdcndError: as the daemon refused it; they are still kept.
        WrongState: it takes longer than `PUT_BACK_S`; likewise.
    """
    try:
        async with asyncio.timeout(PUT_BACK_S):
            await load(axis, kept.gains)
    except TimeoutError:
        raise WrongState(
            f"axis {kept.axis}: its gains are not back after {PUT_BACK_S:g} s",
            axis=kept.axis,
            remedy=put_back_by_hand(kept.axis),
        ) from None
    forget(kept)


async def put_back(rig: Rig, kept: KeptGains, client: str) -> None:
    """Do the same under control of this client's own: the axis is off afterwards.

    Raises:
        WrongState: they are those of another drive; they are still kept.
        LdcndError: as the daemon refused it; likewise.
    """
    info = next((each for each in await rig.describe() if each.axis == kept.axis), None)
    if info and kept.model not in ("", info.model):
        raise WrongState(
            f"axis {kept.axis} is a {info.model}; the gains that are kept for it are those of a {kept.model}",
            axis=kept.axis,
            value=info.model,
            limit=kept.model,
            remedy=f"remove {file_of(kept.rig, kept.axis)} if that drive has gone",
        )
    async with rig.control(kept.axis, client=client, lease_s=LEASE_S) as axis:
        await restore(axis, kept)
