"""A simulated SmartStep line under the real bus, without a daemon."""

import asyncio
from collections.abc import AsyncIterator, Callable, Mapping, Sequence
from contextlib import asynccontextmanager
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

from ldcnd.drives.driver import AxisSpec
from ldcnd.drives.smartstep.addresses import NEVER_VALID
from ldcnd.drives.smartstep.drive import SmartStepAxis, UnitSpec
from ldcnd.drives.smartstep.ledger import EepromLedger
from ldcnd.drives.smartstep.network import BAUD, SmartStepNetwork, smartstep_opener
from ldcnd.drives.smartstep.network import smartstep_line as line_of
from ldcnd.drives.smartstep.packet import decode_command
from ldcnd.drives.smartstep.parameters import PN000, Parameter
from ldcnd.drives.smartstep.profiles import SMARTSTEP, Framing, SmartStepProfile, Wiring
from ldcnd.line.bus import Bus
from ldcnd.line.settings import BusSettings
from ldcnd.sim.faults import FaultPlan
from ldcnd.sim.line import open_simulated_line
from ldcnd.sim.smartstep.cable import smartstep_chain
from ldcnd.sim.smartstep.unit import SimulatedUnit
from ldcnd.sim.smartstep.variant import SimulatedVariant


def simulated(
    number: int, variant: SimulatedVariant | None = None, stored: Mapping[Parameter, int] | None = None
) -> SimulatedUnit:
    """Return a drive with this unit number."""
    return SimulatedUnit(variant, {PN000: number << 8, **(stored or {})})


class LosingUnit(SimulatedUnit):
    """A drive whose line loses what a test names.

    Attributes:
        commands: the intact commands that were sent to it, lost ones among them.
    """

    def __init__(
        self, number: int, losses: Callable[[int, bytes], str | None], variant: SimulatedVariant | None = None
    ) -> None:
        """Return a drive with this unit number.

        Args:
            number: its unit number.
            losses: says for the place of a command, from 0, and the command itself what gets lost: "request", "reply",
                or None.
            variant: how the drive behaves.
        """
        super().__init__(variant, {PN000: number << 8})
        self.commands: list[bytes] = []
        self._losses = losses

    def _obey(self, packet: bytes, at_s: float) -> None:
        command = decode_command(packet)
        if command is None or command.address == NEVER_VALID:
            super()._obey(packet, at_s)
            return
        lost = self._losses(len(self.commands), packet)
        self.commands.append(packet)
        if lost == "request":
            return
        super()._obey(packet, at_s)
        if lost == "reply":
            self._pending = None


def losing_once(number: int, start: bytes, *lost: str, variant: SimulatedVariant | None = None) -> LosingUnit:
    """Return a drive for which the first commands that begin like this lose their requests or replies, one by one."""
    left = list(lost)
    return LosingUnit(number, lambda _, packet: left.pop(0) if packet.startswith(start) and left else None, variant)


def executes_in_a_fresh_mode_only(sent: Sequence[bytes]) -> bool:
    """Tell whether the mode of unit 1 was left and entered again between any two executes among these packets."""
    executes = [place for place, data in enumerate(sent) if data.startswith(b"W112001")]
    for earlier, later in pairwise(executes):
        modes = [data[7:11] for data in sent[earlier:later] if data.startswith(b"W112000")]
        if not modes or modes[0] != b"0000" or modes[-1] == b"0000":
            return False
    return True


@dataclass(frozen=True, slots=True)
class SmartStepLine:
    """An open line.

    Attributes:
        bus: its owner.
        network: the configured units, not brought up yet.
    """

    bus: Bus
    network: SmartStepNetwork

    def axis(self, name: str) -> SmartStepAxis:
        """Return a configured unit."""
        axis = self.network.axes[name]
        assert isinstance(axis, SmartStepAxis)
        return axis


@asynccontextmanager
async def smartstep_line(
    units: Sequence[SimulatedUnit],
    *,
    numbers: Sequence[int] | None = None,
    profile: SmartStepProfile = SMARTSTEP,
    ledger: Path | None = None,
    faults: FaultPlan | None = None,
    wiring: Wiring = Wiring.FOUR_WIRE,
    framing: Framing = Framing.SEVEN_EVEN,
) -> AsyncIterator[SmartStepLine]:
    """Open a line with these drives; axis `u1` is unit 1, and so on.

    Args:
        units: the simulated drives.
        numbers: the configured units; those of the drives unless said otherwise.
        profile: of all of them.
        ledger: file of the EEPROM ledger; None for a line without one.
        faults: of the line.
        wiring: of the simulated cable.
        framing: of the simulated port.
    """
    chain = smartstep_chain(units, wiring, framing, faults=faults)
    counted = EepromLedger(ledger) if ledger else None
    specs = tuple(
        UnitSpec(AxisSpec(f"u{number}", number, "smartstep", None), profile, ledger=counted)
        for number in (numbers if numbers is not None else [unit.drive.unit for unit in units])
    )
    opener = smartstep_opener(lambda: open_simulated_line(chain), profile)
    bus, network = line_of(BusSettings("steps", BAUD, margin_s=0.01), opener, specs)
    for spec in specs:  # as after a bring-up
        bus.proofs.expect(spec.axis.address, spec.axis.name).prove()
    async with asyncio.TaskGroup() as group:
        owner = group.create_task(bus.run(), name="bus")
        try:
            await bus.wait_opened()
            yield SmartStepLine(bus, network)
        finally:
            owner.cancel()
