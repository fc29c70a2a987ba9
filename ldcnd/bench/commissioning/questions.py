"""A step that asks and moves nothing: a brake or a hanging load."""

from typing_extensions import override

from ldcnd.bench.commissioning.record import Figure, Result
from ldcnd.bench.commissioning.step import Step, StepContext, done
from ldcnd.client.axis import Axis
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
