"""Each command of the manual loses its request or its reply at every step of a trace, a clear and a write."""

import asyncio
import json

import pytest

from ldcnd.drivers.smartstep.addresses import OperatingMode
from ldcnd.drivers.smartstep.parameters import PN102
from ldcnd.drivers.smartstep.profiles import SmartStepProfile
from ldcnd.errors import BusError, DriveFault, RequestRefused
from ldcnd.model.parameters import CounterName, Memory, WriteParameter
from ldcnd.model.traces import TakeTrace
from ldcnd.wirelog.recorder import WireEvent
from tests.support.smartstep_line import LosingUnit, executes_in_a_fresh_mode_only, smartstep_line

WITHIN_S = 30.0
SHORT = SmartStepProfile(trace_chunk_bytes=1000)
LOSSES = [("request",), ("reply",), ("request", "reply"), ("reply", "request", "reply")]


def loses(step: int, losses: tuple[str, ...]):
    """Lose these, one after the other, from the command at this place on."""
    return lambda place, _packet: losses[place - step] if 0 <= place - step < len(losses) else None


async def trace(axis, _unit):
    armed = await axis.tracer.arm(TakeTrace(channels=("speed_feedback",)))
    recorded = await armed.record(lambda _phase: None)
    return list(recorded.raw[0])


async def clear(axis, _unit):
    return (await axis.parameters.clear_counter(CounterName.FEEDBACK)).value


async def write(axis, _unit):
    request = WriteParameter(parameter="Pn102", value=77, memory=Memory.EEPROM)
    return (await axis.parameters.write(request)).value.stored


STEPS = {trace: 31, clear: 19, write: 6}
"""At least as many commands as each takes without a loss; a step beyond the last one loses nothing."""
CASES = [(work, step, losses) for work, steps in STEPS.items() for step in range(steps) for losses in LOSSES]


@pytest.mark.parametrize("work", STEPS)
async def test_every_step_is_among_those_that_are_lost(work, tmp_path):
    unit = LosingUnit(1, lambda _place, _packet: None)
    async with smartstep_line([unit], profile=SHORT, ledger=tmp_path / "ledger.json") as line:
        await work(line.axis("u1"), unit)

    assert len(unit.commands) <= STEPS[work]


@pytest.mark.parametrize(
    ("work", "step", "losses"), CASES, ids=[f"{work.__name__}-{step}-{'-'.join(lost)}" for work, step, lost in CASES]
)
async def test_after_any_loss_the_end_state_is_known_within_seconds(work, step, losses, tmp_path):
    unit = LosingUnit(1, loses(step, losses))
    unit.drive.motor.position = 2800.0
    path = tmp_path / "ledger.json"
    error = result = None
    async with smartstep_line([unit], profile=SHORT, ledger=path) as line:
        async with asyncio.timeout(WITHIN_S):
            try:
                result = await work(line.axis("u1"), unit)
            except (BusError, DriveFault, RequestRefused) as failure:
                error = failure
        sent = [record.data for record in line.bus.wire_log.records() if record.event is WireEvent.SENT]

    assert unit.drive.mode is OperatingMode.NORMAL
    assert executes_in_a_fresh_mode_only(sent)
    known = json.loads(path.read_text())["u1"]["Pn102"] if path.exists() else 0
    assert unit.drive.memory.writes[PN102.number] <= known <= unit.drive.memory.writes[PN102.number] + 1
    if error:
        assert error.message
    elif work is trace:
        assert result == unit.drive.recorder.rings[0]
    elif work is clear:
        assert result == unit.drive.feedback_counter == 0
    else:
        assert result == unit.drive.memory.stored(PN102) == 77
