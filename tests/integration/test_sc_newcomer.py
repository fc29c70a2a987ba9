"""A PIC-SERVO SC that restarts in a running line: whatever its EEPROM holds, it energises nothing and hurts nobody."""

import asyncio

import pytest

from ldcnd.config.rig import RigConfig
from ldcnd.contract.commands import MoveAbsolute, Power
from ldcnd.contract.meta import Provenance
from ldcnd.contract.samples import AxisState, LinkState
from ldcnd.drives.ldcn.controls import StartUp
from ldcnd.drives.ldcn.packet import CommandCode
from ldcnd.sim.ldcn.chain import ChainSpec, ModuleSpec, build_chain
from tests.support.chain_rig import UNSEEN_MOTIONS_END, drive, rig_on
from tests.support.dialect_rig import COUNTS_PER_MM, GAINS

ENERGISED = StartUp.SAVE | StartUp.AMPLIFIER_ON | StartUp.SERVO_ON
EEPROMS = {
    "erased": None,
    "servo on": ENERGISED,
    "address kept": StartUp.SAVE | StartUp.ADDRESSES,
    "address kept, servo on": ENERGISED | StartUp.ADDRESSES,
}


def config(baud: int) -> RigConfig:
    axis = {
        "model": "pic-servo-sc",
        "unit": "mm",
        "counts_per_unit": COUNTS_PER_MM,
        "velocity": 20,
        "acceleration": 200,
        "reference": "at_reset",
        "gains": GAINS,
    } | UNSEEN_MOTIONS_END
    axes = [axis | {"name": name, "address": address} for address, name in enumerate("xyz", 1)]
    bus = {"name": "line", "port": "sim:line", "baud": baud, "margin_ms": 5, "axis": axes}
    sim = {"name": "line", "module": [{"model": "pic-servo-sc"}] * 3}
    return RigConfig.model_validate({"rig": "sim", "sim": [sim], "bus": [bus]})


@pytest.mark.parametrize(
    ("eeprom", "baud"),
    [("erased", 230_400), ("servo on", 115_200), ("address kept", 115_200), ("address kept, servo on", 230_400)],
)
@pytest.mark.sweep(3)
async def test_an_sc_that_restarts_is_reset_before_it_is_addressed_and_the_others_go_on(eeprom, baud):
    chain = build_chain(ChainSpec((ModuleSpec("pic-servo-sc"),) * 3))
    async with rig_on(chain, config(baud)) as rig:
        for name in "xyz":
            await rig.until(name, lambda state: state.link is LinkState.UP)
            await rig.client.command(name, Power(on=True))
        await rig.client.command("x", MoveAbsolute(position=90.0, velocity=8.0))
        await rig.client.command("z", MoveAbsolute(position=-60.0, velocity=5.0))
        newcomer = drive(chain, 2)
        if EEPROMS[eeprom] is not None:
            newcomer.save(EEPROMS[eeprom])
        seen = len(rig.sent)

        newcomer.power(on=False, at_s=asyncio.get_running_loop().time())
        await asyncio.sleep(2)
        newcomer.power(on=True, at_s=asyncio.get_running_loop().time())
        back = await rig.until("y", lambda state: state.link is LinkState.UP and not state.enabled)
        await asyncio.sleep(0.5)
        energised = (newcomer.stage.drives, newcomer.loop.servo_on)
        await asyncio.sleep(14)  # the others arrive
        sent = rig.sent[seen:]

    resets = [packet.address for packet in sent if packet.command is CommandCode.HARD_RESET]
    assert resets
    assert set(resets) <= {0, 2}  # who hears by a group or has another address works on
    assert not back.referenced
    assert energised == (False, False)
    assert [module.address for module in chain.modules] == [1, 2, 3]
    assert [module.baud for module in chain.modules] == pytest.approx([baud] * 3, rel=0.02)
    assert [round(drive(chain, place).loop.position / COUNTS_PER_MM) for place in (1, 2, 3)] == [90, 0, -60]


async def test_an_sc_that_restarts_with_its_address_at_the_rate_of_power_up_is_not_as_it_was_left():
    """It answers as if only its replies had been lost for a while, with its loop closed by what it has saved."""
    chain = build_chain(ChainSpec((ModuleSpec("pic-servo-sc"),) * 3))
    async with rig_on(chain, config(19_200)) as rig:
        await rig.until("y", lambda state: state.link is LinkState.UP)
        await rig.client.command("y", Power(on=True))
        newcomer = drive(chain, 2)
        newcomer.save(ENERGISED | StartUp.ADDRESSES)
        await rig.client.command("y", Power(on=False))

        newcomer.power(on=False, at_s=asyncio.get_running_loop().time())
        await rig.until("y", lambda state: state.link is LinkState.DOWN)
        newcomer.power(on=True, at_s=asyncio.get_running_loop().time())
        back = await rig.until("y", lambda state: state.link is LinkState.UP and state.enabled)
        (axis,) = [each for each in await rig.client.axes() if each.axis == "y"]

    assert back.state is AxisState.ERROR_STOP
    assert {each.provenance for each in axis.registers if each.name in GAINS} == {Provenance.ASSUMED}
