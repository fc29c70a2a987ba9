"""What happens when the line or the daemon disappears in mid-motion, on the jumping clock."""

import asyncio

import pytest
from structlog.testing import capture_logs

from ldcnd.config.rig import RigConfig, load_config
from ldcnd.contract.commands import MoveAbsolute, MoveVelocity, Power, Reset
from ldcnd.contract.errors import NotReferenced, WrongState
from ldcnd.contract.rig_commands import Rehearsal, Rehearse
from ldcnd.contract.samples import AxisState, LinkState, Moving, PositionSample, Quality, TelemetryItem
from ldcnd.drives.axis_config import LossConfig, LossPolicy
from ldcnd.sim.chain import Chain
from ldcnd.sim.ldcn.chain import ChainSpec, ModuleSpec, build_chain
from tests.support.rig import SIMULATED, RunningRig, running_rig

OUTAGE_S = 1.0


def simulated_chain() -> Chain:
    modules = tuple(ModuleSpec(name) for name in ("ls182ap", "ls182ap", "picservo-v4", "picservo-v4"))
    return build_chain(ChainSpec(modules))


def with_loss(**loss: LossPolicy) -> RigConfig:
    """Return the simulated rig with these policies on axis x."""
    config = load_config(SIMULATED)
    bus = config.bus[0]
    axes = tuple(
        axis.model_copy(update={"loss": LossConfig(**loss)}) if axis.name == "x" else axis for axis in bus.axis
    )
    return config.model_copy(update={"bus": (bus.model_copy(update={"axis": axes}),)})


async def jogging(rig: RunningRig) -> None:
    """Have axis x jog, slowly enough for what follows to happen before the software limit."""
    await rig.power_on("x")
    await rig.client.command("x", MoveVelocity(velocity=10.0))
    await asyncio.sleep(0.5)


async def position_of(rig: RunningRig) -> float:
    async with rig.client.samples("x", TelemetryItem.POSITION) as positions:
        async for _, sample in positions:
            assert isinstance(sample, PositionSample)
            if sample.quality is Quality.GOOD:
                return sample.value
    raise AssertionError("no position was published")


async def pull(rig: RunningRig, chain: Chain) -> None:
    """Pull the adapter, look at the state, and put it back."""
    loop = asyncio.get_running_loop()
    chain.unplug(loop.time())
    state = await rig.until("x", lambda state: state.link is LinkState.DOWN)
    position = await rig.client.last("x", TelemetryItem.POSITION)
    assert (state.state, state.moving, state.quality) == (AxisState.ERROR_STOP, Moving.UNKNOWN, Quality.BAD)
    assert position.quality is Quality.BAD
    await asyncio.sleep(OUTAGE_S)
    chain.replug()
    await rig.until("x", lambda state: state.link is LinkState.UP)


async def test_an_orderly_end_is_no_loss_of_a_drive():
    with capture_logs() as records:
        async with running_rig():
            await asyncio.sleep(2.0)

    assert "ended" in [record["event"] for record in records]
    assert [record for record in records if record["event"] == "drive does not answer"] == []


@pytest.mark.promise("moving-unknown")
@pytest.mark.promise("loss-of-line")
@pytest.mark.parametrize(
    ("policy", "stands"),
    [(LossPolicy.HALT, True), (LossPolicy.QUICK_STOP, True), (LossPolicy.RUN_TO_TARGET, False)],
)
@pytest.mark.sweep(2)
async def test_a_drive_that_still_moves_when_the_line_is_back_does_what_its_policy_says(policy, stands):
    chain = simulated_chain()
    async with running_rig(with_loss(bus=policy), {"line0": chain}) as rig:
        await jogging(rig)

        await pull(rig, chain)
        await asyncio.sleep(2.0)
        before = await position_of(rig)
        await asyncio.sleep(1.0)

        assert (await position_of(rig) == pytest.approx(before, abs=0.002)) is stands
        assert before > 10.0  # it moved on while nobody could reach it


@pytest.mark.promise("start-moves-nothing")
async def test_after_a_lost_line_nothing_resumes_and_nothing_is_believed():
    chain = simulated_chain()
    async with running_rig(chains={"line0": chain}) as rig:
        await jogging(rig)

        await pull(rig, chain)
        await asyncio.sleep(2.0)
        state = await rig.client.state("x")

        assert (state.state, state.referenced, state.enabled) == (AxisState.ERROR_STOP, False, True)
        assert state.last_error.startswith("move_velocity: the drive did not answer")
        with pytest.raises(WrongState, match="error stop"):
            await rig.client.command("x", MoveAbsolute(position=0.0))
        await rig.client.command("x", Reset())
        await rig.client.command("x", Power(on=True))
        with pytest.raises(NotReferenced):
            await rig.client.command("x", MoveAbsolute(position=0.0))


@pytest.mark.promise("loss-of-line")
@pytest.mark.parametrize(
    ("policy", "moves_on"), [(LossPolicy.HALT, False), (LossPolicy.POWER_OFF, False), (LossPolicy.RUN_TO_TARGET, True)]
)
async def test_the_end_of_the_daemon_brings_each_axis_to_rest_as_configured(policy, moves_on):
    chain = simulated_chain()
    async with running_rig(with_loss(daemon=policy), {"line0": chain}) as rig:
        await jogging(rig)
    loop = asyncio.get_running_loop()

    await asyncio.sleep(1.0)
    chain.advance(loop.time())
    drive = chain.modules[0]
    drive.catch_up(loop.time())
    before = drive.shaft.position_counts
    await asyncio.sleep(1.0)
    drive.catch_up(loop.time())

    assert (abs(drive.shaft.position_counts - before) > 1000) is moves_on


@pytest.mark.parametrize("kind", list(Rehearsal))
@pytest.mark.sweep(2)
async def test_a_rehearsed_loss_does_what_the_policy_says(kind):
    async with running_rig() as rig:
        await jogging(rig)

        request = Rehearse(kind=kind, axis="x")
        reply = await rig.client.ask(request, timeout_s=30.0)
        await asyncio.sleep(2.0)
        before = await position_of(rig)
        await asyncio.sleep(1.0)

        assert reply.policy == LossPolicy.HALT
        assert await position_of(rig) == pytest.approx(before, abs=0.002)
