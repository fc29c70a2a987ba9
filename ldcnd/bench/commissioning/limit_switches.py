"""Limit switches and their polarity: a person presses each, and the inputs are watched."""

import asyncio
from collections.abc import Callable, Mapping
from typing import Literal

from pydantic import ValidationError
from typing_extensions import override

from ldcnd.bench.commissioning.record import ConfigProposal, Figure, Result, StepState
from ldcnd.bench.commissioning.step import AxisContext, Step, StepContext, done
from ldcnd.bench.machine_faults import MachineFault, fault_found, named
from ldcnd.client.axis import Axis
from ldcnd.contract.errors import Remedy, WrongState, step
from ldcnd.contract.samples import InputsSample, TelemetryItem

PRESS_S = 60.0
"""Longest time in which a switch is pressed, seconds."""
SIDES = ("reverse", "forward")
LEVELS: Mapping[bool, Literal["high", "low"]] = {True: "high", False: "low"}
STOPS = ConfigProposal(table="", key="limit_switches", value="stop")
"""The drive itself stops a motion that runs onto a switch, also without a host."""
Levels = tuple[bool | None, bool | None]


class LimitSwitches(Step):
    """Watches the inputs while a person presses the switches."""

    name = "limits"
    title = "Limit switches and their polarity"
    about = (
        "You press each limit switch by hand; the inputs are watched. From that come level and order of the switches."
    )
    moves = False
    depends = ("direction", "home.switch_active", "limit_switches")

    @override
    def obstacle(self, site: AxisContext) -> str:
        shows = TelemetryItem.INPUTS.value in site.info.items
        return "" if shows else f"not possible on this model: a {site.info.model} shows no limit switch inputs"

    @override
    async def run(self, site: StepContext, axis: Axis) -> Result:
        person = site.person
        if not await person.confirm("has the axis limit switches?"):
            return Result(state=StepState.SKIPPED, text="it has no limit switches")
        sample = await site.rig.latest(axis.name, TelemetryItem.INPUTS)
        if sample is None:
            raise WrongState(
                f"axis {axis.name}: its inputs are not published", axis=axis.name, remedy="set `rates.inputs` above 0"
            )
        idle = _levels(sample)
        if None in idle:
            raise WrongState(
                f"axis {axis.name}: this drive shows its limit switches only while its power driver is on",
                axis=axis.name,
                remedy=Remedy(
                    "{}; it then holds its position while you press them",
                    step("power", f"ldcnd power on {axis.name}", on=True),
                ),
            )
        pressed: list[int] = []
        for side in SIDES:
            person.tell(f"press the {side} limit switch, and let it go")
            pressed.append(await self._pressed(site, idle, side))
            await self._until(
                site, lambda levels: levels == idle, f"came back to its level at rest after the {side} switch"
            )
        return _judged(site, idle, pressed)

    async def _pressed(self, site: StepContext, idle: Levels, side: str) -> int:
        """Wait until one input differs from its level at rest; return which."""
        changed = await self._until(
            site,
            lambda levels: levels != idle and None not in levels,
            f"changed with the {side} switch",
        )
        which = [number for number in (0, 1) if changed[number] != idle[number]]
        if len(which) > 1:
            raise WrongState(
                f"axis {site.info.axis}: both inputs change with the {side} switch",
                axis=site.info.axis,
                remedy="separate the wires of the two switches",
            )
        return which[0]

    @staticmethod
    async def _until(site: StepContext, wanted: Callable[[Levels], bool], what: str) -> Levels:
        """Watch the inputs until their levels are as wanted; return them.

        Raises:
            DriveFault: they do not become so in time.
        """
        axis = site.info.axis
        try:
            async with asyncio.timeout(PRESS_S), site.rig.samples(axis, TelemetryItem.INPUTS) as samples:
                levels = _levels(await site.rig.latest(axis, TelemetryItem.INPUTS))
                while not wanted(levels):
                    levels = _levels((await anext(samples))[1])
        except TimeoutError:
            seen = f"axis {axis}: within {PRESS_S:g} s no input {what}"
            raise fault_found(seen, MachineFault.SWITCH_DEAD, MachineFault.SWITCH_HELD) from None
        return levels


def _levels(sample: object) -> Levels:
    return (sample.reverse_limit, sample.forward_limit) if isinstance(sample, InputsSample) else (None, None)


def _judged(site: StepContext, idle: Levels, pressed: list[int]) -> Result:
    figures = tuple(
        Figure(what=f"{side} switch", value=f"{SIDES[number]} input, {LEVELS[not idle[number]]} when pressed")
        for side, number in zip(SIDES, pressed, strict=True)
    )
    if pressed[0] == pressed[1]:
        return _wrong(figures, MachineFault.SWITCHES_JOINED, MachineFault.SWITCH_DEAD)
    if pressed != [0, 1]:
        return _wrong(figures, MachineFault.SWITCHES_SWAPPED)
    if idle[0] != idle[1]:
        return _wrong(figures, MachineFault.SWITCHES_UNLIKE, MachineFault.SWITCH_HELD)
    active: Literal["high", "low"] = LEVELS[not idle[0]]
    result = done(f"both inputs are {active} when their switch is pressed").model_copy(update={"figures": figures})
    proposals: list[ConfigProposal] = []
    text = result.text
    if active != site.config.switch_active and site.config.home is None:
        text += f': write `switch_active = "{active}"` into `home` when it gets one'
    else:
        if active != site.config.switch_active:
            proposals.append(ConfigProposal(table="home", key="switch_active", value=active))
        if site.config.limit_switches != STOPS.value and _can_stop(site, active):
            text += "; the drive can stop on them by itself"
            proposals.append(STOPS)
    return result.model_copy(update={"text": text, "proposals": tuple(proposals)})


def _wrong(figures: tuple[Figure, ...], *faults: MachineFault) -> Result:
    return Result(state=StepState.FAILED, text=named(faults), figures=figures, faults=faults)


def _can_stop(site: StepContext, active: str) -> bool:
    """Return whether the configuration may say that the drive stops on its switches."""
    document = site.config.model_dump(mode="json") | {STOPS.key: STOPS.value}
    if document["home"]:
        document["home"]["switch_active"] = active
    try:
        type(site.config).model_validate(document)
    except ValidationError:
        return False
    return True
