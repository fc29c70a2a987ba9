"""Sixty machines drawn by lot, tuned from their traces alone."""

import math
from dataclasses import replace

import pytest

from ldcnd.drivers.ldcn.profiles import PIC_SERVO_V4
from tests.support.simulated_plants import drawn_plants, excite, tuned

SEED = 24
PLANTS = 60
SAMPLES_S = 0.005
"""Two samples of a trace: what settles within so much of each other settles alike."""


def settles_as_well(outcome):
    usual = outcome.reference.settling_s if outcome.reference.settled else math.inf
    return outcome.measured.settled and outcome.measured.settling_s <= usual + SAMPLES_S


@pytest.mark.soak
@pytest.mark.timeout(3600)
def test_sixty_drawn_machines_are_identified_and_tuned():
    found = []
    for plant in drawn_plants(SEED, PLANTS):
        print(plant)
        found.append((plant, tuned(PIC_SERVO_V4, plant)))
        print(found[-1][1].known, found[-1][1].measured, found[-1][1].reference)

    assert sum(outcome.acceleration_error < 0.1 for _, outcome in found) >= 0.95 * PLANTS
    assert sum(settles_as_well(outcome) for _, outcome in found) >= 0.85 * PLANTS
    for plant, outcome in found:
        assert outcome.measured.settled, plant
        assert not outcome.tripped, plant
        assert outcome.measured.overshoot < 0.15, plant
        assert outcome.farthest_counts <= plant.distance_counts, plant


@pytest.mark.soak
@pytest.mark.timeout(600)
def test_sixty_reversed_motors_stay_within_the_distance():
    for plant in drawn_plants(SEED, PLANTS):
        print(plant)
        wrong = replace(plant, motor=replace(plant.motor, motor_reversed=True, load_nm=0.0))

        found = excite(PIC_SERVO_V4, wrong, seed=plant.number)

        assert found.records == ()
        assert found.farthest_counts <= plant.distance_counts
