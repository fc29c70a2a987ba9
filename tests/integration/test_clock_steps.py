"""The machine's clock is set: leases and motions go by one that nobody sets, ages by that of the run of the daemon."""

import asyncio
from dataclasses import dataclass

import pytest

from ldcnd.client.lease import control
from ldcnd.config.rig import load_config
from ldcnd.contract.commands import MoveAbsolute, MoveVelocity, Power
from ldcnd.contract.errors import LeaseExpired
from ldcnd.contract.leases import Acquire
from ldcnd.contract.samples import AxisState
from tests.integration.test_shown_before_read import console_of
from tests.integration.test_top_view import followed
from tests.support.rig import SIMULATED, running_rig, two_axes

HOUR_S = 3600.0
STEPS = [HOUR_S, -HOUR_S]


@dataclass
class Clock:
    """How wrong the machine's clock is."""

    off_s: float = 0.0


def leased():
    return load_config(SIMULATED).model_copy(update={"authority": "leased"})


@pytest.mark.parametrize("step_s", STEPS)
@pytest.mark.sweep(2)
async def test_a_lease_that_is_renewed_outlives_a_step_of_the_clock(step_s: float):
    clock = Clock()
    async with running_rig(leased(), clock_off_s=lambda: clock.off_s) as rig:
        await rig.until("x", lambda state: state.link == "up")
        async with control(rig.client, "ann", "x", lease_s=0.5) as held:
            await held.command("x", Power(on=True))
            clock.off_s = step_s
            await asyncio.sleep(3.0)

            reply = await held.command("x", MoveAbsolute(position=5.0))
            state = await rig.client.wait_for_end("x", reply.command_id)

    assert (state.state, state.last_error) == (AxisState.STANDSTILL, None)


@pytest.mark.parametrize("step_s", STEPS)
async def test_a_lease_that_is_not_renewed_ends_in_its_time_whatever_the_clock_says(step_s: float):
    clock = Clock()
    loop = asyncio.get_running_loop()
    async with running_rig(leased(), clock_off_s=lambda: clock.off_s) as rig:
        await rig.until("x", lambda state: state.link == "up")
        lease = (await rig.client.ask(Acquire(client="ann", axes=("x",), lease_s=1.0))).lease
        acquired_s = loop.time()
        await rig.client.command("x", Power(on=True, lease=lease))
        await rig.client.command("x", MoveVelocity(velocity=5.0, lease=lease))
        clock.off_s = step_s
        await rig.until("x", lambda state: state.state is not AxisState.CONTINUOUS_MOTION)
        braked_s = loop.time() - acquired_s
        with pytest.raises(LeaseExpired):
            await rig.client.command("x", MoveVelocity(velocity=5.0, lease=lease))

    assert 0.9 < braked_s < 1.2


@pytest.mark.parametrize("step_s", STEPS)
async def test_a_step_of_the_clock_ends_no_motion_and_loses_no_axis(step_s: float):
    clock = Clock()
    async with running_rig(clock_off_s=lambda: clock.off_s) as rig:
        await rig.until("x", lambda state: state.link == "up")
        await rig.client.command("x", Power(on=True))
        reply = await rig.client.command("x", MoveAbsolute(position=20.0))
        await asyncio.sleep(0.3)
        clock.off_s = step_s

        state = await rig.client.wait_for_end("x", reply.command_id)

    assert (state.state, state.last_error, state.link) == (AxisState.STANDSTILL, None, "up")


@pytest.mark.parametrize("step_s", STEPS)
async def test_who_looks_on_believes_a_daemon_that_comes_back_with_another_clock(step_s: float):
    clock = Clock()
    async with running_rig(two_axes(), clock_off_s=lambda: clock.off_s) as rig, console_of(rig) as pages:
        async with followed(rig) as glance:
            await rig.until("x", lambda state: state.link == "up")
            await asyncio.sleep(3.0)
            before = pages["x"]["live"]
            clock.off_s = step_s
            await rig.begin_anew(5.0, killed=True)
            await asyncio.sleep(3.0)
            (x,) = [row for row in glance().axes if row.axis == "x"]

    assert (before, pages["x"]["live"], pages["x"]["mark"]) == (True, True, "not homed")
    assert x.shown_position.endswith(" mm not homed")
    assert x.age_s < 1.0
