"""The examination of a line as the command does it, on the jumping clock."""

from pathlib import Path

import pytest

from ldcnd.cli.doctor import examine_line
from ldcnd.config.rig import load_config
from ldcnd.errors import BusDown
from ldcnd.model.health import Finding, Verdict

MIXED = Path(__file__).parents[2] / "config" / "mixed.toml"


async def test_every_configured_drive_of_the_line_is_examined():
    rig = load_config(MIXED)
    found: list[Finding] = []

    await examine_line(rig, rig.bus[1], found.append)

    assert {finding.axis for finding in found} == {"feed", "spool"}
    assert len(found) == 20
    assert all(finding.verdict is not Verdict.WRONG for finding in found)


async def test_a_port_that_does_not_open_is_told():
    rig = load_config(MIXED)
    absent = rig.bus[1].model_copy(update={"port": "/dev/absent-adapter"})

    with pytest.raises(ExceptionGroup) as failure:
        await examine_line(rig, absent, lambda _: None)

    assert failure.group_contains(BusDown)
