"""Sixty machines drawn by lot, tuned from their traces alone."""

from dataclasses import replace

import pytest

from ldcnd.drivers.ldcn.profiles import PIC_SERVO_V4
from ldcnd.errors import DriveFault
from ldcnd.tuning.ldcn.excitation import Bounds, Excitation
from ldcnd.tuning.ldcn.verdict import objection
from tests.support.simulated_plants import SimulatedAxis, drawn_plants, tuned

SEED = 24
PLANTS = 60


def settles_as_well(outcome):
    return objection(outcome.measured, outcome.reference) is None


@pytest.mark.soak
@pytest.mark.timeout(3600)
def test_sixty_drawn_machines_are_identified_and_tuned():
    found = []
    for plant in drawn_plants(SEED, PLANTS):
        print(plant)
        found.append((plant, tuned(PIC_SERVO_V4, plant)))
        print(found[-1][1].known, found[-1][1].measured, found[-1][1].reference)

    assert sum(outcome.acceleration_error < 0.1 for _, outcome in found) >= 0.95 * PLANTS
    assert sum(settles_as_well(outcome) for _, outcome in found) >= 0.9 * PLANTS
    for plant, outcome in found:
        assert outcome.measured is not None, plant
        assert outcome.measured.settled, plant
        assert outcome.measured.overshoot < 0.15, plant
        assert outcome.farthest_counts <= plant.distance_counts, plant


@pytest.mark.soak
@pytest.mark.timeout(600)
@pytest.mark.parametrize(
    ("wrong", "said"),
    [({"motor_reversed": True}, "against an output"), ({"encoder_disconnected": True}, "the encoder counted nothing")],
    ids=["reversed motors", "disconnected encoders"],
)
def test_sixty_machines_that_are_wired_wrongly_stay_within_the_distance(wrong, said):
    for plant in drawn_plants(SEED, PLANTS):
        print(plant)
        axis = SimulatedAxis(PIC_SERVO_V4, replace(plant, motor=replace(plant.motor, **wrong)))

        with pytest.raises(DriveFault, match=said):
            axis.run(Excitation(PIC_SERVO_V4, Bounds(plant.distance_counts)).pulses())

        assert axis.farthest_counts <= plant.distance_counts
