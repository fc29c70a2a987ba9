"""What stands around the terminals of simulated PIC-I/Os: cylinders, doors and locks with their sensors, and switches.

A part is at its start or at its end, or on the way, which takes time. Parts have no drive of their own for their way
back: a valve whose line is low lets its part go where its spring pushes it. A line that is no output is pulled up,
unless it is held low: it floats, and its valve is on.
"""

import math
from collections.abc import Sequence
from typing import Annotated, Self

from pydantic import AfterValidator, Field, model_validator

from ldcnd.contract.frozen import Frozen
from ldcnd.drives.ldcn.pic_io import LINES
from ldcnd.sim.ldcn.drive import SimulatedDrive
from ldcnd.sim.ldcn.power import FaultCondition

LineNumber = Annotated[int, Field(ge=1, le=LINES)]
Place = Annotated[int, Field(ge=1, le=31)]
_ROUNDING = 1.0 + 1e-9
Share = Annotated[float, Field(ge=0, le=1)]


def _within(span: tuple[float, float]) -> tuple[float, float]:
    if span[0] > span[1]:
        raise ValueError(f"the first share must not be above the second: {span[0]:g} and {span[1]:g}")
    return span


class SensorConfig(Frozen):
    """A sensor of a part, at a line of the PIC-I/O."""

    line: LineNumber
    """The line that it drives."""
    between: Annotated[tuple[Share, Share], AfterValidator(_within)]
    """Range in which it sees the part, as shares of the way: `[0, 0]` at the start, `[1, 1]` at the end."""
    inverted: bool = False
    """Whether the line is low where it sees the part, not high."""


class PartConfig(Frozen):
    """A cylinder, a door, a lock: driven by an output, seen by sensors."""

    name: str
    """Its name, for events and for parts that it holds."""
    module: Place
    """Place of its PIC-I/O in the chain, from 1 on."""
    output: LineNumber
    """The line that drives it to its end while it is high."""
    inverted: bool = False
    """Whether a low line drives it to its end instead."""
    travel_s: float = Field(default=0.0, ge=0, le=3600)
    """Time from start to end, and back."""
    held_by: str | None = None
    """A part that holds this one where it is, unless that part is at its start."""
    sensors: tuple[SensorConfig, ...] = ()
    """Its sensors."""


class ImbalanceSwitchConfig(Frozen):
    """A switch that a rotor hits which is out of balance, while it is fast."""

    module: Place
    """Place of its PIC-I/O in the chain, from 1 on."""
    line: LineNumber
    """The line that it drives: low while it is hit."""
    inverted: bool = False
    """Whether the line is high while it is hit, not low."""
    drive: Place
    """Place of the drive that turns the rotor; its condition `unbalanced` says that the rotor is out of balance."""
    above_counts_per_s: float = Field(gt=0)
    """Speed above which the rotor hits it."""


class MachineConfig(Frozen):
    """What stands around the terminals of a line's PIC-I/Os."""

    part: tuple[PartConfig, ...] = ()
    """Cylinders, doors and locks."""
    imbalance: tuple[ImbalanceSwitchConfig, ...] = ()
    """Imbalance switches."""

    @model_validator(mode="after")
    def _one_driver_of_a_line(self) -> Self:
        by_name = {part.name: part for part in self.part}
        if len(by_name) < len(self.part):
            raise ValueError("part: two have one name")
        driven = [(part.module, sensor.line) for part in self.part for sensor in part.sensors]
        driven += [(switch.module, switch.line) for switch in self.imbalance]
        for module, line in driven:
            if driven.count((module, line)) > 1:
                raise ValueError(f"part, imbalance: line {line} of module {module} is driven twice")
        for part in self.part:
            holder = by_name.get(part.held_by) if part.held_by else None
            if part.held_by and (holder is None or holder.module != part.module):
                raise ValueError(f"part {part.name}: there is no part {part.held_by} at module {part.module}")
            if holder and holder.held_by:
                raise ValueError(f"part {part.name}: {holder.name}, which holds it, is held itself")
        return self


class _Part:
    def __init__(self, config: PartConfig) -> None:
        self.config = config
        self.at = 1.0 if config.inverted else 0.0
        self.jammed = False

    def goal(self, high: int) -> float:
        return float(bool(high & 1 << self.config.output - 1) is not self.config.inverted)

    def lacks_s(self, goal: float) -> float:
        return abs(goal - self.at) * self.config.travel_s

    def go(self, goal: float, for_s: float) -> None:
        if self.lacks_s(goal) <= for_s * _ROUNDING:
            self.at = goal
        else:
            self.at += math.copysign(for_s / self.config.travel_s, goal - self.at)


class Surroundings:
    """The parts and the switches at one PIC-I/O."""

    def __init__(self, parts: Sequence[PartConfig] = ()) -> None:
        held = sorted(parts, key=lambda part: part.held_by is not None)  # what holds moves before what it holds
        self._parts = {part.name: _Part(part) for part in held}
        self._switches: list[tuple[ImbalanceSwitchConfig, SimulatedDrive]] = []

    def add(self, switch: ImbalanceSwitchConfig, drive: SimulatedDrive) -> None:
        """Put a switch beside the rotor of a drive."""
        self._switches.append((switch, drive))

    @property
    def names(self) -> tuple[str, ...]:
        """The names of the parts."""
        return tuple(self._parts)

    def at(self, part: str) -> float:
        """Return where a part is: 0 at its start, 1 at its end."""
        return self._parts[part].at

    def jam(self, part: str, *, jammed: bool) -> None:
        """Let something hold a part where it is, or let go of it."""
        self._parts[part].jammed = jammed

    def run(self, for_s: float, high: int) -> None:
        """Let time pass.

        Args:
            for_s: how long.
            high: bits of the lines that are high, driven or pulled up.
        """
        while for_s > 0.0:
            moving = []
            for part in self._parts.values():
                goal = part.goal(high)
                if goal == part.at or part.jammed or self._held(part, high):
                    continue
                if part.config.travel_s:
                    moving.append((part, goal))
                else:
                    part.at = goal
            if not moving:
                return
            span_s = min(for_s, *(part.lacks_s(goal) for part, goal in moving))
            for part, goal in moving:
                part.go(goal, span_s)
            for_s -= span_s

    def _held(self, part: _Part, high: int) -> bool:
        """Tell whether another part holds this one, or is about to, being the faster of the two."""
        if part.config.held_by is None:
            return False
        holder = self._parts[part.config.held_by]
        return holder.at > 0.0 or (holder.goal(high) > 0.0 and not holder.jammed)

    def levels(self, present: int, at_s: float) -> int:
        """Return the levels of the lines with what sensors and switches make of them."""
        for part in self._parts.values():
            for sensor in part.config.sensors:
                low, high = sensor.between
                present = _with(present, sensor.line, high=(low <= part.at <= high) is not sensor.inverted)
        for switch, drive in self._switches:
            drive.catch_up(at_s)
            speed = abs(drive.shaft.velocity_counts) / drive.profile.servo_cycle_s
            hit = drive.suffers(FaultCondition.UNBALANCED) and speed > switch.above_counts_per_s
            present = _with(present, switch.line, high=hit is switch.inverted)
        return present


def _with(levels: int, line: int, *, high: bool) -> int:
    return levels | 1 << line - 1 if high else levels & ~(1 << line - 1)
