"""Quantities for people: as text, and as pictures against time."""

import importlib
import math
from pathlib import Path
from typing import TYPE_CHECKING

from ldcnd.contract.commands import CommandReply, Verb
from ldcnd.contract.condition import Condition, assess
from ldcnd.contract.errors import ConfigError
from ldcnd.contract.events import CommandOutcome, CommandStatus
from ldcnd.contract.meta import AxisInfo
from ldcnd.contract.samples import (
    AdcSample,
    FaultSample,
    InputsSample,
    IoSample,
    LatchSample,
    PositionSample,
    Sample,
    StateSample,
    VelocitySample,
)
from ldcnd.contract.units import Dimension, quantity_text
from ldcnd.parts import require

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


MOST_DECIMALS = 6


def decimals(info: AxisInfo) -> int:
    """Return how many decimals show one encoder count of an axis, or as much of it as a table has room for."""
    scale = info.counts_per_unit
    return min(MOST_DECIMALS, max(0, math.ceil(math.log10(scale)))) if scale else 0


def in_counts(value: float, info: AxisInfo) -> float:
    """Return a position of an axis in its unit as whole encoder counts make it: who keeps it is led back to it."""
    scale = info.counts_per_unit or 1.0
    return round(value * scale) / scale


def number(value: float, info: AxisInfo, per: str = "") -> str:
    """Return a value of an axis with its unit; `per` is what follows the unit, such as `/s`."""
    return f"{value:.{decimals(info)}f} {info.unit}{per}"


def place(position: PositionSample, info: AxisInfo, state: StateSample) -> str:
    """Return a position of an axis in this state, in brackets and with its mark where it does not say where it is."""
    condition = assess(state, position_quality=position.quality)
    return condition.position(f"{position.value:.{decimals(info)}f}", info.unit)


def seconds(value: float) -> str:
    """Return a time in the unit that fits."""
    return f"{value * 1e3:.0f} ms" if value < 1 else f"{value:.2f} s"


def values_of(reply: CommandReply, info: AxisInfo, condition: Condition | None) -> str:
    """Return what the drive's registers make of a command.

    Args:
        reply: its answer.
        info: of its axis.
        condition: in which a motion finds the axis: its end says as little where that is as its place does. None of a
            command that begins no motion.
    """
    parts = []
    if reply.position is not None and reply.ends is None:
        digits = f"{reply.position:.{decimals(info)}f}"
        parts.append(f"to {condition.position(digits, info.unit) if condition else number(reply.position, info)}")
    if reply.target is not None:
        parts.append(f"to A/D count {reply.target}")
    if reply.duty is not None:
        parts.append(f"duty {reply.duty:.1%}")
    if reply.velocity is not None:
        parts.append(f"at {quantity_text(reply.velocity, info, Dimension.VELOCITY)}")
    if reply.acceleration is not None:
        parts.append(f"with {quantity_text(reply.acceleration, info, Dimension.ACCELERATION)}")
    if reply.ends is not None:
        parts.append(reply.ends)
    elif reply.duration_s is not None:
        parts.append(f"in {seconds(reply.duration_s)}")
    return f": {', '.join(parts)}" if parts else ""


def rounded(value: float) -> str:
    """Return a value that a register rounds, to four digits."""
    return f"{value:.4g}"


def outcome(info: AxisInfo, ended: CommandOutcome, state: StateSample) -> str:
    """Return how a command that was waited for has ended, and where."""
    axis = info.axis
    if ended.status is not CommandStatus.DONE:
        return f"{axis}: {state_word(state)}: {ended.verb}: {ended.reason or ended.status}"
    done = "homed" if ended.verb == Verb.HOME else "done"
    where = ""
    if ended.position is not None:
        where = f" at {number(ended.position, info)}"
    if ended.following_error is not None and ended.settled is not None:
        where += f", {number(abs(ended.following_error), info)} off its target"
    if ended.settled is False:
        where += ", NOT SETTLED"
    return f"{axis}: {done}, {state_word(state)}{where}"


def state_word(state: StateSample) -> str:
    """Return the state of an axis and everything that is to be said of it."""
    return assess(state).summary


def sample_text(sample: Sample) -> str:
    """Return one sample of telemetry."""
    match sample:
        case PositionSample():
            return f"position {sample.value:14.4f} {sample.unit}{_worth(sample)}"
        case VelocitySample():
            return f"velocity {sample.value:14.4f} {sample.unit}{_worth(sample)}"
        case AdcSample():
            return f"adc      {sample.volts:10.3f} V ({sample.counts} of {sample.full_scale}){_worth(sample)}"
        case InputsSample():
            words = ("off", "on")
            levels = (
                f"{name.replace('_', ' ')} {'?' if (level := getattr(sample, name)) is None else words[level]}"
                for name in ("reverse_limit", "forward_limit", "index", "stop_input", "amplifier_enable")
            )
            return f"inputs   {', '.join(levels)}{_worth(sample)}"
        case LatchSample():
            at = f"{sample.value:14.4f} {sample.unit}, up to {sample.error:.2g} {sample.unit} behind the edge"
            return f"latch    {at}{_worth(sample)}"
        case IoSample():
            named = "".join(
                f", {name} {'not known' if value is None else str(value).lower()}"
                for name, value in sample.named.items()
            )
            pins = "".join("01"[level] for level in sample.levels)
            return f"io       lines 1 to 12 {pins}, A/D {sample.adc}, counter {sample.counter}{named}{_worth(sample)}"
        case StateSample():
            return f"state    {state_word(sample)}"
        case FaultSample():
            return "fault    " + ("; ".join(f"{fault.code}: {fault.text}" for fault in sample.active) or "none")
        case _:
            return sample.model_dump_json()


def _worth(sample: Sample) -> str:
    return "" if sample.quality == "good" else f"  ({sample.quality})"


WIDTH_IN = 10.0
ROW_IN = 2.2
DOTS_PER_INCH = 120


def stacked_rows(count: int) -> "tuple[Figure, list[Axes]]":
    """Return an empty picture and its rows, the uppermost first; they share the time below the last.

    Raises:
        ConfigError: matplotlib is missing.
    """
    require("matplotlib")
    module = importlib.import_module("matplotlib.figure")
    figure: Figure = module.Figure(figsize=(WIDTH_IN, 1.0 + ROW_IN * count), dpi=DOTS_PER_INCH, layout="constrained")
    rows = figure.subplots(count, 1, sharex=True, squeeze=False)
    for (axes,) in rows:
        axes.grid(visible=True, alpha=0.3)
    return figure, [axes for (axes,) in rows]


def save_figure(figure: "Figure", path: Path) -> None:
    """Write a picture in the format that its name tells.

    Raises:
        ConfigError: it cannot be written, or its name tells no known format.
    """
    try:
        figure.savefig(path)
    except (OSError, ValueError) as error:
        raise ConfigError(f"{path}: cannot be drawn: {error}") from error
