"""Two families in one daemon, on the jumping clock."""

import asyncio
import tomllib
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path

import pytest

from ldcnd.client.events import latest_events
from ldcnd.client.overview import overview
from ldcnd.config.interlocks import Requirement
from ldcnd.config.rig import RigConfig, load_config
from ldcnd.contract.commands import MoveVelocity, Power, Reset
from ldcnd.contract.condition import Alarm, Place
from ldcnd.contract.errors import DataRefused, EepromBudgetSpent, LdcndError, NotSupported, ValueOutOfRange
from ldcnd.contract.leases import Acquire
from ldcnd.contract.parameters import (
    AlarmReport,
    ClearCounter,
    CounterName,
    CounterReply,
    ListParameters,
    Memory,
    ParameterDump,
    ParameterList,
    ParameterReply,
    ReadAlarms,
    ReadAllParameters,
    ReadParameter,
    WriteParameter,
)
from ldcnd.contract.rig_commands import SetSpeedOverride
from ldcnd.contract.samples import (
    AxisState,
    FaultSample,
    LinkState,
    MonitorName,
    Moving,
    PositionSample,
    Quality,
    StateSample,
    TelemetryItem,
    VelocitySample,
)
from ldcnd.daemon.requirements import lack_of_axis
from ldcnd.drives.smartstep.parameters import PN100
from ldcnd.line.exchange import Lane
from ldcnd.line.flight_recorder import WireEvent
from ldcnd.sim.smartstep.cable import smartstep_chain
from ldcnd.sim.smartstep.unit import SimulatedUnit
from ldcnd.sim.smartstep.variant import SimulatedVariant
from tests.support.rig import RunningRig, running_rig
from tests.support.smartstep_line import LosingUnit, simulated

MIXED = Path(__file__).parents[2] / "config" / "mixed.toml"


@asynccontextmanager
async def mixed_rig(state_dir: Path, units: list[SimulatedUnit]) -> AsyncIterator[RunningRig]:
    config = load_config(MIXED).model_copy(update={"state_dir": state_dir})
    async with running_rig(config, chains={"steps": smartstep_chain(units)}) as rig:
        yield rig


@asynccontextmanager
async def mixed_rig_at(
    rate_hz: float, state_dir: Path, units: list[SimulatedUnit], **others_hz: float
) -> AsyncIterator[RunningRig]:
    """Run the rig with all items of its first SmartStep at one rate, but for those that are named."""
    document = tomllib.loads(MIXED.read_text(encoding="utf-8")) | {"state_dir": str(state_dir)}
    document["bus"][1]["axis"][0]["rates"] = dict.fromkeys(("position", "velocity", "state"), rate_hz) | others_hz
    async with running_rig(RigConfig.model_validate(document), chains={"steps": smartstep_chain(units)}) as rig:
        yield rig


def lack(rig: RunningRig, age_s: float, **required: object) -> str:
    """Say why an interlock would not have it of `feed`; empty when it would."""
    requirement = Requirement.model_validate({"axis": "feed"} | required)
    now_s = asyncio.get_running_loop().time()
    found = lack_of_axis(rig.daemon.rig.axes["feed"], requirement, now_s, age_s, lambda _: False)
    return found.text if found else ""


def two_drives() -> list[SimulatedUnit]:
    units = [simulated(1), simulated(2)]
    units[0].drive.set_run(0.0, on=True)
    units[0].drive.set_pulse_rate(200.0, 0.0)
    return units


@pytest.mark.long
async def test_a_smartstep_publishes_the_same_shapes_as_the_other_family(tmp_path):
    async with mixed_rig(tmp_path, two_drives()) as rig:
        state = await rig.until("feed", lambda state: state.moving is Moving.YES)
        await asyncio.sleep(10.0)
        position = await rig.client.last("feed", TelemetryItem.POSITION)
        velocity = await rig.client.last("feed", TelemetryItem.VELOCITY)
        fault = await rig.client.last("feed", TelemetryItem.FAULT)
        at_rest = await rig.client.state("spool")

    assert (state.state, state.enabled, state.link) == (AxisState.DISCRETE_MOTION, True, LinkState.UP)
    assert isinstance(position, PositionSample)
    assert position.value == pytest.approx(position.counts / 8000)
    assert isinstance(velocity, VelocitySample)
    assert velocity.value == pytest.approx(0.1, abs=0.01)
    assert isinstance(fault, FaultSample)
    assert fault.active == ()
    assert (at_rest.state, at_rest.moving) == (AxisState.DISABLED, Moving.NO)


@pytest.mark.long
async def test_monitors_are_published_below_the_axis(tmp_path):
    async with mixed_rig(tmp_path, two_drives()) as rig:
        await asyncio.sleep(12.0)
        monitors = await rig.client.monitors("feed")
        infos = {axis.axis: axis for axis in await rig.client.axes()}

    assert monitors[MonitorName.TORQUE_REFERENCE].value == 5
    assert monitors[MonitorName.TORQUE_REFERENCE].unit == "%"
    assert monitors[MonitorName.INPUT_SIGNALS].high == ("RESET",)
    assert monitors[MonitorName.POSITION_DEVIATION].quality is Quality.GOOD
    assert set(infos["feed"].monitors) == {name.value for name in monitors}


@pytest.mark.long
async def test_monitors_of_a_drive_that_has_fallen_silent_are_no_measurements_any_more(tmp_path):
    units = two_drives()
    async with mixed_rig(tmp_path, units) as rig:
        await asyncio.sleep(12.0)
        units[0].power_off(asyncio.get_running_loop().time())
        await rig.until("feed", lambda state: state.link is LinkState.DOWN)
        await asyncio.sleep(1.0)
        monitors = await rig.client.monitors("feed")

    assert {each.quality for each in monitors.values()} == {Quality.BAD}


async def test_an_alarm_is_shown_and_goes_with_the_reset_input(tmp_path):
    units = two_drives()
    async with mixed_rig(tmp_path, units) as rig:
        await rig.until("feed", lambda state: state.enabled)
        loop = asyncio.get_running_loop()
        units[0].drive.provoke(0x0070, loop.time())
        stopped = await rig.until("feed", lambda state: state.state is AxisState.ERROR_STOP)
        fault = await rig.client.last("feed", TelemetryItem.FAULT)
        report = await rig.client.command("feed", ReadAlarms())
        units[0].drive.press_reset(loop.time())
        again = await rig.until("feed", lambda state: state.state is not AxisState.ERROR_STOP)
        cleared = await rig.client.last("feed", TelemetryItem.FAULT)

    assert not stopped.enabled
    assert [entry.code for entry in fault.active] == ["alarm_0070"]
    assert isinstance(report, AlarmReport)
    assert (report.present.text, report.history[0].code, len(report.history)) == ("Overload", 0x0070, 10)
    assert again.enabled
    assert (cleared.active, cleared.first) == ((), None)


@pytest.mark.parametrize(
    "command",
    [
        Power(on=True),
        MoveVelocity(velocity=1.0),
        Reset(),
    ],
)
@pytest.mark.sweep(2)
async def test_motion_enable_and_reset_are_refused_and_not_offered(tmp_path, command):
    async with mixed_rig(tmp_path, two_drives()) as rig:
        await rig.until("feed", lambda state: state.enabled)
        with pytest.raises(NotSupported):
            await rig.client.command("feed", command)
        infos = {axis.axis: axis for axis in await rig.client.axes()}

    assert command.verb not in infos["feed"].capabilities
    assert "write_parameter" in infos["feed"].capabilities
    assert "write_parameter" not in infos["x"].capabilities


async def test_parameters_are_refused_on_a_drive_without_them(tmp_path):
    async with mixed_rig(tmp_path, two_drives()) as rig:
        with pytest.raises(NotSupported):
            await rig.client.command("x", ReadParameter(parameter="Pn100"))


async def test_parameters_are_listed_read_written_and_dumped(tmp_path):
    units = two_drives()
    async with mixed_rig(tmp_path, units) as rig:
        listed = await rig.client.command("feed", ListParameters())
        await rig.client.command("feed", WriteParameter(parameter="Pn100", value=120))
        saved = await rig.client.command("feed", WriteParameter(parameter="Pn102", value=50, memory=Memory.EEPROM))
        said = [each.reason for each in await latest_events(rig.client, 100, "feed") if each.status == "done"]
        dump = await rig.client.command("feed", ReadAllParameters(), timeout_s=60)

    assert isinstance(listed, ParameterList)
    assert len(listed.parameters) == 22
    assert isinstance(saved, ParameterReply)
    assert (saved.value.stored, saved.value.eeprom_writes, saved.written) == (50, 1, True)
    assert isinstance(dump, ParameterDump)
    assert {value.parameter for value in dump.values if value.differs} == {"Pn100", "Pn102"}
    assert units[0].drive.memory.active(PN100) == 120
    assert units[1].drive.memory.active(PN100) == 80
    assert (tmp_path / "eeprom-writes.json").exists()
    assert said == ["parameter Pn100, value 120, memory ram", "parameter Pn102, value 50, memory eeprom"]


@pytest.mark.parametrize(
    ("write", "error"),
    [
        (WriteParameter(parameter="Pn100", value=3000), DataRefused),
        (WriteParameter(parameter="Pn999", value=1), ValueOutOfRange),
    ],
)
async def test_a_refused_write_comes_back_as_its_own_error(tmp_path, write, error):
    async with mixed_rig(tmp_path, two_drives()) as rig:
        with pytest.raises(LdcndError) as refusal:
            await rig.client.command("feed", write)

    assert type(refusal.value) is error


async def test_the_same_command_id_never_writes_eeprom_twice(tmp_path):
    units = two_drives()
    async with mixed_rig(tmp_path, units) as rig:
        for value in (101, 101):
            request = WriteParameter(parameter="Pn100", value=value, memory=Memory.EEPROM, command_id="save-1")
            await rig.client.command("feed", request)

    assert units[0].drive.memory.writes[PN100.number] == 1


async def test_the_budget_outlives_the_daemon(tmp_path):
    (tmp_path / "eeprom-writes.json").write_text('{"feed": {"Pn100": 9000}}')
    async with mixed_rig(tmp_path, two_drives()) as rig:
        with pytest.raises(EepromBudgetSpent):
            await rig.client.command("feed", WriteParameter(parameter="Pn100", value=1, memory=Memory.EEPROM))


async def test_a_cleared_counter_is_the_new_position(tmp_path):
    units = two_drives()
    async with mixed_rig(tmp_path, units) as rig:
        await rig.until("feed", lambda state: state.moving is Moving.YES)
        units[0].drive.set_pulse_rate(0.0, asyncio.get_running_loop().time())
        await rig.until("feed", lambda state: state.moving is Moving.NO)
        reply = await rig.client.command("feed", ClearCounter(counter=CounterName.FEEDBACK))
        await asyncio.sleep(3.0)
        position = await rig.client.last("feed", TelemetryItem.POSITION)

    assert isinstance(reply, CounterReply)
    assert reply.value == 0
    assert position.counts == 0


async def test_a_reply_of_a_smartstep_that_is_lost_makes_its_place_uncertain_and_nothing_else_unknown(tmp_path):
    armed: list[str] = []
    losing = LosingUnit(1, lambda _, sent: armed.pop() if armed and sent.startswith(b"W1") else None)
    losing.drive.set_run(0.0, on=True)
    losing.drive.set_pulse_rate(200.0, 0.0)
    seen = []
    async with mixed_rig_at(2.0, tmp_path, [losing, simulated(2)], position=0.2) as rig:
        await rig.until("feed", lambda state: state.moving is Moving.YES)
        armed.append("reply")
        await rig.until("feed", lambda state: state.link is LinkState.DEGRADED)
        await rig.until("feed", lambda state: state.link is LinkState.UP)
        while not seen or (seen[-1].seen.place is Place.UNCERTAIN and len(seen) < 100):
            seen += [now for now in await overview(rig.client) if now.info.axis == "feed"]
            await asyncio.sleep(0.1)

    *uncertain, last = seen
    assert {(each.seen.place, each.condition.alarm) for each in uncertain} == {(Place.UNCERTAIN, Alarm.MINOR)}
    assert {(each.seen.state, each.seen.moving, each.seen.link) for each in seen} == {
        (AxisState.DISCRETE_MOTION, Moving.YES, LinkState.UP)
    }
    assert {each.seen.velocity is None for each in seen} == {False}
    assert last.seen.place is Place.KNOWN  # it was read in its turn


async def test_a_smartstep_whose_position_is_not_asked_for_is_seen_to_stand_within_what_clients_wait(tmp_path):
    units = two_drives()
    async with mixed_rig_at(1.0, tmp_path, units, position=0.0) as rig:
        await rig.until("feed", lambda state: state.moving is Moving.YES)
        loop = asyncio.get_running_loop()
        units[0].drive.set_pulse_rate(0.0, loop.time())
        began_s = loop.time()
        await rig.until("feed", lambda state: state.moving is Moving.NO)
        took_s = loop.time() - began_s

    assert took_s < 4.0


async def test_a_smartstep_that_creeps_below_its_speed_feedback_neither_stands_nor_is_slow(tmp_path):
    units = two_drives()
    units[0].drive.set_pulse_rate(12.0, 0.0)  # 0.36 r/min, which reads 0
    async with mixed_rig_at(1.0, tmp_path, units) as rig:
        creeping = await rig.until("feed", lambda state: state.moving is Moving.YES)
        await asyncio.sleep(5.0)
        velocity = await rig.client.last("feed", TelemetryItem.VELOCITY)
        lacks = lack(rig, 2.0, standstill=True), lack(rig, 2.0, below=0.001)
        units[0].drive.set_pulse_rate(0.0, asyncio.get_running_loop().time())
        standing = await rig.until("feed", lambda state: state.moving is Moving.NO)
        met = lack(rig, 2.0, standstill=True), lack(rig, 2.0, below=0.001)

    assert velocity.value == 0.0
    assert (creeping.state, standing.state) == (AxisState.DISCRETE_MOTION, AxisState.STANDSTILL)
    assert lacks[0].startswith("does not stand")
    assert lacks[1].startswith("may be at")
    assert met == ("", "")


@pytest.mark.long
async def test_no_word_of_a_smartstep_that_is_older_than_an_interlock_allows_proves_that_it_stands(tmp_path):
    units = [simulated(number, SimulatedVariant(response_s=0.15)) for number in (1, 2)]
    units[0].drive.set_run(0.0, on=True)
    loop, allowed_s = asyncio.get_running_loop(), []
    # the line carries a third of these polls: the speed comes every two to three seconds, some word all the time
    async with mixed_rig_at(2.0, tmp_path, units) as rig:
        bus = rig.daemon.rig.buses[1].bus

        def speeds_asked() -> int:
            return sum(each.event is WireEvent.SENT and each.data[:7] == b"W108000" for each in bus.wire_log.records())

        await rig.until("feed", lambda state: state.moving is Moving.NO)
        before = speeds_asked()
        while speeds_asked() == before:
            await asyncio.sleep(0.02)
        await asyncio.sleep(0.03)  # it has read that word: 0
        began_s = loop.time()
        units[0].drive.set_pulse_rate(10_000.0, began_s)
        while (since_s := loop.time() - began_s) < 4.0:
            if not lack(rig, 1.05, standstill=True):
                allowed_s.append(since_s)
            await asyncio.sleep(0.02)

    assert max(allowed_s, default=0.0) < 1.1


@pytest.mark.long
async def test_an_alarm_that_a_drive_enters_in_its_history_is_an_event(tmp_path):
    units = two_drives()
    async with mixed_rig(tmp_path, units) as rig:
        await rig.until("feed", lambda state: state.enabled)
        await asyncio.sleep(12.0)  # its history was read: what stands there is no news
        units[0].drive.provoke(0x0051, asyncio.get_running_loop().time())
        await asyncio.sleep(12.0)
        events = await latest_events(rig.client, 100, "feed")

    (alarm,) = [event for event in events if event.verb == "alarm_history"]
    assert (alarm.code, alarm.status, alarm.client) == ("alarm_0051", "failed", None)
    assert alarm.reason == "A.51: Overspeed: new in the alarm history of the drive"


@pytest.mark.long
async def test_a_stop_on_the_other_line_is_not_delayed(tmp_path):
    async def longest_stop_s(*, busy: bool) -> float:
        async with mixed_rig(tmp_path, two_drives()) as rig:
            await rig.until("x", lambda state: state.link is LinkState.UP)
            line = rig.daemon.rig.buses[0].bus
            async with asyncio.TaskGroup() as group:
                if busy:
                    for axis in ("feed", "spool"):
                        dump = rig.client.command(axis, ReadAllParameters(), 60.0)
                        group.create_task(dump, name=f"dump {axis}")
                for _ in range(20):
                    await asyncio.sleep(0.05)
                    await rig.client.stop("x")
            return line.statistics.latency[Lane.STOP].longest_s

    # either may meet a poll of its own line on the wire, which is waited for
    assert await longest_stop_s(busy=True) <= await longest_stop_s(busy=False) + 2e-3


async def test_a_stop_says_which_drive_that_turns_it_could_not_stop_and_which_stands(tmp_path):
    async with mixed_rig(tmp_path, two_drives()) as rig:
        await rig.until("feed", lambda state: state.moving is Moving.YES)
        await rig.until("spool", lambda state: state.moving is Moving.NO)
        reply = await rig.client.stop()
        state = await rig.client.state("feed")

    assert reply.confirmed == ("x",)
    assert set(reply.axes) == {"x", "feed", "spool"}
    assert reply.unstoppable == ("feed", "spool")
    assert reply.shortfall == (
        "NOT stopped: feed; the drive takes no stop over its line and has no latch. Use the machine's emergency stop."
    )
    assert (reply.standing, reply.unreached) == (("spool",), "No stop reaches spool: no motion at the last reading.")
    assert isinstance(state, StateSample)
    assert not state.stop_latched


async def test_who_controls_a_drive_that_takes_no_motions_is_not_asked_for_the_speed_of_the_others(tmp_path):
    async with mixed_rig(tmp_path, two_drives()) as rig:
        await rig.client.ask(Acquire(client="bob", axes=("feed",), lease_s=60))
        held = await rig.client.ask(Acquire(client="ann", axes=("x",), lease_s=60))
        await rig.client.ask(SetSpeedOverride(percent=25))
        raised = await rig.client.ask(SetSpeedOverride(percent=100, leases=(held.lease,)))

    assert raised.percent == 100


async def test_a_drive_that_loses_power_is_down_and_comes_back_by_itself(tmp_path):
    units = two_drives()
    async with mixed_rig(tmp_path, units) as rig:
        await rig.until("feed", lambda state: state.enabled)
        await rig.until("spool", lambda state: state.link is LinkState.UP)
        units[0].power_off(asyncio.get_running_loop().time())
        await rig.until("feed", lambda state: state.link is LinkState.DOWN)
        neighbour = await rig.client.state("spool")
        units[0].power_on(asyncio.get_running_loop().time())
        back = await rig.until("feed", lambda state: state.link is LinkState.UP and state.enabled)

    assert neighbour.link is LinkState.UP
    assert back.state is AxisState.DISCRETE_MOTION


async def drive_changes(rig: RunningRig) -> list[tuple[str | None, str | None]]:
    events = await latest_events(rig.client, 50, "feed")
    return [(event.code, event.reason) for event in events if event.verb == "drive_changed"]


@pytest.mark.promise("foreign-program-found")
@pytest.mark.long
async def test_a_parameter_that_another_program_has_changed_is_found_within_a_minute(tmp_path):
    units = two_drives()
    async with mixed_rig(tmp_path, units) as rig:
        await asyncio.sleep(60.0)
        quiet = await drive_changes(rig)
        before = units[0].drive.memory.active(PN100)

        units[0].drive.memory.write(PN100.ram_address, before + 7)
        await asyncio.sleep(55.0)
        fault, said = await rig.client.last("feed", TelemetryItem.FAULT), await drive_changes(rig)
        held = units[0].drive.memory.active(PN100)
        await rig.client.command("feed", WriteParameter(parameter="Pn100", value=before, memory=Memory.RAM))
        await asyncio.sleep(3.0)
        cleared = await rig.client.last("feed", TelemetryItem.FAULT)

    assert quiet == []
    assert said == [("drive_changed", f"Pn100 is {before + 7} and was {before}")]
    assert isinstance(fault, FaultSample)
    assert [(each.code, each.source, each.stops) for each in fault.active] == [("drive_changed", "daemon", False)]
    assert held == before + 7
    assert isinstance(cleared, FaultSample)
    assert cleared.active == ()


@pytest.mark.long
async def test_a_smartstep_that_was_reset_has_lost_what_was_written_to_its_ram_and_that_is_said(tmp_path):
    units = two_drives()
    async with mixed_rig(tmp_path, units) as rig:
        stored = units[0].drive.memory.stored(PN100)
        await rig.client.command("feed", WriteParameter(parameter="Pn100", value=stored + 5, memory=Memory.RAM))
        await asyncio.sleep(60.0)

        units[0].drive.memory.power_on()
        await asyncio.sleep(55.0)
        said = await drive_changes(rig)

    assert said == [("drive_changed", f"Pn100 is {stored} and was {stored + 5}")]
