"""Parameters from drive to drive: the plan, what speaks against it, and a clone that is interrupted and completed."""

import asyncio

import pytest

from ldcnd.contract.errors import DataRefused, LdcndError
from ldcnd.contract.parameters import Memory, PlanParameters, WriteParameter
from ldcnd.drives.smartstep.parameters import PARAMETERS, PN000, PN102, PN304
from ldcnd.drives.smartstep.transfer import AT_ONCE, AT_POWER_ON
from tests.support.smartstep_line import simulated, smartstep_line

OLD = {
    parameter: (parameter.limits.value.lowest + 7 if parameter.limits else 0x0011)
    for parameter in PARAMETERS
    if parameter is not PN000
}
"""Twenty-one parameters with values that no factory has set."""


async def carried_out(access, plan):
    """Send the writes of a plan as a client does; return those that are done, and the error that ended it."""
    done = []
    for write in plan.writes:
        try:
            await access.write(WriteParameter(parameter=write.parameter, value=write.value, memory=write.memory))
        except LdcndError as error:
            return done, error
        done.append(write)
    return done, None


async def wanted_of(axis):
    values = {value.parameter: value.stored for value in await axis.parameters.read_all()}
    return PlanParameters(values=values, driver_type=(await axis.parameters.facts()).driver_type)


async def test_a_replaced_drive_differs_in_its_unit_number_only_after_a_clone_and_a_power_cycle(tmp_path):
    old = simulated(1, stored={**OLD, PN000: 0x0101})
    new = simulated(2)
    async with smartstep_line([old, new], ledger=tmp_path / "ledger.json") as line:
        request = await wanted_of(line.axis("u1"))
        access = line.axis("u2").parameters

        done, error = await carried_out(access, await access.plan(request))
        again = await access.plan(request)
        now_s = asyncio.get_running_loop().time()
        new.power_off(now_s)
        new.power_on(now_s)
        first = {value.parameter: (value.stored, value.active) for value in await line.axis("u1").parameters.read_all()}
        second = {value.parameter: (value.stored, value.active) for value in await access.read_all()}

    assert len({write.parameter for write in done}) >= 20
    assert (error, again.writes) == (None, ())
    assert {label for label in first if first[label] != second[label]} == {"Pn000"}
    assert (first["Pn000"], second["Pn000"]) == ((0x0101, 0x0101), (0x0201, 0x0201))


async def test_a_write_that_fails_in_the_middle_is_said_and_the_same_again_completes_it(tmp_path):
    old = simulated(1, stored=OLD)
    new = simulated(2)
    async with smartstep_line([old, new], ledger=tmp_path / "ledger.json") as line:
        request = await wanted_of(line.axis("u1"))
        access = line.axis("u2").parameters
        limits = new.drive.memory._limits
        healthy, limits[PN304.number] = limits[PN304.number], type(limits[PN304.number])(1, 2)

        plan = await access.plan(request)
        done, error = await carried_out(access, plan)
        limits[PN304.number] = healthy
        rest = await access.plan(request)
        completed, none = await carried_out(access, rest)

    assert isinstance(error, DataRefused)
    assert 0 < len(done) < len(plan.writes)
    assert list(rest.writes) == list(plan.writes[len(done) :])
    assert (len(completed), none) == (len(rest.writes), None)


async def test_each_write_says_its_memory_its_digits_and_when_it_takes_effect(tmp_path):
    async with smartstep_line([simulated(1)], ledger=tmp_path / "ledger.json") as line:
        request = PlanParameters(values={"Pn000": 0x0F01, "Pn102": 50}, driver_type=0x000C)
        plan = await line.axis("u1").parameters.plan(request)

    assert [(write.parameter, write.memory, write.value, write.effective) for write in plan.writes] == [
        ("Pn000", Memory.EEPROM, 0x0101, AT_POWER_ON),
        ("Pn102", Memory.EEPROM, 50, AT_ONCE),
        ("Pn102", Memory.RAM, 50, AT_ONCE),
    ]
    assert plan.writes[0].digits == ("Pn000.0 = 1: rotation direction, clockwise is forward [X]",)
    assert "power-on" in plan.remarks[0]


@pytest.mark.parametrize(("driver_type", "words"), [(0x000D, "000DH"), (None, "do not say")])
async def test_values_of_another_or_an_unknown_type_are_refused_unless_allowed(driver_type, words):
    async with smartstep_line([simulated(1)]) as line:
        access = line.axis("u1").parameters
        request = PlanParameters(values={"Pn102": 50}, driver_type=driver_type)
        plan = await access.plan(request)
        allowed = await access.plan(request.model_copy(update={"any_type": True}))

    assert words in plan.problems[0]
    assert (allowed.problems, len(allowed.writes)) == ((), 2)


async def test_trying_out_leaves_out_what_takes_effect_at_power_on():
    async with smartstep_line([simulated(1)]) as line:
        request = PlanParameters(values={"Pn202": 8, "Pn102": 50}, driver_type=0x000C, memory=Memory.RAM)
        plan = await line.axis("u1").parameters.plan(request)

    assert [(write.parameter, write.memory) for write in plan.writes] == [("Pn102", Memory.RAM)]
    assert "Pn202" in plan.remarks[0]


async def test_what_is_in_use_is_saved_to_eeprom_with_the_unit_number_that_is_stored(tmp_path):
    drive = simulated(1)
    async with smartstep_line([drive], ledger=tmp_path / "ledger.json") as line:
        access = line.axis("u1").parameters
        await access.write(WriteParameter(parameter="Pn102", value=66))
        values = {value.parameter: value.active for value in await access.read_all() if value.differs}
        plan = await access.plan(PlanParameters(values=values, any_type=True, memory=Memory.EEPROM))
        await carried_out(access, plan)

    assert drive.drive.memory.stored(PN102) == 66
    assert drive.drive.memory.stored(PN000) == 0x0100


async def test_what_the_drive_or_the_manual_lacks_is_a_problem():
    async with smartstep_line([simulated(1)]) as line:
        request = PlanParameters(values={"Pn7FF": 1}, driver_type=0x000C)
        plan = await line.axis("u1").parameters.plan(request)

    assert "Pn7FF" in plan.problems[0]
