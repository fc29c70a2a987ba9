"""A motion from its acceptance to its end, step by step."""

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from dataclasses import dataclass

from ldcnd.client.rig_client import RigClient, Samples
from ldcnd.errors import OutcomeUnknown
from ldcnd.model.commands import CommandReply
from ldcnd.model.samples import LinkState, PositionSample, StateSample


@dataclass(frozen=True, slots=True)
class Progress:
    """How far a motion is.

    Attributes:
        position: where the axis is, in its units.
        left: how far it still has to go, signed; None for a motion without an end of its own.
        unit: of both.
    """

    position: float
    left: float | None
    unit: str


class Motion:
    """The progress of one command, with each position that comes, until the command has ended.

    Attributes:
        end: the state after it; None until then. Its `last_error` tells why it did not end as asked.
    """

    def __init__(self, command: CommandReply, first: StateSample | None, samples: Samples) -> None:
        self.end: StateSample | None = None
        self._command = command
        self._samples = samples
        self._take(first)

    def __aiter__(self) -> "Motion":
        return self

    async def __anext__(self) -> Progress:
        """Return the next step.

        Raises:
            OutcomeUnknown: the drive stopped answering.
        """
        while self.end is None:
            _, sample = await anext(self._samples)
            if isinstance(sample, PositionSample):
                return Progress(sample.value, self._left(sample.value), sample.unit)
            self._take(sample if isinstance(sample, StateSample) else None)
        raise StopAsyncIteration

    def _left(self, position: float) -> float | None:
        return None if self._command.position is None else self._command.position - position

    def _take(self, state: StateSample | None) -> None:
        if state is None:
            return
        if state.link is LinkState.DOWN:
            axis = self._command.axis
            raise OutcomeUnknown(f"axis {axis}: the drive does not answer any more", axis=axis)
        if state.command is None or state.command.command_id != self._command.command_id:
            self.end = state


@asynccontextmanager
async def follow(client: RigClient, command: CommandReply) -> AsyncIterator[Motion]:
    """Follow a command that was accepted, for the time of the context.

    Args:
        client: the rig.
        command: what `command` returned.
    """
    async with client.samples(command.axis) as samples:
        yield Motion(command, await client.state(command.axis), samples)
