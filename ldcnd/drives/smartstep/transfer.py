"""Moving parameters from one drive, or a file, to another: what has to be written where, and what speaks against it.

The unit number stays: of Pn000 only the third digit from the right is the unit number (manual 2.2 (6)), the others are
settings of the machine and move. What takes effect at power-on goes to EEPROM, because RAM is lost then; the rest goes
to EEPROM permanently and to RAM to be in use at once. Whether a write to EEPROM changes RAM is not stated, so both are
written where both differ. Ranges are hints and refuse nothing. Pure.
Source: manual 2.2, note on EEPROM, (6); 3.
"""

from collections.abc import Iterator, Mapping, Sequence

from ldcnd.contract.parameters import (
    DriveFacts,
    Memory,
    ParameterValue,
    PlannedParameters,
    PlannedWrite,
    PlanParameters,
)
from ldcnd.drives.smartstep.parameters import (
    PARAMETERS,
    PN000,
    UNIT_DIGIT,
    Parameter,
    digit_of,
    digit_texts,
    find_parameter,
    unit_number,
    with_digit,
)

AT_ONCE = "at once"
AT_POWER_ON = "at the next power-on"
UNKNOWN = "not known; at the next power-on at the latest"


def listed(name: str) -> Parameter | None:
    """Return the listed parameter that a dump or a person means by a name; None where there is none."""
    found = find_parameter(name)
    return found if found and found in PARAMETERS else None


def plan_writes(request: PlanParameters, current: Sequence[ParameterValue], facts: DriveFacts) -> PlannedParameters:
    """Return the writes after which a drive holds the values of a request.

    Args:
        request: the values and where they come from.
        current: what the drive holds.
        facts: what the drive is.
    """
    held = {value.parameter: value for value in current}
    writes: list[PlannedWrite] = []
    problems, remarks = _type_problems(request, facts), []
    for parameter, word in _each_once(request.values, problems):
        value = held.get(parameter.label)
        if value is None:
            problems.append(f"{parameter.label}: this drive does not have it")
            continue
        if request.memory is Memory.RAM and _takes_effect(parameter) is not True:
            if word != value.active:
                remarks.append(f"{parameter.label} takes effect {_effective(parameter)} and is not tried out in RAM")
            continue
        writes += _writes(parameter, word, value, request.memory)
        remarks += _range_remarks(parameter, word)
    if any(write.effective != AT_ONCE for write in writes):
        remarks.append("some values take effect at the next power-on: switch the drive off and on, then compare again")
    return PlannedParameters(writes=tuple(writes), problems=tuple(problems), remarks=tuple(remarks))


def check_values(values: Mapping[str, int]) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Check the values of a dump without a drive; return what is wrong, and what deserves attention."""
    wrong: list[str] = []
    remarks: list[str] = []
    there = set[str]()
    for parameter, word in _each_once(values, wrong):
        there.add(parameter.label)
        remarks += _range_remarks(parameter, word)
        remarks += [text for text in digit_texts(parameter, word) if _is_odd_digit(parameter, word, text)]
    remarks += [f"{each.label} is missing: {each.name}" for each in PARAMETERS if each.label not in there]
    return tuple(wrong), tuple(remarks)


def _each_once(values: Mapping[str, int], wrong: list[str]) -> Iterator[tuple[Parameter, int]]:
    """Yield the parameters of a dump, each once; say what the manual does not list, and what stands there twice."""
    seen: dict[str, str] = {}
    for name, word in values.items():
        parameter = listed(name)
        if parameter is None:
            wrong.append(f"{name}: the manual lists no such parameter")
        elif parameter.label in seen:  # by its number and by its name
            wrong.append(f"{name}: names the same parameter as {seen[parameter.label]}")
        else:
            seen[parameter.label] = name
            yield parameter, word


def _is_odd_digit(parameter: Parameter, word: int, text: str) -> bool:
    """Tell whether a digit has a value that is not among those that are known."""
    place = int(text[len(parameter.label) + 1])
    known = next((digit for digit in parameter.digits if digit.place == place), None)
    return bool(known and known.values and digit_of(word, place) not in known.values)


def _type_problems(request: PlanParameters, facts: DriveFacts) -> list[str]:
    if request.any_type or request.driver_type == facts.driver_type:
        return []
    if request.driver_type is None:
        return ["the values do not say from which type of drive they are; allow any type to use them all the same"]
    types = f"driver type {request.driver_type:04X}H, this drive is {facts.driver_type:04X}H"
    return [f"the values are from {types}; allow any type to use them all the same"]


def _writes(parameter: Parameter, word: int, value: ParameterValue, memory: Memory | None) -> list[PlannedWrite]:
    writes = []
    if memory is not Memory.RAM:
        stored = _with_unit_of(parameter, word, value.stored)
        if stored != value.stored:
            writes.append(_write(parameter, Memory.EEPROM, value.stored, stored))
    if memory is not Memory.EEPROM and _takes_effect(parameter):
        active = _with_unit_of(parameter, word, value.active)
        if active != value.active:
            writes.append(_write(parameter, Memory.RAM, value.active, active))
    return writes


def _with_unit_of(parameter: Parameter, word: int, held: int) -> int:
    """Return the word with the unit number that the drive has."""
    return with_digit(word, UNIT_DIGIT, unit_number(held)) if parameter.number == PN000.number else word


def _write(parameter: Parameter, memory: Memory, before: int, value: int) -> PlannedWrite:
    texts = zip(digit_texts(parameter, before), digit_texts(parameter, value), strict=True)
    return PlannedWrite(
        parameter=parameter.label,
        name=parameter.name,
        memory=memory,
        before=before,
        value=value,
        effective=AT_ONCE if memory is Memory.RAM else _effective(parameter),
        digits=tuple(after for old, after in texts if old != after),
    )


def _takes_effect(parameter: Parameter) -> bool | None:
    """Tell whether a change in RAM takes effect at once; None where it is not known."""
    return None if parameter.power_cycle is None else not parameter.power_cycle


def _effective(parameter: Parameter) -> str:
    return {True: AT_ONCE, False: AT_POWER_ON, None: UNKNOWN}[_takes_effect(parameter)]


def _range_remarks(parameter: Parameter, word: int) -> list[str]:
    limits = parameter.limits
    if limits is None or limits.value.lowest <= word <= limits.value.highest:
        return []
    span = f"{limits.value.lowest} to {limits.value.highest} [{limits.confidence.value}]"
    return [f"{parameter.label} = {word} is outside of {span}; the drive decides"]
