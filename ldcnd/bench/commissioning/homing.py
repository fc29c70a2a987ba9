"""Home repeatability: the reference is searched several times by the configured method; the marks must agree."""

from functools import partial

from typing_extensions import override

from ldcnd.bench.commissioning.record import Figure, PlotSeries, Result, StepState
from ldcnd.bench.commissioning.step import Step, StepContext, closed_loop, key_released, moved_while_held, rest_counts
from ldcnd.client.axis import Axis
from ldcnd.contract.commands import Home, Verb
from ldcnd.drives.axis_config import HomeConfig

SEARCHES = 5
MOST_SEARCHES = 50
BACK_S = 2.0
"""Before each further search it goes back by what it searches in this time at most, seconds."""
REQUESTED = set(Home.model_fields) & set(HomeConfig.model_fields)
"""What a request can say of a search."""


class HomeRepeatability(Step):
    """Searches the reference several times and compares where it was found."""

    name = "home"
    title = "Home and its repeatability"
    about = "The reference is searched several times as `home` of the configuration says; the marks are compared."
    needs = (Verb.POWER, Verb.HOME, Verb.MOVE_RELATIVE)
    depends = ("direction", "counts_per_unit", "home")

    @override
    def obstacle(self, site: StepContext) -> str:
        if site.config.home is None and not super().obstacle(site):
            return "not possible without `home` in the configuration: say there what marks the reference position"
        return super().obstacle(site)

    @override
    async def preview(self, site: StepContext) -> tuple[str, ...]:
        home = site.config.home
        if home is None:
            return ()
        fastest = max(abs(home.velocity), home.find_velocity or 0.0)
        far = fastest * home.timeout_s if home.distance is None else home.distance
        then = "" if home.move_to is None else f", and goes to {site.length(home.move_to)} behind each"
        return (
            (
                f"{site.info.axis} searches {home.method.value} at {site.length(fastest)}/s at most, for"
                f" {home.timeout_s:g} s and {site.length(far)} at most, {SEARCHES} times unless you say otherwise{then}"
            ),
            (
                f"between the searches it goes back by at most {site.length(abs(home.velocity) * BACK_S)}, at"
                f" {site.length(abs(home.velocity))}/s, and never behind where it began"
            ),
            "it moves while you hold the key; letting go halts it and ends the step",
            "its loop is closed and stays closed; its positions count from the reference afterwards",
        )

    @override
    async def run(self, site: StepContext, axis: Axis) -> Result:
        home, person = site.config.home, site.person
        if home is None:
            return Result(state=StepState.NOT_POSSIBLE, text=self.obstacle(site))
        while not 1 < (searches := round(await person.number("how many searches", SEARCHES))) <= MOST_SEARCHES:
            person.tell(f"2 to {MOST_SEARCHES}")
        sign = -1 if site.info.direction == "reverse" else 1
        # with what was said before: the daemon may run with another `home` than the file
        search = partial(axis.home, **home.model_dump(include=REQUESTED, exclude_none=True))
        marks: list[float] = []
        what = f"{axis.name} searches its reference {searches} times"
        async with person.holding(what) as released, closed_loop(site, axis) as before:
            began = sign * before / site.counts_per_unit
            for number in range(1, searches + 1):
                if await moved_while_held(axis, search, released) is None:
                    raise key_released(axis)
                marks.append(await _mark(site, axis))
                person.tell(f"search {number}: {site.length(marks[-1] - marks[0])} from the first")
                if number < searches:
                    here = sign * await rest_counts(axis) / site.counts_per_unit
                    # between where it began and the mark is no other mark
                    back = min(abs(marks[0] + home.position - began), abs(home.velocity) * BACK_S)
                    goal = marks[0] + home.position - (back if home.velocity > 0 else -back)
                    go_back = partial(axis.move_relative, goal - here, velocity=abs(home.velocity))
                    if await moved_while_held(axis, go_back, released) is None:
                        raise key_released(axis)
        return _judged(site, marks)


async def _mark(site: StepContext, axis: Axis) -> float:
    """Return where position 0 is, by the encoder, in axis units from where it counted from at first."""
    await rest_counts(axis)
    sample = axis.position.sample
    sign = -1 if site.info.direction == "reverse" else 1
    return sign * sample.counts / site.counts_per_unit - sample.value


def _judged(site: StepContext, marks: list[float]) -> Result:
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
            PlotSeries(
                title="Deviation from the mean",
                x="search",
                y=unit,
                points=tuple((float(number), each) for number, each in enumerate(deviations, 1)),
            ),
        ),
    )
