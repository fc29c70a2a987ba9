"""The reference page has a row for every command, item, flag, fault and dialect."""

import re
from pathlib import Path

import pytest

from ldcnd.drives.ldcn.faults import FaultCode
from ldcnd.drives.ldcn.packet import AuxFlag, CommandCode, StatusFlag, StatusItem
from ldcnd.drives.ldcn.profiles import PROFILES, Support

PAGE = (Path(__file__).parents[2] / "docs" / "reference" / "ldcn-nmc.md").read_text(encoding="utf-8")


def bit_of(flag: int) -> str:
    return str(flag.bit_length() - 1)


EXPECTED = {
    "commands": [f"| {command.name} | {command.value:X} |" for command in CommandCode],
    "items and flags": [f"| {flag.name} | {bit_of(flag)} |" for flag in [*StatusItem, *StatusFlag, *AuxFlag]],
    "faults": [f"| {code.value} |" for code in FaultCode],
    "dialects": [f"| `{profile.name}` |" for profile in PROFILES.values() if profile.support is Support.FULL],
}  # fmt: skip


@pytest.mark.parametrize("kind", EXPECTED)
def test_the_page_has_a_row_for_each(kind):
    rows = [re.sub(r"\s*\|\s*", " | ", line).strip() for line in PAGE.splitlines() if line.startswith("|")]

    assert [text for text in EXPECTED[kind] if not any(text in row for row in rows)] == []
