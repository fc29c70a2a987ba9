"""What a refusal tells people to type is typed in the state that refused, and then the command works."""

import asyncio
from dataclasses import dataclass

import pytest

from ldcnd.config.rig import RigConfig, load_config
from ldcnd.contract.leases import Acquire
from ldcnd.contract.samples import LinkState
from ldcnd.contract.traces import TakeTrace
from tests.support.command_line import VirtualRig, virtual_rig
from tests.support.rig import SIMULATED

FILLED = {
    "POSITION": "5",
    "KP": "100",
    "EL": "4000",
    "PERCENT": "100",
    "VALUE": "61",
    "FILE": "{file}",
}
"""What stands for each word that a remedy leaves open."""


@dataclass(frozen=True)
class Case:
    """A refusal, and what it tells people to type.

    Attributes:
        before: commands that lead to its state.
        refused: the command that is refused in it.
        typed: what the remedy names.
        waits_s: time that the remedy says to wait.
        then: what works afterwards; the refused command when empty.
    """

    before: tuple[str, ...]
    refused: str
    typed: str
    waits_s: float = 0.0
    then: str = ""


LONG = "axis move x 60 --velocity 5"
CASES = {
    "disabled": Case((), "axis move x 1 --relative --wait", "axis power x on"),
    "not homed": Case(("axis power n on",), "axis move n 1", "axis home n", waits_s=30.0),
    "not homed, place known": Case(("axis power z on",), "axis move z 6", "axis set-position z POSITION"),
    "moving": Case((LONG,), "axis move x 1 --wait", "axis halt x", waits_s=2.0),
    "moving, unreferenced": Case((LONG,), "axis set-position x 1", "axis halt x", waits_s=2.0),
    "resetting in motion": Case((LONG,), "axis reset x", "axis halt x", waits_s=2.0),
    "latched": Case(("axis stop x",), "axis power x on", "axis reset x"),
    "speed override": Case(("axis power x on", "speed 0"), "axis move x 1 --wait", "speed PERCENT"),
    "without gains": Case((), "axis power g on", "axis gains g --kp KP --el EL"),
    "pin is an output": Case(
        ("axis outputs z --limit2 low",),
        "axis home z --method forward_limit --velocity 5",
        "axis outputs z --limit1 input --limit2 input",
    ),
    "traced": Case(("TRACE x",), "trace take x --channel position --samples 5", "trace abort x"),
    "unlisted parameter": Case((), "params get feed Pn999", "params list feed", then="params get feed Pn100"),
    "budget spent": Case(
        (), "params set feed Pn102 57 --eeprom", "params restart-count feed", then="params set feed Pn102 57 --eeprom"
    ),
}


def rig_config() -> RigConfig:
    """Two families; `n` and `z` are not homed, `g` has no gains, the EEPROM of `feed` was written too often."""
    rig, mixed = load_config(SIMULATED), load_config(SIMULATED.with_name("mixed.toml"))
    x, y, z, c = rig.bus[0].axis
    axes = (
        x,
        y.model_copy(update={"name": "n", "reference": "required"}),
        z.model_copy(update={"reference": "required"}),
        c.model_copy(update={"name": "g", "gains": None}),
    )
    line = rig.bus[0].model_copy(update={"axis": axes})
    return rig.model_copy(update={"bus": (line, mixed.bus[1]), "sim": (*rig.sim, mixed.sim[1])})


@pytest.fixture(scope="module")
def rig(tmp_path_factory):
    kept = tmp_path_factory.mktemp("state")
    (kept / "eeprom-writes.json").write_text('{"feed": {"Pn102": 9000}}')
    with pytest.MonkeyPatch.context() as patch:
        with virtual_rig(patch, rig_config().model_copy(update={"state_dir": kept})) as here:
            for axis in ("x", "n", "z", "g", "feed"):
                here.wait(here.rig.until(axis, lambda state: state.link is LinkState.UP))
            yield here


def type_line(here: VirtualRig, line: str):
    if line.startswith("TRACE"):
        request = TakeTrace(channels=("position",), samples=5000, interval_s=0.1)
        return here.wait(here.rig.client.command(line.split()[1], request))
    for word, filled in FILLED.items():
        line = line.replace(word, filled)
    return here.run(line, typed="y\n")


@pytest.mark.parametrize("case", CASES.values(), ids=CASES)
def test_what_a_refusal_names_is_a_way_out_of_the_state_that_refused(rig, case):
    for line in case.before:
        type_line(rig, line)
    rig.wait(asyncio.sleep(0.5))

    refused = type_line(rig, case.refused)
    assert refused.code != 0
    assert f"ldcnd {case.typed}" in refused.errors
    way_out = type_line(rig, case.typed)
    assert way_out.code == 0, way_out.errors
    rig.wait(asyncio.sleep(case.waits_s))
    now = type_line(rig, case.then or case.refused)
    assert now.code == 0, now.errors


def test_control_that_a_refusal_tells_people_to_take_is_enough(rig, monkeypatch):
    here = rig
    client = here.rig.client
    here.run("axis power x on")
    here.wait(client.ask(Acquire(client="ann", axes=("x",), lease_s=60.0)))
    refused = here.run("axis move x 1 --relative")
    assert "ldcnd lease hold --axis x --force -- COMMAND" in refused.errors
    held = here.wait(client.ask(Acquire(client="ldcnd", axes=("x",), lease_s=60.0, force=True)))
    monkeypatch.setenv("LDCND_LEASE", held.lease)

    assert here.run("axis move x 1 --relative --wait").code == 0
    assert here.run("axis jog x 1 --for 0.2").code == 0
