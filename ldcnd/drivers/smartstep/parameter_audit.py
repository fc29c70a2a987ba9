"""Whether the parameters of a drive are what they were, or what this host has written. Pure.

A drive that was reset has again what its EEPROM holds; one that another program, or the handheld unit, has changed has
something else. Only values in use are compared: those in EEPROM act from the next power-on on, and show then.
"""

from ldcnd.drivers.smartstep.parameters import PARAMETERS
from ldcnd.model.parameters import Memory, ParameterValue


class ParameterAudit:
    """The expected value of each parameter of one drive, from its first reading on."""

    def __init__(self) -> None:
        self._held: dict[str, int] = {}
        self._stored: dict[str, int] = {}  # what this host has written to EEPROM: in use after the next power-on
        self._odd: tuple[str, int] | None = None  # not believed before it reads the same again
        self._found: dict[str, int] = {}

    @property
    def differences(self) -> str:
        """Say what differs; empty when nothing does."""
        return "; ".join(
            f"{label} is {value} and was {self._held[label]}" for label, value in sorted(self._found.items())
        )

    def read(self, place: int, value: int) -> bool:
        """Take the value in use of `PARAMETERS[place]`; return whether it has to be read again at once."""
        label = PARAMETERS[place].label
        if value == self._stored.get(label):
            self._held[label] = value
        if value == self._held.setdefault(label, value):
            self._found.pop(label, None)
        elif self._found.get(label) != value:
            if self._odd != (label, value):
                self._odd = (label, value)
                return True
            self._found[label] = value
        self._odd = None
        return False

    def wrote(self, value: ParameterValue, memory: Memory) -> None:
        """This host has written a parameter, or found there what it was to write: that is expected from now on."""
        label = value.parameter
        self._held[label] = value.active
        self._found.pop(label, None)
        if memory is Memory.EEPROM:
            self._stored[label] = value.stored
        else:
            self._stored.pop(label, None)  # a reset would undo it
