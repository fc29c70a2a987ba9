"""The examination of a line as the command does it, on the jumping clock."""

import asyncio
from pathlib import Path

import pytest

from ldcnd.bench.cli.examine import examine_line
from ldcnd.config.rig import load_config
from ldcnd.contract.errors import BusDown
from ldcnd.contract.health import Finding, Verdict
from ldcnd.testing.jumping_loop import JumpingLoop
from tests.support.command_line import run_here

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

    with pytest.raises(BusDown, match="/dev/absent-adapter cannot be opened"):
        await examine_line(rig, absent, lambda _: None)


def test_what_a_drive_shows_of_its_traces_is_reported_and_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    config = tmp_path / "mixed.toml"
    config.write_text(MIXED.read_text())
    loop = JumpingLoop()
    monkeypatch.setattr(asyncio, "run", loop.run_until_complete)

    ran = run_here(
        "doctor", "verify", "--config", str(config), "--bus", "steps", "--axis", "feed", "--write", typed="\n" * 9
    )  # fmt: skip
    loop.close()

    report = {line.split()[0]: line.split()[1] for line in ran.printed.splitlines()[:-1]}
    (feed,) = [axis.smartstep for bus in load_config(config).bus for axis in bus.axis if axis.name == "feed"]
    assert ran.code == 1  # its pulses are too slow to show their gear
    assert {key for key, state in report.items() if state == "open"} == {"command_pulse_gear", "string_checksum"}
    assert feed.trace.word_layout == "msb-io"
    assert not feed.trace.verified
