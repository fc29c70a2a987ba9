"""Simulated modules without a servo loop, as far as a host that enumerates a chain needs them: PIC-I/O and PIC-STEP.

They keep the chain together, obey what is common to all modules, and answer with a layout of their own.
Sources: later vendor data sheets; widths of items that no source here describes are 0.
"""

from dataclasses import dataclass

from ldcnd.drivers.ldcn.profiles import PIC_IO, Profile
from ldcnd.drivers.ldcn.received import ReceivedCommand
from ldcnd.drivers.ldcn.status import StatusFlag, StatusItem
from ldcnd.sim.ldcn.module import SimulatedModule
from ldcnd.sim.ldcn.quirks import ModuleSettings

PIC_IO_ITEM_BYTES = (2, 1, 1, 1, 4, 2, 2, 4)
"""Inputs, A/D 1 to 3, timer, identity, inputs and timer as captured by the synchronisation command."""
IDENTITY_ONLY_ITEM_BYTES = (0, 0, 0, 0, 0, 2, 0, 0)


@dataclass(frozen=True, slots=True)
class Terminals:
    """What is connected to a PIC-I/O: twelve input bits and three A/D values."""

    inputs: int = 0x0FFF
    analog: tuple[int, int, int] = (0, 0, 0)


class SimulatedIo(SimulatedModule):
    """A module that only reports.

    Attributes:
        terminals: may be replaced while it runs.
    """

    def __init__(self, profile: Profile, settings: ModuleSettings) -> None:
        self.terminals = Terminals()
        self._item_bytes = PIC_IO_ITEM_BYTES if profile is PIC_IO else IDENTITY_ONLY_ITEM_BYTES
        super().__init__(profile, settings)

    def restart(self) -> None:
        """See `SimulatedModule`."""

    def run(self, cycles: int) -> None:
        """See `SimulatedModule`: nothing here moves."""

    def execute(self, command: ReceivedCommand) -> None:
        """See `SimulatedModule`: outputs and timers are not simulated."""

    def status(self, items: StatusItem, *, checksum_error: bool) -> bytes:
        """See `SimulatedModule`."""
        body = bytearray([StatusFlag.CHECKSUM_ERROR if checksum_error else 0])
        identity = self.profile.device_id | self.settings.version << 8
        terminals = self.terminals
        values = (terminals.inputs, *terminals.analog, 0, identity, terminals.inputs, 0)
        for bit, (width, value) in enumerate(zip(self._item_bytes, values, strict=True)):
            if items & 1 << bit:
                body += value.to_bytes(4, "little")[:width]
        body.append(sum(body) & 0xFF)
        return bytes(body)
