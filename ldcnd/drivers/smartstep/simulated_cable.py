"""The wires between a host and simulated SmartSteps: who hears whom, and what collides.

Four wires: every drive hears the host alone, the host hears the drives. Two wires: everybody hears everybody. A drive
with unit number 0 never releases its transmitter, so on a pair that it shares nothing else gets through.
Source: manual 1 (4), (5) and 2.2 (6); the two-wire hazards follow from the formats in 2.2.
"""

from collections.abc import Sequence

from ldcnd.drivers.smartstep.parity import DAMAGED
from ldcnd.drivers.smartstep.profiles import Wiring
from ldcnd.drivers.smartstep.simulated_unit import CHARACTER_S, SimulatedUnit, Transmission


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
        """When a drive will next begin to send, as far as they know; None when all are silent."""
        starts = [unit.next_start_s for unit in self.units if unit.next_start_s is not None]
        return min(starts, default=None)

    def _is_held(self) -> bool:
        """Tell whether a transmitter that is never released shares its pair with another one."""
        others = len(self.units) > 1 or self._wiring is Wiring.TWO_WIRE
        return others and any(unit.always_transmits for unit in self.units)

    def _overlaps(self, item: Transmission) -> bool:
        return self._last is not None and self._last.end_s - CHARACTER_S / 2 > item.start_s

    def _collect(self, to_s: float) -> None:
        # A drive may answer what it overheard, so this goes on until nobody begins to send any more.
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
