"""Axes that start in one servo cycle, stop by one packet and show one instant."""

import asyncio
import contextlib

import pytest

from ldcnd.config.rig import load_config
from ldcnd.contract.commands import HomeMethod, MoveAbsolute
from ldcnd.contract.errors import (
    BusError,
    ConfigError,
    DriveFault,
    NotSupported,
    OutcomeUnknown,
    ValueOutOfRange,
    WrongState,
)
from ldcnd.contract.samples import AxisState
from ldcnd.drives.driver import CountsMotion, HomeCapture, StopMode
from ldcnd.drives.ldcn.commands import spaced
from ldcnd.drives.ldcn.config import LineSpec
from ldcnd.drives.ldcn.controls import StopControl
from ldcnd.drives.ldcn.packet import CommandCode, Packet, encode_packet
from ldcnd.drives.line_config import GroupConfig
from ldcnd.drives.network import StartPolicy
from ldcnd.sim.faults import FaultKind, FaultPlan, LineFault
from ldcnd.sim.ldcn.chain import ChainSpec, ModuleSpec, build_chain
from tests.support.bare_network import bare_network, specs
from tests.support.chain_rig import drive, rig_on, simulated_config
from tests.support.rig import SIMULATED

MODULES = ("ls182ap", "picservo-v4", "picservo-v4", "ls182ap")
AXES = specs("ls-182ap", "pic-servo-v4", "pic-servo-v4", "ls-182ap")
PAIR = LineSpec(groups=(GroupConfig(name="pair", axes=("a2", "a3")),))
LED_PAIR = LineSpec(groups=(GroupConfig(name="pair", axes=("a2", "a3"), leader="a3"),))
THERE = CountsMotion(20_000, 20_000.0, 100_000.0)
BACK = CountsMotion(-20_000, 20_000.0, 100_000.0)


def chain_of(*modules, faults=None):
    return build_chain(
        ChainSpec(tuple(ModuleSpec(module) for module in modules or MODULES), faults=faults or FaultPlan())
    )


def wanted():
    """Nothing has overtaken the motion."""


async def up(line, *, power=True):
    await line.network.bring_up()
    for axis in line.network.axes.values() if power else ():
        await axis.power(on=True)


@pytest.mark.parametrize("line_spec", [PAIR, LED_PAIR])
async def test_members_start_with_one_packet_and_nobody_else_does(line_spec):
    chain = chain_of()
    async with bare_network(chain, AXES, line=line_spec) as line:
        await up(line)
        before = len(line.sent())

        await line.network.start_group({"a2": THERE, "a3": BACK}, wanted)
        started = [packet for packet in line.sent(before) if packet.command is CommandCode.START_MOTION]
        await asyncio.sleep(3)

    assert [packet.address for packet in started] == [0x81]
    assert [drive(chain, address).loop.position for address in (1, 4)] == [0, 0]
    assert abs(drive(chain, 2).loop.position - 20_000) <= 1
    assert abs(drive(chain, 3).loop.position + 20_000) <= 1


async def test_a_start_that_the_leader_alone_has_received_damaged_is_not_sent_again(monkeypatch):
    chain = chain_of()
    leader = chain.modules[2]
    start = encode_packet(Packet(0x81, CommandCode.START_MOTION))
    damaged = []

    def hear_all(data, starts_at_s, byte_s):
        if data == start and not damaged:
            damaged.append(data)
            data = data[:-1] + b"\x00"
        for number, value in enumerate(data):
            leader.hear(value, starts_at_s + (number + 1) * byte_s)

    monkeypatch.setattr(leader, "hear_all", hear_all)
    async with bare_network(chain, AXES, line=LED_PAIR) as line:
        await up(line)
        before = len(line.sent())

        with pytest.raises(OutcomeUnknown, match="all were commanded to stop"):
            await line.network.start_group({"a2": THERE, "a3": BACK}, wanted)
        started = [packet for packet in line.sent(before) if packet.command is CommandCode.START_MOTION]
        await asyncio.sleep(3)

    assert damaged
    assert len(started) == 1
    assert max(abs(drive(chain, address).loop.position) for address in (2, 3)) < 100


def is_leader(packet):
    return packet.command is CommandCode.SET_ADDRESS and not packet.data[1] & 0x80


async def test_set_baud_goes_to_groups_while_they_have_no_leader():
    async with bare_network(chain_of(), AXES, line=LED_PAIR) as line:
        await up(line, power=False)
        sent = line.sent()

    rate_changes = [at for at, packet in enumerate(sent) if packet.command is CommandCode.SET_BAUD_RATE]
    leaders = [at for at, packet in enumerate(sent) if is_leader(packet)]
    assert len(rate_changes) >= 2
    assert leaders
    assert min(leaders) > max(rate_changes)


async def test_a_leader_keeps_leading_while_another_drive_is_brought_back():
    chain = chain_of()
    async with bare_network(chain, AXES, line=LED_PAIR) as line:
        await up(line, power=False)
        now_s = asyncio.get_running_loop().time()
        chain.modules[3].power(on=False, at_s=now_s)
        chain.modules[3].power(on=True, at_s=now_s)
        before = len(line.sent())
        for _ in range(3):
            with contextlib.suppress(BusError):
                await line.network.axes["a4"].stop(StopMode.OFF)
        await line.network.rejoin(lambda _: None)
        sent = line.sent(before)

    assert [module.address for module in chain.modules] == [1, 2, 3, 4]
    assert chain.modules[2].leader
    assert not [packet for packet in sent if packet.command is CommandCode.SET_ADDRESS and packet.address == 3]


async def test_a_leader_that_did_not_hear_that_it_leads_is_told_before_its_group_starts(monkeypatch):
    chain = chain_of()
    leader, lost = chain.modules[2], []

    def hear_all(data, starts_at_s, byte_s):
        packet = Packet(data[1], CommandCode(data[2] & 0x0F), data[3:-1]) if data[0] == 0xAA else None
        if lost or (packet and packet.address == 3 and is_leader(packet)):
            lost.append(data)
            return
        for number, value in enumerate(data):
            leader.hear(value, starts_at_s + (number + 1) * byte_s)

    async with bare_network(chain, AXES, line=LED_PAIR) as line:
        await up(line)
        now_s = asyncio.get_running_loop().time()
        leader.power(on=False, at_s=now_s)
        leader.power(on=True, at_s=now_s)
        for _ in range(3):
            with contextlib.suppress(BusError):
                await line.network.axes["a3"].stop(StopMode.OFF)
        monkeypatch.setattr(leader, "hear_all", hear_all)
        await line.network.rejoin(lambda _: None)
        monkeypatch.undo()  # it is heard again
        await line.network.rejoin(lambda _: None)
        assert lost
        assert not line.network.incomplete()
        assert not leader.leader
        await line.network.axes["a3"].power(on=True)

        await line.network.start_group({"a2": THERE, "a3": BACK}, wanted)
        await asyncio.sleep(3)

    assert leader.leader
    assert [drive(chain, address).loop.position // 100 for address in (2, 3)] == [200, -200]


@pytest.mark.parametrize("baud", [9600, 19_200, 115_200, 230_400])
def test_group_packets_are_a_servo_cycle_apart_on_the_wire(baud):
    byte_s = 10 / baud

    piece = spaced([b"first", b"second"], byte_s)

    gap = piece.removeprefix(b"first").removesuffix(b"second")
    assert set(gap) == {0}
    assert len(gap) * byte_s >= 0.51e-3


async def test_the_whole_line_is_a_group_when_none_is_configured():
    chain = chain_of()
    async with bare_network(chain, AXES) as line:
        await up(line)

        await line.network.start_group(dict.fromkeys(line.network.axes, THERE), wanted)
        await asyncio.sleep(0.3)
        positions = [drive(chain, address).loop.position for address in (1, 2, 3, 4)]

    assert min(positions) > 1000
    assert max(positions) - min(positions) < 50


async def test_nothing_starts_when_one_load_fails():
    chain = chain_of()
    async with bare_network(chain, AXES, line=PAIR) as line:
        await up(line)

        with pytest.raises(ValueOutOfRange):
            await line.network.start_group({"a2": THERE, "a3": CountsMotion(1 << 40, 1.0, 1.0)}, wanted)
        await asyncio.sleep(1)

        assert CommandCode.START_MOTION not in {packet.command for packet in line.sent()}
    assert drive(chain, 2).loop.position == 0


async def test_nothing_starts_when_a_loop_is_open():
    chain = chain_of()
    async with bare_network(chain, AXES, line=PAIR) as line:
        await up(line, power=False)
        await line.network.axes["a2"].power(on=True)

        with pytest.raises(DriveFault, match="a3"):
            await line.network.start_group({"a2": THERE, "a3": BACK}, wanted)

        assert CommandCode.START_MOTION not in {packet.command for packet in line.sent()}


async def test_a_group_that_did_not_hear_its_start_is_stopped_and_reported():
    chain = chain_of(faults=FaultPlan((LineFault(FaultKind.REQUEST_LOST, 1.0, from_s=20.0, until_s=20.5),), 1))
    loop = asyncio.get_running_loop()
    async with bare_network(chain, AXES, line=PAIR) as line:
        await up(line)
        real_start = line.network._groups._start_motion

        async def start_unheard(group):
            await asyncio.sleep(20.1 - loop.time())
            await real_start(group)
            await asyncio.sleep(20.6 - loop.time())

        line.network._groups._start_motion = start_unheard
        with pytest.raises(OutcomeUnknown, match="did not start"):
            await line.network.start_group({"a2": THERE, "a3": BACK}, wanted)
        commands = [packet.command for packet in line.sent()]

    assert commands.count(CommandCode.START_MOTION) == 1
    assert commands.index(CommandCode.STOP_MOTOR, commands.index(CommandCode.START_MOTION)) > 0
    assert [drive(chain, address).loop.position for address in (2, 3)] == [0, 0]


async def test_an_adopted_line_is_regrouped_before_its_groups_are_used():
    chain = chain_of()
    async with bare_network(chain, AXES) as line:
        await up(line)
    async with bare_network(chain, AXES, line=LineSpec(start=StartPolicy.ADOPT, groups=PAIR.groups)) as line:
        report = await line.network.bring_up()
        untouched = [module.group for module in chain.modules]

        await line.network.start_group({"a2": THERE, "a3": BACK}, wanted)
        await asyncio.sleep(3)

    assert not report.reset
    assert untouched == [0xFF] * 4
    assert [module.group for module in chain.modules] == [0xFF, 0x81, 0x81, 0xFF]
    assert [module.address for module in chain.modules] == [1, 2, 3, 4]
    assert [drive(chain, address).loop.position // 1000 for address in (1, 4)] == [0, 0]
    assert abs(drive(chain, 2).loop.position - 20_000) <= 1


async def test_a_group_of_an_open_loop_is_not_stopped_together():
    chain = chain_of()
    async with bare_network(chain, AXES, line=PAIR) as line:
        await up(line, power=False)
        await line.network.axes["a2"].power(on=True)
        before = len(line.sent())

        await line.network.stop_together(StopMode.SMOOTH, frozenset({"a2"}))

        assert line.sent(before) == []
    assert not drive(chain, 3).loop.servo_on


async def test_a_snapshot_shows_one_instant_of_moving_axes():
    chain = chain_of()
    async with bare_network(chain, AXES, line=LineSpec(snapshot=True)) as line:
        await up(line)
        await line.network.start_group(dict.fromkeys(line.network.axes, THERE), wanted)
        await asyncio.sleep(0.5)

        frozen = await line.network.snapshot(wanted)

    assert frozen.until_s - frozen.from_s < 0.004
    frozen = frozen.counts
    assert frozen.keys() == {"a1", "a2", "a3", "a4"}
    assert min(frozen.values()) > 5000
    # at 20000 counts a second two servo cycles are 20 counts; five packets in between would be hundreds
    assert max(frozen.values()) - min(frozen.values()) < 40


async def test_no_snapshot_unless_configured():
    chain = chain_of()
    async with bare_network(chain, AXES) as line:
        await up(line)

        with pytest.raises(NotSupported, match="not configured"):
            await line.network.snapshot(wanted)


async def test_what_needs_a_packet_to_everybody_says_why_it_does_not_work_on_a_line_that_was_taken_over():
    chain, whole = chain_of(), dict.fromkeys(("a1", "a2", "a3", "a4"), THERE)
    async with bare_network(chain, AXES, line=LineSpec(snapshot=True)) as line:
        await up(line)
        await line.network.snapshot(wanted)
        await line.network.bring_up()  # as after a gap of the line
        refusals = []
        for refused in (line.network.snapshot(wanted), line.network.start_group(whole, wanted)):
            with pytest.raises(NotSupported, match="the line was taken over") as raised:
                await refused
            refusals.append(raised.value.remedy)
    grouped = LineSpec(snapshot=True, start=StartPolicy.ADOPT, groups=(GroupConfig(name="all", axes=tuple(whole)),))
    async with bare_network(chain, AXES, line=grouped) as line:
        await line.network.bring_up()
        await line.network.snapshot(wanted)
        await line.network.start_group(whole, wanted)

    axes = ("all its axes", "these axes")
    assert refusals == [f'put {each} into a [[bus.group]], or restart the daemon with start = "reset"' for each in axes]


async def test_no_snapshot_while_a_homing_runs():
    chain = chain_of()
    async with bare_network(chain, AXES, line=LineSpec(snapshot=True)) as line:
        await up(line)
        await line.network.axes["a2"].load(CountsMotion(None, 100.0, 1000.0), home=HomeCapture(HomeMethod.INDEX))

        with pytest.raises(WrongState, match="a2 is homing"):
            await line.network.snapshot(wanted)

        assert CommandCode.SAVE_CURRENT_POSITION_AS_HOME not in {packet.command for packet in line.sent()}


async def test_the_stop_of_a_rig_begins_with_one_packet_for_all_its_drives():
    chain = build_chain(ChainSpec(tuple(ModuleSpec(name) for name in ("ls182ap", "ls182ap") + ("picservo-v4",) * 2)))
    async with rig_on(chain, simulated_config()) as rig:
        await rig.power_on("x", "y", "z", "c")
        await rig.client.command("x", MoveAbsolute(position=50.0))
        await rig.client.command("c", MoveAbsolute(position=500.0))
        await asyncio.sleep(0.5)
        before = len(rig.sent)

        reply = await rig.client.stop()
        stops = [packet.address for packet in rig.sent[before:] if packet.command is CommandCode.STOP_MOTOR]
        states = [await rig.until(name, lambda state: state.state is AxisState.STANDSTILL) for name in ("x", "c")]

    assert set(reply.confirmed) == {"x", "y", "z", "c"}
    assert stops[0] == 0xFF
    assert sorted(stops[1:]) == [1, 2, 3, 4]
    assert all(state.stop_latched for state in states)


async def test_the_stop_of_a_rig_closes_no_open_loop():
    chain = build_chain(ChainSpec(tuple(ModuleSpec(name) for name in ("ls182ap", "ls182ap") + ("picservo-v4",) * 2)))
    async with rig_on(chain, simulated_config()) as rig:
        await rig.power_on("x", "z")

        before = len(rig.sent)
        await rig.client.stop()
        stops = [packet for packet in rig.sent[before:] if packet.command is CommandCode.STOP_MOTOR]

    assert {packet.address for packet in stops} == {1, 2, 3, 4}
    assert [packet.data for packet in stops if packet.address in (2, 4)] == [bytes([StopControl.MOTOR_OFF])] * 2
    assert [drive(chain, address).loop.servo_on for address in (1, 2, 3, 4)] == [True, False, True, False]


@pytest.mark.parametrize(
    ("addition", "complaint"),
    [
        ('group = [{ name = "g", axes = ["x", "nobody"] }]', "no axis 'nobody' on this bus"),
        ('group = [{ name = "g", axes = ["x", "y"], leader = "z" }]', "leader 'z' is not one of x, y"),
        ('group = [{ name = "g", axes = ["x", "y"] }, { name = "h", axes = ["y", "z"] }]', "'y' is given more than"),
        ("baud = 230400", "ls-182ap at address 1 reaches 125000 at most"),
        (
            'baud = 125000\nmodule = [{ address = 5, model = "ls-231" }]',
            "of ls-231 at .* only 9600, 19200, 57600, 115200",
        ),
        ('module = [{ address = 4, model = "pic-io" }]', "address 4 of a module is given twice"),
        ('module = [{ address = 5, model = "toaster" }]', "no such module"),
    ],
)
def test_impossible_lines_are_refused_before_anything_is_opened(tmp_path, addition, complaint):
    rate = "baud = 115200"
    instead = addition if addition.startswith("baud") else f"{rate}\n{addition}"
    file = tmp_path / "rig.toml"
    file.write_text(SIMULATED.read_text().replace(rate, instead, 1))

    with pytest.raises(ConfigError, match=complaint):
        load_config(file)
