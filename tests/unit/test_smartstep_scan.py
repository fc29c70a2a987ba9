"""Looking for drives on a line of which nothing is known, and why there are none."""

import pytest

from ldcnd.bench.known import show_findings
from ldcnd.bench.smartstep.family import SMARTSTEP_BENCH, SOFT_PARITY
from ldcnd.contract.health import Verdict
from ldcnd.drives.smartstep.network import smartstep_opener
from ldcnd.drives.smartstep.profiles import Framing, Wiring
from ldcnd.sim.faults import FaultKind, FaultPlan, LineFault
from ldcnd.sim.line import open_simulated_line
from ldcnd.sim.smartstep.cable import smartstep_chain
from tests.support.smartstep_line import simulated


async def scanned(units, **line):
    chain = smartstep_chain(units, framing=Framing.SOFT_PARITY, **line)
    found = []
    opener = smartstep_opener(lambda: open_simulated_line(chain), SOFT_PARITY)
    look = SMARTSTEP_BENCH.scan("sim", give_addresses=False, opener=opener)
    await show_findings(look.bus, "sim", look.findings, found.append)
    assert [f"unit {drive.address:X}" for drive in look.drives] == [each.axis for each in found if each.axis != "-"]
    return found


async def test_every_drive_of_a_line_is_found_by_its_unit_number():
    found = await scanned([simulated(1), simulated(9), simulated(15)])

    assert [finding.axis for finding in found] == ["unit 1", "unit 9", "unit F"]
    assert all(finding.verdict is Verdict.FINE and "000CH" in finding.text for finding in found)


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ({}, "nothing comes back"),
        ({"wiring": Wiring.TWO_WIRE, "echo": True}, "the host hears itself"),
    ],
)
async def test_a_line_without_drives_says_what_is_wrong(line, words):
    silent = simulated(1)
    silent.power_off(0.0)

    (finding,) = await scanned([silent], **line)

    assert finding.verdict is Verdict.WRONG
    assert words in finding.text


async def test_wrong_parity_is_told_from_silence():
    jamming = [simulated(0), simulated(1)]

    found = await scanned(jamming, faults=FaultPlan((LineFault(FaultKind.REPLY_BIT_FLIPPED, 1.0),)))

    assert found[-1].verdict is Verdict.WRONG or "unit 0" in found[0].axis
