"""Interlocks of a configuration: what a motion, a power-off or an output requires of inputs, outputs, axes and modules.

They are software: a means against mistakes, and no safety function.
"""

import math
from collections.abc import Mapping
from enum import StrEnum
from typing import Literal, Self

from pydantic import Field, model_validator

from ldcnd.contract.frozen import Frozen
from ldcnd.drives.axis_config import AxisConfig
from ldcnd.drives.line_config import BusConfig
from ldcnd.drives.toml import Name, refuse_duplicates

LOOKS = 4
"""Times that a rule is looked at within its bound."""


class Requirement(Frozen):
    """What must hold: of exactly one input, output, module or axis; what is not known does not hold."""

    input: Name | None = None
    """A named input."""
    output: Name | None = None
    """A named output."""
    module: Name | None = None
    """An I/O module, which must answer."""
    axis: Name | None = None
    """An axis, which must answer."""
    value: bool = True
    """Value that the input must have; of an output true is high."""
    standstill: bool = False
    """The axis must stand."""
    below: float | None = Field(default=None, gt=0)
    """Speed that the axis must be below, units a second: what is read, and what is commanded."""
    min: float | None = None
    """Lowest position of the axis, which must be referenced."""
    max: float | None = None
    """Highest position of the axis, which must be referenced."""
    homed: bool = False
    """The axis must be referenced."""

    @model_validator(mode="after")
    def _of_one(self) -> Self:
        if sum(each is not None for each in (self.input, self.output, self.module, self.axis)) != 1:
            raise ValueError("a requirement names exactly one input, output, module or axis")
        if self.is_of_state and self.axis is None:
            raise ValueError("standstill, below, min, max and homed are of an axis")
        if "value" in self.model_fields_set and self.input is None and self.output is None:
            raise ValueError("value: only an input or an output has a value")
        return self

    @property
    def is_of_state(self) -> bool:
        """Whether it is about how an axis is, and not only that it answers."""
        return self.standstill or self.homed or (self.below, self.min, self.max) != (None, None, None)


class InterlockKind(StrEnum):
    """What an interlock forbids."""

    POSITION = "position"
    """Motions of the axis to a place."""
    VELOCITY = "velocity"
    """Motions of the axis at a velocity or duty."""
    HOME = "home"
    """The search for its reference."""
    POWER_ON = "power_on"
    """To close its loop."""
    POWER_OFF = "power_off"
    """To open its loop by `power` or `reset`; never a stop, a loss policy or the end of the daemon."""
    HIGH = "high"
    """To drive the output high, or to let go of it."""
    LOW = "low"
    """To drive the output low, or to let go of it."""


MOTIONS = (InterlockKind.POSITION, InterlockKind.VELOCITY, InterlockKind.HOME)
LEVELS = (InterlockKind.HIGH, InterlockKind.LOW)


class InterlockConfig(Frozen):
    """A rule that is asked before a motion or an output is written, and watched while a motion lasts."""

    name: Name
    """Name of the rule, for people, messages and overrides."""
    of: Name
    """The axis or the named output that it binds."""
    kind: tuple[InterlockKind, ...] = ()
    """What it forbids while a requirement does not hold; without it all motions of the axis, or both levels."""
    above: float | None = Field(default=None, ge=0)
    """Speed above which a motion of the axis is bound, units a second; without it every motion is."""
    requires: tuple[Requirement, ...] = Field(min_length=1, max_length=16)
    """What must hold, all of it."""
    reaction: Literal["halt", "quick_stop", "power_off", "none"] = "halt"
    """How a motion under way is ended when a requirement does not hold any more."""
    within_ms: float = Field(default=500.0, ge=20, le=60_000)
    """Longest time from the last proof of a requirement to the reaction: older readings are unknown."""

    @property
    def names(self) -> tuple[str, ...]:
        """The axes, modules, inputs and outputs that it is about."""
        required = (each.axis or each.module or each.input or each.output for each in self.requires)
        return (self.of, *filter(None, required))

    def kinds(self, *, output: bool) -> tuple[InterlockKind, ...]:
        """Return what it forbids."""
        return self.kind or (LEVELS if output else MOTIONS)


def check_interlocks(interlocks: tuple[InterlockConfig, ...], buses: tuple[BusConfig, ...]) -> None:
    """Refuse rules about what is not there, and bounds that the polls cannot keep.

    Raises:
        ValueError: says which rule, which name and what there is.
    """
    refuse_duplicates("interlock", [rule.name for rule in interlocks])
    axes = {axis.name: axis for bus in buses for axis in bus.axis}
    modules = [name for bus in buses for name in bus.module_names]
    inputs = {name: each for bus in buses for name, each in bus.inputs.items()}
    outputs = {name: each for bus in buses for name, each in bus.outputs.items()}
    for rule in interlocks:
        where = f"interlock {rule.name}"
        _known(where, "axis or output", rule.of, [*axes, *outputs])
        possible = LEVELS if rule.of in outputs else tuple(kind for kind in InterlockKind if kind not in LEVELS)
        for kind in rule.kind:
            if kind not in possible:
                raise ValueError(f"{where}: {rule.of} takes no kind {kind.value!r}; those are {', '.join(possible)}")
        if rule.above is not None and rule.of in outputs:
            raise ValueError(f"{where}: above is of the motion of an axis, and {rule.of} is an output")
        for each in rule.requires:
            for what, name, there in (
                ("axis", each.axis, list(axes)),
                ("module", each.module, modules),
                ("input", each.input, list(inputs)),
                ("output", each.output, list(outputs)),
            ):
                if name is not None:
                    _known(where, what, name, there)
            _check_bound(rule, each, axes, {**inputs, **outputs})


def _known(where: str, what: str, name: str, there: list[str]) -> None:
    if name not in there:
        raise ValueError(f"{where}: there is no {what} {name!r}; there are: {', '.join(there) or 'none'}")


def _check_bound(
    rule: InterlockConfig, each: Requirement, axes: Mapping[str, AxisConfig], lines: Mapping[str, tuple[object, float]]
) -> None:
    """Refuse a bound within which its readings cannot come, one disturbed reading of a debounced input among them."""
    debounce_ms, polled = 0.0, "it"
    if each.axis is not None:
        rates = axes[each.axis].rates
        rate_hz = rates.proven_hz if each.is_of_state else rates.heard_hz
        polled = (each.is_of_state and rates.slowest) or polled
    elif name := each.input or each.output:
        line, rate_hz = lines[name]
        debounce_ms = getattr(line, "debounce_ms", 0.0)
    else:
        return
    takes, period_ms = "two polls", 1000.0 / rate_hz
    proven_ms = 2 * period_ms + 2 * debounce_ms
    if debounce_ms > 0:  # the disturbed one, the next, those until that has stayed for its time, and the last reply
        takes = "a disturbed poll and the debouncing"
        proven_ms = max(proven_ms, (3.5 + debounce_ms // period_ms) * period_ms)
    least_ms = proven_ms * LOOKS / (LOOKS - 1)
    if rule.within_ms < least_ms:
        raise ValueError(
            f"interlock {rule.name}: within_ms {rule.within_ms:g} is less than {takes} of"
            f" {each.axis or each.input or each.output} take; allow {math.ceil(least_ms)}, or poll {polled} faster"
        )
