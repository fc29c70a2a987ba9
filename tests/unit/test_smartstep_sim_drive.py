import pytest

from ldcnd.drives.smartstep.addresses import OperatingMode
from ldcnd.drives.smartstep.monitors import (
    ALARMS,
    NO_ALARM,
    AlarmKind,
    InputSignal,
    OutputSignal,
    input_levels,
    output_levels,
    signed_word,
)
from ldcnd.drives.smartstep.packet import ResponseStatus
from ldcnd.drives.smartstep.parameters import PARAMETERS, PN000, PN100, PN304, PN505
from ldcnd.sim.smartstep.drive import EEPROM_LIFE, SimulatedMemory, SimulatedMotor, SimulatedSmartStep
from ldcnd.sim.smartstep.variant import SimulatedVariant
from tests.support.smartstep_monitors import MONITORS


def test_ram_is_lost_and_eeprom_kept_at_power_on():
    memory = SimulatedMemory({PN100: 40}, eeprom_changes_ram=False)
    memory.write(PN100.ram_address, 60)
    memory.write(PN304.eeprom_address, 1000)

    assert (memory.active(PN100), memory.stored(PN100)) == (60, 40)
    memory.power_on()

    assert (memory.active(PN100), memory.active(PN304)) == (40, 1000)


@pytest.mark.parametrize(("at_once", "active"), [(False, 40), (True, 60)])
def test_eeprom_write_changes_ram_where_the_variant_says_so(at_once, active):
    memory = SimulatedMemory({PN100: 40}, eeprom_changes_ram=at_once)

    memory.write(PN100.eeprom_address, 60)

    assert memory.stored(PN100) == 60
    assert memory.active(PN100) == active


def test_value_out_of_range_is_refused_and_costs_no_write():
    memory = SimulatedMemory({PN100: 40}, eeprom_changes_ram=False)

    assert not memory.write(PN100.eeprom_address, 2001)
    assert memory.stored(PN100) == 40
    assert memory.writes[PN100.number] == 0


def test_eeprom_wears_out_after_its_life():
    memory = SimulatedMemory({PN100: 40}, eeprom_changes_ram=False)
    for _ in range(EEPROM_LIFE):
        memory.write(PN100.eeprom_address, 60)

    memory.write(PN100.eeprom_address, 70)

    assert memory.writes[PN100.number] == EEPROM_LIFE + 1
    assert memory.stored(PN100) == 60


@pytest.mark.parametrize("address", [0x0003, 0x1003, 0x0FFF, 0x2000])
def test_there_is_nothing_at_unlisted_addresses(address):
    memory = SimulatedMemory({}, eeprom_changes_ram=False)

    assert memory.read(address) is None
    assert not memory.holds(address)


MOTOR_RATE_AT_3000_RPM = 100_000.0


def turning(rate: float = MOTOR_RATE_AT_3000_RPM, to_s: float = 2.0) -> SimulatedMotor:
    motor = SimulatedMotor(servo_on=True, pulse_rate=rate)
    motor.advance(to_s)
    return motor


def test_pulse_train_makes_speed_and_following_deviation():
    motor = turning()

    assert motor.rpm(motor.speed) == pytest.approx(3000)
    assert motor.deviation == pytest.approx(400_000 / 40)
    assert motor.position == pytest.approx(400_000 * 2.0 - motor.deviation)


def test_counts_commanded_are_travelled_or_still_in_the_deviation():
    motor = turning()
    motor.pulse_rate = 0.0
    motor.advance(5.0)

    assert motor.position == pytest.approx(motor.command_units * motor.gear)
    assert motor.speed == pytest.approx(0, abs=1e-6)


def test_servo_off_coasts_and_clears_the_deviation():
    motor = turning()
    before = motor.position
    motor.servo_on = False
    motor.advance(4.0)

    assert motor.position == pytest.approx(before + 400_000 * 0.05)
    assert motor.deviation == 0.0
    assert motor.command_units == pytest.approx(400_000)


def test_jammed_shaft_stands_while_deviation_and_torque_grow():
    motor = SimulatedMotor(servo_on=True, pulse_rate=100.0, jammed=True)
    motor.advance(1.0)

    assert (motor.position, motor.speed) == (0.0, 0.0)
    assert motor.deviation == pytest.approx(400)
    assert motor.torque_percent == pytest.approx(200)


def test_acceleration_takes_torque():
    starting = SimulatedMotor(servo_on=True, pulse_rate=MOTOR_RATE_AT_3000_RPM)
    starting.advance(0.001)

    assert starting.torque_percent > turning().torque_percent + 100


def test_earlier_time_changes_nothing():
    motor = turning()
    before = motor.position

    motor.advance(1.0)

    assert (motor.position, motor.at_s) == (before, 2.0)


def test_trembling_feedback_has_two_values():
    motor = SimulatedMotor(servo_on=True, tremble=-1)
    seen = set()
    for step in range(50):
        motor.advance(step * 0.003)
        seen.add(motor.feedback)

    assert seen == {0, -1}


SETTING, DATA_ERROR, ADDRESS_ERROR = (
    ResponseStatus.SETTING,
    ResponseStatus.SETTING_DATA_ERROR,
    ResponseStatus.SETTING_ADDRESS_ERROR,
)
RATE_AT_3000_RPM = 100_000.0


def drive_with(variant: SimulatedVariant | None = None, *, run: bool = True) -> SimulatedSmartStep:
    drive = SimulatedSmartStep(variant or SimulatedVariant(), {PN100: 40})
    if run:
        drive.set_run(0.0, on=True)
    return drive


def test_every_documented_address_answers_and_the_invalid_one_does_not():
    drive = drive_with()
    documented = [
        *(parameter.eeprom_address for parameter in PARAMETERS),
        *(parameter.ram_address for parameter in PARAMETERS),
        *(monitor.address for monitor in MONITORS),
        *range(0x8500, 0x850C),
        *range(0x5000, 0x5007),
        *(0x2000, 0x5100, 0x5101, 0x8105, 0x8106, 0x8518, 0x8700, 0x8701, 0x8702, 0x8800),
    ]

    assert [address for address in documented if drive.read(address) is None] == []
    assert [address for address in (0x2001, 0x3000, 0x8010, 0xC000) if drive.read(address) is not None] == []


def test_monitors_of_a_running_motor_make_sense():
    drive = drive_with()
    drive.set_pulse_rate(RATE_AT_3000_RPM, 0.0)
    drive.advance(2.0)

    assert drive.read(0x8000) == 3000
    assert drive.read(0x8007) == 3000
    assert drive.read(0x8008) == 2500
    assert drive.read(0x8002) == 5
    assert (drive.read(0x800D) << 16 | drive.read(0x800C)) == 200_000
    assert output_levels(drive.read(0x8006)) == OutputSignal.BKIR


def test_motor_at_rest_is_in_position():
    drive = drive_with()

    assert output_levels(drive.read(0x8006)) == OutputSignal.INP | OutputSignal.BKIR
    assert input_levels(drive.read(0x8005)) == InputSignal.RESET


def test_large_deviation_is_an_alarm_that_stops_the_motor_and_stays_in_the_history():
    drive = drive_with()
    drive.write(PN505.ram_address, 1)
    drive.set_jammed(0.0, jammed=True)
    drive.set_pulse_rate(1000.0, 0.0)
    drive.advance(1.0)

    assert drive.read(0x850A) == 0x00D0
    assert drive.read(0x8500) == 0x00D0
    assert output_levels(drive.read(0x8006)) == OutputSignal.ALM
    assert drive.read(0x8008) == 0


def test_overspeed_is_an_alarm():
    drive = drive_with()
    drive.set_pulse_rate(1.6 * RATE_AT_3000_RPM, 0.0)
    drive.advance(1.0)

    assert drive.read(0x850A) == 0x0051


@pytest.mark.parametrize("known", ALARMS, ids=lambda known: known.text)
def test_any_alarm_can_be_provoked(known):
    drive = drive_with()

    drive.provoke(known.code, 1.0)

    assert drive.read(0x850A) == drive.read(0x8500) == known.code
    assert drive.motor.servo_on is (known.kind is not AlarmKind.ALARM)


def test_history_keeps_ten_newest_first_and_reset_clears_only_the_present_alarm():
    drive = drive_with()
    for code in range(1, 12):
        drive.provoke(code, 1.0)

    drive.press_reset(2.0)

    assert [drive.read(0x8500 + entry) for entry in range(10)] == list(range(11, 1, -1))
    assert drive.read(0x850A) == NO_ALARM


def test_power_cycle_loads_ram_from_eeprom_and_takes_the_new_unit_number():
    drive = drive_with()
    drive.write(PN100.ram_address, 60)
    drive.write(PN000.eeprom_address, 0x0500)
    assert drive.unit == 0

    drive.power_on(3.0)

    assert drive.unit == 5
    assert drive.read(PN100.ram_address) == 40


def test_pulses_go_on_over_a_power_cycle():
    drive = drive_with()
    drive.set_pulse_rate(100.0, 0.0)

    drive.power_on(3.0)
    drive.advance(4.0)

    assert drive.command_counter == 100


@pytest.mark.parametrize(
    ("mode", "command", "feedback"),
    [(OperatingMode.COMMAND_COUNTER_CLEAR, 0, 800), (OperatingMode.FEEDBACK_COUNTER_CLEAR, 200, 0)],
)
def test_clear_mode_clears_its_counter_and_returns_to_normal(mode, command, feedback):
    drive = drive_with()
    drive.set_pulse_rate(100.0, 0.0)
    drive.set_pulse_rate(0.0, 2.0)
    drive.advance(5.0)
    drive.motor.position = round(drive.motor.position)

    assert drive.write(0x2000, mode) is SETTING
    assert drive.write(0x2001, 1) is SETTING
    assert drive.read(0x2000) == mode
    drive.advance(5.02)

    assert drive.read(0x2000) == OperatingMode.NORMAL
    assert (drive.command_counter, drive.feedback_counter) == (command, feedback)


def test_leaving_a_clear_mode_without_executing_clears_nothing():
    drive = drive_with()
    drive.motor.command_units = 500

    drive.write(0x2000, OperatingMode.COMMAND_COUNTER_CLEAR)
    drive.write(0x2000, OperatingMode.NORMAL)
    drive.advance(1.0)

    assert drive.command_counter == 500


def test_undocumented_mode_is_a_data_error():
    drive = drive_with()

    assert drive.write(0x2000, 0x2002) is DATA_ERROR
    assert drive.read(0x2000) == OperatingMode.NORMAL
    assert drive.write(0x2001, 2) is DATA_ERROR


@pytest.mark.parametrize("address", [0x1100, 0x0100, 0x5002, 0xC000])
def test_settings_but_mode_and_operation_are_address_errors_while_tracing(address):
    drive = drive_with()
    drive.write(0x2000, OperatingMode.DATA_TRACE)

    assert drive.write(address, 60) is ADDRESS_ERROR
    assert drive.read(0x1100) == 40
    assert drive.write(0x2000, OperatingMode.NORMAL) is SETTING
    assert drive.write(0x1100, 60) is SETTING


def test_trace_records_speed_and_deviation_of_a_start():
    drive = drive_with()
    for address, value in ((0x5000, 0x8101), (0x5001, 0x8104), (0x5002, 8)):
        assert drive.write(address, value) is SETTING
    drive.write(0x2000, OperatingMode.DATA_TRACE)
    drive.write(0x2001, 1)
    drive.set_pulse_rate(RATE_AT_3000_RPM, 0.0)

    drive.advance(0.999)
    assert drive.read(0x2000) == OperatingMode.DATA_TRACE
    drive.advance(1.01)

    assert drive.read(0x2000) == OperatingMode.NORMAL
    speeds, deviations = drive.recorder.rings
    assert speeds[-1] & 0x7FFF == 10_000  # 3000 of 4500 r/min
    assert deviations[-1] & 0x7FFF == 2500
    assert speeds[0] & 0x7FFF < speeds[10] & 0x7FFF < speeds[100] & 0x7FFF
    assert speeds[0] & 0x8000 == 0  # no longer in position


def test_trace_of_command_pulses_counts_them_in_two_time_units():
    drive = drive_with()
    drive.write(0x5000, 0x0003)
    drive.set_pulse_rate(RATE_AT_3000_RPM, 0.0)
    drive.write(0x2000, OperatingMode.DATA_TRACE)
    drive.write(0x2001, 1)
    drive.advance(1.0)

    assert signed_word(drive.recorder.rings[0][10]) == 50


def test_ending_a_trace_early_stops_it():
    drive = drive_with()
    drive.write(0x2000, OperatingMode.DATA_TRACE)
    drive.write(0x2001, 1)

    drive.write(0x2000, OperatingMode.NORMAL)

    assert drive.recorder.next_s is None


@pytest.mark.parametrize("active_low", [True, False])
def test_run_level_follows_the_variant(active_low):
    drive = drive_with(SimulatedVariant(run_active_low=active_low), run=False)
    assert not drive.motor.servo_on

    drive.set_run(1.0, on=True)

    assert drive.motor.servo_on
    assert bool(drive.read(0x8005) & InputSignal.RUN) is not active_low
