"""A lease in the environment is honoured by every command that sends, and by programs, on the jumping clock."""

import asyncio
from pathlib import Path

import pytest

from ldcnd.client.events import latest_events
from ldcnd.client.rig import Rig, UnfinishedMotion
from ldcnd.config.rig import RigConfig, load_config
from ldcnd.contract.catalogue import BY_VERB
from ldcnd.contract.commands import About, AxisCommand, Effect
from ldcnd.contract.leases import Acquire, Release, Renew
from ldcnd.contract.samples import LinkState
from tests.support.command_line import VirtualRig, virtual_rig
from tests.support.rig import SIMULATED

SENT = (
    "power on x",
    "move x 1 --wait",
    "move x 1 --relative --wait",
    "jog x 2 --for 0.3",
    "axis set-position x 0",
    "home x --wait",
    "axis probe z --source forward_limit --distance 1 --velocity 4 --wait",
    "halt x",
    "axis outputs z --limit1 input",
    "axis gains x --kp 100 --kd 1000 --ki 0 --el 4000",
    "axis pwm z 0.1 1",
    "axis track z 0",
    "power off z",
    "reset y",
    "trace take x --channel position --samples 5",
    "trace abort x",
    "speed 50",
    "speed 100",
    "params set feed Pn102 61",
    "params set feed Pn102 62 --eeprom",
    "params save feed --yes",
    "params dump feed {dump}",
    "params set feed Pn102 41 --eeprom",
    "params restore feed {dump} --yes",
    "params restart-count feed --yes",
    "axis clear-counter spool feedback",
    "trace take feed --channel speed_feedback --samples 20",
    "bus set-io cabinet 4=high",
    "bus set-io-timer cabinet timer",
)
NOT_TYPED = {
    "move_velocity",  # `jog` holds it
    "move_analog",  # no axis here has a sensor for it
}
"""What needs control and has no line above."""
ALL = ("x", "y", "z", "c", "feed", "spool")


def both_families(state_dir: Path) -> RigConfig:
    rig, mixed = load_config(SIMULATED), load_config(SIMULATED.with_name("mixed.toml"))
    line = rig.bus[0].model_dump(mode="json", exclude_unset=True)
    line["module"] = [{"name": "cabinet", "address": 5, "model": "pic-io", "outputs": [4]}]
    sim = rig.sim[0].model_dump(mode="json", exclude_unset=True)
    sim["module"].append({"model": "pic-io"})
    whole = rig.model_dump(mode="json", exclude_unset=True)
    steps = mixed.model_dump(mode="json", exclude_unset=True)
    whole |= {"authority": "leased", "state_dir": str(state_dir)}
    whole |= {"bus": [line, steps["bus"][1]], "sim": [sim, steps["sim"][1]]}
    return RigConfig.model_validate(whole)


@pytest.fixture
def rig(monkeypatch, tmp_path):
    with virtual_rig(monkeypatch, both_families(tmp_path)) as here:
        for axis in ALL:
            here.wait(here.rig.until(axis, lambda state: state.link is LinkState.UP))
        yield here


def held(here: VirtualRig, *axes: str) -> str:
    """Take control, as `ldcnd lease hold` does, and return the lease."""
    return here.wait(here.rig.client.ask(Acquire(client="ann", axes=axes, lease_s=60.0))).lease


@pytest.mark.long
def test_every_command_inside_lease_hold_is_sent_under_its_lease(rig, monkeypatch, tmp_path):
    lease = held(rig, *ALL)
    monkeypatch.setenv("LDCND_LEASE", lease)
    failed = []
    for line in SENT:
        rig.wait(rig.rig.client.ask(Renew(lease=lease)))  # all of them take longer than a lease lasts
        held_line = rig.run(line.format(dump=tmp_path / "feed.toml"))
        if held_line.code and not line.startswith(("axis probe", "axis pwm", "axis track", "trace abort")):  # may fail
            failed.append((line, held_line.printed, held_line.errors))
        assert "lease" not in held_line.errors, (line, held_line.errors)
    assert not failed, "\n".join(map(repr, failed))

    events = rig.wait(latest_events(rig.rig.client, 500))
    under_it = {event.verb for event in events if event.client == "ann"}
    wanted = {
        str(verb)
        for verb, command in BY_VERB[About.AXIS].items()
        if issubclass(command, AxisCommand) and command.needs_lease() and command.effect is not Effect.QUESTION
    }
    assert wanted - under_it == NOT_TYPED


def test_outside_of_it_what_needs_control_is_refused(rig, tmp_path):
    held(rig, *ALL)
    (tmp_path / "feed.toml").write_text("type = 1\n[parameters]\nPn102 = 41\n")
    for line in SENT:
        if line.startswith(("jog", "move", "reset", "params set")):
            refused = rig.run(line)
            assert "lease_held" in refused.errors, line


def test_a_program_inside_lease_hold_uses_its_control_and_leaves_it_to_its_holder(rig, monkeypatch):
    client = rig.rig.client
    client.lease = held(rig, "x")
    monkeypatch.setenv("LDCND_LEASE", client.lease)

    async def program() -> None:
        robot = Rig(client, await client.daemon())
        for _ in range(2):  # the second one is not taken for one that comes late
            async with robot.control("x", client="program") as x:
                await x.power(on=True)
                await (await x.move_relative(1.0)).done()
        with pytest.warns(UnfinishedMotion, match="x: move_velocity"):
            async with robot.control("x", client="program") as x:
                await x.move_velocity(5.0)
        await asyncio.sleep(1.0)
        assert (await client.state("x")).command is None  # what was not waited for was halted at the end
        async with robot.control("y", client="program") as y:
            assert y.control.lease.client == "program"  # what is not held for it, it takes itself
        await client.ask(Release(lease=client.lease))

    rig.wait(program())


def test_a_drill_is_held_under_what_is_inherited_unless_it_needs_its_client_to_die(rig, monkeypatch):
    monkeypatch.setenv("LDCND_LEASE", held(rig, *ALL))
    stopped = rig.run("drill daemon-stop x --velocity 5 --yes")
    lost = rig.run("drill client-loss x --velocity 5 --yes")

    assert (stopped.code, "stands" in stopped.printed) == (0, True)
    assert (lost.code, "run it outside" in lost.errors) == (1, True)
