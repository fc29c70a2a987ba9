"""What is known of commissioning an axis: one JSON file beside the configuration, written whole after every step."""

import json
from enum import StrEnum
from pathlib import Path

from pydantic import Field, JsonValue

from ldcnd import durable
from ldcnd.bench.machine_faults import MachineFault
from ldcnd.contract.errors import ConfigError
from ldcnd.contract.frozen import Frozen


class StepState(StrEnum):
    """How far a step is."""

    OPEN = "open"
    DONE = "done"
    SKIPPED = "skipped"
    FAILED = "failed"
    NOT_POSSIBLE = "not_possible"
    NOT_NEEDED = "not_needed"


class Figure(Frozen):
    """One thing that was measured, or answered by a person."""

    what: str
    """Its name, for people."""
    value: float | str
    """The number, or the answer."""
    unit: str = ""
    """Unit of a number."""


class PlotSeries(Frozen):
    """Points that belong together, for a plot."""

    title: str
    """What it shows."""
    x: str
    """Name of the abscissa, with its unit."""
    y: str
    """Name of the ordinate, with its unit."""
    points: tuple[tuple[float, float], ...]
    """In the order in which they were measured."""


class ConfigProposal(Frozen):
    """A value for the configuration of the axis."""

    table: str
    """Table below the axis, such as `limits`; empty for a key of the axis itself."""
    key: str
    """Key in that table."""
    value: int | float | str
    """The value."""

    @property
    def name(self) -> str:
        """Table and key."""
        return f"{self.table}.{self.key}" if self.table else self.key

    @property
    def literal(self) -> str:
        """The value as TOML writes it."""
        return json.dumps(self.value, ensure_ascii=False) if isinstance(self.value, str) else repr(self.value)


class Result(Frozen):
    """What a step has led to."""

    state: StepState
    """How it went."""
    text: str
    """The same in a sentence; for a skipped step the reason."""
    figures: tuple[Figure, ...] = ()
    """What was measured."""
    series: tuple[PlotSeries, ...] = ()
    """The same over something, for plots."""
    proposals: tuple[ConfigProposal, ...] = ()
    """What it proposes for the configuration."""
    faults: tuple[MachineFault, ...] = ()
    """What may be wrong with the machine; of several it cannot be told which."""


class StepRecord(Frozen):
    """What is kept of one step."""

    step: str
    """Its name."""
    result: Result = Result(state=StepState.OPEN, text="")
    """What it has led to."""
    at: str = ""
    """When that was, in UTC."""
    by: str = ""
    """Whose answers they were."""
    basis: dict[str, JsonValue] = Field(default_factory=dict)
    """The identity of the drive and the configuration that it depends on, as they were then."""
    reopened: str = ""
    """Why it is open again; empty when it is not."""


class CommissioningRecord(Frozen):
    """Everything that is known of commissioning one axis."""

    rig: str
    """The rig."""
    axis: str
    """The axis."""
    steps: dict[str, StepRecord] = Field(default_factory=dict)
    """By their names; a missing one is open."""

    def of(self, step: str) -> StepRecord:
        """Return what is kept of a step."""
        return self.steps.get(step) or StepRecord(step=step)

    def with_step(self, record: StepRecord) -> "CommissioningRecord":
        """Return the record with a step replaced."""
        return self.model_copy(update={"steps": {**self.steps, record.step: record}})


def file_of(config: Path, rig: str, axis: str) -> Path:
    """Return where the record of an axis is, seen from its configuration."""
    return config.with_name(f"commissioning-{rig}-{axis}.json")


def read(path: Path, rig: str, axis: str) -> CommissioningRecord:
    """Return the record in a file; an empty one without a file.

    Raises:
        ConfigError: the file is no record of this axis.
    """
    try:
        record = durable.read(path, CommissioningRecord.model_validate_json) or CommissioningRecord(rig=rig, axis=axis)
    except durable.DamagedFile as error:
        raise ConfigError(str(error), remedy="move it away to begin anew") from error
    if (record.rig, record.axis) != (rig, axis):
        raise ConfigError(f"{path} is about axis {record.axis} of rig {record.rig}", remedy="move it away")
    return record


def write(path: Path, record: CommissioningRecord) -> None:
    """Replace the file; it is on the disk when this returns.

    Raises:
        ConfigError: it cannot be written.
    """
    try:
        durable.replace(path, record.model_dump_json(indent=1) + "\n")
    except OSError as error:
        raise ConfigError(f"{path}: cannot be written: {error.strerror}") from error


def changes(record: StepRecord, now: dict[str, JsonValue]) -> list[str]:
    """Return in words how the basis of a step has changed; a value that it has itself proposed is no change."""
    proposed = {each.name: each.value for each in record.result.proposals}
    said = []
    for name, before in record.basis.items():
        if name not in now:
            continue
        after = now[name]
        if after != before and (name not in proposed or after != proposed[name]):
            said.append(f"{name} was {_shown(before)} and is {_shown(after)}")
    return said


def _shown(value: JsonValue) -> str:
    return "not set" if value is None else str(value)
