"""Gains: the axis is tuned in its place of the checklist, where its gains are found by the host."""

from typing_extensions import override

from ldcnd.bench.commissioning.record import ConfigProposal, Figure, PlotSeries, Result, StepState
from ldcnd.bench.commissioning.step import AxisContext, Step, StepContext
from ldcnd.bench.kept_gains import LEASE_S, open_loop
from ldcnd.bench.known import BENCHES
from ldcnd.client.axis import Axis
from ldcnd.client.lease import program_name
from ldcnd.contract.commands import Verb
from ldcnd.parts import require

WITHIN_COUNTS = 2000
"""Proposed distance from where the axis stands, counts."""
LOWEST_HZ, HIGHEST_HZ = 1.0, 200.0
SHOWN = ("kp", "kd", "ki", "il", "ol", "el")
CLIENT = program_name("ldcnd commission")


class GainsStep(Step):
    """Tunes an axis; of a drive that tunes itself it asks whether that was done."""

    name = "gains"
    title = "Gains"
    about = (
        "The axis is moved a little and identified, gains are proposed and tried, and kept when you agree. It needs two"
        " steps before: unit, scale and first gains, and motor against encoder. Of a drive that tunes itself this step"
        " asks whether that was done."
    )
    moves = False
    needs = (Verb.SET_GAINS,)

    @override
    def obstacle(self, site: AxisContext) -> str:
        gains_are_parameters = Verb.WRITE_PARAMETER in site.info.capabilities
        return "" if gains_are_parameters else super().obstacle(site)

    @override
    async def preview(self, site: StepContext) -> tuple[str, ...]:
        if not _is_tuned_here(site):
            return await super().preview(site)
        require("numpy")
        return ("you are asked for a distance; what would move is shown then, and nothing moves before you agree",)

    @override
    async def run(self, site: StepContext, axis: Axis) -> Result:
        return await (_tuned(site, axis) if _is_tuned_here(site) else _asked(site))


def gain_proposals(gains: dict[str, int]) -> tuple[ConfigProposal, ...]:
    """Return gains as values for the configuration: the table `gains` of the axis, whoever writes it."""
    return tuple(ConfigProposal(table="gains", key=register, value=value) for register, value in gains.items())


def _is_tuned_here(site: StepContext) -> bool:
    family = BENCHES.get(site.info.family)
    return family is not None and family.is_tuned_by_host


async def _asked(site: StepContext) -> Result:
    """Ask whether a drive that tunes itself was tuned."""
    registers = {each.name: each.value for each in site.info.registers if each.value is not None}
    figures = tuple(Figure(what=name, value=registers[name]) for name in SHOWN if name in registers)
    if await site.person.confirm(
        f"are the gains of {site.info.axis} tuned, and in the configuration or stored in the drive"
    ):
        return Result(state=StepState.DONE, text="tuned, by your answer", figures=figures)
    return Result(state=StepState.OPEN, text="let the drive tune itself, then run this step again")


async def _tuned(site: StepContext, axis: Axis) -> Result:
    """Ask for distance and bandwidth, and tune an axis.

    Raises:
        Left: the person has left; the old gains are back.
        LdcndError: it cannot be tuned; likewise.
    """
    from ldcnd.bench.tuning import report as reports  # noqa: PLC0415 - needs an optional package

    person, unit = site.person, site.info.unit
    earlier = site.record.of(GainsStep.name).result
    kept = (
        earlier if earlier.state is StepState.DONE else Result(state=StepState.OPEN, text="the axis has its old gains")
    )
    if axis.state.enabled and not await _is_switched_off(site):
        return kept
    usual = WITHIN_COUNTS / site.counts_per_unit
    within = await person.number(f"within which distance of where it stands may it move, in {unit}", usual, site.info)
    tuned = await reports.tune(site.rig.client, person, axis.name, within, await _bandwidth(site))
    if tuned is None:
        return kept
    person.show_moves(unit, tuned.curves)
    report = tuned.report
    if report.after is None and report.objection is None:  # the proposal was not wanted
        return kept
    person.tell(*reports.table(report), *reports.ending(report))
    if not report.applied or report.after is None:
        return kept
    figures = (
        Figure(what="bandwidth", value=report.margins.bandwidth_hz, unit="Hz"),
        Figure(what="phase margin", value=report.margins.phase_deg, unit="degrees"),
        *(Figure(what=register, value=value) for register, value in report.gains.items()),
    )
    series = tuple(
        PlotSeries(title=each.label, x="s", y=unit, points=tuple(zip(each.times_s, each.positions, strict=True)))
        for each in tuned.curves
    )
    return Result(
        state=StepState.DONE,
        text=f"tuned: it settles in {report.after.settling_s * 1e3:.0f} ms, overshoot {report.after.overshoot:.1%}",
        figures=figures,
        series=series,
        proposals=gain_proposals(report.gains),
    )


async def _bandwidth(site: StepContext) -> float | None:
    while wanted_hz := await site.person.number("bandwidth of the loop in Hz, or 0 for what settles soonest", 0):
        if LOWEST_HZ <= wanted_hz <= HIGHEST_HZ:
            return wanted_hz
        site.person.tell(f"{LOWEST_HZ:g} to {HIGHEST_HZ:g} Hz, or 0")
    return None


async def _is_switched_off(site: StepContext) -> bool:
    """Switch an axis off if the person agrees; tell whether it is off, as tuning needs it."""
    name = site.info.axis
    if not await site.person.confirm(f"{name} is powered: switch it off? What falls without power falls"):
        return False
    async with site.rig.control(name, client=CLIENT, lease_s=LEASE_S) as axis:
        await open_loop(axis)
    return True
