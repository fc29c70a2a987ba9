"""`ldcnd bus snapshot`, `bus set-io`, `bus set-io-timer` and `axis probe`, typed in front of a daemon."""

import json

import pytest

from ldcnd.config.rig import RigConfig
from ldcnd.contract.samples import LatchSample, LinkState, TelemetryItem
from ldcnd.sim.ldcn.chain import ChainSpec, ModuleSpec, build_chain
from ldcnd.sim.ldcn.io import IoWiring
from ldcnd.sim.plant import MotorPlant
from tests.support.command_line import Ran, VirtualRig, virtual_rig
from tests.support.dialect_rig import GAINS

AXIS = {
    "name": "x",
    "address": 1,
    "model": "pic-servo-v4",
    "unit": "mm",
    "counts_per_unit": 1000,
    "velocity": 10,
    "acceleration": 100,
    "reference": "at_reset",
    "gains": GAINS,
}
CABINET = {"name": "cabinet", "address": 2, "model": "pic-io", "outputs": [4, 9], "rate": 20}
LINE = {"name": "line0", "port": "sim:line", "baud": 115_200, "snapshot": True, "axis": [AXIS], "module": [CABINET]}
CONFIG = RigConfig.model_validate(
    {
        "rig": "bench",
        "sim": [{"name": "line", "module": [{"model": "pic-servo-v4"}, {"model": "pic-io"}]}],
        "bus": [LINE],
    }
)


@pytest.fixture
def bench(monkeypatch):
    """A servo whose forward switch is at 5 mm, and a PIC-I/O whose line 1 is low."""
    plant = MotorPlant(reverse_limit_counts=-20_000, forward_limit_counts=5_000, index_spacing_counts=100_000)
    servo = ModuleSpec("pic-servo-v4", plant)
    chain = build_chain(ChainSpec((servo, ModuleSpec("pic-io", wiring=IoWiring(low=(1,))))))
    with virtual_rig(monkeypatch, CONFIG, {"line": chain}) as rig:
        rig.wait(rig.rig.until("x", lambda state: state.link is LinkState.UP))
        yield rig


def last_line(ran: Ran) -> str:
    """Return what was printed last: the daemon logs in the same process."""
    return ran.printed.splitlines()[-1]


def test_a_probe_latches_and_its_position_can_be_read(bench: VirtualRig):
    assert bench.run("power on x").code == 0

    probed = bench.run("axis probe x --source forward_limit --distance 9 --velocity 4 --wait")
    latch = bench.wait(bench.rig.client.last("x", TelemetryItem.LATCH))
    nothing = bench.run("axis probe x --source reverse_limit --distance -1 --velocity 4 --wait")

    assert probed.code == 0, probed.errors
    assert "5.00" in last_line(probed)
    assert isinstance(latch, LatchSample)
    assert 0.0 <= latch.value - 5.0 <= latch.error
    assert nothing.code != 0
    assert "no input came on the way" in nothing.printed + nothing.errors


def test_a_snapshot_shows_positions_inputs_and_the_instant(bench: VirtualRig):
    assert bench.run("bus set-io-timer cabinet timer --prescale 8").code == 0
    first = bench.run("bus snapshot line0")
    reply = json.loads(last_line(bench.run("bus snapshot line0 --json")))
    unknown = bench.run("bus snapshot nowhere")

    assert first.code == 0
    assert "\nx " in f"\n{first.printed}"
    assert "cabinet  1=low 2=high" in first.printed
    assert "all within" in first.printed
    assert (reply["positions"][0]["axis"], reply["io"][0]["proven"]) == ("x", True)
    assert (unknown.code, "line0" in unknown.errors) == (1, True)


def test_outputs_are_set_by_line_and_level(bench: VirtualRig):
    done = bench.run("bus set-io cabinet 4=high 9=low --pwm1 0.5")
    back = json.loads(last_line(bench.run("bus set-io cabinet 4=input --json")))
    forbidden = bench.run("bus set-io cabinet 5=high")
    misspelt = bench.run("bus set-io cabinet 4=on")

    assert done.code == 0
    assert last_line(done).startswith("cabinet: 1=low 2=high 3=high 4=high")
    assert last_line(done).endswith("outputs: 4, 9")
    assert back["outputs"] == [9]
    assert (forbidden.code, "not configured as an output" in forbidden.errors) == (1, True)
    assert misspelt.code == 2
    assert "LINE=high" in misspelt.errors


def test_a_module_can_be_watched_as_an_axis_can(bench: VirtualRig):
    watched = bench.run("watch cabinet --count 1")
    other = bench.run("watch closet --count 1")

    assert watched.code == 0, watched.errors
    assert "cabinet" in last_line(watched)
    assert "lines 1 to 12 0111" in last_line(watched)
    assert other.code != 0
    assert "closet" in other.errors
