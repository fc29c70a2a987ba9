"""Registers that cannot be read back, and the pins that can be outputs; on the jumping clock."""

import asyncio

import pytest

from ldcnd.drivers.ldcn.controls import LimitPins
from ldcnd.errors import (
    ValueOutOfRange,
    WrongState,
)
from ldcnd.model.commands import MoveAbsolute, SetGains, SetOutputs
from ldcnd.model.meta import Provenance
from tests.support.dialect_rig import (
    AXIS,
    GAINS,
    LS_182AP,
    V4,
    dialect_rig,
)


async def test_limit_pins_become_outputs_one_by_one_and_inputs_again():
    async with dialect_rig(V4) as rig:
        await rig.until(lambda state: state.link == "up")

        await rig.send(SetOutputs(limit1="high"))
        assert rig.drive._pins == LimitPins.LIMIT1_HIGH | LimitPins.LIMIT2_INPUT

        await rig.send(SetOutputs(limit2="low"))
        assert rig.drive._pins == LimitPins.LIMIT1_HIGH

        await rig.send(SetOutputs(limit1="input", limit2="input"))
        assert rig.drive._pins == LimitPins.LIMIT1_INPUT | LimitPins.LIMIT2_INPUT


async def test_a_new_servo_rate_divisor_keeps_velocities_what_they_are():
    async with dialect_rig(LS_182AP) as rig:
        await rig.power_on()

        await rig.send(SetGains(sr=2))
        loop = asyncio.get_running_loop()
        began_s = loop.time()
        reply = await rig.send(MoveAbsolute(position=10.0, velocity=10.0))
        await rig.rig.client.wait_for_end(AXIS, reply.command_id)

        assert rig.drive.loop.gains.sr == 2
        assert reply.duration_s - 0.1 < loop.time() - began_s < reply.duration_s + 0.3  # it settles afterwards
        await asyncio.sleep(1.0)
        assert rig.position_mm == pytest.approx(10.0, abs=0.02)


async def test_the_servo_rate_divisor_is_not_changed_in_motion():
    async with dialect_rig(LS_182AP) as rig:
        await rig.power_on()
        await rig.send(MoveAbsolute(position=15.0, velocity=2.0))

        with pytest.raises(WrongState):
            await rig.send(SetGains(sr=2))
        await rig.send(SetGains(ki=300))

        assert (rig.drive.loop.gains.sr, rig.drive.loop.gains.ki) == (1, 300)


async def test_a_drive_without_current_limit_refuses_one():
    async with dialect_rig(LS_182AP) as rig:
        await rig.power_on()

        with pytest.raises(ValueOutOfRange, match="reserved on this drive"):
            await rig.send(SetGains(cl=101))


async def test_gains_that_were_changed_survive_switching_off_and_on():
    async with dialect_rig(V4) as rig:
        await rig.until(lambda state: state.link == "up")
        await rig.send(SetGains(kp=200, deadband=4, cl=131))

        await rig.power_on()

        gains = rig.drive.loop.gains
        assert (gains.kp, gains.deadband, gains.cl, gains.kd) == (200, 4, 131, GAINS["kd"])


async def test_registers_say_where_their_values_come_from():
    async with dialect_rig(V4) as rig:
        await rig.until(lambda state: state.link == "up")
        (before,) = await rig.rig.client.axes()
        await rig.power_on()
        await rig.done(MoveAbsolute(position=1.0))
        (moved,) = await rig.rig.client.axes()
        await rig.done(MoveAbsolute(position=0.0))
        await rig.rig.client.stop(AXIS)
        (stopped,) = await rig.rig.client.axes()

    fresh = {register.name: register for register in before.registers}
    after = {register.name: register for register in moved.registers}
    last = {register.name: register for register in stopped.registers}
    assert (fresh["kp"].value, fresh["sr"].value, fresh["kp"].provenance) == (0, 1, Provenance.RESET)
    assert (after["kp"].value, after["kp"].provenance) == (GAINS["kp"], Provenance.WRITTEN_AND_ACKNOWLEDGED)
    assert (after["position"].value, after["position"].provenance) == (1000, Provenance.WRITTEN_AND_ACKNOWLEDGED)
    assert (after["limit1_pin"].value, after["limit2_pin"].value) == (0x04, 0x08)
    assert (last["velocity"].value, last["velocity"].provenance) == (None, Provenance.UNKNOWN)
