"""Tuning as a step of the checklist: what is asked before, and the result that the record keeps."""

from dataclasses import dataclass

from ldcnd.bench.commissioning.checklist import CLIENT, STEPS
from ldcnd.bench.commissioning.record import ConfigProposal, Figure, PlotSeries, Result, StepState
from ldcnd.bench.known import BENCHES
from ldcnd.bench.person import Person
from ldcnd.client.axis import seen
from ldcnd.client.kept_gains import LEASE_S, open_loop
from ldcnd.client.rig import Rig
from ldcnd.client.rig_client import RigClient
from ldcnd.config.rig import RigConfig
from ldcnd.console.commissioning.messages import CurveView
from ldcnd.parts import require

WITHIN_COUNTS = 2000
"""Proposed distance from where the axis stands, counts."""
LOWEST_HZ, HIGHEST_HZ = 1.0, 200.0


ABOUT = (
    "The axis is moved a little and identified, gains are proposed and tried, and kept when you agree. It needs two"
    f" steps before: {STEPS['settings'].title}, and {STEPS['motor'].title}."
)


@dataclass(frozen=True, slots=True)
class Tuning:
    """What a tuning has led to.

    Attributes:
        result: of the step; None where the gains are the old ones.
        curves: the test moves.
        unit: of the axis.
    """

    result: Result | None
    curves: tuple[CurveView, ...] = ()
    unit: str = ""


def is_offered(config: RigConfig, axis: str) -> bool:
    """Tell whether the gains of an axis of a configuration are found here."""
    families = [BENCHES.get(bus.family) for bus in config.bus if axis in [each.name for each in bus.axis]]
    return any(family is not None and family.is_tuned_by_host for family in families)


async def tune(client: RigClient, person: Person, name: str) -> Tuning | None:
    """Ask for distance and bandwidth, and tune an axis; None when it was not to move.

    Raises:
        ConfigError: an optional package is missing.
        Left: the person has left; the old gains are back.
        LdcndError: it cannot be tuned; likewise.
    """
    require("numpy")
    from ldcnd.bench.tuning.ldcn import guided  # noqa: PLC0415 - needs an optional package

    rig = Rig(client, await client.daemon())
    if not await _is_off(rig, person, name):
        return None
    info = next(each for each in await rig.describe() if each.axis == name)
    usual = WITHIN_COUNTS / (info.counts_per_unit or 1.0)
    within = await person.number(f"within which distance of where it stands may it move, in {info.unit}", usual)
    bandwidth_hz = await _bandwidth(person)
    tuned = await guided.tune(client, person, name, within, bandwidth_hz)
    if tuned is None:
        return None
    curves = tuple(CurveView.model_validate(each.model_dump()) for each in tuned.curves)
    report = tuned.report
    if report.after is None and report.objection is None:  # the proposal was not wanted
        return Tuning(None, curves, info.unit)
    person.tell(*guided.table(report), *guided.ending(report))
    if not report.applied or report.after is None:
        return Tuning(None, curves, info.unit)
    result = Result(
        state=StepState.DONE,
        text=f"tuned: it settles in {report.after.settling_s * 1e3:.0f} ms, overshoot {report.after.overshoot:.1%}",
        figures=(
            Figure(what="bandwidth", value=report.margins.bandwidth_hz, unit="Hz"),
            Figure(what="phase margin", value=report.margins.phase_deg, unit="degrees"),
            *(Figure(what=register, value=value) for register, value in report.gains.items()),
        ),
        series=tuple(
            PlotSeries(
                title=each.label, x="s", y=info.unit, points=tuple(zip(each.times_s, each.positions, strict=True))
            )
            for each in tuned.curves
        ),
        proposals=tuple(
            ConfigProposal(table="gains", key=register, value=value) for register, value in report.gains.items()
        ),
    )
    return Tuning(result, curves, info.unit)


async def _bandwidth(person: Person) -> float | None:
    while wanted_hz := await person.number("bandwidth of the loop in Hz, or 0 for what settles soonest", 0):
        if LOWEST_HZ <= wanted_hz <= HIGHEST_HZ:
            return wanted_hz
        person.tell(f"{LOWEST_HZ:g} to {HIGHEST_HZ:g} Hz, or 0")
    return None


async def _is_off(rig: Rig, person: Person, name: str) -> bool:
    """Switch an axis off if it is on and the person agrees; tell whether it is off, as tuning wants it."""
    async with rig.watch(name) as axis:
        if not (await seen(axis)).state.enabled:
            return True
    if not await person.confirm(f"{name} is powered: switch it off? What falls without power falls"):
        return False
    async with rig.control(name, client=CLIENT, lease_s=LEASE_S) as axis:
        await open_loop(axis)
    return True
