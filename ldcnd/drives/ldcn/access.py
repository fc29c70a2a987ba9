"""What the parts of an LDCN or NMC servo drive share: the way to it, and what is known of it."""

from dataclasses import dataclass

from ldcnd.contract.errors import RegisterUnknown
from ldcnd.drives.driver import AxisSpec
from ldcnd.drives.ldcn import commands
from ldcnd.drives.ldcn.commands import Node
from ldcnd.drives.ldcn.packet import AuxFlag, StatusFlag, StatusItem, StatusPacket
from ldcnd.drives.ldcn.profiles import Profile
from ldcnd.drives.ldcn.record import DriveState
from ldcnd.drives.ldcn.registers import ServoRegisters, Unknown
from ldcnd.line.bus import Bus

STATE_ITEMS = StatusItem.POSITION | StatusItem.VELOCITY | StatusItem.AUX


@dataclass(frozen=True, slots=True)
class ServoAccess:
    """One servo drive on its line.

    Attributes:
        spec: what the configuration says of it.
        profile: its dialect.
        bus: its line.
        node: where it answers.
        book: what its registers hold.
        state: what else is known of it.
    """

    spec: AxisSpec
    profile: Profile
    bus: Bus
    node: Node
    book: ServoRegisters
    state: DriveState

    async def read(self, items: StatusItem) -> StatusPacket:
        """Read these items of its status."""
        return await self.bus.execute(commands.read_status(self.node, items))

    async def stands(self) -> bool:
        """Read the drive: no profile of a closed loop runs, and it shows no more velocity than a loop that hunts."""
        status = await self.read(STATE_ITEMS)
        if status.aux is not None and not status.aux & AuxFlag.SERVO_ON:
            return True
        return bool(status.flags & StatusFlag.MOVE_DONE) and abs(status.velocity or 0) <= 1

    def unknown(self, register: str, remedy: str) -> RegisterUnknown:
        """Return the refusal of what needs a register of which it is not known what it holds."""
        holding = self.book[register]
        why = f": {holding.why}" if isinstance(holding, Unknown) else ""
        return RegisterUnknown(
            f"axis {self.spec.name}: what register {register} of the drive holds is not known{why}",
            axis=self.spec.name,
            value=register,
            remedy=remedy,
        )
