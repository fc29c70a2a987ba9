"""An axis that a stop holds goes on holding while one daemon dies and the next takes its line over."""

import asyncio
import contextlib
from pathlib import Path

import pytest

from ldcnd.config.rig import RigConfig
from ldcnd.contract.commands import Power
from ldcnd.contract.errors import LdcndError
from ldcnd.contract.samples import LinkState
from ldcnd.sim.ldcn.chain import ChainSpec, ModuleSpec, build_chain
from tests.support.chain_rig import drive, rig_on

MODELS = {"x": "ls-182ap", "y": "pic-servo-v4", "z": "pic-servo-sc"}
GAINS = {"kp": 100, "kd": 3000, "ki": 50, "il": 100, "ol": 250, "el": 4000}


def adopting(state_dir: Path, baud: int) -> RigConfig:
    axes = [
        {"name": name, "model": model, "address": place, "velocity": 20_000, "acceleration": 100_000, "gains": GAINS}
        for place, (name, model) in enumerate(MODELS.items(), 1)
    ]
    bus = {"name": "line", "port": "sim:line", "baud": baud, "margin_ms": 5, "start": "adopt", "axis": axes}
    sim = {"name": "line", "module": [{"model": model} for model in MODELS.values()]}
    return RigConfig.model_validate(
        {"rig": "sim", "state_dir": str(state_dir), "bus": [bus | {"adopt_fallback": "reset"}], "sim": [sim]}
    )


@pytest.mark.parametrize("baud", [19_200, 115_200])
async def test_a_latched_axis_that_holds_a_load_is_not_let_go_of_by_the_next_daemon(tmp_path, baud):
    """Its stop is sent again before the line is taken over: what a drive holds is not known."""
    chain = build_chain(ChainSpec(tuple(ModuleSpec(name) for name in ("ls182ap", "picservo-v4", "picservo-sc"))))
    config = adopting(tmp_path, baud)
    async with rig_on(chain, config) as rig:
        for axis in MODELS:
            await rig.until(axis, lambda state: state.link is LinkState.UP)
            await rig.client.command(axis, Power(on=True))
        await rig.client.stop()
        await asyncio.sleep(1.0)
        await rig.kill()
    loops = [drive(chain, place).loop for place in (1, 2, 3)]
    assert all(loop.servo_on for loop in loops)

    async with rig_on(chain, config) as rig:
        for axis in MODELS:
            state = await rig.until(axis, lambda state: state.link is LinkState.UP)
            assert state.stop_latched
        await asyncio.sleep(2.0)
        assert [drive(chain, place).loop.servo_on for place in (1, 2, 3)] == [True, True, True]


async def test_a_stop_in_place_of_a_reset_that_a_drive_does_not_hear_lets_go_of_no_load(tmp_path):
    """A PIC-SERVO in the group of another host obeys no other reset, and holds on at its address."""
    chain = build_chain(ChainSpec((ModuleSpec("picservo-v4"),)))
    document = adopting(tmp_path, 19_200).model_dump(mode="json", exclude_unset=True)
    (bus,) = document["bus"]
    bus |= {"start": "reset", "axis": [bus["axis"][1] | {"address": 1}]}
    bus.pop("adopt_fallback")
    document["sim"][0]["module"] = document["sim"][0]["module"][:1]
    config = RigConfig.model_validate(document)
    async with rig_on(chain, config) as rig:
        await rig.power_on("y")
        await rig.kill()
    chain.modules[0].group = 0x90

    async with rig_on(chain, config, up=False) as rig:
        while "found" not in rig.line.problem:
            await asyncio.sleep(0.01)
        with contextlib.suppress(LdcndError):
            await rig.client.stop("y")
        await asyncio.sleep(0.3)
        state = await rig.client.state("y")

        assert (drive(chain, 1).loop.servo_on, state.stop_pending) == (True, False)
