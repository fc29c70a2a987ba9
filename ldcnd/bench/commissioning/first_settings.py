"""The steps that ask and move nothing: what falls without power, and what a configuration needs before anything moves.

A configuration that `ldcnd scan` has begun works in counts and has no gains: nothing is known of the machine then.
"""

from collections.abc import Iterator

from typing_extensions import override

from ldcnd.bench.commissioning.record import ConfigProposal, Figure, Result, StepState
from ldcnd.bench.commissioning.step import AxisContext, Step, StepContext, done
from ldcnd.client.axis import Axis
from ldcnd.contract.commands import Verb
from ldcnd.drives.axis_config import AxisConfig, LossPolicy

LOADS = {
    "none": "nothing, and there is no brake",
    "hangs": "the load: it hangs",
    "brake": "nothing: a brake holds the axis",
    "both": "the load, unless its brake holds it",
}
POWERING_OFF = ("bus", "client", "daemon")


def powered_off(config: AxisConfig) -> str:
    """Return a remark for an axis that falls without power, where its configuration powers it off; empty otherwise."""
    losses = [name for name in POWERING_OFF if getattr(config.loss, name) is LossPolicy.POWER_OFF]
    return f"; `loss` powers it off when {' and '.join(losses)} is lost: it falls then" if losses else ""


class LoadStep(Step):
    """Asks for a hanging load and a brake."""

    name = "load"
    title = "Brake or hanging load"
    about = (
        "You say whether something falls when the motor has no power, and whether a brake holds it. `hold` measures."
    )
    moves = False
    depends = ("loss.client", "loss.bus", "loss.daemon")

    @override
    async def run(self, site: StepContext, axis: Axis) -> Result:
        answer = await site.person.choose("what falls without power", LOADS)
        remark = await site.person.ask("a remark for the report, or nothing")
        figures = [Figure(what="load", value=answer)]
        if remark:
            figures.append(Figure(what="remark", value=remark))
        text = {
            "none": "nothing falls without power",
            "hangs": "the load falls without power: secure it before every step that opens the loop",
            "brake": "nothing falls, and a brake holds the axis: release it before it moves",
            "both": "a brake holds the load: see that it closes before the loop opens, and release it before it moves",
        }[answer]
        if answer in ("hangs", "both"):
            text += powered_off(site.config)
        return done(text).model_copy(update={"figures": tuple(figures)})


COUNT = "count"
SOFT_GAINS = {"kp": 100, "kd": 1000, "ki": 50, "il": 200, "ol": 250, "el": 1000}
"""Registers of a loop that is stable on common motors, and stiff on none."""
DIGITS = 6
MARKS = {
    "none": "nothing, or not known yet",
    "index": "the index of the encoder",
    "forward_limit": "the forward limit switch",
    "reverse_limit": "the reverse limit switch",
}
HOME_COUNTS_PER_S = 500
"""Speed of a search for the reference, counts a second: a quarter of a count in a servo cycle, slow for any index."""


class FirstSettings(Step):
    """Asks for what a configuration needs before anything can move."""

    name = "settings"
    title = "Unit, scale and first gains"
    about = (
        "You say in which unit the axis works, about how many encoder counts one of it has, and how fast it moves by"
        " default. Soft gains are proposed with that: without gains the loop stays open."
    )
    moves = False
    needs = (Verb.SET_GAINS,)

    @override
    def unneeded(self, site: AxisContext) -> str:
        config = site.config
        known = config.gains is not None and config.counts_per_unit is not None
        return "unit, scale and gains are in the configuration" if known else ""

    @override
    async def preview(self, site: StepContext) -> tuple[str, ...]:
        gains = ", ".join(f"{name} = {value}" for name, value in SOFT_GAINS.items())
        return (*await super().preview(site), f"soft gains for the beginning: {gains}")

    @override
    async def run(self, site: StepContext, axis: Axis) -> Result:
        proposals = [*await _scale(site)] if site.config.counts_per_unit is None else []
        if site.config.gains is None:
            proposals += [ConfigProposal(table="gains", key=name, value=value) for name, value in SOFT_GAINS.items()]
        text = "; ".join(f"{each.name} = {each.literal}" for each in proposals if not each.table)
        return Result(state=StepState.DONE, text=text or "gains only", proposals=tuple(proposals))


async def _scale(site: StepContext) -> tuple[ConfigProposal, ...]:
    """Ask for unit, scale, and what is measured in them."""
    person, config = site.person, site.config
    while not (unit := await person.ask("unit of the axis, such as mm, deg or turn; count for encoder counts")):
        person.tell("a unit is needed")
    scale = 1.0
    if unit != COUNT:
        person.tell(
            f"encoder counts of one {unit}: four times the lines of the encoder, divided by how many {unit} a turn of"
            " it is; a guess will do, a later step measures it"
        )
        while (scale := await person.number(f"encoder counts of one {unit}")) <= 0:
            person.tell("it must be above 0")
    settings: dict[str, float | str] = {} if unit == COUNT else {"unit": unit, "counts_per_unit": scale}
    for key, per in (("velocity", "s"), ("acceleration", "s²")):
        usual = float(f"{getattr(config, key) / scale:.{DIGITS}g}")
        while (value := await person.number(f"{key} of its moves, in {unit}/{per}", usual)) <= 0:
            person.tell("it must be above 0")
        settings[key] = value
    mark = await person.choose("what marks its reference position", MARKS)
    home = () if mark == "none" else tuple(_home(mark, scale))
    return (*(ConfigProposal(table="", key=key, value=value) for key, value in settings.items()), *home)


def _home(mark: str, scale: float) -> Iterator[ConfigProposal]:
    speed = float(f"{HOME_COUNTS_PER_S / scale:.{DIGITS}g}")
    yield ConfigProposal(table="home", key="method", value=mark)
    yield ConfigProposal(table="home", key="velocity", value=-speed if mark == "reverse_limit" else speed)
