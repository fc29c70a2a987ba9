"""How a daemon comes to a line that somebody else left behind."""

import asyncio
import contextlib

import pytest

from ldcnd.client.overview import overview
from ldcnd.contract.commands import MoveAbsolute, MoveVelocity, Power
from ldcnd.contract.errors import LdcndError
from ldcnd.contract.samples import AxisState, LinkState, Moving, StateSample, TelemetryItem
from ldcnd.contract.troubles import Severity
from ldcnd.drives.ldcn.addressing import WAITING_ADDRESSES
from ldcnd.drives.ldcn.controls import StopControl
from ldcnd.drives.ldcn.packet import CommandCode
from ldcnd.drives.ldcn.received import LoadTrajectory
from ldcnd.drives.ldcn.trajectory import ProfileMode, Trajectory
from ldcnd.sim.faults import FaultInjector, FaultPlan, FaultyReply, FaultyRequest
from ldcnd.sim.ldcn.chain import ChainSpec, ModuleSpec, build_chain
from tests.support.chain_rig import UNSEEN_MOTIONS_END, drive, rig_on, simulated_config
from tests.support.rig import running_rig

ONE = 1 << 16
"""One count per tick, as programmed velocity."""
HARMLESS = {CommandCode.READ_STATUS, CommandCode.NO_OPERATION}
OPEN_LOOPS_OFF = {CommandCode.STOP_MOTOR}
"""Drives that an earlier host has left with an open loop are switched off, in case it was a duty."""
ADOPTING = simulated_config(start="adopt")
MODELS = ("ls182ap", "ls182ap", "picservo-v4", "picservo-v4")


def chain_of(*models):
    return build_chain(ChainSpec(tuple(ModuleSpec(model) for model in models or MODELS)))


def commands_in(packets):
    return {packet.command for packet in packets}


async def leave_x_moving(chain, config, *, to=50.0):
    """Let a first daemon start a motion of x, with z enabled, and kill it in the middle."""
    async with rig_on(chain, config) as rig:
        await rig.power_on("x")
        await rig.client.command("z", Power(on=True))
        await rig.client.command("x", MoveAbsolute(position=to))
        await asyncio.sleep(0.5)
        await rig.kill()


@pytest.mark.promise("start-moves-nothing")
async def test_a_daemon_killed_in_mid_move_is_followed_by_one_that_adopts():
    chain = chain_of()
    await leave_x_moving(chain, simulated_config())
    await asyncio.sleep(0.2)
    left_at = drive(chain, 1).loop.position
    assert 1000 < left_at < 49_000

    async with rig_on(chain, ADOPTING) as rig:
        adopted_with = commands_in(rig.sent)
        moving = await rig.until("x", lambda state: state.link is LinkState.UP)
        await rig.until("x", lambda state: state.moving is Moving.YES)
        x, *others = await overview(rig.client)
        (worst, *_) = x.condition.wrong
        ended = await rig.until("x", lambda state: state.state is AxisState.STANDSTILL)
        await asyncio.sleep(0.5)
        (bus,) = await rig.client.buses()
        sent = commands_in(rig.sent)
        stops = [packet.data[0] & StopControl.SMOOTH for packet in rig.sent if packet.command is CommandCode.STOP_MOTOR]

    assert adopted_with <= HARMLESS | OPEN_LOOPS_OFF
    assert sent <= HARMLESS | OPEN_LOOPS_OFF
    assert not any(stops)  # a motion with an end has it
    assert (moving.state, moving.referenced) == (AxisState.DISCRETE_MOTION, False)
    assert (worst.severity, worst.short) == (Severity.WRONG, "moves without a command")
    assert "started by no client that is connected" in worst.text
    assert not any("moves" in note for other in others for note in other.condition.notes)
    assert (ended.state, ended.last_error) == (AxisState.STANDSTILL, None)
    assert (bus.up, bus.started_by, bus.baud) == (True, "adoption", 115_200)
    assert abs(drive(chain, 1).loop.position - 50_000) <= 1
    assert [drive(chain, address).loop.position for address in (2, 4)] == [0, 0]
    assert [drive(chain, address).loop.servo_on for address in (1, 2, 3, 4)] == [True, False, True, False]


async def test_an_adopted_motion_is_stopped_smoothly():
    chain = chain_of()
    await leave_x_moving(chain, simulated_config())

    async with rig_on(chain, ADOPTING) as rig:
        await rig.until("x", lambda state: state.state is AxisState.DISCRETE_MOTION)
        reply = await rig.client.stop("x")
        state = await rig.until("x", lambda state: state.state is AxisState.STANDSTILL)

    assert reply.confirmed == ("x",)
    assert state.stop_latched
    assert drive(chain, 1).loop.servo_on
    assert drive(chain, 1).loop.position < 40_000


async def test_a_line_is_found_at_the_rate_where_a_crashed_host_left_it():
    chain = chain_of()
    await leave_x_moving(chain, simulated_config(baud=57_600, divisors="alternate"))

    async with rig_on(chain, ADOPTING) as rig:
        (bus,) = await rig.client.buses()
        sent = commands_in(rig.sent)

    assert (bus.baud, bus.started_by) == (57_600, "adoption")
    assert any("57600" in remark for remark in bus.remarks)
    assert sent <= HARMLESS | OPEN_LOOPS_OFF


async def test_what_cannot_be_adopted_stays_down_and_says_why():
    chain = chain_of()

    async with rig_on(chain, ADOPTING, up=False) as rig:
        await asyncio.sleep(5)
        (bus,) = await rig.client.buses()
        sent = commands_in(rig.sent)

    assert not bus.up
    assert "address 1 (axis x): expected Logosol LS-182AP, found nothing" in bus.problem
    assert "allow adopt_fallback" in bus.problem
    assert sent <= HARMLESS


async def test_what_cannot_be_adopted_is_reset_if_the_configuration_allows_it():
    chain = chain_of()

    async with rig_on(chain, simulated_config(start="adopt", adopt_fallback="reset")) as rig:
        (bus,) = await rig.client.buses()

    assert (bus.up, bus.started_by) == (True, "reset")
    assert any("not taken over" in remark for remark in bus.remarks)


async def test_a_drive_that_moves_is_not_reset_by_the_fallback():
    chain = chain_of()
    await leave_x_moving(chain, simulated_config())
    loop = asyncio.get_running_loop()
    chain.modules[3].power(on=False, at_s=loop.time())

    async with rig_on(chain, simulated_config(start="adopt", adopt_fallback="reset"), up=False) as rig:
        async with asyncio.timeout(5):
            while rig.line.problem == "not opened yet":
                await asyncio.sleep(0.1)
        (bus,) = await rig.client.buses()
        still_moving = drive(chain, 1).loop.servo_on
        chain.modules[3].power(on=True, at_s=loop.time())
        async with asyncio.timeout(30):
            await rig.daemon.wait_up()
        (later,) = await rig.client.buses()

    assert still_moving
    assert "address 1, Logosol LS-182AP (id 90, version 20), moves" in bus.problem
    assert (later.up, later.started_by) == (True, "adoption")
    assert any("address 4 had lost power" in remark for remark in later.remarks)
    assert CommandCode.HARD_RESET not in commands_in(rig.sent)


def creep(chain, counts_per_tick):
    """Let axis x jog as a foreign host would have it, and forget who did it."""
    command = Trajectory(
        velocity=round(counts_per_tick * ONE), acceleration=ONE, mode=ProfileMode.VELOCITY, start_now=True
    )
    drive(chain, 1).execute(LoadTrajectory(command))


async def left_creeping(chain, counts_per_tick):
    async with rig_on(chain, simulated_config()) as rig:
        await rig.power_on("x")
        await rig.kill()
    creep(chain, counts_per_tick)


@pytest.mark.parametrize("counts_per_tick", [0.02, 0.3, 0.9, 3.0])
@pytest.mark.sweep(2)
async def test_a_drive_that_creeps_is_not_reset_by_the_fallback(counts_per_tick):
    chain = chain_of()
    await left_creeping(chain, counts_per_tick)
    chain.modules[3].power(on=False, at_s=asyncio.get_running_loop().time())

    async with rig_on(chain, simulated_config(start="adopt", adopt_fallback="reset"), up=False) as rig:
        await asyncio.sleep(5)
        (bus,) = await rig.client.buses()

    assert drive(chain, 1).loop.servo_on
    assert "address 1, Logosol LS-182AP (id 90, version 20), moves" in bus.problem
    assert CommandCode.HARD_RESET not in commands_in(rig.sent)


async def test_a_drive_that_is_silent_is_not_known_to_stand_and_not_reset():
    chain = chain_of()
    async with rig_on(chain, simulated_config()) as rig:
        await rig.kill()
    chain.modules[3].power(on=False, at_s=asyncio.get_running_loop().time())

    async with rig_on(chain, simulated_config(start="adopt", adopt_fallback="reset"), up=False) as rig:
        await asyncio.sleep(5)
        (bus,) = await rig.client.buses()

    assert "address 4 (axis c) does not answer and may move" in bus.problem
    assert CommandCode.HARD_RESET not in commands_in(rig.sent)


async def test_a_line_that_was_lost_with_a_drive_is_not_reset_while_another_moves():
    chain = chain_of()
    async with rig_on(chain, simulated_config(UNSEEN_MOTIONS_END)) as rig:
        await rig.power_on("x")
        creep(chain, 0.3)
        now_s = asyncio.get_running_loop().time()
        chain.unplug(now_s, 1.0)
        chain.modules[3].power(on=False, at_s=now_s)
        await asyncio.sleep(5)

    assert drive(chain, 1).loop.servo_on


@pytest.mark.promise("rejoin-resets-nothing")
@pytest.mark.parametrize("stopped", [False, True])
@pytest.mark.sweep(2)
async def test_a_drive_that_a_restarted_one_keeps_from_hearing_is_not_reset(stopped):
    chain = chain_of()
    loop = asyncio.get_running_loop()
    async with rig_on(chain, simulated_config(UNSEEN_MOTIONS_END)) as rig:
        await rig.power_on("y")
        await rig.client.command("y", MoveVelocity(velocity=1.0))
        before_outage = len(rig.sent)
        chain.unplug(loop.time(), 1.0)
        chain.modules[0].power(on=False, at_s=loop.time())
        await rig.until("x", lambda state: state.link is LinkState.DOWN)
        chain.modules[0].power(on=True, at_s=loop.time())
        if stopped:
            with contextlib.suppress(LdcndError):
                await rig.client.stop("y")
        async with asyncio.timeout(5):
            await rig.daemon.wait_up()
        states = {axis: await rig.until(axis, lambda state: state.link is LinkState.UP) for axis in ("x", "y")}
        before = drive(chain, 2).loop.position
        await asyncio.sleep(1)
        moved = drive(chain, 2).loop.position - before
        (bus,) = await rig.client.buses()
        sent = commands_in(rig.sent[before_outage:])

    assert bus.started_by == "adoption"
    assert any("address 1 had lost power" in remark for remark in bus.remarks)
    assert CommandCode.HARD_RESET not in sent
    assert (states["x"].enabled, states["x"].referenced) == (False, False)
    assert (abs(moved) < 100) == stopped
    assert drive(chain, 2).loop.servo_on


async def test_a_line_that_was_lost_while_its_rate_changed_is_brought_to_one_rate():
    chain = chain_of()
    loop = asyncio.get_running_loop()
    async with rig_on(chain, simulated_config(UNSEEN_MOTIONS_END)) as rig:
        await rig.power_on("y")
        await rig.client.command("y", MoveVelocity(velocity=1.0))
        chain.unplug(loop.time(), 1.0)
        chain.modules[2].baud = 57_600.0
        await rig.until("x", lambda state: state.link is LinkState.DOWN)
        async with asyncio.timeout(5):
            await rig.daemon.wait_up()
        (bus,) = await rig.client.buses()

    assert (bus.started_by, bus.baud) == ("adoption", 115_200)
    assert drive(chain, 2).loop.servo_on


@pytest.mark.promise("moving-unknown")
@pytest.mark.promise("motions-without-end")
@pytest.mark.parametrize("counts_per_tick", [0.02, 0.3, 0.9, 3.0])
@pytest.mark.sweep(2)
async def test_a_motion_without_an_end_that_a_host_has_left_moves_until_it_was_ended(counts_per_tick):
    chain = chain_of()
    await left_creeping(chain, counts_per_tick)
    false = set()

    def look(sample: StateSample) -> None:
        if sample.moving is Moving.NO and drive(chain, 1).loop.trajectory.velocity:
            false.add((sample.t, sample.state))

    async with rig_on(chain, ADOPTING) as rig:
        first = await rig.until("x", lambda state: state.link is LinkState.UP)
        async with rig.client.samples("x", "state") as states, asyncio.timeout(10):
            await rig.until("x", lambda state: state.moving is Moving.YES)
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(5):
                    async for _, sample in states:
                        look(sample)
        last = await rig.client.state("x")
        before = drive(chain, 1).shaft.position_counts
        await asyncio.sleep(1.0)
        after = drive(chain, 1).shaft.position_counts

    assert first.moving is not Moving.NO
    assert not false
    assert (last.state, last.moving, last.stop_pending, last.stop_latched) == (
        AxisState.STANDSTILL,
        Moving.NO,
        False,
        False,
    )
    assert abs(after - before) <= 2


async def test_a_line_that_was_lost_is_adopted_whatever_the_policy():
    chain = chain_of()
    async with rig_on(chain, simulated_config(UNSEEN_MOTIONS_END)) as rig:
        await rig.power_on("x")
        await rig.client.command("x", MoveAbsolute(position=50.0))
        await asyncio.sleep(0.5)

        chain.unplug(asyncio.get_running_loop().time(), 1.0)
        lost = await rig.until("x", lambda state: state.link is LinkState.DOWN)
        await rig.daemon.wait_up()
        found = await rig.until("x", lambda state: state.link is LinkState.UP)
        await asyncio.sleep(3)
        (bus,) = await rig.client.buses()

    assert lost.state is AxisState.ERROR_STOP
    assert not found.referenced
    assert bus.started_by == "adoption"
    assert drive(chain, 1).loop.servo_on
    assert abs(drive(chain, 1).loop.position - 50_000) <= 1


@pytest.mark.long
async def test_stops_during_a_take_over_delay_it_at_most():
    chain = chain_of()
    await leave_x_moving(chain, simulated_config())

    async with rig_on(chain, ADOPTING, up=False) as rig:
        async with asyncio.TaskGroup() as group:
            for number in range(100):
                for axis in ("x", "y", "z", "c"):
                    group.create_task(rig.client.stop(axis), name=f"stop {axis} {number}")
                await asyncio.sleep(0.0031)
        async with asyncio.timeout(5):
            await rig.daemon.wait_up()
        (bus,) = await rig.client.buses()

    assert bus.started_by == "adoption"


async def test_modules_that_are_no_axes_are_kept_and_published():
    chain = chain_of("ls182ap", "ls182ap", "picservo-v4", "picservo-v4", "picio", "picstep")
    config = simulated_config(module=[{"address": 5, "model": "pic-io"}, {"address": 6, "model": "pic-step"}])

    async with rig_on(chain, config) as rig:
        await asyncio.sleep(2)
        (bus,) = await rig.client.buses()

    assert [(module.address, module.model, module.axis) for module in bus.modules] == [
        (1, "ls-182ap", "x"),
        (2, "ls-182ap", "y"),
        (3, "pic-servo-v4", "z"),
        (4, "pic-servo-v4", "c"),
        (5, "pic-io", None),
        (6, "pic-step", None),
    ]
    assert [module.status for module in bus.modules] == [None, None, None, None, 0, 0]


@pytest.mark.parametrize("start", ["reset", "adopt"])
async def test_a_line_with_a_module_that_is_not_configured_stays_down_and_says_which_lines_describe_it(start):
    chain = chain_of("ls182ap", "ls182ap", "picservo-v4", "picservo-v4", "picstep")
    described = simulated_config(module=[{"address": 5, "model": "pic-step"}])
    async with rig_on(chain, described):
        pass
    before = [drive(chain, address).loop.position for address in (1, 2, 3, 4)]

    async with rig_on(chain, simulated_config(start=start), up=False) as rig:
        await asyncio.sleep(8)
        (bus,) = await rig.client.buses()

    assert not bus.up
    assert "address 5: PIC-STEP (id 3, version 1) is not configured" in bus.problem
    assert start == "adopt" or 'needs [[bus.module]] with address = 5 and model = "pic-step"' in bus.problem
    assert [drive(chain, address).loop.position for address in (1, 2, 3, 4)] == before


async def test_the_simulated_rig_publishes_its_first_position_within_a_second_of_being_started():
    began_at_s = asyncio.get_running_loop().time()
    async with running_rig() as rig, rig.client.samples("x", TelemetryItem.POSITION) as samples:
        await anext(samples)
        took_s = asyncio.get_running_loop().time() - began_at_s

    assert took_s < 1.0


async def referenced_after(chain, **bus):
    async with rig_on(chain, simulated_config(**bus)) as rig:
        await asyncio.sleep(1.0)
        return {name: axis.tracker.status.referenced for name, axis in rig.daemon.rig.axes.items()}


@pytest.mark.promise("reference-at-reset")
@pytest.mark.parametrize("baud", [9600, 19_200, 57_600, 115_200])
@pytest.mark.sweep(2)
async def test_a_reset_of_drives_that_an_earlier_host_has_used_gives_no_reference(baud):
    chain = chain_of()
    assert all((await referenced_after(chain, baud=baud)).values())
    again = await referenced_after(chain)

    assert not any(again.values())


async def test_drives_that_were_powered_off_and_on_between_two_daemons_are_where_they_were_powered_on():
    chain = chain_of()
    await referenced_after(chain)
    now_s = asyncio.get_running_loop().time()
    for module in chain.modules:
        module.power(on=False, at_s=now_s)
        module.power(on=True, at_s=now_s)

    assert all((await referenced_after(chain)).values())


@pytest.mark.promise("reference-at-reset")
@pytest.mark.parametrize("place", range(4))
@pytest.mark.parametrize("baud", [19_200, 115_200])
@pytest.mark.sweep(2)
async def test_one_drive_that_was_powered_on_does_not_stand_for_those_that_kept_their_power(place, baud):
    chain = chain_of()
    await referenced_after(chain, baud=baud)
    now_s = asyncio.get_running_loop().time()
    chain.modules[place].power(on=False, at_s=now_s)
    chain.modules[place].power(on=True, at_s=now_s)

    assert not any((await referenced_after(chain, baud=baud)).values())


class FirstReplySpoilt(FaultInjector):
    """Leaves so many bytes of the first reply of the first module, and spoils no other."""

    def __init__(self, left: int) -> None:
        super().__init__(FaultPlan())
        self.spoilt, self._left, self._asked = False, left, False

    def request(self, data: bytes, at_s: float) -> FaultyRequest:
        self._asked = b"\xaa\x01" in data
        return super().request(data, at_s)

    def reply(self, data: bytes, at_s: float) -> FaultyReply:
        if self.spoilt or not self._asked:
            return super().reply(data, at_s)
        self.spoilt = True
        return FaultyReply(data[: self._left])


@pytest.mark.promise("reference-at-reset")
@pytest.mark.parametrize("left", [0, 1], ids=["lost", "damaged"])
async def test_one_spoilt_reply_makes_no_drive_that_was_moved_one_that_was_powered_on(left):
    """The last one waits for its address, and the first has kept its own, and what it was moved by."""
    chain = chain_of()
    await referenced_after(chain)
    now_s = asyncio.get_running_loop().time()
    chain.modules[3].power(on=False, at_s=now_s)
    chain.modules[3].power(on=True, at_s=now_s)
    chain.injector = injector = FirstReplySpoilt(left)

    assert not any((await referenced_after(chain)).values())
    assert injector.spoilt


@pytest.mark.promise("reference-at-reset")
async def test_a_drive_whose_shaft_turns_while_it_is_reset_is_not_referenced():
    chain = chain_of()
    turning = asyncio.create_task(turn(chain, 2), name="turning")
    referenced = await referenced_after(chain)
    turning.cancel()

    assert referenced == {"x": True, "y": False, "z": True, "c": True}


async def turn(chain, address):
    """Turn a shaft by hand."""
    while True:
        await asyncio.sleep(0.01)
        drive(chain, address).shaft.position_counts += 5


@pytest.mark.parametrize("placed", [1, 2, 3])
@pytest.mark.sweep(2)
async def test_a_line_that_a_killed_daemon_has_addressed_in_part_is_taken_over(placed):
    chain = chain_of(*["ls182ap"] * 4)
    axes = [axis | {"model": "ls-182ap"} for axis in simulated_config().model_dump()["bus"][0]["axis"]]
    config = simulated_config(start="adopt", adopt_fallback="reset", axis=axes)
    async with rig_on(chain, config, up=False) as rig:
        while chain.modules[placed - 1].address != placed:
            await asyncio.sleep(0.0005)
        await rig.kill()
    assert chain.modules[placed].address in WAITING_ADDRESSES

    began_at_s = asyncio.get_running_loop().time()
    async with rig_on(chain, config):
        took_s = asyncio.get_running_loop().time() - began_at_s

    assert [module.address for module in chain.modules] == [1, 2, 3, 4]
    assert took_s < 5.0
