"""Interface of commands that go on after they were accepted: a homing, a timed duty, a stream of set-points."""

from abc import ABC, abstractmethod

from ldcnd.axis.permit import Permit
from ldcnd.axis.tracker import AxisTracker
from ldcnd.contract.commands import CommandReply
from ldcnd.drives.driver import AxisReading
from ldcnd.line.exchange import NEVER_S


class Procedure(ABC):
    """A command that takes steps of its own: when a reading calls for one, or at its deadline.

    Attributes:
        permit: of the command that began it.
        deadline_s: when it takes a step without being called for, in loop time.
        watch_s: longest time between two readings while it runs, seconds, whatever the poll rates; infinite where the
            drive ends it.
    """

    permit: Permit
    deadline_s: float = NEVER_S
    watch_s: float = NEVER_S

    @abstractmethod
    async def begin(self) -> CommandReply:
        """Check, plan, and start.

        Raises:
            RequestRefused: it cannot be done; nothing was sent.
            BusError: the line failed; `OutcomeUnknown` when the drive may have started.
        """

    @abstractmethod
    def calls_for_step(self, reading: AxisReading) -> bool:
        """Tell whether the next step is due; the reading was requested after the latest step took effect."""

    @abstractmethod
    async def step(self) -> bool:
        """Take the next step and tell whether more of them are to come; a step whose packets were lost is taken again.

        Raises:
            StopLatched: a stop has overtaken it.
            RequestRefused: its sender has lost the right to it; the axis is brought to rest.
            BusError: the line failed.
        """

    def outlived(self, tracker: AxisTracker) -> bool:
        """Tell whether the axis has left its command: a fault, a stop or another command ended it."""
        return not tracker.status.is_at(self.permit.command_id)
