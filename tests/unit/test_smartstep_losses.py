"""Each command of the manual loses its request or its reply at every step of a trace, a clear and a write."""

import asyncio
import json

import pytest

from ldcnd.contract.errors import BusError, DriveFault, RequestRefused
from ldcnd.contract.parameters import CounterName, Memory, WriteParameter
from ldcnd.contract.traces import TakeTrace, TraceTrigger, TriggerKind
from ldcnd.drives.smartstep.addresses import EEPROM_AREA, RAM_AREA, OperatingMode, Register, TraceRegister
from ldcnd.drives.smartstep.packet import Function, decode_command
from ldcnd.drives.smartstep.parameters import PN102
from ldcnd.drives.smartstep.profiles import SMARTSTEP
from ldcnd.line.flight_recorder import WireEvent
from ldcnd.sim.smartstep.variant import BENCH_TRIGGER_MAP
from tests.support.smartstep_line import LosingUnit, executes_in_a_fresh_mode_only, smartstep_line

WITHIN_S = 30.0
SHORT = SMARTSTEP.with_trace(chunk_bytes=1000, trigger_map=BENCH_TRIGGER_MAP)
LOSSES = [("request",), ("reply",), ("request", "reply"), ("reply", "request", "reply")]


def loses(step: int, losses: tuple[str, ...]):
    """Lose these, one after the other, from the command at this place on."""
    return lambda place, _packet: losses[place - step] if 0 <= place - step < len(losses) else None


async def trace(axis, _unit):
    armed = await axis.tracer.arm(TakeTrace(channels=("speed_feedback",)))
    recorded = await armed.record(lambda _phase, _uploaded: None)
    return list(recorded.raw[0])


async def clear(axis, _unit):
    return (await axis.parameters.clear_counter(CounterName.FEEDBACK)).value


async def write(axis, _unit):
    request = WriteParameter(parameter="Pn102", value=77, memory=Memory.EEPROM)
    return (await axis.parameters.write(request)).value.stored


async def triggered(axis, unit):
    trigger = TraceTrigger(channel="speed_feedback", kind=TriggerKind.RISING, level=100.0)
    request = TakeTrace(
        channels=("speed_feedback",), trigger=trigger, full_scale={"speed_feedback": 3000.0}, timeout_s=20
    )
    armed = await axis.tracer.arm(request)
    unit.drive.set_run(asyncio.get_running_loop().time(), on=True)
    unit.drive.set_pulse_rate(8000.0, asyncio.get_running_loop().time())
    recorded = await armed.record(lambda _phase, _uploaded: None)
    first = unit.drive.read(Register.TRGADR)
    return list(recorded.raw[0][-first:] + recorded.raw[0][:-first]) if first else list(recorded.raw[0])


async def try_out(axis, _unit):
    return (await axis.parameters.write(WriteParameter(parameter="Pn102", value=77))).value.active


STEPS = {trace: 31, clear: 19, write: 6, try_out: 6, triggered: 40}
"""At least as many commands as each takes without a loss; a step beyond the last one loses nothing."""
CASES = [
    # every step is lost in one of the ways, of the longest work every fourth; the soak loses each in all of them
    pytest.param(
        work,
        step,
        losses,
        id=f"{work.__name__}-{step}-{'-'.join(losses)}",
        marks=[]
        if losses is LOSSES[step % len(LOSSES)] and (work is not triggered or step % 4 == 3)
        else [pytest.mark.soak],
    )
    for work, steps in STEPS.items()
    for step in range(steps)
    for losses in LOSSES
]


def kind_of(packet):
    """Return what a command is, as far as its repeating matters."""
    command = decode_command(packet)
    if command.function is not Function.SETTING:
        return command.function.name
    if command.address in EEPROM_AREA:
        return "EEPROM"
    return "RAM" if command.address in RAM_AREA else f"{command.address:04X}H"


async def test_every_command_of_the_manual_is_among_those_that_are_lost(tmp_path):
    kinds = set()
    for work in STEPS:
        unit = LosingUnit(1, lambda _place, _packet: None)
        async with smartstep_line([unit], profile=SHORT, ledger=tmp_path / "ledger.json") as line:
            await work(line.axis("u1"), unit)
        kinds |= set(map(kind_of, unit.commands))

    settings = {f"{each.value:04X}H" for each in TraceRegister if each is not TraceRegister.MAXTRQC}
    assert kinds == {"REFERENCE", "STRING_REFERENCE", "EEPROM", "RAM", "2000H", "2001H", *settings}


@pytest.mark.parametrize("work", STEPS)
async def test_every_step_is_among_those_that_are_lost(work, tmp_path):
    unit = LosingUnit(1, lambda _place, _packet: None)
    async with smartstep_line([unit], profile=SHORT, ledger=tmp_path / "ledger.json") as line:
        await work(line.axis("u1"), unit)

    assert len(unit.commands) <= STEPS[work]


@pytest.mark.parametrize(("work", "step", "losses"), CASES)
@pytest.mark.sweep(4)
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
    assert unit.drive.read(Register.OSVELCC) == unit.variant.osvelcc
    assert executes_in_a_fresh_mode_only(sent)
    known = json.loads(path.read_text())["u1"]["Pn102"] if path.exists() else 0
    assert unit.drive.memory.writes[PN102.number] <= known <= unit.drive.memory.writes[PN102.number] + 1
    if error:
        assert error.message
    elif work in {trace, triggered}:
        assert result == unit.drive.recorder.rings[0]
    elif work is clear:
        assert result == unit.drive.feedback_counter == 0
    elif work is try_out:
        assert result == unit.drive.memory.active(PN102) == 77
    else:
        assert result == unit.drive.memory.stored(PN102) == 77
