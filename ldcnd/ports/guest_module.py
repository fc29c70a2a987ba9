"""A module as a guest sees it: addresses, groups, rate and status mask are the guest's, the readings are the drive's.

The guest talks to a chain of these instead of to the line. What only arranges (Hard Reset, Set Address, Set Baud Rate,
Define Status) is obeyed here, as `SimulatedModule` does, and never reaches the line. Nothing here can send to the line:
a command that could change a drive is handed to `refuse` and not done.
"""

from collections.abc import Callable

from ldcnd.drives.ldcn.packet import StatusFlag, StatusItem, StatusPacket, encode_status
from ldcnd.drives.ldcn.profiles import Profile
from ldcnd.drives.ldcn.received import ReceivedCommand
from ldcnd.sim.ldcn.module import SimulatedModule
from ldcnd.sim.ldcn.quirks import ModuleSettings

Read = Callable[[StatusItem], StatusPacket | None]
"""Returns what the drive has last sent if it has all of these items and is recent enough, otherwise None."""


class ReadOnlyModule(SimulatedModule):
    """A servo module that answers with the drive's readings and executes nothing.

    Without a recent reading it is silent, as a module is that does not reply: no value is invented.

    Attributes:
        unread: how many replies were left out because there was no recent reading.
    """

    def __init__(
        self, profile: Profile, settings: ModuleSettings, read: Read, refuse: Callable[[ReceivedCommand], None]
    ) -> None:
        self._read, self._refuse = read, refuse
        self.unread = 0
        super().__init__(profile, settings)

    def restart(self) -> None:
        """A guest's Hard Reset reaches no drive."""

    def run(self, cycles: int) -> None:
        """The drive counts its own servo cycles."""

    def execute(self, command: ReceivedCommand) -> None:
        """Refuse what could change the drive."""
        self._refuse(command)

    def status(self, items: StatusItem, *, checksum_error: bool) -> bytes:
        """Return the packet that the drive could send now, with the guest's own checksum error alone in its bit."""
        reading = self._read(items)
        if reading is None:
            self.unread += 1
            return b""
        data = bytearray(encode_status(self.profile, items, reading))
        flag = int(StatusFlag.CHECKSUM_ERROR)
        data[0] = data[0] & ~flag | (flag if checksum_error else 0)
        data[-1] = sum(data[:-1]) & 0xFF
        return bytes(data)
