"""Travel: a person jogs the axis to both ends, or types where they are; the limits keep a margin from them."""

from contextlib import suppress

from typing_extensions import override

from ldcnd.bench.commissioning.record import ConfigProposal, Figure, Result, StepState
from ldcnd.bench.commissioning.step import Step, StepContext, closed_loop, rest_counts
from ldcnd.bench.person import typed_number
from ldcnd.client.axis import Axis
from ldcnd.contract.commands import Verb
from ldcnd.contract.errors import LeaseExpired, ValueOutOfRange

MARGIN = 0.02
"""Share of the travel that the limits keep from each end."""
DIGITS = 6
HELP = "jog VELOCITY runs it while you hold the key, here takes where it is, a number is where the end is"


class Travel(Step):
    """Finds both ends of the travel."""

    name = "travel"
    title = "Travel"
    about = "You jog the axis to each end while you hold the key, or type where the end is. The limits keep a margin."
    needs = (Verb.POWER, Verb.JOG)
    depends = ("direction", "counts_per_unit", "home")

    @override
    def obstacle(self, site: StepContext) -> str:
        if site.config.modulo is not None:
            return "a rotary axis turns endlessly: it has no ends"
        return super().obstacle(site)

    @override
    async def preview(self, site: StepContext) -> tuple[str, ...]:
        limits = site.info.limits
        low = "none" if limits.position_min is None else site.length(limits.position_min)
        high = "none" if limits.position_max is None else site.length(limits.position_max)
        return (
            (
                f"{site.info.axis} runs while you hold the key, at {site.length(site.config.velocity)}/s at most;"
                " letting go halts it, and so does the loss of this program"
            ),
            f"its present limits ({low} to {high}) end it, too; limit switches do where `limit_switches` says so",
            "its loop is closed and stays closed",
        )

    @override
    async def run(self, site: StepContext, axis: Axis) -> Result:
        if not axis.state.referenced:
            raise ValueOutOfRange(
                f"axis {axis.name} is not referenced: its ends would mean nothing",
                axis=axis.name,
                remedy="run the step home, or type the position that it has with `ldcnd axis set-position`",
            )
        site.person.tell(HELP)
        low = await self._end(site, axis, "reverse")
        high = await self._end(site, axis, "forward")
        if low >= high:
            raise ValueOutOfRange(
                f"axis {axis.name}: the reverse end {low:g} is not below the forward end {high:g}", axis=axis.name
            )
        margin = MARGIN * (high - low)
        lowest, highest = (float(f"{each:.{DIGITS}g}") for each in (low + margin, high - margin))
        unit, limits = site.info.unit, site.config.limits
        proposals = [
            ConfigProposal(table="limits", key=key, value=value)
            for key, value, now in (
                ("position_min", lowest, limits.position_min),
                ("position_max", highest, limits.position_max),
            )
            if value != now
        ]
        return Result(
            state=StepState.DONE,
            text=f"it travels {site.length(high - low)}; limits {lowest:g} to {highest:g} keep {site.length(margin)}",
            figures=(
                Figure(what="reverse end", value=low, unit=unit),
                Figure(what="forward end", value=high, unit=unit),
                Figure(what="margin", value=margin, unit=unit),
            ),
            proposals=tuple(proposals),
        )

    async def _end(self, site: StepContext, axis: Axis, side: str) -> float:
        """Return where an end is, in axis units."""
        person = site.person
        while True:
            answer = (await person.ask(f"{side} end: jog VELOCITY, here, or a position in {site.info.unit}")).split()
            match answer:
                case ["here"]:
                    await rest_counts(axis)
                    return axis.position.value
                case ["jog", text] if velocity := typed_number(text):
                    await self._jog(site, axis, velocity)
                case [text] if (position := typed_number(text)) is not None:
                    return position
                case _:
                    person.tell(HELP)

    @staticmethod
    async def _jog(site: StepContext, axis: Axis, velocity: float) -> None:
        """Run while the key is held, no faster than configured."""
        bounded = max(-site.config.velocity, min(velocity, site.config.velocity))
        async with (
            site.person.holding(f"{axis.name} runs at {site.length(bounded)}/s") as released,
            closed_loop(site, axis),
            axis.jogging(bounded) as jog,
        ):
            with suppress(LeaseExpired):  # it is over at the software limit
                while not released.is_set():
                    await jog.held()
        await rest_counts(axis)
        site.person.tell(f"{axis.name} is at {axis.position.value:g} {site.info.unit}")
