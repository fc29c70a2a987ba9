"""SmartStep drives on a simulated line: the cable and its units as one module of `ldcnd.sim`.

One module for the whole cable, because its drives share pairs and may hear each other, which a daisy chain does not
know.
"""

from collections import deque
from collections.abc import Sequence

from ldcnd.drivers.smartstep.parity import DAMAGED, add_parity, strip_parity
from ldcnd.drivers.smartstep.profiles import Framing, Wiring
from ldcnd.drivers.smartstep.simulated_cable import SimulatedCable
from ldcnd.drivers.smartstep.simulated_unit import CHARACTER_S, SimulatedUnit, Transmission
from ldcnd.sim.chain import NEVER_S, Chain, Delivery, Module, Reply
from ldcnd.sim.faults import FaultPlan

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

    def hear(self, value: int | None, at_s: float) -> None:
        """See `Module`."""
        self.cable.host_sends(self._heard(value), at_s - CHARACTER_S)
        self._look(at_s)

    def advance(self, to_s: float) -> Reply | None:
        """See `Module`."""
        self._look(to_s)
        if not self._arriving:
            return None
        item = self._arriving.popleft()
        self._look(to_s)
        data = add_parity(item.characters) if self.framing is Framing.SOFT_PARITY else item.characters
        return Reply(data, item.start_s, CHARACTER_S)

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
