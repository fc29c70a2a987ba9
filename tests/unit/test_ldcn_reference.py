"""The reference page names every command, item, flag and fault, and the tests that it names exist."""

import re
from pathlib import Path

import pytest

from ldcnd.drivers.ldcn.controls import HomingControl, StopControl
from ldcnd.drivers.ldcn.faults import FaultCode
from ldcnd.drivers.ldcn.packet import AuxFlag, Command, StatusFlag, StatusItem
from ldcnd.drivers.ldcn.profiles import PROFILES, Support
from ldcnd.drivers.ldcn.trajectory import TrajectoryControl

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs" / "reference" / "ldcn-nmc.md").read_text()
ROWS = [[cell.strip() for cell in line.strip("|").split("|")] for line in PAGE.splitlines() if line.startswith("|")]
NAMED = sorted(set(re.findall(r"`(test_\w+)`", PAGE)))


def defined_tests() -> set[str]:
    sources = [*ROOT.glob("tests/*/test_*.py")]
    return {
        name for path in sources for name in re.findall(r"^(?:async )?def (test_\w+)", path.read_text(), re.MULTILINE)
    }


DEFINED = defined_tests()


def bit_of(flag: int) -> str:
    return str(flag.bit_length() - 1)


@pytest.mark.parametrize("name", NAMED)
def test_test_that_the_page_names_exists(name):
    assert name in DEFINED


@pytest.mark.parametrize("command", Command)
def test_page_lists_the_command_with_its_code(command):
    assert [row[1] for row in ROWS if row[0] == command.name] == [f"{command.value:X}"]


@pytest.mark.parametrize(
    "flag", [*StatusItem, *StatusFlag, *AuxFlag], ids=lambda flag: f"{type(flag).__name__}.{flag.name}"
)
def test_page_lists_the_item_or_flag_with_its_bit(flag):
    assert bit_of(flag) in [row[1] for row in ROWS if row[0] == flag.name]


@pytest.mark.parametrize(
    "flag", [*TrajectoryControl, *StopControl, *HomingControl], ids=lambda flag: f"{type(flag).__name__}.{flag.name}"
)
def test_page_lists_the_control_bit(flag):
    assert f"{bit_of(flag)} {flag.name}" in [row[0] for row in ROWS]


@pytest.mark.parametrize("code", FaultCode)
def test_page_lists_the_fault(code):
    assert code.value in [row[0] for row in ROWS]


@pytest.mark.parametrize("profile", [profile for profile in PROFILES.values() if profile.support is Support.FULL])
def test_page_lists_the_dialect(profile):
    assert f"`{profile.name}`" in [row[3] for row in ROWS if len(row) > 3]


def test_every_row_of_every_table_names_its_test():
    entries = [row for row in ROWS if row[-1] != "test" and set(row[0]) != {"-"}]

    assert [row for row in entries if not re.fullmatch(r"`test_\w+`(, `test_\w+`)*", row[-1])] == []
    assert len(entries) > 90
