"""Bring-up and polling of a SmartStep line: nobody is written to, nobody starves."""

import asyncio
import itertools
from contextlib import nullcontext

import pytest

from ldcnd.contract.errors import NetworkMismatch, OutcomeUnknown, WrongState
from ldcnd.contract.parameters import CounterName
from ldcnd.contract.samples import MonitorName, TelemetryItem
from ldcnd.drives.driver import AxisReading, Fault, Moves, ReadingListeners
from ldcnd.drives.parameter_access import MonitorValue
from ldcnd.drives.smartstep.addresses import OperatingMode, Register
from ldcnd.drives.smartstep.commands import reference
from ldcnd.drives.smartstep.monitors import FEEDBACK_COUNTER_LOW, INPUT_SIGNALS, OUTPUT_SIGNALS, SPEED_FEEDBACK
from ldcnd.drives.smartstep.network import SmartStepPort
from ldcnd.drives.smartstep.packet import add_parity, decode_command
from ldcnd.drives.smartstep.parameters import PN000, PN100
from ldcnd.drives.smartstep.poller import Basic, Listeners, UnitPoller
from ldcnd.drives.smartstep.profiles import Framing, SmartStepProfile, Wiring
from ldcnd.line.exchange import Timing
from ldcnd.line.flight_recorder import WireEvent
from ldcnd.sim.smartstep.variant import SimulatedVariant
from tests.support.recording_receiver import RecordingReceiver
from tests.support.scripted_line import ScriptedLine
from tests.support.smartstep_line import SmartStepLine, simulated, smartstep_line

STATE_AND_REST = (
    Register.PRESENT_ALARM,
    INPUT_SIGNALS.address,
    OUTPUT_SIGNALS.address,
    SPEED_FEEDBACK.address,
)
"""Words that tell of a drive what its position does not."""


async def test_each_packet_waits_until_the_line_has_been_quiet():
    async with smartstep_line([simulated(1)], profile=SmartStepProfile(quiet_s=0.02)) as line:
        for _ in range(5):
            await line.bus.execute(reference(1, PN100.ram_address))
        records = line.bus.wire_log.records()

    exchange_s = 28 * 10 / 9600 + 0.01
    assert records[-1].at_s == pytest.approx(5 * exchange_s + 5 * 0.02, abs=1e-3)


async def test_a_closed_port_sends_nothing_that_waited_for_silence_and_passes_nothing_on():
    line, receiver = ScriptedLine(lambda _: ()), RecordingReceiver()
    port = SmartStepPort(line, Framing.SEVEN_EVEN, 0.02)
    port.attach(receiver)
    port.data_received(b"before")
    port.write(b"W")

    await port.close()
    port.data_received(b"after")
    await asyncio.sleep(1.0)

    assert line.history == ["close"]
    assert receiver.data == b"before"


async def test_a_port_gives_what_its_adapter_has_held_back():
    line, receiver = ScriptedLine(lambda _: ()), RecordingReceiver()
    port = SmartStepPort(line, Framing.SEVEN_EVEN, 0.02)
    port.attach(receiver)
    line.holds_back = True
    port.expect(5)
    line.say(b"ab")
    assert receiver.data == b""

    port.collect()

    assert receiver.data == b"ab"


async def test_soft_parity_serves_a_port_of_eight_bits():
    profile = SmartStepProfile(framing=Framing.SOFT_PARITY)
    async with smartstep_line([simulated(1)], profile=profile, framing=Framing.SOFT_PARITY) as line:
        value = await line.bus.execute(reference(1, PN100.ram_address))

    assert value == 80
    assert add_parity(b"W") != b"W"


class Heard:
    """What a poller has told."""

    def __init__(self) -> None:
        self.readings: list[tuple[AxisReading, TelemetryItem, Timing]] = []
        self.monitors: list[MonitorValue] = []
        self.alarms: list[Fault] = []
        self.missed = 0

    def listen(self, line: SmartStepLine, name: str) -> None:
        def observed(reading: AxisReading, items: frozenset[TelemetryItem], timing: Timing) -> None:
            (item,) = items
            self.readings.append((reading, item, timing))

        def miss(_error: object) -> None:
            self.missed += 1

        now_s = asyncio.get_running_loop().time()
        listeners = ReadingListeners(observed, lambda value, _: self.monitors.append(value), miss, self.alarms.append)
        line.bus.add_poller(line.axis(name).own_poller(now_s, listeners))

    def last(self) -> AxisReading:
        return self.readings[-1][0]


def sent(line: SmartStepLine) -> list[bytes]:
    return [record.data for record in line.bus.wire_log.records() if record.event is WireEvent.SENT]


async def test_bring_up_only_reads():
    async with smartstep_line([simulated(1), simulated(2)]) as line:
        report = await line.network.bring_up()

    functions = {command.function for data in sent(line) if (command := decode_command(data))}
    assert functions == {0}
    assert report.reset is False
    assert report.identities["u2"] == "SmartStep R7D-APL or R7D-APH (version 0001H)"
    assert report.remarks == ()


async def test_a_silent_unit_is_remarked_upon_and_the_others_are_served():
    async with smartstep_line([simulated(1)], numbers=[1, 5]) as line:
        report = await line.network.bring_up()

    assert report.remarks == ("unit 5 (axis u5) does not answer",)
    assert set(report.identities) == {"u1"}


async def test_a_line_where_nobody_answers_is_not_up():
    async with smartstep_line([simulated(1)], numbers=[3]) as line:
        with pytest.raises(NetworkMismatch, match="none of"):
            await line.network.bring_up()


async def test_units_that_are_to_have_one_number_are_remarked_upon():
    drives = [simulated(1), simulated(2), simulated(4)]
    for drive in drives[:2]:
        drive.drive.memory.write(PN000.eeprom_address, 0x0300)
    drives[2].drive.memory.write(PN000.eeprom_address, 0x0200)
    async with smartstep_line(drives) as line:
        report = await line.network.bring_up()

    makes, later = "Pn000.2 makes it unit", "at its next power-on"
    assert report.remarks == (
        f"unit 1 (axis u1): {makes} 3 {later}",
        f"unit 2 (axis u2): {makes} 3 {later}, but unit number 3 is that of axis u1 from its next power-on on",
        f"unit 4 (axis u4): {makes} 2 {later}, but unit number 2 is that of axis u2",
    )


async def test_a_trace_that_was_left_armed_is_remarked_upon():
    drive = simulated(1)
    drive.drive.mode = OperatingMode.DATA_TRACE
    async with smartstep_line([drive]) as line:
        report = await line.network.bring_up()

    assert "2000H" in report.remarks[0]


async def test_a_line_on_which_a_drive_hears_itself_stays_down_and_nothing_more_is_asked():
    drive = simulated(1, SimulatedVariant(hears_itself=True))
    async with smartstep_line([drive], wiring=Wiring.TWO_WIRE) as line:
        with pytest.raises(NetworkMismatch, match="its own replies"):
            await line.network.bring_up()
        with pytest.raises(WrongState, match="its own replies"):
            await line.axis("u1").parameters.read("Pn109")

        assert line.axis("u1").words.self_hearing
    assert not any(data.startswith((b"W1020", b"W11")) for data in sent(line))


async def test_state_follows_run_alarm_and_speed():
    drive = simulated(1)
    heard = Heard()
    async with smartstep_line([drive]) as line:
        heard.listen(line, "u1")
        await asyncio.sleep(2.0)
        disabled = heard.last()
        drive.drive.set_run(asyncio.get_running_loop().time(), on=True)
        drive.drive.set_pulse_rate(500.0, asyncio.get_running_loop().time())
        await asyncio.sleep(3.0)
        moving = heard.last()
        drive.drive.provoke(0x0010, asyncio.get_running_loop().time())
        await asyncio.sleep(3.0)
        alarmed = heard.last()

    assert (disabled.enabled, disabled.faults) == (False, ())
    assert (moving.enabled, moving.profile_done) == (True, False)
    assert moving.velocity_counts_per_s == pytest.approx(2000.0, rel=0.1)
    assert moving.position_counts > 1000
    assert not alarmed.enabled
    assert [(fault.code, fault.stops) for fault in alarmed.faults] == [("alarm_0010", True)]


async def test_a_warning_does_not_disable():
    drive = simulated(1)
    drive.drive.set_run(0.0, on=True)
    drive.drive.provoke(0x0091, 0.0)
    heard = Heard()
    async with smartstep_line([drive]) as line:
        heard.listen(line, "u1")
        await asyncio.sleep(2.0)

    assert heard.last().enabled
    assert [fault.stops for fault in heard.last().faults] == [False]


async def test_position_is_right_while_the_counter_runs_through_a_boundary():
    drive = simulated(1)
    drive.drive.set_run(0.0, on=True)
    drive.drive.set_pulse_rate(40_000.0, 0.0)
    heard = Heard()
    async with smartstep_line([drive]) as line:
        heard.listen(line, "u1")
        await asyncio.sleep(20.0)

    positions = [
        (timing.received_at_s, reading.position_counts)
        for reading, item, timing in heard.readings
        if item is TelemetryItem.POSITION
    ]
    speed = 40_000 * 4
    assert len(positions) >= 19
    for (earlier_s, earlier), (later_s, later) in itertools.pairwise(positions):
        assert later - earlier == pytest.approx(speed * (later_s - earlier_s), abs=0.05 * speed)


async def test_a_reading_says_how_old_the_oldest_word_is_that_tells_state_and_rest():
    drive, heard = simulated(1), Heard()
    async with smartstep_line([drive]) as line:
        line.axis("u1")._rates_hz = {Basic.STATE: 1.0, Basic.VELOCITY: 0.25, Basic.POSITION: 5.0}
        heard.listen(line, "u1")
        await asyncio.sleep(12.0)
        asked = [
            (record.at_s, int(record.data[3:7], 16))
            for record in line.bus.wire_log.records()
            if record.event is WireEvent.SENT
        ]

    ages_s = []
    for reading, item, timing in heard.readings:
        latest_s = {address: at_s for at_s, address in asked if at_s <= timing.sent_at_s}
        oldest_s = min(latest_s[address] for address in (*STATE_AND_REST, FEEDBACK_COUNTER_LOW.address))
        assert reading.pieces.behind_s == pytest.approx(timing.sent_at_s - oldest_s, abs=1e-6)
        assert reading.pieces.position is (item is TelemetryItem.POSITION)
        ages_s.append(reading.pieces.behind_s)
    assert max(ages_s) > 3.0
    assert {item for _, item, _ in heard.readings} == {
        TelemetryItem.STATE,
        TelemetryItem.VELOCITY,
        TelemetryItem.POSITION,
    }


async def positions_from_a_clear_on(line: SmartStepLine, heard: Heard, *, ends: bool = True) -> list[int]:
    """Clear the feedback counter of `u1`; return what is told of its position till three seconds behind that."""
    since_s, clear = asyncio.get_running_loop().time(), line.axis("u1").parameters.clear_counter
    with nullcontext() if ends else pytest.raises(OutcomeUnknown, match="was not cleared"):
        await clear(CounterName.FEEDBACK)
    await asyncio.sleep(3.0)
    return [
        reading.position_counts
        for reading, item, timing in heard.readings
        if item is TelemetryItem.POSITION and timing.received_at_s > since_s
    ]


@pytest.mark.long
async def test_a_counter_that_is_cleared_at_any_instant_of_its_polls_is_0_from_then_on():
    drive, heard = simulated(1), Heard()
    async with smartstep_line([drive]) as line:
        heard.listen(line, "u1")
        loop = asyncio.get_running_loop()
        for step in range(20):
            drive.drive.motor.position += 70_196  # by hand
            await asyncio.sleep(3.0 + (0.05 * step - loop.time()) % 1.0)
            assert heard.last().position_counts == 70_196

            told = await positions_from_a_clear_on(line, heard)

            assert set(told) <= {70_196, 0}
            assert told[-1] == 0
    assert sum(each.pieces.recounted for each, _, _ in heard.readings) == 20


@pytest.mark.parametrize("ends", [True, False])
async def test_what_a_counter_showed_before_its_clear_corrects_nothing_behind_it(ends):
    drive, heard = simulated(1, SimulatedVariant(clear_s=0.01 if ends else 100.0)), Heard()
    drive.drive.motor.position = 65_636
    async with smartstep_line([drive]) as line:
        heard.listen(line, "u1")
        await asyncio.sleep(3.0)
        assert heard.last().position_counts == 65_636

        told = await positions_from_a_clear_on(line, heard, ends=ends)

    assert set(told) <= {65_636, 0}
    assert told[-1] == 0


async def test_a_mute_unit_is_asked_seldom_and_does_not_starve_the_others():
    heard, mute = Heard(), Heard()
    async with smartstep_line([simulated(1)], numbers=[1, 5]) as line:
        heard.listen(line, "u1")
        mute.listen(line, "u5")
        await asyncio.sleep(60.0)
        asked = sum(data.startswith(b"W5") for data in sent(line))

    states = [item for _, item, _ in heard.readings if item is TelemetryItem.STATE]
    assert mute.missed == asked < 15
    assert len(states) >= 55


async def test_a_unit_that_comes_back_is_identified_and_polled_again():
    drive = simulated(1)
    heard = Heard()
    async with smartstep_line([drive]) as line:
        heard.listen(line, "u1")
        await asyncio.sleep(2.0)
        loop = asyncio.get_running_loop()
        drive.power_off(loop.time())
        await asyncio.sleep(20.0)
        line.axis("u1").identity = None
        readings = len(heard.readings)
        drive.power_on(loop.time())
        await asyncio.sleep(15.0)

    assert len(heard.readings) > readings + 8
    assert line.axis("u1").identity is not None


async def test_monitors_come_at_their_rates():
    told: list[MonitorValue] = []
    async with smartstep_line([simulated(1)]) as line:
        axis = line.axis("u1")
        rates = {
            Basic.STATE: 1.0,
            MonitorName.TORQUE_REFERENCE: 2.0,
            MonitorName.INPUT_COUNTER: 0.5,
            MonitorName.INPUT_SIGNALS: 0.1,
        }
        listeners = Listeners(
            lambda *_: None,
            lambda value, _: told.append(value),
            lambda *_: None,
            lambda _: None,
            lambda: None,
            lambda _: False,
            lambda *_: False,
        )
        line.bus.add_poller(UnitPoller(line.bus, 1, axis.profile, rates, 0.0, listeners))
        await asyncio.sleep(20.0)

    counts = {name: sum(value.reading.monitor is name for value in told) for name in MonitorName}
    assert counts[MonitorName.TORQUE_REFERENCE] in range(39, 42)
    assert counts[MonitorName.INPUT_COUNTER] in range(10, 12)
    assert {value.reading.high for value in told if value.reading.monitor is MonitorName.INPUT_SIGNALS} == {
        ("RUN", "RESET")
    }


@pytest.mark.long
async def test_polling_for_long_leaves_nothing_behind_in_the_queue():
    heard = Heard()
    async with smartstep_line([simulated(1)]) as line:
        heard.listen(line, "u1")
        await asyncio.sleep(100.0)
        polls = line.bus._schedule.polls
        kept = len(polls._later) + len(polls._turns) + len(polls._due)

    assert len(heard.readings) > 260
    assert kept < 50


async def test_a_smartstep_is_no_drive_that_moves_homes_or_has_gains():
    async with smartstep_line([simulated(1)]) as line:
        axis = line.axis("u1")

        assert not isinstance(axis, Moves)


@pytest.mark.parametrize("late_s", [0.0, 20.0], ids=["at once", "late"])
async def test_a_drive_that_joins_late_and_hears_itself_is_asked_for_one_word_only(late_s):
    drive = simulated(2, SimulatedVariant(hears_itself=True))
    drive.power_off(0.0)
    async with smartstep_line([simulated(1), drive]) as line:
        await line.network.bring_up()
        axis = line.axis("u2")
        ignore = ReadingListeners(lambda *_: None, lambda *_: None, lambda *_: None, lambda _: None)
        line.bus.add_poller(axis.own_poller(asyncio.get_running_loop().time(), ignore))
        await asyncio.sleep(late_s)
        now_s = asyncio.get_running_loop().time()
        drive.power_on(now_s)
        await asyncio.sleep(30.0)
        sent = [
            record.data
            for record in line.bus.wire_log.records()
            if record.event is WireEvent.SENT and record.at_s > now_s and record.data.startswith(b"W2")
        ]

    assert axis.words.self_hearing
    assert sent[-1].startswith(b"W20850A")
    assert {data[3:7] for data in sent} == {b"850A"}


async def test_a_poller_that_is_removed_while_its_poll_is_on_the_wire_sends_nothing_more():
    async with smartstep_line([simulated(1)]) as line:
        ignore = ReadingListeners(lambda *_: None, lambda *_: None, lambda *_: None, lambda _: None)
        poller = line.axis("u1").own_poller(asyncio.get_running_loop().time(), ignore)
        line.bus.add_poller(poller)
        await asyncio.sleep(3.0)
        while line.bus.is_idle:
            await asyncio.sleep(0.001)

        line.bus.remove_poller(poller)
        sent = line.bus.statistics.exchanges
        await asyncio.sleep(10.0)

    assert line.bus.statistics.exchanges == sent


async def test_an_alarm_that_came_and_went_between_two_readings_is_told_within_a_minute():
    drive, heard = simulated(1), Heard()
    drive.drive.alarm_history[0] = 0x0010
    async with smartstep_line([drive]) as line:
        line.axis("u1")._rates_hz = {Basic.STATE: 1.0, Basic.VELOCITY: 1.0, Basic.ALARM_HISTORY: 10 / 60}
        heard.listen(line, "u1")
        await asyncio.sleep(10.0)
        before = list(heard.alarms)
        now_s = asyncio.get_running_loop().time()
        drive.drive.provoke(0x0051, now_s)
        drive.drive.press_reset(now_s)
        drive.power_off(now_s)  # what comes while it is out of reach is told when it is back
        await asyncio.sleep(15.0)
        drive.drive.alarm_history.insert(0, 0x0070)
        drive.power_on(asyncio.get_running_loop().time())
        await asyncio.sleep(60.0)

    assert before == []
    assert [alarm.code for alarm in heard.alarms] == ["alarm_0051", "alarm_0070"]
