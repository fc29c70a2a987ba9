"""Encoder direction and counts per unit: a known motion, measured by a person."""

from functools import partial

from typing_extensions import override

from ldcnd.bench.commissioning.record import ConfigProposal, Figure, Result, StepState
from ldcnd.bench.commissioning.step import (
    Step,
    StepContext,
    closed_loop,
    done,
    key_released,
    moved_while_held,
    refuse_previewed,
    rest_counts,
)
from ldcnd.client.axis import Axis
from ldcnd.contract.commands import Verb
from ldcnd.contract.errors import ValueOutOfRange

SHARE = 0.5
"""Share of the configured velocity at which it moves."""
DEFAULT_S = 2.0
"""Duration of the motion that is proposed, seconds."""
DIGITS = 6
AGREES = 0.002
"""A measured scale that differs by a smaller share is the configured one."""


class Scale(Step):
    """Moves a known distance, has it measured, and computes direction and counts per unit."""

    name = "scale"
    title = "Encoder direction and counts per unit"
    about = (
        "The axis moves a small distance while you hold the key. You measure how far it really went, and which way;"
        " from that come `direction` and `counts_per_unit`."
    )
    needs = (Verb.POWER, Verb.MOVE_RELATIVE)
    depends = ("direction", "counts_per_unit", "unit")

    @override
    def obstacle(self, site: StepContext) -> str:
        if site.info.counts_per_unit is None and not super().obstacle(site):
            return "not possible while the axis works in counts: give it `unit` and a guess of `counts_per_unit`"
        return super().obstacle(site)

    @override
    async def preview(self, site: StepContext) -> tuple[str, ...]:
        velocity = SHARE * site.config.velocity
        return (
            (
                f"{site.info.axis} moves by the distance that you choose, at {site.length(velocity)}/s and by the"
                f" present scale of {site.counts_per_unit:g} counts a {site.info.unit}; wrong if that is"
            ),
            "the drive ends the motion there; letting go halts it before",
            "its loop is closed and stays closed",
        )

    @override
    async def run(self, site: StepContext, axis: Axis) -> Result:
        person, unit = site.person, site.info.unit
        velocity = SHARE * site.config.velocity
        while not (distance := await person.number(f"how far shall it move, signed, in {unit}", velocity * DEFAULT_S)):
            person.tell("that would not move it")
        refuse_previewed(await axis.preview(distance=distance, velocity=velocity))
        moves = f"{site.info.axis} moves by {site.length(distance)}"
        async with person.holding(moves) as released, closed_loop(site, axis) as before:
            ended = await moved_while_held(axis, partial(axis.move_relative, distance, velocity=velocity), released)
            counts = await rest_counts(axis) - before
            if ended is None and not counts:
                raise key_released(axis)
        if ended is None:
            person.tell("halted; what it went until then can be measured as well")
        measured = await person.number(f"how far did it go, signed, in {unit}")
        return _judged(site, distance, counts, measured)


def _judged(site: StepContext, distance: float, counts: int, measured: float) -> Result:
    axis = site.info.axis
    if not measured or not counts:
        raise ValueOutOfRange(
            f"axis {axis}: {counts} counts and {measured:g} {site.info.unit} tell no scale",
            axis=axis,
            remedy="move farther, and check that the encoder counts (step motor)",
        )
    scale = float(f"{abs(counts / measured):.{DIGITS}g}")
    direction = "forward" if (counts > 0) == (measured > 0) else "reverse"
    figures = (
        Figure(what="asked", value=distance, unit=site.info.unit),
        Figure(what="counted", value=counts, unit="counts"),
        Figure(what="measured", value=measured, unit=site.info.unit),
        Figure(what="scale", value=scale, unit=f"counts a {site.info.unit}"),
        Figure(what="direction", value=direction),
    )
    proposals = []
    if direction != site.info.direction:
        proposals.append(ConfigProposal(table="", key="direction", value=direction))
    if abs(scale / site.counts_per_unit - 1) > AGREES:
        proposals.append(ConfigProposal(table="", key="counts_per_unit", value=scale))
    if not proposals:
        return done("direction and scale are as configured").model_copy(update={"figures": figures})
    changed = " and ".join(each.name for each in proposals)
    text = f"{changed} of the configuration must change: {counts} counts are {measured:g} {site.info.unit}"
    return Result(state=StepState.DONE, text=text, figures=figures, proposals=tuple(proposals))
