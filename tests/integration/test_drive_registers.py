"""Registers that cannot be read back, and the pins that can be outputs; on the jumping clock."""

import asyncio

import pytest

from ldcnd.contract.commands import (
    Halt,
    Home,
    MoveAbsolute,
    MoveRelative,
    MoveVelocity,
    Power,
    Reset,
    SetGains,
    SetOutputs,
)
from ldcnd.contract.errors import LdcndError, RegisterUnknown, ReplyTimeout, StopLatched, ValueOutOfRange, WrongState
from ldcnd.contract.leases import Acquire, Release
from ldcnd.contract.meta import Provenance
from ldcnd.contract.questions import Preview
from ldcnd.contract.samples import AxisState, LinkState, Quality, TelemetryItem
from ldcnd.drives.ldcn.controls import LimitPins
from ldcnd.drives.ldcn.packet import CommandCode
from ldcnd.line.flight_recorder import WireEvent
from ldcnd.sim.faults import FaultInjector, FaultPlan, FaultyReply, FaultyRequest
from tests.support.dialect_rig import (
    AXIS,
    GAINS,
    LS_182AP,
    SC,
    V4,
    Dialect,
    DialectRig,
    adopting_rig,
    dialect_rig,
)
from tests.support.held_line import LONG, queued


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


# -- replies that are lost ---------------------------------------------------------------------------------------------

SR_10 = {"gains": GAINS | {"sr": 10, "kp": 40, "kd": 200, "ki": 0}, "limits": {"velocity": 20, "acceleration": 200}}


class Swallowed(FaultInjector):
    """Loses the replies to one command, which the module executes, or the requests."""

    def __init__(self, command: CommandCode, *, executed: bool) -> None:
        super().__init__(FaultPlan())
        self._command, self._executed, self._on = command, executed, False

    def request(self, data: bytes, at_s: float) -> FaultyRequest:
        packet = data[data.rfind(b"\xaa") :]
        self._on = len(packet) > 2 and packet[2] & 15 == self._command
        return FaultyRequest((None,) * len(data) if self._on and not self._executed else tuple(data))

    def reply(self, data: bytes, at_s: float) -> FaultyReply:
        return FaultyReply(b"" if self._on else data)


async def send_unanswered(rig: DialectRig, command, written: CommandCode, *, executed: bool = True) -> None:
    """Send a command that writes a register, with no reply to that packet."""
    rig.chain.injector = Swallowed(written, executed=executed)
    try:
        with pytest.raises(ReplyTimeout):
            await rig.send(command)
    finally:
        rig.chain.injector = FaultInjector(FaultPlan())
    await rig.until(lambda state: state.link is LinkState.UP)
    await asyncio.sleep(0.2)  # polls go on


async def fastest_mm_per_s(rig: DialectRig, seconds: float) -> float:
    """Watch the shaft for a while; return its highest speed."""
    fastest, before, loop = 0.0, rig.position_mm, asyncio.get_running_loop()
    ends_s = loop.time() + seconds
    while loop.time() < ends_s:
        await asyncio.sleep(0.02)
        rig.drive.catch_up(loop.time())
        fastest, before = max(fastest, abs(rig.position_mm - before) / 0.02), rig.position_mm
    return fastest


@pytest.mark.parametrize("executed", [True, False])
async def test_a_move_after_a_lost_set_gain_keeps_its_limit(executed):
    async with dialect_rig(LS_182AP, **SR_10) as rig:
        await rig.power_on()
        await send_unanswered(rig, SetGains(sr=1, kp=350, kd=3000), CommandCode.SET_GAIN, executed=executed)
        velocity = await rig.rig.client.last("x", TelemetryItem.VELOCITY)
        (unknown,) = await rig.rig.client.axes()

        reply = await rig.send(MoveRelative(distance=10.0, velocity=20.0))

        assert await fastest_mm_per_s(rig, 0.8) == pytest.approx(20.0, rel=0.1)
        assert (rig.drive.loop.gains.sr, rig.drive.loop.gains.kp) == (10, 40)
        assert reply.velocity == pytest.approx(20.0, rel=1e-4)
        assert velocity.quality is Quality.UNCERTAIN
        (sr,) = [register for register in unknown.registers if register.name == "sr"]
        assert (sr.value, sr.provenance, "10 or 1" in sr.why) == (None, Provenance.UNKNOWN, True)
        await rig.until(lambda state: state.command is None)
        await asyncio.sleep(0.2)
        assert (await rig.rig.client.last("x", TelemetryItem.VELOCITY)).quality is Quality.GOOD


async def test_gains_that_may_have_changed_in_a_motion_are_loaded_again_at_rest():
    async with dialect_rig(V4) as rig:
        await rig.power_on()
        await rig.send(MoveRelative(distance=5.0, velocity=2.0))
        await send_unanswered(rig, SetGains(kp=300), CommandCode.SET_GAIN)
        assert rig.drive.loop.gains.kp == 300
        await rig.send(Halt())
        await rig.until(lambda state: state.command is None)

        await rig.done(MoveRelative(distance=1.0))

        assert rig.drive.loop.gains.kp == GAINS["kp"]


SLOW = {"gains": SR_10["gains"] | {"sr": 1}, "limits": {"velocity": 0.5, "acceleration": 200}, "velocity": 0.5}
"""Below a count in a servo tick, of which a drive shows nothing."""


async def creep(rig: DialectRig, **sender: object) -> None:
    """Have a velocity changed on its way to one that shows in no status."""
    for velocity in (0.3, 0.15):
        await rig.send(MoveVelocity(velocity=velocity, **sender))
        await asyncio.sleep(0.5)


@pytest.mark.parametrize("dialect", [V4, LS_182AP], ids=lambda dialect: dialect.name)
async def test_lent_gains_are_not_taken_back_while_an_axis_creeps(dialect):
    async with dialect_rig(dialect, **SLOW) as rig:
        await rig.power_on()
        lease = (await rig.rig.client.ask(Acquire(client="tuner", axes=(AXIS,), lease_s=60.0))).lease
        await rig.send(SetGains(sr=10, lent=True, lease=lease))
        await creep(rig, lease=lease)
        await rig.rig.client.ask(Release(lease=lease, leave_running=True))

        await rig.send(MoveVelocity(velocity=0.2))
        in_motion = rig.drive.loop.gains.sr
        await rig.send(Halt())
        await rig.power_on()  # at rest its loop was opened

        assert (in_motion, rig.drive.loop.gains.sr) == (10, 1)


async def test_gains_that_may_have_changed_while_an_axis_creeps_are_loaded_again_at_rest():
    async with dialect_rig(V4, **SLOW) as rig:
        await rig.power_on()
        await creep(rig)
        await send_unanswered(rig, SetGains(kp=50), CommandCode.SET_GAIN)

        await rig.send(MoveVelocity(velocity=0.2))
        in_motion = rig.drive.loop.gains.kp
        await rig.send(Halt())
        await rig.until(lambda state: state.command is None)
        await rig.send(MoveRelative(distance=0.5))

        assert (in_motion, rig.drive.loop.gains.kp) == (50, 40)


async def test_a_drive_that_creeps_as_it_is_taken_over_gets_no_other_servo_rate():
    async with dialect_rig(LS_182AP, **SLOW | {"gains": SR_10["gains"]}) as before:
        await before.power_on()
        await creep(before)
        await before.rig.lives.kill_daemon()
    async with adopting_rig(LS_182AP, before, **SLOW) as rig:
        await rig.until(lambda state: state.link == "up")

        with pytest.raises(WrongState, match="moves"):
            await rig.send(SetGains(kp=50))

        assert rig.drive.loop.gains.sr == 10


async def test_a_drive_that_was_taken_over_is_given_the_configured_gains_before_it_moves():
    config = {"gains": GAINS | {"sr": 2}, "limits": {"velocity": 20, "acceleration": 200}}
    async with dialect_rig(LS_182AP, **config) as before:
        await before.power_on()
        await before.send(SetGains(sr=1))
    before.drive.catch_up(asyncio.get_running_loop().time())
    async with adopting_rig(LS_182AP, before, **config) as rig:
        await rig.until(lambda state: state.enabled)
        await asyncio.sleep(0.5)
        assumed = await rig.rig.client.last("x", TelemetryItem.VELOCITY)
        assert rig.drive.loop.gains.sr == 1  # adoption itself sends nothing

        await rig.send(MoveRelative(distance=10.0, velocity=20.0))

        assert await fastest_mm_per_s(rig, 0.8) == pytest.approx(20.0, rel=0.1)
        assert rig.drive.loop.gains.sr == 2
        assert assumed.quality is Quality.UNCERTAIN


@pytest.mark.parametrize("speed", [4.0, 12.0])
async def test_a_motion_with_other_gains_than_configured_is_taken_over_and_shown_no_slower_than_it_is(speed):
    """Nothing tells with which divisor the drive counts: a bound on its speed must not pass for kept."""
    config = SR_10 | {"loss": {"daemon": "run_to_target"}}
    async with dialect_rig(LS_182AP, start_counts=-19_000, **config) as before:
        await before.power_on()
        await before.send(SetGains(sr=1, kp=350, kd=3000, ki=400))
        await before.send(MoveAbsolute(position=38.0, velocity=speed))
    before.drive.catch_up(asyncio.get_running_loop().time())
    async with adopting_rig(LS_182AP, before, **config) as rig:
        await rig.until(lambda state: state.enabled)
        await asyncio.sleep(0.5)
        shown = await rig.rig.client.last("x", TelemetryItem.VELOCITY)

        assert await fastest_mm_per_s(rig, 0.5) == pytest.approx(speed, rel=0.1)
        assert (shown.value >= 0.9 * speed, shown.quality) == (True, Quality.UNCERTAIN)


async def test_a_velocity_that_follows_another_is_planned_with_the_divisor_that_the_drive_has():
    """Control ends in mid-motion: the gains of before are due, and the drive counts with those that were lent yet."""
    rates = {"limits": {"velocity": 20, "acceleration": 0.1}, "acceleration": 0.1}
    async with dialect_rig(LS_182AP, **SR_10 | rates) as rig:
        await rig.power_on()
        held = await rig.rig.client.ask(Acquire(client="ann", axes=(AXIS,), lease_s=60.0))
        await rig.send(SetGains(sr=1, kp=350, kd=3000, lent=True, lease=held.lease))
        await rig.send(MoveVelocity(velocity=5.0, lease=held.lease))
        await asyncio.sleep(1.0)
        await rig.rig.client.ask(Release(lease=held.lease, leave_running=True))
        await asyncio.sleep(0.1)

        plan = await rig.rig.client.ask(Preview(velocity=4.0), AXIS)
        before = len(changing(rig))
        reply = await rig.send(MoveVelocity(velocity=4.0))

        assert list(plan.packets) == changing(rig)[before:]
        (axis,) = await rig.rig.client.axes()
        (acceleration,) = [register.value for register in axis.registers if register.name == "acceleration"]
        assert acceleration == 1  # 58.2 counts/s^2; 2 would be above the limit
        assert plan.acceleration == reply.acceleration == pytest.approx(0.0582, rel=0.001)
        assert (await rig.rig.client.state(AXIS)).state is AxisState.CONTINUOUS_MOTION
        assert rig.drive.loop.gains.sr == 1


async def test_a_set_gain_that_stays_unanswered_keeps_the_axis_from_moving():
    async with dialect_rig(LS_182AP, **SR_10) as rig:
        await rig.power_on()
        await send_unanswered(rig, SetGains(sr=1), CommandCode.SET_GAIN)
        at = rig.position_mm

        await send_unanswered(rig, MoveRelative(distance=5.0), CommandCode.SET_GAIN)

        assert await fastest_mm_per_s(rig, 1.0) < 0.1
        assert rig.position_mm == pytest.approx(at, abs=0.02)


@pytest.mark.parametrize("executed", [True, False])
async def test_a_pin_that_is_not_named_stays_what_it_is(executed):
    async with dialect_rig(V4) as rig:
        await rig.until(lambda state: state.link == "up")
        await rig.send(SetOutputs(limit1="high"))

        await send_unanswered(rig, SetOutputs(limit2="high"), CommandCode.IO_CONTROL, executed=executed)
        await rig.send(SetOutputs(limit2="high"))
        assert rig.drive._pins == LimitPins.LIMIT1_HIGH | LimitPins.LIMIT2_HIGH

        await send_unanswered(rig, SetOutputs(limit2="low"), CommandCode.IO_CONTROL, executed=executed)
        held = rig.drive._pins
        with pytest.raises(RegisterUnknown, match="limit2_pin") as refusal:
            await rig.send(SetOutputs(limit1="low"))
        assert "both limit1 and limit2" in str(refusal.value.remedy)
        assert rig.drive._pins == held

        await rig.send(SetOutputs(limit1="low", limit2="low"))
        assert rig.drive._pins == LimitPins(0)


async def test_a_packet_that_a_stop_has_kept_from_the_line_leaves_every_pin_known():
    async with dialect_rig(V4, line=LONG) as rig:
        await rig.until(lambda state: state.link == "up")
        bus = rig.rig.daemon.rig.buses[0].bus
        asked = await queued(bus, rig.chain, rig.send(SetOutputs(limit2="high")))
        await rig.rig.client.stop(AXIS)
        with pytest.raises(StopLatched):
            await asked

        await rig.send(Reset())
        await rig.send(SetOutputs(limit1="low"))

        assert rig.drive._pins == LimitPins.LIMIT2_INPUT


async def test_pins_of_a_drive_that_was_taken_over_are_named_together():
    async with dialect_rig(V4) as before:
        await before.until(lambda state: state.link == "up")
        await before.send(SetOutputs(limit1="high", limit2="high"))
    async with adopting_rig(V4, before) as rig:
        await rig.until(lambda state: state.link == "up")
        with pytest.raises(RegisterUnknown):
            await rig.send(SetOutputs(limit2="low"))

        assert rig.drive._pins == LimitPins.LIMIT1_HIGH | LimitPins.LIMIT2_HIGH


async def test_no_capture_is_armed_on_a_pin_of_a_drive_that_was_taken_over_and_may_have_become_an_output():
    async with dialect_rig(V4) as before:
        await before.until(lambda state: state.link == "up")
    async with adopting_rig(V4, before) as rig:
        await rig.until(lambda state: state.link == "up")
        await rig.send(Power(on=True))
        made_outputs = SetOutputs(limit1="high", limit2="high")
        await send_unanswered(rig, made_outputs, CommandCode.IO_CONTROL, executed=True)

        with pytest.raises(RegisterUnknown, match="limit1_pin"):
            await rig.send(Home(method="reverse_limit", velocity=-1.0))


# -- previews and limits -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("dialect", [V4, SC, LS_182AP], ids=lambda dialect: dialect.name)
async def test_the_preview_of_a_disabled_axis_is_what_the_move_will_be(dialect: Dialect):
    async with dialect_rig(dialect, **SR_10) as rig:
        await rig.until(lambda state: state.link == "up")
        disabled = await rig.rig.client.ask(Preview(distance=3.0, velocity=7.0), "x")
        await rig.power_on()
        enabled = await rig.rig.client.ask(Preview(distance=3.0, velocity=7.0), "x")
        reply = await rig.send(MoveRelative(distance=3.0, velocity=7.0))

    assert disabled.packets == enabled.packets
    assert (disabled.velocity, disabled.acceleration) == (reply.velocity, reply.acceleration)
    assert disabled.duration_s == pytest.approx(reply.duration_s)


def codes(packets) -> list[CommandCode]:
    """Return the commands of packets, which are bytes or in hexadecimal."""
    data = [bytes.fromhex(packet) if isinstance(packet, str) else packet for packet in packets]
    return [CommandCode(packet[2] & 15) for packet in data]


def changing(rig: DialectRig) -> list[str]:
    """Return what was sent to the drive and does more than read it, in hexadecimal."""
    records = rig.rig.daemon.rig.buses[0].bus.wire_log.records()
    sent = [record.data for record in records if record.event is WireEvent.SENT]
    reads = (CommandCode.READ_STATUS, CommandCode.NO_OPERATION)
    return [packet.hex(" ") for packet in sent if codes([packet])[0] not in reads]


async def test_a_preview_shows_what_arms_the_limit_switch_ahead():
    async with dialect_rig(V4, limit_switches="stop") as rig:
        await rig.power_on()
        for position in (3.0, -2.0):
            plan = await rig.rig.client.ask(Preview(position=position), "x")
            before = len(changing(rig))
            await rig.done(MoveAbsolute(position=position))

            assert list(plan.packets) == changing(rig)[before:]
            assert CommandCode.SET_HOMING_MODE in codes(plan.packets)


async def test_a_preview_shows_gains_only_where_they_are_loaded():
    """Before a motion from rest, and once, however many motions follow each other."""
    approach = {"direction": "positive", "distance": 1.0}
    legs = [*2 * [CommandCode.LOAD_TRAJECTORY], CommandCode.START_MOTION]  # what no status shows is told twice
    async with dialect_rig(V4, approach=approach) as rig:
        await rig.power_on()
        await rig.send(MoveVelocity(velocity=5.0))
        await send_unanswered(rig, SetGains(kp=300), CommandCode.SET_GAIN)
        moving = await rig.rig.client.ask(Preview(velocity=4.0), "x")
        before = len(changing(rig))
        await rig.send(MoveVelocity(velocity=4.0))
        sent = changing(rig)[before:]
        await rig.send(Halt())
        await rig.until(lambda state: state.command is None)
        resting = await rig.rig.client.ask(Preview(position=0.0), "x")
        before = len(changing(rig))
        await rig.done(MoveAbsolute(position=0.0))
        done = codes(changing(rig)[before:])

    assert list(moving.packets) == sent
    assert codes(sent) == legs
    loaded = [code for code in codes(resting.packets) if code not in legs]
    assert codes(resting.packets) == loaded + 2 * legs
    assert {*loaded} == {CommandCode.SET_GAIN}
    assert done == codes(resting.packets)


async def test_a_preview_of_a_move_needs_a_speed_above_0():
    async with dialect_rig(V4) as rig:
        await rig.until(lambda state: state.link == "up")
        for velocity in (-1.0, 0.0):
            plan = await rig.rig.client.ask(Preview(position=5.0, velocity=velocity), "x")
            assert (plan.refusal.code, plan.duration_s) == ("value_out_of_range", None)
        assert (await rig.rig.client.ask(Preview(velocity=-1.0), "x")).refusal is None


async def test_an_acceleration_at_its_limit_is_not_rounded_beyond_it():
    step = 1 / 0.017179869184 / 1000
    limits = {"acceleration": 3.6 * step, "velocity": 20}
    async with dialect_rig(V4, limits=limits, acceleration=3.6 * step) as rig:
        await rig.power_on()

        reply = await rig.send(MoveVelocity(velocity=20.0))

        assert reply.acceleration == pytest.approx(3 * step)
        assert 19.999 < reply.velocity <= 20.0


async def test_a_limit_below_the_smallest_acceleration_of_the_drive_refuses_the_move():
    async with dialect_rig(V4, limits={"acceleration": 0.03}, acceleration=0.03) as rig:
        await rig.power_on()

        with pytest.raises(LdcndError, match=r"too small for the drive, the least is 58\.2") as refusal:
            await rig.send(MoveVelocity(velocity=1.0))

        assert refusal.value.code == "value_out_of_range"
