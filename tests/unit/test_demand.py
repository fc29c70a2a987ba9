"""How often an item is asked for when somebody takes it, when nobody does, and just afterwards."""

from ldcnd.daemon.demand import LINGER_S, Demand
from ldcnd.model.samples import TelemetryItem

POSITION, VELOCITY, ADC, STATE = (
    TelemetryItem.POSITION,
    TelemetryItem.VELOCITY,
    TelemetryItem.ADC,
    TelemetryItem.STATE,
)
RATES = {POSITION: 20.0, VELOCITY: 10.0, ADC: 0.5, STATE: 5.0}


def test_what_nobody_takes_has_its_idle_rate_and_the_state_keeps_its_own():
    assert Demand().asked_hz(RATES, 1.0, 0.0) == {POSITION: 1.0, VELOCITY: 1.0, ADC: 0.5, STATE: 5.0}


def test_what_somebody_takes_has_its_own_rate_and_nothing_else_has():
    demand = Demand()

    demand.subscribed(POSITION, 7.0, present=True)

    assert demand.asked_hz(RATES, 1.0, 7.0) == {POSITION: 20.0, VELOCITY: 1.0, ADC: 0.5, STATE: 5.0}


def test_a_subscriber_that_comes_back_soon_finds_no_gap():
    demand = Demand()
    demand.subscribed(POSITION, 0.0, present=True)

    demand.subscribed(POSITION, 10.0, present=False)

    assert demand.asked_hz(RATES, 1.0, 10.0 + 0.9 * LINGER_S)[POSITION] == 20.0
    assert demand.asked_hz(RATES, 1.0, 10.0 + LINGER_S)[POSITION] == 1.0


def test_to_hear_that_nobody_has_come_is_no_reason_to_linger():
    demand = Demand()

    demand.subscribed(POSITION, 10.0, present=False)

    assert demand.asked_hz(RATES, 1.0, 10.0)[POSITION] == 1.0


def test_an_idle_rate_never_makes_anything_quicker():
    assert Demand().asked_hz(RATES, 100.0, 0.0) == RATES
