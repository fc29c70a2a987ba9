"""What the configuration of a simulated line lets happen reaches the daemon's clients."""

import asyncio

import pytest

from ldcnd.config.rig import RigConfig, load_config
from ldcnd.contract.commands import Power
from ldcnd.contract.samples import AxisState
from tests.support.rig import SIMULATED, running_rig

HAPPENS_AT_S = 20.0


def with_event(**event) -> RigConfig:
    document = load_config(SIMULATED).model_dump(mode="json", exclude_unset=True)
    document["sim"][0]["event"] = [{"at_s": HAPPENS_AT_S, **event}]
    return RigConfig.model_validate(document)


@pytest.mark.long
async def test_an_overvoltage_at_its_time_is_a_fault_of_its_axis_only():
    async with running_rig(with_event(module=2, begins="overvoltage")) as rig:
        loop = asyncio.get_running_loop()
        for axis in ("x", "y"):
            await rig.until(axis, lambda state: state.link == "up")
            await rig.client.command(axis, Power(on=True))
        assert loop.time() < HAPPENS_AT_S

        await rig.until("y", lambda state: state.state is AxisState.ERROR_STOP)

        assert HAPPENS_AT_S < loop.time() < HAPPENS_AT_S + 1.0
        assert (await rig.client.state("x")).state is AxisState.STANDSTILL


@pytest.mark.long
async def test_a_module_without_supply_loses_its_link():
    async with running_rig(with_event(module=4, power="off")) as rig:
        await rig.until("c", lambda state: state.link == "up")

        await rig.until("c", lambda state: state.link != "up")

        assert HAPPENS_AT_S < asyncio.get_running_loop().time() < HAPPENS_AT_S + 5.0
        assert (await rig.client.state("x")).link == "up"
