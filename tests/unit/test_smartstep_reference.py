"""The reference page says what the tables say, and the tests that it names exist."""

import re
from pathlib import Path

import pytest

from ldcnd.drivers.smartstep.addresses import OperatingMode, Register
from ldcnd.drivers.smartstep.monitors import ALARMS, MONITORS
from ldcnd.drivers.smartstep.packet import ResponseStatus
from ldcnd.drivers.smartstep.parameters import PARAMETERS, Fact, Parameter
from ldcnd.drivers.smartstep.profiles import ASSUMPTIONS, Confidence
from ldcnd.drivers.smartstep.trace_data import DataObject, IoObject

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs" / "reference" / "smartstep.md").read_text()
ROWS = [[cell.strip() for cell in line.strip("|").split("|")] for line in PAGE.splitlines() if line.startswith("|")]
NAMED = sorted(set(re.findall(r"`(test_\w+)`", PAGE)))


def defined_tests() -> set[str]:
    sources = ROOT.glob("tests/*/test_smartstep_*.py")
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
    entries = [row for row in ROWS if row[-1] != "test" and set(row[0]) != {"-"}]

    assert [row for row in entries if not re.fullmatch(r"`test_\w+`", row[-1])] == []
    assert len(entries) > 150


def test_page_explains_every_mark():
    assert [mark.value for mark in Confidence if f"`{mark.value}`" not in PAGE] == []
