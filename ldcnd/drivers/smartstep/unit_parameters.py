"""The parameters, counters and alarms of one SmartStep, as the daemon asks for them."""

from collections.abc import Callable

from ldcnd.drivers.parameter_access import ParameterAccess, Written
from ldcnd.drivers.smartstep.addresses import Register
from ldcnd.drivers.smartstep.alarms import HISTORY_LENGTH, alarm
from ldcnd.drivers.smartstep.counter_clear import clear_counter
from ldcnd.drivers.smartstep.counters import Counter
from ldcnd.drivers.smartstep.doubts import doubt_info
from ldcnd.drivers.smartstep.parameter_store import EepromRules, ParameterStore, parameter_info
from ldcnd.drivers.smartstep.parameters import PARAMETERS
from ldcnd.drivers.smartstep.profiles import SmartStepProfile
from ldcnd.drivers.smartstep.words import Words
from ldcnd.model.parameters import AlarmEntry, CounterName, DoubtInfo, ParameterInfo, ParameterValue
from ldcnd.model.requests import WriteParameterRequest

COUNTERS = {CounterName.COMMAND: Counter.COMMAND, CounterName.FEEDBACK: Counter.FEEDBACK}


class UnitParameters(ParameterAccess):
    """See `ParameterAccess`."""

    def __init__(
        self, words: Words, profile: SmartStepProfile, eeprom: EepromRules, cleared: Callable[[], None]
    ) -> None:
        self._words = words
        self._profile = profile
        self._store = ParameterStore(words, profile, eeprom)
        self._cleared = cleared

    @property
    def self_hearing(self) -> bool:
        """See `ParameterAccess`."""
        return self._words.self_hearing

    def known(self) -> tuple[ParameterInfo, ...]:
        """See `ParameterAccess`."""
        return tuple(map(parameter_info, PARAMETERS))

    async def read(self, parameter: str, *, unlisted: bool = False) -> ParameterValue:
        """See `ParameterAccess`."""
        return await self._store.read(self._store.find(parameter, unlisted=unlisted))

    async def read_all(self) -> tuple[ParameterValue, ...]:
        """See `ParameterAccess`."""
        return await self._store.read_all()

    async def write(self, request: WriteParameterRequest) -> Written:
        """See `ParameterAccess`."""
        return await self._store.write(request)

    async def clear_counter(self, counter: CounterName) -> int:
        """See `ParameterAccess`."""
        value = await clear_counter(self._words, COUNTERS[counter])
        self._cleared()
        return value

    async def alarms(self) -> tuple[AlarmEntry, tuple[AlarmEntry, ...]]:
        """See `ParameterAccess`."""
        present = _entry(await self._words.read(Register.PRESENT_ALARM))
        history = [_entry(await self._words.read(Register.ALARM_HISTORY + place)) for place in range(HISTORY_LENGTH)]
        return present, tuple(history)

    def doubts(self) -> tuple[DoubtInfo, ...]:
        """See `ParameterAccess`."""
        return tuple(doubt_info(self._profile, doubt) for doubt in self._profile.doubts)


def _entry(word: int) -> AlarmEntry:
    known = alarm(word)
    return AlarmEntry(code=known.code, text=known.text, kind=known.kind.value)
