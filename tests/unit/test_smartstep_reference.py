"""The reference page says what the tables say, and the tests that it names exist."""

import re
from pathlib import Path

import pytest

from ldcnd.drivers.smartstep.addresses import OperatingMode, Register
from ldcnd.drivers.smartstep.monitors import ALARMS, MONITORS, AlarmKind
from ldcnd.drivers.smartstep.packet import ResponseStatus
from ldcnd.drivers.smartstep.parameters import PARAMETERS, PN000, UNIT_DIGIT, Fact, Parameter
from ldcnd.drivers.smartstep.profiles import ASSUMPTIONS, Confidence, SmartStepProfile
from ldcnd.drivers.smartstep.trace_data import DataObject, IoObject

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs" / "reference" / "smartstep.md").read_text()
ROWS = [[cell.strip() for cell in line.strip("|").split("|")] for line in PAGE.splitlines() if line.startswith("|")]
NAMED = sorted(set(re.findall(r"`(test_\w+)`", PAGE)))


def defined_tests() -> set[str]:
    others = ("unit/test_cli_params.py", "integration/test_mixed_rig.py", "integration/test_params_cli.py")
    sources = [*ROOT.glob("tests/*/test_smartstep_*.py"), *(ROOT / "tests" / name for name in others)]
    return {
        name for path in sources for name in re.findall(r"^(?:async )?def (test_\w+)", path.read_text(), re.MULTILINE)
    }


def has_row(*cells: str) -> bool:
    return any(row[: len(cells)] == list(cells) for row in ROWS)


def shown(fact: Fact | None, text: str) -> str:
    return f"{text} [{fact.confidence.value}]" if fact else "-"


def parameter_row(parameter: Parameter) -> list[str]:
    unit, limits, default, cycle = parameter.unit, parameter.limits, parameter.default, parameter.power_cycle
    return [
        f"{parameter.eeprom_address:04X}H",
        f"{parameter.ram_address:04X}H",
        parameter.label,
        parameter.name,
        "digits" if parameter.nibbles else shown(unit, unit.value if unit else ""),
        shown(limits, f"{limits.value.lowest} to {limits.value.highest}" if limits else ""),
        shown(default, str(default.value) if default else ""),
        shown(cycle, "yes" if cycle and cycle.value else "no"),
    ]


@pytest.mark.parametrize("name", NAMED)
def test_test_that_the_page_names_exists(name):
    assert name in defined_tests()


@pytest.mark.parametrize("parameter", PARAMETERS, ids=lambda parameter: parameter.label)
def test_page_lists_the_parameter_with_all_that_is_known(parameter):
    assert has_row(*parameter_row(parameter))


DIGITS = [(parameter, digit) for parameter in PARAMETERS for digit in parameter.digits]


@pytest.mark.parametrize(("parameter", "digit"), DIGITS, ids=lambda each: getattr(each, "label", None) or each.place)
def test_page_lists_the_digit_with_its_mark(parameter, digit):
    values = ", ".join(f"{value:X} {text}" for value, text in digit.values.items())
    mark = digit.confidence

    assert any(
        row[:2] == [f"{parameter.label}.{digit.place}", digit.title] and row[3] == mark.value and values in row[2]
        for row in ROWS
    )
    assert (mark is Confidence.STATED) is ((parameter, digit.place) == (PN000, UNIT_DIGIT))


@pytest.mark.parametrize("monitor", MONITORS, ids=lambda monitor: f"{monitor.address:04X}")
def test_page_lists_the_monitor(monitor):
    sign = "signed" if monitor.signed else "unsigned"

    assert has_row(f"{monitor.address:04X}H", monitor.label, monitor.title, monitor.unit or "bits", sign)


@pytest.mark.parametrize("known", ALARMS, ids=lambda known: f"{known.code:04X}")
def test_page_lists_the_alarm(known):
    assert has_row(f"{known.code:04X}H", known.text, known.kind.value)


@pytest.mark.parametrize("register", Register)
def test_page_lists_the_register(register):
    assert has_row(f"{register.value:04X}H", register.name)


@pytest.mark.parametrize("status", ResponseStatus)
def test_page_lists_the_response_status(status):
    assert has_row(f"{status.value:X}", status.function.name.lower().replace("_", " "))


@pytest.mark.parametrize("code", [*OperatingMode])
def test_page_lists_the_operating_mode(code):
    assert has_row(f"{code.value:04X}H", code.name)


@pytest.mark.parametrize("code", [*DataObject, *IoObject], ids=lambda code: code.name)
def test_page_lists_the_trace_code(code):
    assert has_row(f"{code.value:02X}H", code.name)


@pytest.mark.parametrize("assumption", ASSUMPTIONS, ids=lambda assumption: assumption.key)
def test_page_lists_the_assumption_with_its_confidence(assumption):
    assert has_row(assumption.key, assumption.question, assumption.confidence.value)


def test_every_row_of_every_table_names_its_test():
    pins = {"direction", "-", "host to drive", "drive to host", "---"}
    entries = [row for row in ROWS if row[-1] not in {"test", *pins} and set(row[0]) != {"-"}]

    assert [row for row in entries if not re.fullmatch(r"`test_\w+`", row[-1])] == []
    assert len(entries) > 150


def test_page_explains_every_mark():
    assert [mark.value for mark in Confidence if f"`{mark.value}`" not in PAGE] == []


FINDINGS = [row for row in ROWS if re.match(r"\d+ ", row[0])]


def test_every_finding_of_the_audit_has_its_test():
    assert {int(row[0].split()[0]) for row in FINDINGS} == set(range(1, 26))
    assert all(re.fullmatch(r"`test_\w+`", row[2]) for row in FINDINGS)


PINS = {
    "CN1": {
        "19": "GND", "20": "RXD+", "21": "RXD-", "22": "TXD+", "23": "TXD-", "24": "RT", "shell": "FG",
    },
    "CN3": {"1": "/TXD", "2": "/RXD", "3": "PRMU", "7": "+5V", "8": "GND", "shell": "FG"},
}  # fmt: skip
"""Section 1.1 of the manual, whole; its "P -> D" is from the host to the drive."""
TO_DRIVE = {"RXD+", "RXD-", "/RXD"}
FROM_DRIVE = {"TXD+", "TXD-", "/TXD"}


@pytest.mark.parametrize("connector", PINS)
def test_the_page_has_the_pins_of_both_connectors(connector):
    table = PAGE[PAGE.index(f"| {connector} pin |") :].partition("\n\n")[0]
    shown: dict[str, tuple[str, str]] = {}
    for line in table.splitlines()[2:]:
        pins, signals, direction = (cell.strip() for cell in line.strip("|").split("|"))
        names = re.split(r", ?", signals.partition(":")[0].replace(", shield", ""))
        shown |= {pin: (name, direction) for pin, name in zip(pins.split(", "), names, strict=True)}

    assert {pin: name for pin, (name, _) in shown.items()} == PINS[connector]
    assert {name for name, direction in shown.values() if direction == "host to drive"} == TO_DRIVE & set(
        PINS[connector].values()
    )
    assert {name for name, direction in shown.values() if direction == "drive to host"} == FROM_DRIVE & set(
        PINS[connector].values()
    )


CLAIM = re.compile(r"documents no command that enables, moves, stops or resets a SmartStep \(sections 3 to 6\)")
OVERCLAIM = re.compile(r"(?:port|line|drive|protocol) (?:has|knows|takes) no command|there is no command")


@pytest.mark.parametrize("known", [each for each in ALARMS if each.kind is AlarmKind.ALARM], ids=lambda each: each.text)
def test_alarm_pages_say_what_the_manual_documents(known):
    page = (ROOT / "ldcnd" / "fault_pages" / f"alarm_{known.code:04x}.md").read_text()
    text = " ".join(page.split())

    assert f'code {known.code:04X}H, "{known.text}" (serial communications manual, section 3' in text
    assert CLAIM.search(text)
    assert not OVERCLAIM.search(text)


def test_every_field_of_the_profile_is_used():
    sources = [
        path.read_text() for path in (ROOT / "ldcnd").rglob("*.py") if path.name not in {"profiles.py", "config.py"}
    ]
    fields = [name for name in SmartStepProfile.__slots__ if name != "assumptions"]
    owners = "(?:profile|SMARTSTEP|SOFT_PARITY)"
    unused = [name for name in fields if not any(re.search(rf"{owners}\.{name}\b", text) for text in sources)]

    assert unused == []
