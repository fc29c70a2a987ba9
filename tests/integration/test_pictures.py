"""What commands that look print where nothing is known of a terminal: on 80 columns, aligned, without control codes."""

import asyncio
import re

import pytest

from tests.support.chain_rig import simulated_config
from tests.support.command_line import virtual_rig

COLUMNS = 80
TABLES = ("list", "fleet", "bus list", "lease list", "speed", "axis preview x --position 10", "axis at x --ago 0.5")
OURS = re.compile(r"^(?!\d{4}-\d\d-\d\d \d\d:)")
"""No line of the daemon's log, which is printed in this process, too."""


@pytest.fixture(scope="module", name="pictures")
def shown():
    """What each command prints while one axis is homed, and none moves."""
    with pytest.MonkeyPatch.context() as patch, virtual_rig(patch, simulated_config()) as rig:
        rig.wait(asyncio.sleep(1))
        for line in ("power on", "axis set-position x 12.5"):
            rig.run(line)
        rig.wait(asyncio.sleep(2))
        yield {line: list(filter(OURS.match, rig.run(line).printed.splitlines())) for line in TABLES}


@pytest.mark.parametrize("command", TABLES)
def test_a_table_has_room_on_80_columns_and_no_control_codes(pictures, command):
    lines = pictures[command]

    assert lines
    assert [line for line in lines if len(line) > COLUMNS] == []
    assert "".join(lines).isprintable()


@pytest.mark.parametrize(("command", "first"), [("list", 0), ("fleet", 1)])
def test_columns_stand_below_each_other_with_their_units(pictures, command, first):
    rows = [line for line in pictures[command][first:] if not line.lstrip().startswith("!")]
    starts = [{match.start() for match in re.finditer(r"(?<=  )\S", line)} for line in rows]

    assert len(rows) == 4
    assert set.intersection(*starts) >= {min(each) for each in starts if each}
    assert len(set.intersection(*starts)) >= 3
    if command == "list":
        assert "12.500 mm" in rows[0]
