"""Home repeatability: the reference is searched several times by the configured method; the marks must agree."""

from typing_extensions import override

from ldcnd.client.axis import Axis
from ldcnd.commissioning.record import Figure, Result, Series, StepState
from ldcnd.commissioning.step import Site, Step, ended_while_held, rest_counts
from ldcnd.errors import CommandAborted
from ldcnd.model.commands import Verb

SEARCHES = 5
MOST_SEARCHES = 50
BACK_S = 2.0
"""Before each further search it goes back by what it searches in this time at most, seconds."""


class HomeRepeatability(Step):
    """Searches the reference several times and compares where it was found."""

    name = "home"
    title = "Home and its repeatability"
    about = "The reference is searched several times as `home` of the configuration says; the marks are compared."
    needs = (Verb.POWER, Verb.HOME, Verb.MOVE_RELATIVE)
    depends = ("direction", "counts_per_unit", "home")

    @override
    def obstacle(self, site: Site) -> str:
        if site.config.home is None and not super().obstacle(site):
            return "not possible without `home` in the configuration: say there what marks the reference position"
        return super().obstacle(site)

    @override
    async def preview(self, site: Site) -> tuple[str, ...]:
        home = site.config.home
        if home is None:
            return ()
        far = abs(home.velocity) * home.timeout_s if home.distance is None else home.distance
        return (
            (
                f"{site.info.axis} searches {home.method.value} at {home.velocity:g} {site.info.unit}/s, for"
                f" {home.timeout_s:g} s and {site.length(far)} at most, {SEARCHES} times unless you say otherwise"
            ),
            (
                f"between the searches it goes back by at most {site.length(abs(home.velocity) * BACK_S)}, and never"
                " behind where it began"
            ),
            "it moves while you hold the key; letting go halts it and ends the step",
            "its loop is closed and stays closed; its positions count from the reference afterwards",
        )

    @override
    async def run(self, site: Site, axis: Axis) -> Result:
        home, person = site.config.home, site.person
        if home is None:
            return Result(state=StepState.NOT_POSSIBLE, text=self.obstacle(site))
        while not 1 < (searches := round(await person.number("how many searches", SEARCHES))) <= MOST_SEARCHES:
            person.tell(f"2 to {MOST_SEARCHES}")
        await axis.power(on=True)
        sign = -1 if site.info.direction == "reverse" else 1
        began = sign * await rest_counts(axis) / site.counts_per_unit
        marks: list[float] = []
        async with person.holding(f"{axis.name} searches its reference {searches} times") as released:
            for number in range(1, searches + 1):
                if await ended_while_held(axis, await axis.home(), released) is None:
                    raise _halted(axis)
                marks.append(await _mark(site, axis))
                person.tell(f"search {number}: {site.length(marks[-1] - marks[0])} from the first")
                if number < searches:
                    here = sign * await rest_counts(axis) / site.counts_per_unit
                    # between where it began and the mark is no other mark
                    back = min(abs(marks[0] + home.position - began), abs(home.velocity) * BACK_S)
                    goal = marks[0] + home.position - (back if home.velocity > 0 else -back)
                    if await ended_while_held(axis, await axis.move_relative(goal - here), released) is None:
                        raise _halted(axis)
        return _judged(site, marks)


async def _mark(site: Site, axis: Axis) -> float:
    """Return where position 0 is, by the encoder, in axis units from where it counted from at first."""
    await rest_counts(axis)
    sample = axis.position.sample
    sign = -1 if site.info.direction == "reverse" else 1
    return sign * sample.counts / site.counts_per_unit - sample.value


def _halted(axis: Axis) -> CommandAborted:
    return CommandAborted(f"axis {axis.name}: the key was let go", axis=axis.name, remedy="run the step again")


def _judged(site: Site, marks: list[float]) -> Result:
    mean = sum(marks) / len(marks)
    deviations = [mark - mean for mark in marks]
    spread = max(marks) - min(marks)
    deviation = (sum(each * each for each in deviations) / (len(marks) - 1)) ** 0.5
    unit = site.info.unit
    return Result(
        state=StepState.DONE,
        text=f"{len(marks)} searches, {site.length(spread)} from the lowest to the highest",
        figures=(
            Figure(what="searches", value=len(marks)),
            Figure(what="spread", value=spread, unit=unit),
            Figure(what="standard deviation", value=deviation, unit=unit),
            Figure(what="one count", value=1 / site.counts_per_unit, unit=unit),
        ),
        series=(
            Series(
                title="Deviation from the mean",
                x="search",
                y=unit,
                points=tuple((float(number), each) for number, each in enumerate(deviations, 1)),
            ),
        ),
    )
