"""A lease in the environment is honoured by every command that sends, on the jumping clock."""

import pytest

from ldcnd.config.rig import load_config
from ldcnd.model.leases import Acquire
from tests.support.command_line import virtual_rig
from tests.support.rig import SIMULATED

SENT = [
    "axis power x on",
    "axis move x 1 --wait",
    "axis jog x 2 --for 0.3",
    "axis set-position x 0",
    "axis outputs x --limit1 input",
    "axis gains x --kp 100 --kd 1000 --ki 0 --el 4000",
    "axis pwm x 0.1 1",
    "axis track x 0",
    "axis clear-counter x command",
    "axis reset x",
    "params set x Pn102 61",
    "params restart-count x --yes",
    "params save x",
    "trace take x --channel position --samples 5",
    "trace abort x",
    "power on x",
    "speed 100",
    "group move x=1 y=1",
]
WITHOUT = ("lease_held", "lease_required", "lease_expired", "control_needed")


@pytest.fixture
def leased(monkeypatch):
    """A rig on which all axes are held, with authority `leased`; yields what runs commands, and the lease."""
    config = load_config(SIMULATED).model_copy(update={"authority": "leased"})
    with virtual_rig(monkeypatch, config) as here:
        here.wait(here.rig.until("x", lambda state: state.link == "up"))
        lease = here.wait(here.rig.client.ask(Acquire(client="ann", axes=("x", "y", "z", "c"), lease_s=60.0)))
        yield here, lease.lease


@pytest.mark.parametrize("line", SENT)
def test_a_command_inside_lease_hold_is_sent_under_its_lease(leased, monkeypatch, line):
    here, lease = leased
    outside = here.run(line)
    monkeypatch.setenv("LDCND_LEASE", lease)
    inside = here.run(line)

    assert "Usage" not in inside.errors + outside.errors
    assert not any(code in inside.errors for code in WITHOUT), inside.errors
    if line not in {"speed 100", "axis outputs x --limit1 input", "params save x"}:  # the same as before, or read first
        assert any(code in outside.errors for code in WITHOUT), outside.errors
