"""Registers made of clocks: LS-182AP manual, calculation after its examples; PIC-SERVO manual, 4.4."""

import pytest

from ldcnd.contract.errors import ValueOutOfRange
from ldcnd.drives.ldcn.profiles import PROFILES
from ldcnd.drives.ldcn.registers import baud_divisor
from ldcnd.drives.ldcn.trajectory import (
    acceleration_counts_per_s2,
    programmed_acceleration,
    programmed_velocity,
    velocity_counts_per_s,
)

LS_182AP = PROFILES["ls-182ap"]
V4 = PROFILES["pic-servo-v4"]
SC = PROFILES["pic-servo-sc"]


def test_the_manuals_examples_of_programmed_values():
    assert programmed_velocity(2000, 1, LS_182AP) == 67_109
    assert programmed_acceleration(20_000, 1, LS_182AP) == 344
    assert programmed_acceleration(8000, 1, LS_182AP) == 137


def test_the_servo_divisor_slows_the_profile_on_version_4_but_not_on_sc():
    assert programmed_velocity(2000, 3, V4) == round(3 * 67_108.864)
    assert programmed_acceleration(20_000, 3, V4) == round(9 * 343.59738368)
    assert programmed_velocity(2000, 3, SC) == 67_109


def test_registers_convert_back():
    assert velocity_counts_per_s(67_109, 1, V4) == pytest.approx(2000, rel=1e-5)
    assert velocity_counts_per_s(65_536, 2, V4) == pytest.approx(1 / 0.001024)
    assert acceleration_counts_per_s2(65_536, 2, V4) == pytest.approx(1 / 0.001024**2)


def test_standstill_is_zero():
    assert programmed_velocity(0, 1, V4) == 0


def test_a_velocity_backward_has_the_register_of_its_speed_and_is_refused_with_its_sign():
    assert programmed_velocity(-2000, 1, LS_182AP) == 67_109
    with pytest.raises(ValueOutOfRange) as refusal:
        programmed_velocity(-1e-3, 1, V4)

    assert refusal.value.nearest == -velocity_counts_per_s(1, 1, V4)


@pytest.mark.parametrize("counts_per_s", [float("nan"), float("inf"), 1e9])
def test_a_velocity_that_no_register_holds_is_refused(counts_per_s):
    with pytest.raises(ValueOutOfRange):
        programmed_velocity(counts_per_s, 1, V4)


def test_the_refusal_of_a_fast_velocity_names_the_fastest():
    with pytest.raises(ValueOutOfRange) as refusal:
        programmed_velocity(1e9, 1, V4)

    assert programmed_velocity(refusal.value.nearest, 1, V4) == 0x7FFF_FFFF


def test_an_acceleration_that_would_become_zero_is_refused_with_the_least():
    with pytest.raises(ValueOutOfRange) as refusal:
        programmed_acceleration(20, 1, V4)

    assert programmed_acceleration(refusal.value.nearest, 1, V4) == 1


@pytest.mark.parametrize("divisor", [0, 256])
def test_a_servo_divisor_is_1_to_255(divisor):
    with pytest.raises(ValueOutOfRange):
        velocity_counts_per_s(1, divisor, V4)


def test_a_rate_without_a_code_is_refused_with_the_nearest():
    with pytest.raises(ValueOutOfRange) as refusal:
        baud_divisor(38_400)

    assert refusal.value.nearest == 37_879
