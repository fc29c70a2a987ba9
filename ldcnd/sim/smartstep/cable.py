"""The wires between a host and simulated SmartSteps: receivers and collisions; one module of a simulated line.

Four wires: every drive receives from the host alone, the host from the drives. Two wires: all receive from all. A drive
with unit number 0 never releases its transmitter, so on a pair that it shares nothing else gets through. One module
stands for the whole cable, because its drives share pairs and may receive from each other, unlike in a daisy chain.
Source: manual 1 (4), (5) and 2.2 (6); the two-wire hazards follow from the formats in 2.2.
"""

from collections import deque
from collections.abc import Sequence

from typing_extensions import override

from ldcnd.drives.smartstep.packet import DAMAGED, add_parity, strip_parity
from ldcnd.drives.smartstep.profiles import Framing, Wiring
from ldcnd.line.exchange import NEVER_S
from ldcnd.sim.chain import Chain, Delivery, Module, ModuleReply
from ldcnd.sim.faults import FaultPlan
from ldcnd.sim.smartstep.unit import CHARACTER_S, SimulatedUnit, Transmission


class SimulatedCable:
    """A line with its drives; 9600 baud, ten bits a character.

    Attributes:
        units: the drives on it.
    """

    def __init__(
        self, units: Sequence[SimulatedUnit], wiring: Wiring = Wiring.FOUR_WIRE, *, echo: bool = False
    ) -> None:
        """Connect drives.

        Args:
            units: at least one.
            wiring: four wires unless a test wants the hazards of two.
            echo: the host's receiver stays on while it sends (two wires only).
        """
        self.units = tuple(units)
        self._wiring = wiring
        self._echo = echo and wiring is Wiring.TWO_WIRE
        self._heard: list[Transmission] = []
        self._last: Transmission | None = None

    def host_sends(self, characters: bytes, start_s: float) -> Transmission:
        """Put the host's characters on the wire, one after the other, and return them with their times."""
        self._collect(start_s)
        sending = Transmission(characters, start_s)
        if self._wiring is Wiring.TWO_WIRE and (self._is_held() or self._overlaps(sending)):
            sending = _damaged(sending)
        for unit in self.units:
            unit.receive(sending.characters, sending.end_s)
        if self._echo:
            self._heard.append(sending)
        return sending

    def host_hears(self, to_s: float) -> list[Transmission]:
        """Return what began to arrive at the host by then, in order, and was not returned before."""
        self._collect(to_s)
        heard, self._heard = sorted(self._heard, key=lambda item: item.start_s), []
        return heard

    def next_start_s(self) -> float | None:
        """When a drive will next begin to send, as determined so far; None when all are silent."""
        starts = [unit.next_start_s for unit in self.units if unit.next_start_s is not None]
        return min(starts, default=None)

    def _is_held(self) -> bool:
        """Tell whether a transmitter that is never released shares its pair with another one."""
        others = len(self.units) > 1 or self._wiring is Wiring.TWO_WIRE
        return others and any(unit.always_transmits for unit in self.units)

    def _overlaps(self, item: Transmission) -> bool:
        return self._last is not None and self._last.end_s - CHARACTER_S / 2 > item.start_s

    def _collect(self, to_s: float) -> None:
        # A drive may answer what it overheard, so this goes on until no drive begins to send.
        while begun := [(unit, item) for unit in self.units for item in unit.transmissions(to_s)]:
            for unit, item in sorted(begun, key=lambda pair: pair[1].start_s):
                self._carry(unit, item, together=[other for who, other in begun if who is not unit])

    def _carry(self, sender: SimulatedUnit, item: Transmission, together: Sequence[Transmission]) -> None:
        collides = any(other.start_s < item.end_s and item.start_s < other.end_s for other in together)
        held = self._is_held() and not sender.always_transmits
        arriving = _damaged(item) if collides or held or self._overlaps(item) else item
        if self._last is None or arriving.end_s > self._last.end_s:
            self._last = arriving
        self._heard.append(arriving)
        if self._wiring is Wiring.TWO_WIRE:
            for unit in self.units:
                if unit is not sender:
                    unit.receive(arriving.characters, arriving.end_s)


def _damaged(item: Transmission) -> Transmission:
    return Transmission(bytes([DAMAGED]) * len(item.characters), item.start_s)


BAUD = 9600


class SimulatedSmartSteps(Module):
    """All drives of a line.

    Attributes:
        cable: for looking behind the line.
        framing: how the host's port makes characters; with soft parity the drives see damaged ones as such.
    """

    baud = float(BAUD)
    yields_to_host = False

    def __init__(self, cable: SimulatedCable, framing: Framing = Framing.SEVEN_EVEN) -> None:
        self.cable = cable
        self.framing = framing
        self._arriving: deque[Transmission] = deque()

    @override
    def hear(self, value: int | None, at_s: float) -> None:
        self.cable.host_sends(self._heard(value), at_s - CHARACTER_S)
        self._look(at_s)

    @override
    def advance(self, to_s: float) -> ModuleReply | None:
        self._look(to_s)
        if not self._arriving:
            return None
        item = self._arriving.popleft()
        self._look(to_s)
        data = add_parity(item.characters) if self.framing is Framing.SOFT_PARITY else item.characters
        return ModuleReply(data, item.start_s, CHARACTER_S)

    def _heard(self, value: int | None) -> bytes:
        if value is None:
            return bytes([DAMAGED])
        if self.framing is Framing.SOFT_PARITY:
            return strip_parity(bytes([value]))
        return bytes([min(value, DAMAGED)])

    def _look(self, now_s: float) -> None:
        self._arriving += self.cable.host_hears(now_s)
        begins_s = self.cable.next_start_s()
        if self._arriving:
            self.next_event_s = now_s
        else:
            self.next_event_s = NEVER_S if begins_s is None else begins_s


def smartstep_chain(
    units: Sequence[SimulatedUnit],
    wiring: Wiring = Wiring.FOUR_WIRE,
    framing: Framing = Framing.SEVEN_EVEN,
    *,
    echo: bool = False,
    faults: FaultPlan | None = None,
    delivery: Delivery = Delivery.WHOLE,
) -> Chain:
    """Return a line at 9600 baud with these drives on it; the sole module is a `SimulatedSmartSteps`."""
    module = SimulatedSmartSteps(SimulatedCable(units, wiring, echo=echo), framing)
    chain = Chain([module], faults, delivery=delivery)
    chain.baud = BAUD
    return chain
