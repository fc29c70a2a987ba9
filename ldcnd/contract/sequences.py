"""Named positions and sequences of a machine: data of its configuration, which a client carries out.

The daemon reads them over and does nothing with them: every command of a sequence passes its gate as any other.
"""

from collections.abc import Iterator, Mapping
from typing import Literal

from pydantic import Field

from ldcnd.contract.frozen import Frozen
from ldcnd.contract.units import DIMENSIONS, POSITION, Described, quantity_text

SequenceVerb = Literal[
    "power", "home", "move_absolute", "move_relative", "move_velocity", "halt", "set_gains", "set_position", "reset"
]


class NamedPosition(Frozen):
    """Position of several axes under one name."""

    name: str = Field(pattern=r"^[a-z0-9][a-z0-9_]{0,62}$")
    """Name of the position, such as `park`."""
    axes: Mapping[str, float] = Field(min_length=1)
    """Position of each axis; `go` moves them one after the other, in this order."""


class SequenceStep(Frozen):
    """One step: what it commands, what it waits for, and for how long."""

    name: str = ""
    """Name for people; made from the rest when missing."""
    do: SequenceVerb | None = None
    """Command that is sent to `axis`; its motion has ended when the step is over."""
    axis: str | None = None
    """Axis of the command."""
    arguments: Mapping[str, bool | float | str] = {}
    """Fields of the command, such as { velocity = "3000 rpm", duration_s = 60 }."""
    go: str | None = None
    """Named position to which its axes are moved."""
    set: Mapping[str, bool] = {}
    """Outputs that are written before anything moves, at once, true for high; one without a name is MODULE.LINE."""
    until: Mapping[str, bool] = {}
    """Named inputs and outputs, and the values that they must have at the end; what is not known has none."""
    leave_running: bool = False
    """The step is over when its command is accepted; a later step may wait for `standstill`."""
    standstill: tuple[str, ...] = ()
    """Axes that must stand at the end."""
    pause_s: float = Field(default=0.0, ge=0, le=86_400)
    """Time that follows, seconds."""
    timeout_s: float = Field(default=60.0, gt=0, le=90_000)
    """Longest time of all but the pause, seconds; then the sequence has failed."""

    def title(self, units: Mapping[str, Described], positions: Mapping[str, NamedPosition]) -> str:
        """Return what people read.

        Args:
            units: of the axes, by name.
            positions: the named positions, by name.
        """
        parts = [" ".join([self.do.replace("_", " "), str(self.axis), *self._given(units)])] if self.do else []
        parts += [f"go to {self.go}{_places(positions[self.go], units)}"] if self.go else []
        parts += [f"{name} {'high' if high else 'low'}" for name, high in self.set.items()]
        parts += [f"until {name} is {str(value).lower()}" for name, value in self.until.items()]
        parts += [f"until {axis} stands" for axis in self.standstill]
        return self.name or ", ".join(parts) or f"wait for {self.pause_s:g} s"

    def _given(self, units: Mapping[str, Described]) -> Iterator[str]:
        """Yield the arguments in words, numbers of the axis in the units in which people read them."""
        info = units.get(str(self.axis))
        for name, value in self.arguments.items():
            said = _SAID.get(name, name)
            if name == "on":
                yield "on" if value else "off"
            elif isinstance(value, str | bool):
                yield f"{said} {str(value).lower() if isinstance(value, bool) else value}"
            elif info and name in DIMENSIONS:
                yield f"{said} {quantity_text(value, info, DIMENSIONS[name])}"
            else:
                yield f"{said} {value:g}{' s' if name.endswith('_s') else ''}"


_SAID = {"position": "to", "distance": "by", "velocity": "at", "acceleration": "with", "duration_s": "for"}


def _places(position: NamedPosition, units: Mapping[str, Described]) -> str:
    known = [
        f"{axis} {quantity_text(at, units[axis], POSITION)}" for axis, at in position.axes.items() if axis in units
    ]
    return f" ({', '.join(known)})" if known else ""


class SequenceConfig(Frozen):
    """Steps that a client carries out one after the other; the first that fails ends it, and what moves is halted."""

    name: str = Field(pattern=r"^[a-z0-9][a-z0-9_]{0,62}$")
    """Name of the sequence."""
    step: tuple[SequenceStep, ...] = Field(min_length=1, max_length=500)
    """The steps."""

    def used(self, positions: Mapping[str, NamedPosition]) -> tuple[str, ...]:
        """Return the axes that it moves, or waits for; `positions` are the named ones, by name."""
        used: list[str] = []
        for step in self.step:
            used += [step.axis] if step.axis else []
            used += [*positions[step.go].axes] if step.go else []
            used += step.standstill
        return tuple(dict.fromkeys(used))

    def names(self, positions: Mapping[str, NamedPosition]) -> tuple[str, ...]:
        """Return the axes, modules, inputs and outputs that it is about; `positions` are the named ones, by name."""
        # a line by its number is MODULE.LINE
        lines = (name.partition(".")[0] for step in self.step for name in (*step.set, *step.until))
        return tuple(dict.fromkeys((*self.used(positions), *lines)))

    @property
    def writes(self) -> bool:
        """Whether it writes outputs: then it needs control of all axes of the rig."""
        return any(step.set for step in self.step)


def going_to(position: NamedPosition) -> SequenceConfig:
    """Return the sequence of one step that moves the axes of a position there, one after the other."""
    return SequenceConfig(name=f"go_{position.name}"[:63], step=(SequenceStep(go=position.name, timeout_s=86_400),))


class StepReport(Frozen):
    """What came of one step: a line of the record."""

    sequence: str
    """Name of the sequence."""
    step: int
    """Number of the step, from 1."""
    of: int
    """Number of steps."""
    title: str
    """Name of the step."""
    event: Literal["begun", "done", "failed", "stopped", "paused"]
    """What happened to it; paused: it waits to begin."""
    t: int
    """Instant, UTC in ns since 1970."""
    took_s: float | None = None
    """How long it took, seconds; null before its end."""
    reason: str | None = None
    """Why it has failed; of one that is done, that a speed override made its motions slower than it says."""
