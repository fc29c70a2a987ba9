"""What the page of a fault says to clear it is typed in the state of that fault, line for line; then the axis moves."""

import asyncio
import re
from collections.abc import Callable
from dataclasses import dataclass

import pytest

from ldcnd.contract.fault_pages import page_text
from ldcnd.testing.faults import RigFault, RigFaults
from tests.support.command_line import virtual_rig

CLEARING = re.compile(r"## How to clear it\n(.*?)\n## ", re.DOTALL)
TYPED = re.compile(r"`ldcnd ((?:power|reset|home|halt|move) [^`]*)`")


@dataclass(frozen=True, slots=True)
class Case:
    """A fault in the middle of a move of x, and the page that people are led to."""

    page: str
    cause: Callable[[RigFaults], RigFault]
    shown: str = ""
    """The fault of the axis, where it is another one than the page's."""


CASES = {
    "mute": Case("link_lost", lambda faults: faults.mute("x", at=10)),
    "unplugged": Case("bus_down", lambda faults: faults.unplug(after_s=0.5), "link_lost"),
    "jam": Case("not_followed", lambda faults: faults.jam("x", at=10)),
    "encoder lost": Case("encoder_or_hall", lambda faults: faults.encoder_lost("x", at=10)),
    "overheat": Case("overheat", lambda faults: faults.overheat("x", at=10)),
    "overcurrent": Case("overcurrent", lambda faults: faults.overcurrent("x", at=10)),
    "motor short": Case("motor_short_or_overvoltage", lambda faults: faults.motor_short("x", at=10)),
    "overvoltage": Case("motor_short_or_overvoltage", lambda faults: faults.overvoltage("x", at=10)),
    "stop input": Case("stop_input", lambda faults: faults.stop_input("x", at=10)),
    "reset by another": Case("link_lost", lambda faults: faults.reset_by_another(after_s=0.5)),
}


@pytest.mark.parametrize("case", CASES.values(), ids=CASES)
@pytest.mark.sweep(3)
def test_what_the_page_of_a_fault_says_leads_to_an_axis_that_moves(monkeypatch: pytest.MonkeyPatch, case: Case) -> None:
    section = CLEARING.search(page_text(case.page))
    assert section
    with virtual_rig(monkeypatch) as rig:
        lives = rig.rig.lives
        assert lives
        rig.power_on("x")
        assert rig.run("home x --wait").code == 0
        cause = case.cause(lives.faults)
        rig.run("move x 40 --velocity 10 --wait")
        rig.wait(asyncio.sleep(3.0))
        fault = rig.wait(rig.rig.client.last("x", "fault"))
        cause.end()
        rig.wait(asyncio.sleep(8.0))

        lines = [f"{each} --wait" if each == "home x" else each for each in TYPED.findall(section[1])]
        ran = {line: rig.run(line) for line in lines}
        before = lives.truth("x").position
        moved = rig.run("move x 1 --relative --velocity 1 --wait")
        after = lives.truth("x").position

    assert (case.shown or case.page) in [entry.code for entry in fault.active]
    assert {line: each.errors for line, each in ran.items() if each.code} == {}
    assert (moved.code, after - before) == (0, pytest.approx(1.0, abs=0.05)), moved.errors
