"""Readings that a drive cannot have given after the one before are not believed before a second one agrees."""

from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from ldcnd.axis.plausibility import (
    NOISE_COUNTS,
    ROUNDS,
    CounterStep,
    Judgement,
    PlausibilityGate,
    ReadingVerdict,
    agree,
)
from ldcnd.drives.axis_config import AxisConfig
from ldcnd.drives.driver import AxisReading, CountsMotion, Fault
from ldcnd.line.exchange import Timing

CONFIG = AxisConfig.model_validate(
    {
        "name": "x", "address": 1, "model": "ls-182ap", "unit": "mm", "counts_per_unit": 1000,
        "velocity": 20, "acceleration": 200, "limits": {"velocity": 50, "acceleration": 1000},
        "gains": {"kp": 350, "kd": 3000, "el": 4000},
    }
)  # fmt: skip
RESTING = AxisReading(
    position_counts=1000, following_error_counts=0, velocity_counts_per_s=0.0, velocity_resolution_counts_per_s=1953.0,
    adc_counts=None, enabled=True, profile_done=True, homing=False, faults=(), reverse_limit=False, forward_limit=False,
)  # fmt: skip
POLL_S, EXCHANGE_S = 0.05, 0.002
OVERCURRENT = Fault("overcurrent", "the drive has switched off")


class Axis:
    """A gate that has believed a reading, and the clock of its line."""

    def __init__(self, reading: AxisReading = RESTING) -> None:
        self.gate = PlausibilityGate(CONFIG)
        self.now_s = 1000.0
        self.read(reading)
        moved = reading.position_counts + round(reading.velocity_counts_per_s * EXCHANGE_S)
        self.position_counts = moved
        assert self.read(replace(reading, position_counts=moved), standing=False) is ReadingVerdict.BELIEVED

    def read_until_believed(self, reading: AxisReading, after_s: float = EXCHANGE_S) -> int:
        """Return how many such readings it takes."""
        for number in range(1, ROUNDS + 1):
            if self.read(reading, after_s if number == 1 else EXCHANGE_S) is ReadingVerdict.BELIEVED:
                return number
        raise AssertionError(f"{ROUNDS} readings that agree are not believed")

    def read(self, reading: AxisReading, after_s: float = EXCHANGE_S, *, standing: bool = True) -> ReadingVerdict:
        self.now_s += after_s
        timing = Timing(self.now_s - 0.001, self.now_s - 0.0006, self.now_s - 0.0005, self.now_s)
        self.judged = self.gate.judge(reading, timing, standing=standing)
        return self.judged.verdict


def at(counts: int, velocity: float = 0.0) -> AxisReading:
    return replace(RESTING, position_counts=counts, velocity_counts_per_s=velocity)


def test_the_first_reading_is_believed_but_nothing_has_jumped_away_from_it():
    gate = PlausibilityGate(CONFIG)

    judged = [
        gate.judge(reading, Timing(now_s, now_s, now_s, now_s), standing=False)
        for now_s, reading in ((0.0, at(999_999)), *((0.05 + 0.002 * number, RESTING) for number in range(ROUNDS)))
    ]

    verdicts = [each.verdict for each in judged]
    assert verdicts == [ReadingVerdict.BELIEVED, *[ReadingVerdict.ASK_AGAIN] * (ROUNDS - 1), ReadingVerdict.BELIEVED]
    assert not any(each.step for each in judged)


@given(st.integers(-(2**31), 2**31 - 1))
@pytest.mark.long
def test_any_other_position_of_a_standing_axis_is_asked_again(counts: int):
    axis = Axis()

    verdict = axis.read(at(counts), POLL_S)

    assert (verdict is ReadingVerdict.BELIEVED) == (abs(counts - 1000) <= NOISE_COUNTS)


@pytest.mark.parametrize(
    "changed",
    [
        {"enabled": False}, {"profile_done": False}, {"homing": True}, {"reverse_limit": True}, {"forward_limit": True},
        {"faults": (OVERCURRENT,)},
    ],
)  # fmt: skip
def test_any_change_of_the_status_is_asked_again_and_believed_when_it_stands(changed: dict[str, object]):
    axis = Axis()
    other = replace(RESTING, **changed)  # type: ignore[arg-type]

    assert axis.read(other, POLL_S) is ReadingVerdict.ASK_AGAIN
    assert axis.read(other) is ReadingVerdict.BELIEVED
    assert axis.judged.confirmed
    assert axis.judged.confirmed[0] is other


def test_a_reading_that_the_next_one_contradicts_is_forgotten_and_counted():
    axis = Axis()

    axis.read(replace(RESTING, faults=(OVERCURRENT,)), POLL_S)

    assert axis.read(RESTING) is ReadingVerdict.BELIEVED
    assert (axis.judged, axis.gate.withheld) == (Judgement(ReadingVerdict.BELIEVED), 1)


def test_readings_that_contradict_each_other_are_said_to_do_so():
    axis = Axis()

    verdicts = [axis.read(at(100_000 * (number + 1))) for number in range(ROUNDS)]

    assert verdicts == [ReadingVerdict.ASK_AGAIN] * (ROUNDS - 1) + [ReadingVerdict.CONTRADICTS]


@given(
    velocity=st.floats(-50_000, 50_000),
    acceleration=st.floats(-1_000_000, 1_000_000),
    dt_s=st.floats(0.001, 0.5),
)
def test_a_motion_within_the_limits_of_the_axis_is_believed_at_once(velocity: float, acceleration: float, dt_s: float):
    """The velocity of a status packet has no fraction."""
    end = max(-50_000.0, min(50_000.0, velocity + acceleration * dt_s))
    turn_s = abs(end - velocity) / 1_000_000 if abs(acceleration) > 0 else 0.0
    way = (velocity + end) / 2 * turn_s + end * (dt_s - turn_s)

    def told(value: float) -> float:
        return int(value / 1953.0) * 1953.0

    moving = replace(at(0, told(velocity)), profile_done=False)
    axis = Axis(moving)

    # between two readings the instants are known to a servo cycle
    later = replace(moving, position_counts=axis.position_counts + round(way), velocity_counts_per_s=told(end))

    assert axis.read(later, dt_s, standing=False) is ReadingVerdict.BELIEVED


@pytest.mark.parametrize(("counts", "jumped"), [(1000 + 20_000, True), (1000 - 20_000, True), (1000 + 500, False)])
def test_a_confirmed_position_that_no_motion_leads_to_is_a_jump(*, counts: int, jumped: bool):
    axis = Axis()

    assert axis.read_until_believed(at(counts), POLL_S) == (ROUNDS if jumped else 2)
    assert (axis.judged.step is CounterStep.JUMPED) is jumped


@given(st.lists(st.integers(1, ROUNDS - 1), min_size=1, max_size=6))
def test_late_replies_of_another_drive_are_not_believed_though_they_agree(runs: list[int]):
    axis = Axis()

    for run in runs:
        verdicts = [axis.read(at(-30_000)) for _ in range(run)]
        assert verdicts == [ReadingVerdict.ASK_AGAIN] * run
        assert axis.judged.foreign
        assert axis.read(RESTING) is ReadingVerdict.BELIEVED
        assert axis.judged.step is None


def test_a_place_too_far_for_its_speed_is_asked_again_also_of_an_axis_that_was_not_read_for_a_while():
    """What the axis may accelerate would lead there in that time."""
    axis = Axis()

    assert axis.read(at(47_000), 0.38, standing=False) is ReadingVerdict.ASK_AGAIN
    assert axis.judged.foreign


def test_a_shaft_that_is_turned_by_hand_has_not_jumped():
    open_loop = replace(RESTING, enabled=False)
    axis = Axis(open_loop)

    for counts in range(1000, 20_000, 2000):  # 40 mm/s
        axis.read(replace(open_loop, position_counts=counts), POLL_S, standing=False)
        axis.read(replace(open_loop, position_counts=counts), standing=False)
        assert axis.judged.step is None


@pytest.mark.parametrize("poll_s", [0.02, 0.2, 1.0])
def test_a_motion_that_is_faster_than_the_velocity_of_an_axis_without_limits_is_believed(poll_s: float):
    config = CONFIG.model_copy(update={"limits": CONFIG.limits.model_copy(update={"velocity": None})})
    axis = Axis()
    axis.gate.reconfigure(config)
    fast = 200_000.0  # ten times as fast

    verdicts = [
        axis.read(replace(at(round(1000 + fast * poll_s * number), fast), profile_done=False), poll_s, standing=False)
        for number in range(1, 7)
    ]

    assert verdicts[2:] == [ReadingVerdict.BELIEVED] * 4


def test_a_counter_that_wraps_has_not_jumped():
    axis = Axis(at(2**31 - 3))

    assert axis.read(at(-(2**31) + 4), POLL_S) is ReadingVerdict.BELIEVED


def test_a_drive_that_is_back_is_believed_at_once_only_where_it_was():
    axis = Axis()
    axis.gate.after_gap()
    assert axis.read(at(1000 + NOISE_COUNTS), 5.0, standing=False) is ReadingVerdict.BELIEVED

    axis.gate.after_gap()
    assert axis.read(at(1500), 5.0, standing=False) is ReadingVerdict.ASK_AGAIN
    assert axis.judged.foreign
    assert axis.read(at(1500), standing=False) is ReadingVerdict.BELIEVED


def test_a_velocity_that_no_acceleration_leads_to_is_asked_again_though_the_way_fits_it():
    axis = Axis()

    assert axis.read(at(1000 + 2755, 110_000.0), POLL_S, standing=False) is ReadingVerdict.ASK_AGAIN
    assert not axis.judged.foreign


@pytest.mark.parametrize(("counts", "foreign"), [(NOISE_COUNTS, False), (NOISE_COUNTS + 1, True)])
def test_what_a_drive_that_is_back_shows_at_its_place_is_not_another_drives(counts: int, *, foreign: bool):
    axis = Axis()
    axis.gate.after_gap()

    assert axis.read(replace(at(1000 + counts), enabled=False), 5.0, standing=False) is ReadingVerdict.ASK_AGAIN
    assert axis.judged.foreign is foreign


def test_what_leaves_the_place_that_was_confirmed_after_a_gap_has_jumped():
    axis = Axis()
    axis.gate.after_gap()
    axis.read_until_believed(at(1500), 5.0)

    axis.read_until_believed(at(30_000))

    assert axis.judged.step is CounterStep.JUMPED


@pytest.mark.parametrize(("counts", "readings"), [(613, 2), (615, ROUNDS)])
def test_a_jump_of_an_axis_at_rest_is_farther_than_noise_and_resolution_and_an_eighth_of_the_error_limit(
    counts: int, readings: int
):
    """16 and 500 counts, and 98 for the 50 ms in which it may have gone at up to a count a servo tick."""
    axis = Axis()

    assert axis.read_until_believed(at(1000 + counts), POLL_S) == readings


@pytest.mark.parametrize("back", [1000, 2500, 20_000])
def test_a_counter_that_is_set_back_in_mid_motion_has_jumped_also_where_the_axis_soon_passes_its_old_place(back: int):
    speed = 20_000.0
    axis = Axis(replace(at(40_000, speed), profile_done=False))
    axis.gate.expect(CountsMotion(90_000, speed, 200_000.0))
    began_s, counts = axis.now_s, axis.position_counts

    def read(after_s: float) -> ReadingVerdict:
        place = counts - back + round((axis.now_s + after_s - began_s) * speed)
        return axis.read(replace(at(place, speed), profile_done=False), after_s, standing=False)

    verdicts = [read(after_s) for after_s in (0.01, *[0.025] * (ROUNDS - 1))]

    assert verdicts == [ReadingVerdict.ASK_AGAIN] * (ROUNDS - 1) + [ReadingVerdict.BELIEVED]
    assert axis.judged.step is CounterStep.JUMPED


def test_a_false_velocity_that_would_explain_a_jump_does_not_hide_it():
    axis = Axis()

    verdicts = [axis.read(at(40_000, velocity), standing=False) for velocity in (30e6, *[0.0] * (ROUNDS - 1))]

    assert verdicts == [ReadingVerdict.ASK_AGAIN] * (ROUNDS - 1) + [ReadingVerdict.BELIEVED]
    assert axis.judged.step is CounterStep.JUMPED


def test_a_following_error_to_which_no_profile_has_led_is_asked_again_and_forgotten():
    axis = Axis()

    assert axis.read(replace(RESTING, following_error_counts=1781), POLL_S) is ReadingVerdict.ASK_AGAIN
    assert axis.read(RESTING) is ReadingVerdict.BELIEVED
    assert axis.judged.confirmed is None


def test_a_following_error_that_grows_with_its_profile_is_believed_at_once():
    axis = Axis()
    axis.gate.expect(CountsMotion(9000, 20_000.0, 200_000.0))
    for _ in range(2):
        axis.read(replace(RESTING, profile_done=False), standing=False)

    for lag in range(900, 4000, 900):
        jammed = replace(RESTING, profile_done=False, following_error_counts=lag)
        assert axis.read(jammed, POLL_S, standing=False) is ReadingVerdict.BELIEVED


def test_another_place_is_asked_again_once_a_profile_has_led_to_its_target():
    axis = Axis()
    axis.gate.expect(CountsMotion(1000, 20_000.0, 200_000.0))

    assert axis.read(RESTING, standing=False) is ReadingVerdict.BELIEVED
    assert axis.read(at(1064), POLL_S, standing=False) is ReadingVerdict.ASK_AGAIN


def test_a_velocity_that_only_one_of_two_readings_shows_is_not_confirmed_with_the_rest():
    axis = Axis()
    axis.gate.expect(CountsMotion(3000, 20_000.0, 200_000.0))
    false, true = (replace(at(1012, velocity), profile_done=False) for velocity in (-70_000.0, 5859.0))

    assert axis.read(true, standing=False) is ReadingVerdict.ASK_AGAIN
    assert axis.read(false, standing=False) is ReadingVerdict.ASK_AGAIN
    assert axis.read(true, standing=False) is ReadingVerdict.BELIEVED
    assert axis.judged.confirmed is not None
    assert axis.judged.confirmed[0].velocity_counts_per_s == 5859.0


@pytest.mark.parametrize("share", [1.0, 0.1, 0.01])
def test_the_highest_velocity_that_is_possible_explains_every_slower_motion(share: float):
    """Also one that leads past 0, where a counter that was set back would begin."""
    speed = 20_000.0
    shown = replace(at(-500, speed), profile_done=False, velocity_uncertain=True)
    axis = Axis(shown)

    place = float(axis.position_counts)
    while place < 500:
        place += share * speed * POLL_S
        reading = replace(shown, position_counts=round(place), begun_anew=abs(place) <= NOISE_COUNTS)
        assert axis.read(reading, POLL_S, standing=False) is ReadingVerdict.BELIEVED
        assert axis.judged.step is None


@pytest.mark.parametrize("off", [-20_000, -2500, -700, 700, 2500, 20_000])
def test_one_false_reply_in_mid_motion_is_no_jump(off: int):
    speed = 50_000.0
    axis = Axis(replace(at(0, speed), profile_done=False))
    axis.gate.expect(CountsMotion(90_000, speed, 200_000.0))
    began_s, counts = axis.now_s, axis.position_counts

    for after_s, wrong in ((0.02, off), *[(0.025, 0)] * ROUNDS):
        place = counts + round((axis.now_s + after_s - began_s) * speed) + wrong
        axis.read(replace(at(place, speed), profile_done=False), after_s, standing=False)
        assert axis.judged.step is None

    assert axis.judged.verdict is ReadingVerdict.BELIEVED


def test_a_loop_that_hunts_is_not_asked_again_once_its_readings_contradict_each_other_and_then_agrees():
    axis = Axis()
    for number in range(ROUNDS):
        axis.read(at((-1) ** number * 2000))

    hunting = [axis.read(at((-1) ** number * 2000), POLL_S) for number in range(ROUNDS, 20)]
    standing = [axis.read(at(700), POLL_S) for _ in range(ROUNDS + 1)]

    assert hunting == [ReadingVerdict.CONTRADICTS] * len(hunting)
    assert standing == [ReadingVerdict.CONTRADICTS] * ROUNDS + [ReadingVerdict.BELIEVED]


@pytest.mark.parametrize(
    ("begun_anew", "counts", "zeroed"),
    [((False, True), 0, True), ((True, True), 0, False), ((False, True), 1000, False)],
)
def test_a_counter_that_has_restarted_shows_that_it_began_anew_where_no_motion_led(
    begun_anew: tuple[bool, bool], counts: int, *, zeroed: bool
):
    before, after = begun_anew
    axis = Axis(replace(RESTING, begun_anew=before))

    reading = replace(at(counts), enabled=False, begun_anew=after)  # which is asked again, whatever it shows besides
    axis.read_until_believed(reading, EXCHANGE_S)

    assert (axis.judged.step is CounterStep.ZEROED) is zeroed


def test_after_a_gap_another_position_is_confirmed_and_is_no_jump():
    axis = Axis()
    axis.gate.after_gap()

    assert axis.read_until_believed(at(999_999)) == ROUNDS
    assert axis.judged.step is None


@pytest.mark.parametrize(("seconds", "readings"), [(1.0, 2), (0.1, ROUNDS)])
def test_what_is_a_jump_depends_on_what_was_commanded_and_the_time_in_between(seconds: float, readings: int):
    axis = Axis()
    axis.gate.expect(CountsMotion(60_000, 50_000.0, 1_000_000.0))

    came = [axis.read(at(51_000), after_s, standing=False) for after_s in (seconds, *[EXCHANGE_S] * (ROUNDS - 1))]

    assert came.index(ReadingVerdict.BELIEVED) + 1 == readings
    assert (axis.judged.step is CounterStep.JUMPED) is (readings == ROUNDS)


def test_readings_agree_within_what_the_axis_moves_meanwhile():
    assert agree(RESTING, at(1000 + NOISE_COUNTS), 0.0)
    assert not agree(RESTING, at(1000 + NOISE_COUNTS + 1), 0.0)
    assert agree(at(0, 50_000.0), at(100, 50_000.0), 0.01)
    assert not agree(RESTING, replace(RESTING, faults=(OVERCURRENT,)), 0.01)
    slow = RESTING.velocity_resolution_counts_per_s
    assert agree(at(0, 0.0), at(round(NOISE_COUNTS + 0.02 * slow) - 1, 0.0), 0.02)  # as slow as is not shown
