"""What no command takes is one error with a code, whatever a Python program gives to whichever call."""

import math

import pytest

from ldcnd.client.rig import Rig
from ldcnd.contract.errors import MalformedRequest
from tests.support.rig import running_rig

CALLS = {
    "set_io line": lambda rig: rig.set_io("io", high=["11"]),
    "set_io duty": lambda rig: rig.set_io("io", pwm1=1.5),
    "set_io_timer": lambda rig: rig.set_io_timer("io", "often"),
    "set_speed_override": lambda rig: rig.set_speed_override(math.nan),
    "preview_together": lambda rig: rig.preview_together({"x": math.inf}),
    "outcome": lambda rig: rig.outcome(3),
    "lease": lambda rig: rig.control("x", client="a", lease_s=0.0).__aenter__(),
}


@pytest.mark.parametrize("call", CALLS.values(), ids=CALLS)
async def test_a_value_that_a_command_does_not_take_is_named_in_an_error_with_a_code(call):
    async with running_rig() as running:
        rig = Rig(running.client, await running.client.daemon())
        with pytest.raises(MalformedRequest) as refused:
            await call(rig)

    assert refused.value.code == "malformed_request"
    assert "validation error" not in str(refused.value)
