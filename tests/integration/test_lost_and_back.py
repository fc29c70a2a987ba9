"""What goes away and comes back is said on every screen and in the log: modules, lines and drives alike."""

import asyncio
import json

import pytest

from ldcnd.contract.commands import MoveVelocity, Power
from ldcnd.contract.events import LINK_BACK, ReadEvents
from ldcnd.contract.rig_commands import SetIo
from ldcnd.contract.samples import LinkState
from tests.support.command_line import VirtualRig, virtual_rig
from tests.support.machine_rig import LOCK, chain_of_machine, machine
from tests.support.trace_rig import trace_rig

CABINET = 2
ROTOR = 0


@pytest.fixture
def chain():
    return chain_of_machine()


@pytest.fixture
def rig(monkeypatch, chain):
    with virtual_rig(monkeypatch, machine(), chains={"line": chain}) as virtual:
        virtual.wait(virtual.rig.until("rotor", lambda state: state.link is LinkState.UP))
        virtual.wait(asyncio.sleep(2.0))
        yield virtual


def power(virtual: VirtualRig, module, *, on: bool, then_s: float) -> None:
    async def switch() -> None:
        module.power(on=on, at_s=asyncio.get_running_loop().time())
        await asyncio.sleep(then_s)

    virtual.wait(switch())


async def now_s() -> float:
    return asyncio.get_running_loop().time()


def drop(virtual: VirtualRig, then_s: float) -> None:
    async def work() -> None:
        virtual.rig.daemon.rig.lines["line"].bus.drop("a cable that comes loose")
        await asyncio.sleep(then_s)

    virtual.wait(work())


def rows(virtual: VirtualRig, about: str) -> list[tuple[str, str]]:
    """Return what the log says of the link of something: what happened, and why."""
    found = map(json.loads, virtual.run(f"log --json --count 1000 --axis {about}").printed.splitlines())
    return [(row["what"], row["why"]) for row in found if row["what"] in ("link_lost", "link_back")]


@pytest.mark.long
def test_a_module_without_power_is_named_on_every_screen_and_in_the_log(rig, chain):
    rig.wait(rig.rig.client.ask(SetIo(module="cabinet", high=(LOCK,))))
    assert "module" not in rig.run("fleet").printed
    power(rig, chain.modules[CABINET], on=False, then_s=90.0)
    away = {command: rig.run(command).printed for command in ("list", "fleet", "top")}
    power(rig, chain.modules[CABINET], on=True, then_s=10.0)
    back = {command: rig.run(command).printed for command in ("list", "fleet", "top")}

    assert "the module does not answer" in away["fleet"]
    assert "the module does not answer" in away["top"]
    assert "not working: 1 module" in away["top"]
    assert "cabinet  I/O module  line  unknown, no answer" in away["list"]
    for said in back.values():
        assert "no answer" not in said
        assert "does not answer" not in said
    lost, again = rows(rig, "cabinet")
    assert lost == ("link_lost", "the module does not answer")
    assert again[0] == "link_back"
    assert again[1].startswith("the module answers again, 9")
    assert again[1].endswith("output lock, which was high, floats until it is set")
    assert "lock: was set before the module lost its power, and floats until it is set" in back["top"]
    rig.wait(rig.rig.client.ask(SetIo(module="cabinet", high=(LOCK,))))
    rig.wait(asyncio.sleep(2.0))
    assert "floats" not in rig.run("fleet").printed


@pytest.mark.long
def test_watching_a_module_that_does_not_answer_says_so(rig, chain):
    power(rig, chain.modules[CABINET], on=False, then_s=10.0)

    async def later() -> None:
        await asyncio.sleep(8.0)
        chain.modules[CABINET].power(on=True, at_s=asyncio.get_running_loop().time())

    task = rig.wait(_begun(later()))
    watched = rig.run("watch cabinet --count 1")  # the first sample comes with the return
    rig.wait(task)
    assert "cabinet  the module does not answer" in watched.errors


async def _begun(work):
    return asyncio.create_task(work)


@pytest.mark.long
def test_a_line_that_is_lost_and_comes_back_is_in_the_log_with_what_its_axes_were_told(rig):
    rig.wait(rig.rig.client.command("rotor", Power(on=True)))
    rig.wait(rig.rig.client.command("rotor", MoveVelocity(velocity=0.5)))
    rig.wait(asyncio.sleep(2.0))
    drop(rig, then_s=20.0)

    lost, again = rows(rig, "line")
    assert lost[0] == "link_lost"
    assert "a cable that comes loose" in lost[1]
    assert again[0] == "link_back"
    assert [what for what, _ in rows(rig, "cabinet")] == ["link_lost", "link_back"]
    (what, _), (also, why) = rows(rig, "rotor")
    assert (what, also) == ("link_lost", "link_back")
    assert "halt, its policy of loss.bus" in why


@pytest.mark.long
def test_a_link_that_flaps_fills_no_log_and_what_it_ends_with_is_said(rig, chain):
    for _ in range(40):
        power(rig, chain.modules[CABINET], on=False, then_s=1.0)
        power(rig, chain.modules[CABINET], on=True, then_s=4.0)
    flapping = rows(rig, "cabinet")
    power(rig, chain.modules[CABINET], on=True, then_s=70.0)
    assert len(flapping) < 12
    assert [what for what, _ in rows(rig, "cabinet")][-2:] == ["link_lost", "link_back"]


@pytest.mark.long
def test_of_a_loss_that_is_over_every_face_says_what_why_says(rig, chain):
    rig.wait(rig.rig.client.command("rotor", Power(on=True)))
    rig.wait(rig.rig.client.command("rotor", MoveVelocity(velocity=0.5)))
    power(rig, chain.modules[ROTOR], on=False, then_s=10.0)
    power(rig, chain.modules[ROTOR], on=True, then_s=10.0)

    over = "in error stop because of link lost, which is over"
    for command in ("why rotor", "top", "fleet"):
        said = rig.run(command).printed
        assert over in said, command
        assert "check its power" not in said.partition("past fault")[0], command


@pytest.mark.long
def test_all_that_does_not_work_is_counted_and_what_has_one_cause_once(rig, chain):
    for module in chain.modules:
        power(rig, module, on=False, then_s=0.0)
    rig.wait(asyncio.sleep(20.0))
    assert "not working: 2 axes, 1 module" in rig.run("top").printed
    for module in chain.modules:
        power(rig, module, on=True, then_s=0.0)
    rig.wait(asyncio.sleep(20.0))
    assert "not working" not in rig.run("top").printed
    chain.unplug(rig.wait(now_s()))
    rig.wait(asyncio.sleep(5.0))
    assert "not working: 2 axes, 1 module, 1 line (1 cause)" in rig.run("top").printed


async def test_the_return_of_a_smartstep_unit_is_an_event():
    async with trace_rig() as under_test:
        loop, feed, rig = asyncio.get_running_loop(), under_test.units[0], under_test.rig
        await rig.until("feed", lambda state: state.link is LinkState.UP)
        feed.power_off(loop.time())
        await rig.until("feed", lambda state: state.link is LinkState.DOWN)
        feed.power_on(loop.time())
        await rig.until("feed", lambda state: state.link is LinkState.UP)
        await asyncio.sleep(3.0)
        page = await rig.client.ask(ReadEvents(axis="feed"))

    (back,) = [event.reason for event in page.events if event.verb == LINK_BACK]
    assert back is not None
    assert back.startswith("the drive answers again")
    assert "loss.bus" not in back  # it takes no stop over its line
