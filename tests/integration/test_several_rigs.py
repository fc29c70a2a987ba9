"""What takes energy out asks no question where several rigs can be reached, on the jumping clock."""

import json
import subprocess
import sys

import pytest

from ldcnd.config.rig import load_config
from ldcnd.contract.commands import MoveAbsolute, Power
from ldcnd.contract.samples import LinkState
from ldcnd.sim.faults import FaultInjector, FaultKind, FaultPlan, LineFault
from ldcnd.testing.memory_session import MemorySession
from tests.integration.test_kept_references import chain_of
from tests.support.command_line import virtual_rig
from tests.support.process import free_port
from tests.support.rig import SIMULATED, first_axes, running_rig


@pytest.fixture
def two_rigs(monkeypatch):
    """Two rigs on one network, on both of which x moves; yields what runs commands, and both clients."""
    config = load_config(SIMULATED)
    with virtual_rig(monkeypatch) as first:
        second = running_rig(config.model_copy(update={"rig": "mill"}), broker=first.rig.broker)
        mill = first.wait(second.__aenter__())
        for rig in (first.rig, mill):
            first.wait(moving(rig))
        yield first, mill
        first.wait(second.__aexit__(None, None, None))


async def moving(rig):
    await rig.until("x", lambda state: state.link is LinkState.UP)
    await rig.client.command("x", Power(on=True))
    await rig.client.command("x", MoveAbsolute(position=40.0, velocity=1.0))


def said(ran):
    """Return what a command printed, without the logs of the daemons in the same process."""
    return [line for line in ran.printed.splitlines() if not line.startswith("20")]


def states(here, mill):
    return [here.wait(rig.client.state("x")) for rig in (here.rig, mill)]


@pytest.mark.parametrize("line", ["stop", "stop x", "axis stop x"])
@pytest.mark.sweep(2)
def test_a_stop_without_a_rig_stops_every_rig_and_says_which_axes_confirmed(two_rigs, line):
    here, mill = two_rigs

    ran = here.run(line)

    axes = "x" if "x" in line.split() else "x, y, z, c"
    assert said(ran) == [f"mill: stop latched, confirmed by {axes}", f"sim: stop latched, confirmed by {axes}"]
    assert (ran.code, ran.errors) == (0, "")
    assert [state.stop_latched for state in states(here, mill)] == [True, True]


def test_the_rigs_of_a_stop_are_named_in_json(two_rigs):
    here, _ = two_rigs

    ran = here.run("stop --json")

    assert [json.loads(line)["rig"] for line in said(ran)] == ["mill", "sim"]


def test_a_rig_that_is_named_is_stopped_alone(two_rigs):
    here, mill = two_rigs

    ran = here.run("stop --rig mill")

    assert (ran.code, said(ran)) == (0, ["mill: stop latched, confirmed by x, y, z, c"])
    assert [state.stop_latched for state in states(here, mill)] == [False, True]


def test_a_rig_without_the_axis_is_no_failure_and_an_axis_that_no_rig_has_is_one(two_rigs):
    here, _ = two_rigs

    ran = here.run("stop nowhere")

    assert ran.code == 1
    assert ran.errors.count("[unknown_axis]") == 2


@pytest.mark.parametrize(("line", "enabled"), [("halt x", True), ("axis halt x", True), ("power off x", False)])
@pytest.mark.sweep(2)
def test_halt_and_power_off_ask_for_no_rig_either(two_rigs, line, enabled):
    here, mill = two_rigs

    ran = here.run(line)

    assert (ran.code, ran.errors) == (0, "")
    assert [line.partition(":")[0] for line in said(ran)] == ["mill", "sim"]
    now = states(here, mill)
    assert [state.enabled for state in now] == [enabled, enabled]
    assert all(state.command is None or state.command.verb != "move_absolute" for state in now)


def test_a_speed_override_of_0_halts_every_rig_and_another_one_needs_the_name_of_its_rig(two_rigs):
    here, mill = two_rigs

    refused, ran = here.run("speed 50"), here.run("speed 0")

    assert (refused.code, "several rigs answer" in refused.errors) == (1, True)
    assert (ran.code, ran.errors) == (0, "")
    assert said(ran) == [f"{rig}: {text}" for rig in ("mill", "sim") for text in ("speed override 0 %", "x: halted")]
    assert [state.speed_override for state in states(here, mill)] == [0.0, 0.0]
    assert [json.loads(line)["rig"] for line in said(here.run("speed 0 --json"))] == ["mill", "sim"]


def test_a_speed_override_of_0_that_a_drive_has_not_confirmed_says_so(monkeypatch):
    chain = chain_of()
    with virtual_rig(monkeypatch, chains={"line0": chain}) as here:
        here.wait(moving(here.rig))
        chain.injector = FaultInjector(FaultPlan((LineFault(FaultKind.REQUEST_LOST),)))

        ran = here.run("speed 0")

    assert ran.code == 1
    assert "x: halted" not in ran.printed
    assert "NOT confirmed by x: it may move on. Use the machine's emergency stop." in ran.errors


@pytest.mark.parametrize(("line", "enabled"), [("halt x", True), ("power off x", False)])
def test_what_takes_energy_out_waits_for_no_daemon_to_say_what_its_axes_are(two_rigs, monkeypatch, line, enabled):
    here, mill = two_rigs
    query = MemorySession.query

    async def unanswered(session, key, *given, **named):
        return [] if "/meta/axes/" in key else await query(session, key, *given, **named)

    monkeypatch.setattr(MemorySession, "query", unanswered)

    ran, of_all = here.run(line), here.run("power off")

    assert (ran.code, ran.errors) == (0, "")
    now = states(here, mill)
    assert [state.enabled for state in now] == [enabled, enabled]
    assert all(state.command is None or state.command.verb != "move_absolute" for state in now)
    assert of_all.code == 3
    assert of_all.errors.count("nothing was sent") == 2


def test_a_name_that_is_wrong_keeps_no_other_axis_from_being_switched_off(two_rigs):
    here, mill = two_rigs

    ran = here.run("power off nowhere x")

    assert ran.code == 1
    assert ran.errors.count("[unknown_axis]") == 2
    assert "'nowhere'" in ran.errors
    assert [state.enabled for state in states(here, mill)] == [False, False]


def test_an_axis_that_one_rig_only_has_keeps_no_other_axis_from_being_switched_off(monkeypatch):
    with virtual_rig(monkeypatch) as here:
        second = running_rig(first_axes(1).model_copy(update={"rig": "mill"}), broker=here.rig.broker)
        mill = here.wait(second.__aenter__())
        for rig in (here.rig, mill):
            here.wait(moving(rig))
        here.wait(here.rig.client.command("y", Power(on=True)))

        ran = here.run("power off y x")
        now = [*states(here, mill), here.wait(here.rig.client.state("y"))]
        here.wait(second.__aexit__(None, None, None))

    assert (ran.code, ran.errors) == (0, "")
    assert sorted(said(ran)) == ["mill: x: power done", "sim: x: power done", "sim: y: power done"]
    assert [state.enabled for state in now] == [False, False, False]


def test_what_puts_energy_in_still_needs_the_name_of_its_rig(two_rigs):
    here, _ = two_rigs

    ran = here.run("power on x")

    assert ran.code == 1
    assert "several rigs answer" in ran.errors


def test_what_a_remedy_names_is_typed_with_the_options_that_led_to_its_rig(two_rigs):
    here, mill = two_rigs
    here.wait(mill.client.stop("x"))
    here.wait(mill.until("x", lambda state: state.moving == "no"))

    asked, refused = here.run("why x --rig mill"), here.run("move x 1 --rig mill")

    assert "ldcnd reset x --rig mill" in asked.printed
    assert "ldcnd reset x --rig mill" in refused.errors
    assert here.run("reset x --rig mill").code == 0
    assert [state.stop_latched for state in states(here, mill)] == [False, False]
    assert here.wait(here.rig.client.state("x")).moving == "yes"


@pytest.mark.real_time
@pytest.mark.long
def test_a_stop_that_reaches_no_daemon_says_that_nothing_was_stopped():
    ran = subprocess.run(  # noqa: S603
        (sys.executable, "-m", "ldcnd", "stop", "-e", f"tcp/127.0.0.1:{free_port()}"),
        capture_output=True, text=True, timeout=30, check=False,
    )  # fmt: skip

    assert ran.returncode == 3
    assert ran.stderr.startswith("NOT stopped, use the emergency stop: ")


def test_what_is_accepted_and_done_names_its_rig_where_another_could_be_meant(two_rigs):
    here, mill = two_rigs
    for line in ("halt x --rig mill", "power on y --rig mill"):
        assert here.run(line).code == 0
    here.wait(mill.until("x", lambda state: state.moving == "no"))

    moved = said(here.run("move y 1 --wait --rig mill"))
    powered = said(here.run("power off --rig mill"))

    assert [line.startswith("mill: y: ") for line in moved] == [True, True]
    assert [line.split(": ")[0] for line in powered] == ["mill"] * 4


def test_a_rig_that_is_the_only_one_is_not_named(monkeypatch):
    with virtual_rig(monkeypatch) as here:
        here.wait(here.rig.until("x", lambda state: state.link is LinkState.UP))

        powered, moved = said(here.run("power on x")), said(here.run("move x 1 --wait"))

    assert powered == ["x: power done"]
    assert [line.split(": ")[0] for line in moved] == ["x", "x"]
