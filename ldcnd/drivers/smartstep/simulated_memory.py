"""The parameter memory of a simulated drive: EEPROM that wears, RAM that forgets.

Its ranges are those of parameters.py, recollected ones included: a real drive may differ.
Source: manual 2.2, note on EEPROM; 3, parameter table.
"""

from collections.abc import Mapping

from ldcnd.drivers.smartstep.addresses import EEPROM_AREA, RAM_AREA, RAM_OFFSET
from ldcnd.drivers.smartstep.packet import HIGHEST_WORD
from ldcnd.drivers.smartstep.parameters import PARAMETERS, Limits, Parameter

EEPROM_LIFE = 10_000


class SimulatedMemory:
    """Words by parameter number.

    Attributes:
        writes: how often each EEPROM word was written.
    """

    def __init__(self, stored: Mapping[Parameter, int], *, eeprom_changes_ram: bool) -> None:
        self.writes = {parameter.number: 0 for parameter in PARAMETERS}
        self._limits = {parameter.number: _limits(parameter) for parameter in PARAMETERS}
        self._eeprom = {parameter.number: _factory_value(parameter) for parameter in PARAMETERS}
        self._eeprom.update({parameter.number: value for parameter, value in stored.items()})
        self._ram = dict(self._eeprom)
        self._eeprom_changes_ram = eeprom_changes_ram

    def power_on(self) -> None:
        """Load RAM from EEPROM."""
        self._ram = dict(self._eeprom)

    def active(self, parameter: Parameter) -> int:
        """Return the value in use."""
        return self._ram[parameter.number]

    def stored(self, parameter: Parameter) -> int:
        """Return the value kept over power-off."""
        return self._eeprom[parameter.number]

    def read(self, address: int) -> int | None:
        """Return the word at an address of the parameter areas; None where there is none."""
        if address in EEPROM_AREA:
            return self._eeprom.get(address)
        return self._ram.get(address - RAM_OFFSET) if address in RAM_AREA else None

    def holds(self, address: int) -> bool:
        """Tell whether there is a word at this address."""
        return self.read(address) is not None

    def write(self, address: int, value: int) -> bool:
        """Store a word at an address that exists; return False when the value is out of its range."""
        number = address if address in EEPROM_AREA else address - RAM_OFFSET
        limits = self._limits[number]
        if not limits.lowest <= value <= limits.highest:
            return False
        if address in RAM_AREA:
            self._ram[number] = value
            return True
        self.writes[number] += 1
        if self.writes[number] <= EEPROM_LIFE:
            self._eeprom[number] = value
            if self._eeprom_changes_ram:
                self._ram[number] = value
        return True


def _limits(parameter: Parameter) -> Limits:
    return parameter.limits.value if parameter.limits else Limits(0, HIGHEST_WORD)


def _factory_value(parameter: Parameter) -> int:
    return parameter.default.value if parameter.default else 0
