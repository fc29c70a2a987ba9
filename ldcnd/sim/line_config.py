"""The common part of simulated lines: a name, a seed, and what may go wrong on the wires; families add the drives."""

from dataclasses import replace
from typing import Self

from pydantic import Field, model_validator

from ldcnd.config.simulated import SimulatedLineConfig
from ldcnd.contract.frozen import Frozen
from ldcnd.sim.faults import FaultKind, FaultPlan, LineFault


class SimulatedFaultConfig(Frozen):
    """Something that may go wrong on the wires."""

    kind: FaultKind
    """The kind of the event."""
    probability: float = Field(default=1.0, ge=0, le=1)
    """Probability that it happens to one request or reply."""
    from_s: float = Field(default=0.0, ge=0)
    """Possible from this time on, in seconds after the line was opened first."""
    until_s: float | None = Field(default=None, gt=0)
    """Possible before this time."""
    longest_s: float = Field(default=0.0, ge=0)
    """Longest delay of reply_delayed, or the duration of unplugged, in seconds."""

    @model_validator(mode="after")
    def _has_a_length(self) -> Self:
        if self.kind in {FaultKind.REPLY_DELAYED, FaultKind.UNPLUGGED} and self.longest_s == 0.0:
            raise ValueError(f"{self.kind} needs longest_s above 0")
        if self.until_s is not None and self.until_s <= self.from_s:
            raise ValueError(f"until_s {self.until_s:g} is not after from_s {self.from_s:g}")
        return self

    def spec(self, starts_at_s: float) -> LineFault:
        """Return what the simulator plays."""
        fault = LineFault(self.kind, self.probability, starts_at_s + self.from_s, longest_s=self.longest_s)
        return fault if self.until_s is None else replace(fault, until_s=starts_at_s + self.until_s)


class FaultPlanConfig(Frozen):
    """A file of its own for what may go wrong on the wires."""

    fault: tuple[SimulatedFaultConfig, ...] = ()
    """Added to those of the line."""


class FaultyLineConfig(SimulatedLineConfig):
    """One simulated line, and what may go wrong on its wires; its family adds the drives."""

    seed: int = 1
    """Seed of all random values."""
    fault: tuple[SimulatedFaultConfig, ...] = ()
    """Faults of the wires."""

    def faults(self, starts_at_s: float) -> FaultPlan:
        """Return what may go wrong, counted from an instant of the line's clock."""
        return FaultPlan(tuple(fault.spec(starts_at_s) for fault in self.fault), self.seed)
