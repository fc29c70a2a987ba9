"""The steps that find distances: counts of a unit, the reference, and both ends of the travel."""

from contextlib import suppress
from functools import partial

from typing_extensions import override

from ldcnd.bench.commissioning.record import ConfigProposal, Figure, PlotSeries, Result, StepState
from ldcnd.bench.commissioning.step import (
    AxisContext,
    Step,
    StepContext,
    closed_loop,
    done,
    key_released,
    moved_while_held,
    refuse_previewed,
    rest_counts,
)
from ldcnd.bench.person import typed_number
from ldcnd.client.axis import Axis
from ldcnd.contract.commands import Home, Verb
from ldcnd.contract.errors import LeaseExpired, Remedy, ValueOutOfRange, step
from ldcnd.contract.units import Dimension
from ldcnd.drives.axis_config import HomeConfig, whole_turn

SCALE_SHARE = 0.5
"""Share of the configured velocity at which it moves."""
DEFAULT_S = 2.0
"""Duration of the motion that is proposed, seconds."""
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
    def obstacle(self, site: AxisContext) -> str:
        if site.info.counts_per_unit is None and not super().obstacle(site):
            return "not possible while the axis works in counts: give it `unit` and a guess of `counts_per_unit`"
        return super().obstacle(site)

    @override
    async def preview(self, site: StepContext) -> tuple[str, ...]:
        velocity = SCALE_SHARE * site.config.velocity
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
        velocity = SCALE_SHARE * site.config.velocity
        while not (
            distance := await person.number(
                f"how far shall it move, signed, in {unit}", velocity * DEFAULT_S, site.info
            )
        ):
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
        measured = await person.number(f"how far did it go, signed, in {unit}", of=site.info)
        return _scale_found(site, distance, counts, measured)


def _scale_found(site: StepContext, distance: float, counts: int, measured: float) -> Result:
    axis = site.info.axis
    if not measured or not counts:
        raise ValueOutOfRange(
            f"axis {axis}: {counts} counts and {measured:g} {site.info.unit} tell no scale",
            axis=axis,
            remedy="move farther, and check that the encoder counts (step motor)",
        )
    scale, modulo = float(f"{abs(counts / measured):.{DIGITS}g}"), site.config.modulo
    direction = "forward" if (counts > 0) == (measured > 0) else "reverse"
    figures = (
        Figure(what="asked", value=distance, unit=site.info.unit),
        Figure(what="counted", value=counts, unit="counts"),
        Figure(what="measured", value=measured, unit=site.info.unit),
        Figure(what="scale", value=scale, unit=f"counts a {site.info.unit}"),
        Figure(what="direction", value=direction),
    )
    proposals, turn = [], None
    if direction != site.info.direction:
        proposals.append(ConfigProposal(table="", key="direction", value=direction))
    if abs(scale / site.counts_per_unit - 1) > AGREES:
        turn = None if modulo is None else whole_turn(modulo, counts / measured)
        proposals.append(ConfigProposal(table="", key="counts_per_unit", value=turn or scale))
    if not proposals:
        return done("direction and scale are as configured").model_copy(update={"figures": figures})
    changed = " and ".join(each.name for each in proposals)
    text = f"{changed} of the configuration must change: {counts} counts are {measured:g} {site.info.unit}"
    if turn:
        text += f"; {turn} makes a turn whole: type the counts that encoder and gear make of one, if they are others"
    return Result(state=StepState.DONE, text=text, figures=figures, proposals=tuple(proposals))


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
    def obstacle(self, site: AxisContext) -> str:
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
                f"between the searches it goes back to {site.length(abs(home.velocity) * BACK_S)} before the mark at"
                f" most, at {site.length(abs(home.velocity))}/s, and never behind where it began"
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
        return _marks_found(site, marks)


async def _mark(site: StepContext, axis: Axis) -> float:
    """Return where position 0 is, by the encoder, in axis units from where it counted from at first."""
    await rest_counts(axis)
    sample = axis.position.sample
    sign = -1 if site.info.direction == "reverse" else 1
    turns = (sample.turns or 0) * (site.info.modulo or 0.0)  # the encoder counts through them
    return sign * sample.counts / site.counts_per_unit - sample.value - turns


def _marks_found(site: StepContext, marks: list[float]) -> Result:
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
    def obstacle(self, site: AxisContext) -> str:
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
                remedy=Remedy(
                    "run the step home, or, where its position is known, {}",
                    step("set_position", "ldcnd axis set-position"),
                ),
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
                case ["jog", *text] if velocity := typed_number(" ".join(text), site.info, Dimension.VELOCITY):
                    await self._jog(site, axis, velocity)
                case text if (position := typed_number(" ".join(text), site.info)) is not None:
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
