"""What tuning would do to an axis, and whether it may: everything is checked before anything is sent to the drive."""

import math
from dataclasses import dataclass

from ldcnd.bench.kept_gains import kept_for, put_back_by_hand
from ldcnd.bench.tuning.excitation import Bounds, Excitation
from ldcnd.client.axis import Axis, at_rest
from ldcnd.client.rig import Rig
from ldcnd.client.rig_client import RigClient
from ldcnd.contract.errors import (
    NotReferenced,
    NotSupported,
    PositionLimit,
    Remedy,
    StopLatched,
    ValueOutOfRange,
    WrongState,
    step,
)
from ldcnd.contract.meta import AxisInfo
from ldcnd.contract.samples import AxisState
from ldcnd.drives.driver import LARGEST_COUNT
from ldcnd.drives.ldcn.profiles import PROFILES, Profile

WITHIN_COUNTS = 2000
"""Distance where none is wanted, counts."""
PLANNED_WITH = ("model", "address", "identity", "unit", "counts_per_unit", "direction", "modulo", "limits", "approach")
"""What a plan stands on."""
BELOW = 1 - 1e-9
"""Keeps a limit that was converted to counts and back from being exceeded by its rounding."""


@dataclass(frozen=True, slots=True)
class Plan:
    """What tuning would do; nothing has been sent to the drive.

    Attributes:
        info: the axis.
        profile: its dialect.
        bounds: what the axis may be asked to do.
        here_counts: where the axis stands, by its encoder: the bounds are from there.
        lines: the same for people.
    """

    info: AxisInfo
    profile: Profile
    bounds: Bounds
    here_counts: int
    lines: tuple[str, ...]

    @property
    def counts_per_unit(self) -> float:
        """Signed: negative where forward in units is backward in counts."""
        counts = self.info.counts_per_unit or 1.0
        return -counts if self.info.direction == "reverse" else counts

    def units(self, counts: float) -> float:
        """Return counts as a length in axis units, without sign of its own."""
        return counts / abs(self.counts_per_unit)


async def plan(client: RigClient, name: str, within: float | None) -> Plan:
    """Check that an axis can be tuned, and say what that would do; sends nothing to its drive.

    Args:
        client: of the rig.
        name: of the axis.
        within: the distance from where it stands that it may not leave, in axis units; 2000 counts when missing.

    Raises:
        NotSupported: its drive has no gains of this kind.
        StopLatched: a stop is latched.
        WrongState: its loop is closed, it moves, an earlier tuning is not put back, or its kinds of motion have gains
            of their own.
        NotReferenced: it has position limits, and does not know where it is.
        PositionLimit: the distance does not fit between them.
        ValueOutOfRange: it is too short.
    """
    rig = Rig(client, await client.daemon())
    async with rig.watch(name) as axis:
        info = next(each for each in await client.axes() if each.axis == name)
        profile = _profile_of(info)
        if info.gains_for:  # of which set the drive holds the gains, and which one its moves load, are two things
            kinds = ", ".join(f"{kind} {chosen}" for kind, chosen in info.gains_for.items())
            raise WrongState(
                f"axis {name}: its kinds of motion have gains of their own ({kinds}), and tuning finds those of all",
                axis=name,
                value=kinds,
                remedy="take gains_for out of the configuration, restart the daemon, tune, and put it back",
            )
        if kept_for(rig.name, name):
            raise WrongState(
                f"axis {name}: an earlier tuning was cut short and its gains are still to be put back",
                axis=name,
                remedy=put_back_by_hand(name),
            )
        await check_off(axis)
        counts_per_unit = info.counts_per_unit or 1.0
        within_counts = WITHIN_COUNTS if within is None else _counts(name, within * counts_per_unit)
        limits = info.limits
        bounds = Bounds(
            within_counts,
            math.inf if limits.velocity is None else limits.velocity * counts_per_unit * BELOW,
            math.inf if limits.acceleration is None else limits.acceleration * counts_per_unit * BELOW,
        )
        excitation = Excitation(profile, bounds)
        await _check_travel(axis, info, within_counts / counts_per_unit)
        lines = _lines(info, axis.position.value, bounds, excitation)
        here_counts = axis.position.sample.counts
    return Plan(info, profile, bounds, here_counts, lines)


def _counts(axis: str, within_counts: float) -> int:
    """Return a distance in whole counts.

    Raises:
        ValueOutOfRange: it is none, or no drive counts so far.
    """
    if not 0 <= within_counts <= LARGEST_COUNT:
        raise ValueOutOfRange(
            f"axis {axis}: {within_counts:g} counts are no distance",
            axis=axis,
            value=str(within_counts),
            limit=LARGEST_COUNT,
            remedy="give the distance in axis units",
        )
    return round(within_counts)


def check_as_planned(planned: Plan, info: AxisInfo) -> None:
    """Refuse an axis that is another one than when the plan was made and agreed to: distances would mean others.

    Raises:
        WrongState: names what differs.
    """
    differ = [name for name in PLANNED_WITH if getattr(info, name) != getattr(planned.info, name)]
    if differ:
        raise WrongState(
            f"axis {info.axis} has another {' and '.join(differ)} than when this was planned",
            axis=info.axis,
            remedy="tune it again",
        )


def _profile_of(info: AxisInfo) -> Profile:
    profile = PROFILES.get(info.model)
    if profile is None:
        raise NotSupported(f"axis {info.axis}: a {info.model} has no law that is known here", axis=info.axis)
    return profile


async def check_off(axis: Axis) -> None:
    """Refuse an axis whose loop is closed: with the amplifier off, a load that falls has fallen."""
    state = axis.state
    if state.stop_latched:
        raise StopLatched(f"axis {axis.name}: a stop is latched", axis=axis.name, remedy=Remedy("{}", step("reset")))
    if state.enabled or state.state is not AxisState.DISABLED:
        raise WrongState(
            f"axis {axis.name} is in state {state.state.words}: tuning begins with the loop open, and opens it between"
            " moves, so the axis must stay where it is without power",
            axis=axis.name,
            value=state.state.value,
            remedy=Remedy("secure the load, then {}", step("reset"))
            if state.state is AxisState.ERROR_STOP
            else Remedy("secure the load, then {}", step("power", f"ldcnd power off {axis.name}", on=False)),
        )
    await at_rest(axis, watched=True)


async def _check_travel(axis: Axis, info: AxisInfo, within: float) -> None:
    """Refuse a distance that does not fit into the travel of the axis, and an axis that comes from one side only."""
    limits = info.limits
    here = axis.position.value
    lowest, highest = limits.position_min, limits.position_max
    if (lowest is not None or highest is not None) and not axis.state.referenced:
        raise NotReferenced(
            f"axis {axis.name} has position limits and does not know where it is",
            axis=axis.name,
            remedy=Remedy("{}, then power it off", step("home")),
        )
    if (lowest is not None and here - within < lowest) or (highest is not None and here + within > highest):
        raise PositionLimit(
            f"axis {axis.name} stands at {here:g} {info.unit}: {within:g} {info.unit} either way would leave"
            f" {'-inf' if lowest is None else f'{lowest:g}'} to {'inf' if highest is None else f'{highest:g}'}",
            axis=axis.name,
            value=within,
            limit=min(math.inf if lowest is None else here - lowest, math.inf if highest is None else highest - here),
            remedy="move it away from its limits, or allow less with --within",
        )
    for distance in (within, -within):
        if (await axis.preview(distance=distance)).approach_from is not None:
            raise WrongState(
                f"axis {axis.name} comes to its goals from one side (`approach`): tuning moves it both ways",
                axis=axis.name,
                remedy="take `approach` out of the configuration for the tuning",
            )


def _lines(info: AxisInfo, here: float, bounds: Bounds, excitation: Excitation) -> tuple[str, ...]:
    within = bounds.within_counts / (info.counts_per_unit or 1.0)
    distance = f"{within:g} {info.unit} ({bounds.within_counts} counts)"
    output = f"{excitation.most_impulse:.0f} PWM steps times servo ticks"
    return (
        f"{info.axis} stands at {here:g} {info.unit}; it will stay within {distance} of that.",
        "Short pulses come first, then soft moves by a quarter of that, stiff ones by an eighth, test moves by half.",
        "The loop is opened between moves: what does not stay where it is without power must be secured.",
        f"Without an encoder the motor would get pulses of at most {output}; the drive ends them.",
        "Its gains are kept on this host, and put back when it ends, is ended (Ctrl-C in a terminal) or fails.",
        "This is software, not an emergency stop: keep yours within reach.",
    )
