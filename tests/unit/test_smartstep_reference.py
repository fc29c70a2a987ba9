"""The reference page says what the tables of the driver say."""

import re
from pathlib import Path

import pytest

from ldcnd.drives.smartstep.addresses import OperatingMode, Register
from ldcnd.drives.smartstep.packet import ResponseStatus
from ldcnd.drives.smartstep.trace_data import DataObject, IoObject
from tests.support.smartstep_monitors import MONITORS

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs" / "reference" / "smartstep.md").read_text()
ROWS = [[cell.strip() for cell in line.strip("|").split("|")] for line in PAGE.splitlines() if line.startswith("|")]


def has_row(*cells: str) -> bool:
    return any(row[: len(cells)] == list(cells) for row in ROWS)


TABLES = {
    "monitors": [
        (f"{each.address:04X}H", each.label, each.title, each.unit or "bits", "signed" if each.signed else "unsigned")
        for each in MONITORS
    ],
    "registers": [(f"{register.value:04X}H", register.name) for register in Register],
    "response status": [(f"{each.value:X}", each.function.name.lower().replace("_", " ")) for each in ResponseStatus],
    "operating modes": [(f"{code.value:04X}H", code.name) for code in OperatingMode],
    "trace codes": [(f"{code.value:02X}H", code.name) for code in [*DataObject, *IoObject]],
}


@pytest.mark.parametrize("kind", TABLES)
def test_the_page_has_all_that_is_known(kind):
    assert [cells for cells in TABLES[kind] if not has_row(*cells)] == []


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
