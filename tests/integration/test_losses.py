"""What happens when the line or the daemon disappears in mid-motion, on the jumping clock."""

import asyncio

import pytest
from structlog.testing import capture_logs

from ldcnd.config.rig import RigConfig, load_config
from ldcnd.contract.commands import MoveAbsolute, MoveRelative, MoveVelocity, Power, Reset, SetPwm
from ldcnd.contract.errors import NotReferenced, WrongState
from ldcnd.contract.events import DRIVE_CHANGED, ReadEvents
from ldcnd.contract.rig_commands import Rehearsal, Rehearse
from ldcnd.contract.samples import AxisState, LinkState, Moving, PositionSample, Quality, TelemetryItem
from ldcnd.drives.axis_config import LossConfig, LossPolicy
from ldcnd.sim.chain import Chain
from ldcnd.sim.ldcn.chain import ChainSpec, ModuleSpec, build_chain
from tests.support.chain_rig import drive, rig_on, simulated_config, taken_away
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


def of_others(policy: LossPolicy, sr: int) -> RigConfig:
    """Return the simulated rig with this policy of a lost line, and this servo rate divisor, on all its axes."""
    gains = {"kp": 350, "kd": 3000, "ki": 400, "il": 400, "ol": 250, "el": 4000, "sr": sr}
    pwm = {"duty": 0.1, "duration_s": 60.0}
    return simulated_config({"gains": gains, "loss": {"bus": policy.value, "daemon": "run_to_target"}, "pwm": pwm})


@pytest.mark.promise("start-moves-nothing")
@pytest.mark.parametrize("policy", [LossPolicy.HALT, LossPolicy.RUN_TO_TARGET])
async def test_a_drive_that_others_have_set_up_while_its_line_was_lost_is_not_as_it_was_left(policy):
    """It was off, and others have closed its loop, with a servo rate at which the same motion is twice as fast."""
    chain = simulated_chain()
    async with rig_on(chain, of_others(policy, 2)) as rig:
        await rig.power_on("x")
        await rig.client.command("x", Power(on=False))
        async with taken_away(rig.line.bus), rig_on(chain, of_others(policy, 1)) as other:
            await other.power_on("x")
            await other.kill()
        state = await rig.until("x", lambda state: state.link is LinkState.UP and state.enabled)
        await rig.until("x", lambda state: not state.stop_pending)
        page = await rig.client.ask(ReadEvents(axis="x", count=100))
        found = [event.reason for event in page.events if event.verb == DRIVE_CHANGED]
        with pytest.raises(WrongState, match="error stop"):
            await rig.client.command("x", MoveRelative(distance=1.0))
        others = drive(chain, 1).loop.gains.sr
        await rig.client.command("x", Reset())
        await rig.client.command("x", Power(on=True))
        await rig.client.command("x", MoveRelative(distance=1.0))

        assert (state.state, others, drive(chain, 1).loop.gains.sr) == (AxisState.ERROR_STOP, 1, 2)
        assert found == ["its motor was off when it was seen last, and others have closed its loop since"]


@pytest.mark.promise("motions-without-end")
@pytest.mark.parametrize("policy", [LossPolicy.HALT, LossPolicy.RUN_TO_TARGET])
async def test_a_duty_that_others_have_left_while_the_line_was_lost_is_switched_off(policy):
    chain = simulated_chain()
    async with rig_on(chain, of_others(policy, 2)) as rig:
        async with taken_away(rig.line.bus), rig_on(chain, of_others(policy, 2)) as other:
            await other.power_on("x")
            await other.client.command("x", SetPwm(duty=0.05, duration_s=60.0))
            await asyncio.sleep(0.5)
            await other.kill()
        assert abs(drive(chain, 1).shaft.velocity_counts) > 1
        await rig.until("x", lambda state: state.link is LinkState.UP)
        await asyncio.sleep(0.5)

        assert not drive(chain, 1).stage.drives


async def test_a_line_that_nobody_else_had_takes_nothing_from_what_stands():
    """Neither the load that a closed loop holds, nor the state of an axis that was off."""
    chain = simulated_chain()
    async with rig_on(chain, simulated_config()) as rig:
        await rig.power_on("z")
        places = [drive(chain, place).shaft.position_counts for place in (1, 2, 3, 4)]
        async with taken_away(rig.line.bus):
            await asyncio.sleep(OUTAGE_S)
        await rig.until("z", lambda state: state.link is LinkState.UP)
        await asyncio.sleep(1.0)
        after = [await rig.client.state(name) for name in "xyc"]
        faults = [await rig.client.last(name, TelemetryItem.FAULT) for name in "xyc"]

        assert [(state.state, state.stop_pending) for state in after] == [(AxisState.DISABLED, False)] * 3
        assert [sample.active for sample in faults] == [()] * 3
        assert drive(chain, 3).loop.servo_on
        assert [drive(chain, place).shaft.position_counts for place in (1, 2, 3, 4)] == pytest.approx(places, abs=2)


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
