"""PIC-I/O as a module: inputs, analog inputs and counter as a topic, outputs and timer as commands."""

import asyncio
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager

import pytest
from pydantic import ValidationError

from ldcnd.config.plan import plan_bus
from ldcnd.config.rig import RigConfig
from ldcnd.contract.commands import Halt, MoveVelocity, Power, Reset, Stop
from ldcnd.contract.errors import (
    CommandExpired,
    LeaseHeld,
    RegisterUnknown,
    ReplyTimeout,
    StopLatched,
    ValueOutOfRange,
    WrongState,
)
from ldcnd.contract.leases import Acquire
from ldcnd.contract.rig_commands import IoReply, SetIo, SetIoTimer, Snapshot
from ldcnd.contract.samples import IoSample, LinkState, TelemetryItem
from ldcnd.sim.faults import FaultInjector, FaultPlan, FaultyReply, FaultyRequest
from ldcnd.sim.ldcn.chain import ChainSpec, ModuleSpec, build_chain
from ldcnd.sim.ldcn.io import IoWiring, SimulatedIo
from tests.support.dialect_rig import GAINS
from tests.support.held_line import LONG, queued
from tests.support.rig import EPOCH_NS, RunningRig, running_rig

MODULE = {"name": "cabinet", "address": 2, "model": "pic-io", "outputs": [4, 9], "rate": 50}


def config(start: str = "reset", line: dict[str, object] | None = None, **module: object) -> RigConfig:
    axis = {"name": "x", "address": 1, "model": "pic-servo-v4", "velocity": 1000, "acceleration": 1000, "gains": GAINS}
    bus = {"name": "line", "port": "sim:line", "baud": 115_200, "start": start, "axis": [axis]}
    return RigConfig.model_validate(
        {
            "rig": "io",
            "sim": [{"name": "line", "module": [{"model": "picservo-v4"}, {"model": "picio"}]}],
            "bus": [bus | {"module": [MODULE | module]} | (line or {})],
        }
    )


def chain_of():
    wiring = IoWiring(low=(1,), wires=((4, 5),), adc=(0, 51, 255))
    return build_chain(ChainSpec((ModuleSpec("picservo-v4"), ModuleSpec("picio", wiring=wiring))))


@asynccontextmanager
async def cabinet(chain=None, **module: object) -> AsyncIterator[tuple[RunningRig, SimulatedIo]]:
    chain = chain or chain_of()
    async with running_rig(config(**module), {"line": chain}) as rig:
        await rig.until("x", lambda state: state.link is LinkState.UP)
        yield rig, chain.modules[1]


async def sample(rig: RunningRig, wanted: Callable[[IoSample], bool] = lambda _: True) -> IoSample:
    async with asyncio.timeout(5.0), rig.client.samples("cabinet", TelemetryItem.IO) as samples:
        async for _, found in samples:
            assert isinstance(found, IoSample)
            if wanted(found):
                return found
    raise AssertionError


def now_ns() -> int:
    return EPOCH_NS + round(asyncio.get_running_loop().time() * 1e9)


async def set_io(rig: RunningRig, **asked: object) -> IoReply:
    return await rig.client.ask(SetIo(module="cabinet", **asked))


async def test_inputs_and_analog_inputs_are_published():
    async with cabinet() as (rig, io):
        found = await sample(rig)
        io.drive_line(1, high=True, at_s=asyncio.get_running_loop().time())

        assert (found.levels, found.outputs, found.pwm) == ((False,) + (True,) * 11, (), (0.0, 0.0))
        assert (found.adc, found.volts) == ((0, 51, 255), (0.0, 1.0, 5.0))
        assert (await sample(rig, lambda each: each.levels[0])).levels == (True,) * 12


async def test_nothing_is_driven_before_it_is_asked_for_and_what_is_asked_is_read_back():
    async with cabinet() as (rig, io):
        assert io.outputs == 0
        reply = await set_io(rig, low=[4], pwm2=0.5)

        assert (io.outputs, io.latch, io.pwm) == (0b1000, 0, (0, 128))
        assert (reply.outputs, reply.levels[3], reply.levels[4]) == ((4,), False, False)  # line 5 is wired to 4
        assert (await set_io(rig, high=[4, 9])).levels[3:5] == (True, True)
        await set_io(rig, inputs=[4])
        assert (io.outputs, io.pwm) == (0b1_0000_0000, (0, 128))


async def test_lines_that_are_not_configured_as_outputs_are_not_driven():
    async with cabinet() as (rig, io):
        with pytest.raises(ValueOutOfRange, match="line 5 is not configured as an output; those are 4, 9"):
            await set_io(rig, high=[5])
        with pytest.raises(ValueOutOfRange, match="no module 'other'"):
            await rig.client.ask(SetIo(module="other"))

        assert io.outputs == 0


async def test_an_output_that_was_asked_for_before_a_halt_is_not_switched_behind_it():
    async with cabinet() as (rig, io):
        asked = (await rig.client.state("x")).stops
        halted = await rig.client.command("x", Halt())
        with pytest.raises(CommandExpired, match="came after this was asked for"):
            await set_io(rig, high=[4], after_stops={"x": asked})
        before = io.outputs
        await set_io(rig, high=[4], after_stops={"x": halted.stops})

        assert (before, io.outputs) == (0, 0b1000)


@pytest.mark.parametrize(
    ("not_after_s", "for_s", "said"),
    [(None, 4.5, "the turn of set_io came later than its sender waits"), (1.0, 2.0, "later than its sender allows")],
)
async def test_an_output_whose_packet_waits_longer_than_its_sender_wants_is_not_set(not_after_s, for_s, said):
    """The daemon stands still, as by a debugger, while the line waits for another reply."""
    chain = chain_of()
    async with cabinet(chain, line=LONG) as (rig, io):
        not_after = None if not_after_s is None else now_ns() + round(not_after_s * 1e9)
        asked = await queued(rig.daemon.rig.buses[0].bus, chain, set_io(rig, high=[4], not_after=not_after))
        asyncio.get_running_loop().hold_up(for_s)
        with pytest.raises(CommandExpired, match=said):
            await asked
        await asyncio.sleep(1.0)
        left = io.outputs
        await set_io(rig, high=[4])

        assert (left, io.outputs) == (0, 0b1000)


async def test_the_counter_counts_what_it_is_told_to():
    async with cabinet() as (rig, _):
        await rig.client.ask(SetIoTimer(module="cabinet", mode="timer", prescale=8))
        first = await sample(rig)
        await asyncio.sleep(1.0)
        last = await sample(rig)

        elapsed_s = (last.t - first.t) / 1e9
        assert last.counter - first.counter == pytest.approx(625_000 * elapsed_s, rel=0.01)


@pytest.mark.promise("outputs-by-command")
async def test_a_module_that_loses_power_has_inputs_again_and_nothing_is_sent_to_it_by_itself():
    chain = chain_of()
    async with cabinet(chain) as (rig, io):
        await set_io(rig, high=[4], pwm1=1.0)
        loop = asyncio.get_running_loop()
        io.power(on=False, at_s=loop.time())
        await asyncio.sleep(1.0)
        io.power(on=True, at_s=loop.time())
        found = await sample(rig, lambda each: each.outputs == () and each.quality == "good")

        assert (io.outputs, io.latch, io.pwm, found.pwm) == (0, 0, (0, 0), (0.0, 0.0))


async def test_after_a_take_over_all_outputs_are_named_at_once():
    chain = chain_of()
    async with cabinet(chain) as (rig, _):
        await set_io(rig, high=[4], low=[9], pwm1=1.0)
    async with cabinet(chain, start="adopt") as (rig, io):
        unknown = await sample(rig)
        with pytest.raises(WrongState, match="not known"):
            await set_io(rig, low=[4])
        assert (unknown.outputs, unknown.pwm, io.latch & 0b1000, io.pwm) == (None, None, 0b1000, (255, 0))

        reply = await set_io(rig, high=[4], inputs=[9], pwm1=0.0, pwm2=0.0)

        assert (reply.outputs, io.outputs, io.latch, io.pwm) == ((4,), 0b1000, 0b1000, (0, 0))


async def test_lines_and_pwm_that_are_asked_for_at_once_change_in_the_same_cycle():
    async with cabinet() as (rig, io):
        await set_io(rig, low=[4], pwm1=0.0)
        seen = {(io.levels >> 3 & 1, io.pwm[0])}
        execute = io.execute

        def watched(command):
            execute(command)
            seen.add((io.levels >> 3 & 1, io.pwm[0]))

        io.execute = watched
        await set_io(rig, high=[4], pwm1=1.0)

        assert seen == {(0, 0), (1, 255)}


async def test_a_snapshot_captures_inputs_and_count_with_the_positions():
    async with cabinet(line={"snapshot": True}) as (rig, io):
        await rig.client.command("x", Power(on=True))
        still = await rig.client.ask(Snapshot(bus="line"))
        await rig.client.ask(SetIoTimer(module="cabinet", mode="timer"))
        await rig.client.command("x", MoveVelocity(velocity=500.0))
        await asyncio.sleep(0.5)
        first = await rig.client.ask(Snapshot(bus="line"))
        io.drive_line(1, high=True, at_s=asyncio.get_running_loop().time())
        await asyncio.sleep(0.5)
        last = await rig.client.ask(Snapshot(bus="line"))

    assert (still.io[0].levels[0], still.io[0].proven) == (False, False)
    assert (first.io[0].levels[0], first.io[0].proven) == (False, True)
    assert (last.io[0].levels[0], last.io[0].proven) == (True, True)
    elapsed_s = (last.io[0].counter - first.io[0].counter) / 5_000_000
    assert elapsed_s == pytest.approx((last.t - first.t) / 1e9, abs=0.003)
    moved = last.positions[0].position - first.positions[0].position
    assert moved == pytest.approx(500.0 * elapsed_s, abs=5.0)


def test_the_polls_of_modules_are_part_of_the_plan():
    alone = plan_bus(config().bus[0].model_copy(update={"module": ()}))
    with_io = plan_bus(config().bus[0])
    (poll,) = [poll for poll in with_io.polls if poll.axis == "cabinet"]
    silent = plan_bus(config(name=None, outputs=[]).bus[0])

    assert (poll.address, poll.rate_hz, poll.request_bytes, poll.reply_bytes) == (2, 50, 5, 13)
    assert [item.item for item in poll.items] == ["io"]
    assert with_io.load == pytest.approx(alone.load + 50 * poll.longest_s)
    assert alone.load < silent.load < with_io.load
    assert [each.axis for each in silent.polls] == ["x", "address 2"]


@pytest.mark.promise("outputs-by-command")
async def test_outputs_need_the_lease_of_the_line_and_no_latched_stop():
    async with cabinet() as (rig, io):
        lease = await rig.client.ask(Acquire(client="ann", axes=("x",), lease_s=30.0))
        with pytest.raises(LeaseHeld):
            await set_io(rig, high=[4])
        await set_io(rig, high=[4], lease=lease.lease)
        await rig.client.command("x", Power(on=True, lease=lease.lease))
        await rig.client.command("x", Stop())
        with pytest.raises(StopLatched):
            await set_io(rig, low=[4], lease=lease.lease)

        assert io.latch == 0b1000


@pytest.mark.parametrize(
    ("module", "message"),
    [({"name": "x"}, "x"), ({"model": "pic-step"}, "no lines to serve"), ({"name": None}, "with a name of the module")],
)
def test_impossible_modules_are_refused_in_the_configuration(module, message):
    with pytest.raises(ValidationError, match=message):
        config(**module)


class Unanswered(FaultInjector):
    """Loses the replies of the module to these codes, or the requests."""

    def __init__(self, *codes: int, executed: bool = True) -> None:
        super().__init__(FaultPlan())
        self._codes, self._executed, self._on = codes, executed, False

    def request(self, data: bytes, at_s: float) -> FaultyRequest:
        packet = data[data.rfind(b"\xaa") :]
        self._on = len(packet) > 2 and packet[1] == 2 and packet[2] & 15 in self._codes
        return FaultyRequest((None,) * len(data) if self._on and not self._executed else tuple(data))

    def reply(self, data: bytes, at_s: float) -> FaultyReply:
        return FaultyReply(b"" if self._on else data)


async def set_io_unanswered(rig: RunningRig, chain, faults: Unanswered, **asked: object) -> None:
    chain.injector = faults
    try:
        with pytest.raises(ReplyTimeout):
            await set_io(rig, **asked)
    finally:
        chain.injector = FaultInjector(FaultPlan())
    async with asyncio.timeout(5.0):  # a module that has not answered for a while is identified anew
        while not rig.daemon.rig.buses[0].bus.proofs.all_hold():
            await asyncio.sleep(0.01)


async def test_what_has_begun_in_time_is_sent_again_whatever_the_time():
    chain = chain_of()
    async with cabinet(chain, line=LONG) as (rig, io):
        await set_io(rig, low=[4])
        chain.injector = Unanswered(6)
        asked = asyncio.create_task(set_io(rig, high=[4], not_after=now_ns() + 100_000_000))
        while not io.latch:
            await asyncio.sleep(0.0005)
        await asyncio.sleep(0.2)
        chain.injector = FaultInjector(FaultPlan())

        assert (await asked).levels[3]


@pytest.mark.parametrize("executed", [True, False])
async def test_an_output_keeps_its_level_when_another_is_set_after_a_lost_reply(executed):
    chain = chain_of()
    async with cabinet(chain) as (rig, io):
        await set_io(rig, low=[4, 9])
        await set_io_unanswered(rig, chain, Unanswered(6, executed=executed), high=[4])
        held = io.latch & 0b1000

        await set_io(rig, high=[9])

        assert io.latch == held | 0b1_0000_0000


class Stale(FaultInjector):
    """Has replies of the module to Read Status say that line 4 is low."""

    def __init__(self, replies: int) -> None:
        super().__init__(FaultPlan())
        self.left, self._on = replies, False

    def request(self, data: bytes, at_s: float) -> FaultyRequest:
        packet = data[data.rfind(b"\xaa") :]
        self._on = len(packet) > 2 and packet[1] == 2 and packet[2] & 15 == 3
        return FaultyRequest(tuple(data))

    def reply(self, data: bytes, at_s: float) -> FaultyReply:
        if not (self._on and self.left):
            return FaultyReply(data)
        self.left -= 1
        body = bytes((data[0], data[1] & ~0b1000, *data[2:-1]))
        return FaultyReply(body + bytes((sum(body) & 0xFF,)))


async def test_one_reply_does_not_tell_the_level_that_an_output_keeps():
    chain = chain_of()
    async with cabinet(chain, rate=1) as (rig, io):
        await set_io(rig, low=[4, 9])
        await set_io_unanswered(rig, chain, Unanswered(6), high=[4])
        await sample(rig)
        chain.injector = stale = Stale(1)

        await set_io(rig, high=[9])

        assert (io.latch, stale.left) == (0b1_0000_1000, 0)


@pytest.mark.parametrize("executed", [True, False])
async def test_a_line_of_which_it_is_unknown_whether_it_is_an_output_is_to_be_named(executed):
    chain = chain_of()
    async with cabinet(chain) as (rig, io):
        await set_io_unanswered(rig, chain, Unanswered(0, executed=executed), high=[4])
        outputs = io.outputs
        assert (await sample(rig, lambda each: each.outputs is None)).outputs is None

        with pytest.raises(RegisterUnknown, match="line 4") as refusal:
            await set_io(rig, high=[9])

        level = "low" if executed else "high"  # an input is pulled up
        assert io.outputs == outputs
        assert refusal.value.remedy.startswith(f"set output 4 {level} and output 9 high at once")
        await set_io(rig, high=[4, 9])
        assert (io.outputs, io.latch) == (0b1_0000_1000, 0b1_0000_1000)


async def test_a_line_whose_packet_a_stop_has_kept_from_the_line_is_known_to_be_no_output():
    chain = chain_of()
    async with cabinet(chain, line=LONG) as (rig, io):
        asked = await queued(rig.daemon.rig.buses[0].bus, chain, set_io(rig, high=[4]))
        await rig.client.command("x", Stop())
        with pytest.raises(StopLatched):
            await asked

        await rig.client.command("x", Reset())
        await set_io(rig, high=[9])

        assert io.outputs == 0b1_0000_0000


@pytest.mark.parametrize("executed", [True, False])
async def test_a_pwm_output_that_is_unknown_is_to_be_named(executed):
    chain = chain_of()
    async with cabinet(chain) as (rig, io):
        await set_io_unanswered(rig, chain, Unanswered(4, executed=executed), pwm1=1.0)
        pwm = io.pwm

        with pytest.raises(RegisterUnknown, match="pwm 1"):
            await set_io(rig, pwm2=1.0)
        await set_io(rig, high=[4])

        assert io.pwm == pwm
        await set_io(rig, pwm1=0.0, pwm2=1.0)
        assert io.pwm == (0, 255)


async def test_a_stop_between_the_packets_of_one_command_leaves_no_output_at_a_level_that_was_not_asked_for():
    chain = chain_of()
    async with cabinet(chain) as (rig, io):
        before = io.outputs
        asked = asyncio.create_task(set_io(rig, high=[4], low=[9]))
        while io.outputs == before:
            await asyncio.sleep(0.0002)
        await rig.client.stop("x")
        await asked

        assert (io.latch & 0b1000, io.latch & 0b1_0000_0000) == (0b1000, 0)
        with pytest.raises(StopLatched):
            await set_io(rig, high=[9])
