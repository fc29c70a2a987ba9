"""Interlocks: what motions, power and outputs require: asked, watched while a motion lasts, overridden for a time."""

import asyncio
import contextlib
import re

import pytest
from pydantic import ValidationError

from ldcnd.config.interlocks import Requirement
from ldcnd.config.rig import single_line
from ldcnd.contract.commands import (
    Halt,
    Home,
    MoveAbsolute,
    MoveRelative,
    MoveVelocity,
    Power,
    Reset,
    SetGains,
    SetPosition,
    Stop,
)
from ldcnd.contract.condition import assess
from ldcnd.contract.errors import InterlockViolated, LdcndError, LeaseHeld, LeaseUnknown, WrongState
from ldcnd.contract.events import INTERLOCK, ReadEvents
from ldcnd.contract.leases import Acquire, Release
from ldcnd.contract.questions import Preview, Why
from ldcnd.contract.rig_commands import OverrideInterlock, SetIo
from ldcnd.contract.samples import AxisState, LinkState
from ldcnd.daemon.requirements import lack_of_axis
from ldcnd.drives.ldcn.packet import CommandCode, StatusItem
from ldcnd.sim.faults import FaultInjector, FaultyRequest
from ldcnd.sim.ldcn.power import FaultCondition
from tests.support.chain_rig import rig_on
from tests.support.command_line import virtual_rig
from tests.support.machine_rig import (
    CLOSED,
    DOOR_OPENS,
    DOOR_SHUT,
    OPEN,
    SAFE,
    Machine,
    chain_of_machine,
    machine,
    running_machine,
)
from tests.support.rig import running_rig, two_lines

SPIN = MoveVelocity(velocity=5.0)
LOCKED = SetIo(module="cabinet", high=("lock",))
UNLOCKED = SetIo(module="cabinet", low=("lock",))


async def power(rig: Machine, *axes: str) -> None:
    for axis in axes or ("rotor", "table"):
        await rig.client.command(axis, Power(on=True))


async def locked(rig: Machine) -> None:
    await rig.client.ask(LOCKED)
    await rig.named(lock=True, door_closed=True, door_open=False)


async def spinning(rig: Machine, speed: float = 5.0) -> None:
    await locked(rig)
    await power(rig)
    await rig.client.command("rotor", MoveVelocity(velocity=speed))
    await asyncio.sleep(1.0)
    assert rig.speed() == pytest.approx(speed, rel=0.05)


async def refused(rig: Machine, axis: str, command, match: str) -> InterlockViolated:
    with pytest.raises(InterlockViolated, match=match) as refusal:
        await rig.client.command(axis, command)
    return refusal.value


async def events(rig: Machine, verb: str) -> list[str]:
    page = await rig.client.ask(ReadEvents(count=100))
    return [event.reason or "" for event in page.events if event.verb == verb]


# -- each requirement, each kind ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("closed_contact", "open_contact", "lock", "why"),
    [
        (False, False, True, "input door_closed is false"),
        (True, True, True, "input door_open is true"),
        (True, False, False, "output lock is low"),
    ],
)
async def test_a_motion_is_refused_while_one_of_its_requirements_does_not_hold(closed_contact, open_contact, lock, why):
    async with running_machine(machine(DOOR_SHUT)) as rig:
        now_s = asyncio.get_running_loop().time()
        rig.io.drive_line(CLOSED, high=closed_contact, at_s=now_s)
        rig.io.drive_line(OPEN, high=open_contact, at_s=now_s)
        await rig.client.ask(LOCKED if lock else UNLOCKED)
        await rig.named(lock=lock, door_closed=closed_contact, door_open=open_contact)
        await power(rig)

        refusal = await refused(rig, "rotor", SPIN, f"axis rotor: interlock door_shut: {why}")

        assert (refusal.value, refusal.axis, refusal.page) == ("door_shut", "rotor", "faults/interlock_violated")
        assert rig.speed() == 0
        await rig.client.command("rotor", MoveVelocity(velocity=SAFE))  # not above it
        await rig.client.command("table", SPIN)  # another axis


AXIS_RULES = [
    ({"standstill": True}, "axis table does not stand"),
    ({"below": 0.5}, "axis table may be at"),
    ({"min": -1.0, "max": 1.0}, "axis table is not homed"),
    ({"max": -1.0, "homed": True}, "axis table is not homed"),
    ({"homed": True}, "axis table is not homed"),
]


@pytest.mark.parametrize(("requirement", "why"), AXIS_RULES)
@pytest.mark.sweep(2)
async def test_a_motion_requires_another_axis_to_be_so(requirement, why):
    rule = {"name": "clear", "of": "rotor", "requires": [{"axis": "table", **requirement}]}
    async with running_machine(machine(rule)) as rig:
        await power(rig)
        if "standstill" in requirement or "below" in requirement:
            await rig.client.command("table", MoveVelocity(velocity=2.0))
            await refused(rig, "rotor", SPIN, why)  # at once: it is commanded, not yet seen
            await rig.client.command("table", Halt())
            await rig.until("table", lambda state: state.state is AxisState.STANDSTILL)
        else:
            await refused(rig, "rotor", SPIN, why)
            await rig.client.command("table", SetPosition(position=-1.0))
        await rig.client.command("rotor", SPIN)


async def test_a_lock_stays_shut_beside_a_shaft_that_was_lost_in_motion_until_its_coasting_is_over():
    # its encoder dies meanwhile, and looks like rest
    chain = chain_of_machine()
    async with running_machine(machine(DOOR_OPENS, axis={"coast_s": 4.0}), chain) as rig:
        await power(rig)
        await rig.client.ask(LOCKED)
        await rig.client.command("rotor", SPIN)
        await rig.until("rotor", lambda state: state.state is AxisState.CONTINUOUS_MOTION)
        await asyncio.sleep(1.0)
        now_s = asyncio.get_running_loop().time()
        chain.unplug(now_s, 1.0)
        chain.modules[0].set_condition(FaultCondition.ENCODER_STUCK, present=True, at_s=now_s)
        await asyncio.sleep(1.0)
        chain.modules[0].loop.open()
        await rig.until("rotor", lambda state: state.link is LinkState.UP and not (state.enabled or state.stop_pending))
        await rig.client.command("rotor", Reset())
        with pytest.raises(InterlockViolated, match="axis rotor may coast"):
            await rig.client.ask(UNLOCKED)
        await asyncio.sleep(17.0)
        await rig.client.ask(UNLOCKED)


@pytest.mark.parametrize(
    ("ends", "within", "said"),
    [
        ({"min": 0.0, "max": 1.0}, 0.5, "between 0 rev and 1 rev"),
        ({"max": 1.0}, 0.5, "at most 1 rev"),
        ({"min": 2.0}, 2.5, "at least 2 rev"),
    ],
)
async def test_a_motion_requires_another_axis_to_be_in_a_range(ends, within, said):
    rules = [{"name": name, "of": name, "requires": [{"axis": "table", **ends}]} for name in ("rotor", "lock")]
    async with running_machine(machine(*rules)) as rig:
        await power(rig)
        await rig.client.command("table", SetPosition(position=1.5))
        await refused(rig, "rotor", SPIN, f"axis table is at 1.5 rev, which is not {said}$")
        with pytest.raises(InterlockViolated) as refusal:
            await rig.client.ask(LOCKED)
        assert f"wait until axis table is {said}, then" in str(refusal.value.remedy)
        await rig.client.command("table", MoveAbsolute(position=within))
        await rig.until("table", lambda state: state.state is AxisState.STANDSTILL)
        await rig.client.command("rotor", SPIN)


@pytest.mark.parametrize(
    ("kind", "commands"),
    [
        ("position", [MoveRelative(distance=1.0)]),
        ("velocity", [SPIN]),
        ("home", [Home(method="index", velocity=1.0)]),
        ("power_on", [Power(on=True)]),
    ],
)
async def test_a_rule_binds_its_kinds_only(kind, commands):
    rule = {"name": "shut", "of": "rotor", "kind": [kind], "requires": [{"input": "door_closed"}]}
    async with running_machine(machine(rule)) as rig:
        rig.door(closed=False)
        await rig.named(door_closed=False)
        kinds = {"position": MoveRelative(distance=0.1), "velocity": MoveVelocity(velocity=0.1)}
        if kind == "power_on":
            await refused(rig, "rotor", Power(on=True), "interlock shut")
            return
        await power(rig)
        for command in commands:
            await refused(rig, "rotor", command, "interlock shut")
        for other, command in kinds.items():
            if other != kind:
                await rig.client.command("rotor", command)
                break


async def test_a_module_that_does_not_answer_forbids_what_requires_it():
    rule = {"name": "there", "of": "rotor", "requires": [{"module": "cabinet"}]}
    async with running_machine(machine(rule)) as rig:
        await power(rig)
        await rig.client.command("rotor", MoveRelative(distance=0.1))
        await rig.until("rotor", lambda state: state.state is AxisState.STANDSTILL)
        rig.io.power(on=False, at_s=asyncio.get_running_loop().time())
        await asyncio.sleep(0.5)
        await refused(rig, "rotor", SPIN, "module cabinet does not answer")


# -- outputs -----------------------------------------------------------------------------------------------------------


async def test_an_output_is_not_written_while_the_rotor_turns_or_is_about_to():
    async with running_machine(machine(DOOR_OPENS)) as rig:
        await spinning(rig)
        with pytest.raises(InterlockViolated, match="output lock: interlock door_opens: axis rotor may be at 5"):
            await rig.client.ask(UNLOCKED)
        with pytest.raises(InterlockViolated):
            await rig.client.ask(SetIo(module="cabinet", inputs=("lock",)))  # to let go of it may open, too
        await rig.client.ask(LOCKED)
        await rig.client.command("rotor", Halt())
        await asyncio.sleep(0.1)
        with pytest.raises(InterlockViolated):
            await rig.client.ask(UNLOCKED)
        await rig.until("rotor", lambda state: state.state is AxisState.STANDSTILL)
        await rig.client.ask(UNLOCKED)

        assert rig.io.latch & 1 << 9 == 0


@pytest.mark.promise("interlock-asked-and-watched")
@pytest.mark.parametrize("first", ["motion", "output"])
async def test_a_motion_and_an_output_that_forbid_each_other_never_both_pass(first):
    async with running_machine(machine(DOOR_SHUT, DOOR_OPENS)) as rig:
        await locked(rig)
        await power(rig)
        motion = rig.client.command("rotor", SPIN)
        output = rig.client.ask(UNLOCKED)
        both = (motion, output) if first == "motion" else (output, motion)
        results = await asyncio.gather(*both, return_exceptions=True)

        assert any(isinstance(result, InterlockViolated) for result in results)
        await asyncio.sleep(1.0)
        assert rig.speed() < SAFE or rig.io.latch & 1 << 9


# -- watched -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("reaction", ["halt", "quick_stop", "power_off"])
@pytest.mark.sweep(2)
async def test_a_motion_is_ended_when_a_requirement_is_lost(reaction):
    async with running_machine(machine(DOOR_SHUT | {"reaction": reaction})) as rig:
        await spinning(rig)
        rig.door(closed=False)
        await asyncio.sleep(0.1)
        assert rig.speed() < 5.0 * 0.99
        await asyncio.sleep(2.0)

        state = await rig.client.state("rotor")
        assert state.state is (AxisState.DISABLED if reaction == "power_off" else AxisState.STANDSTILL)
        noticed = [each.text for each in assess(state, None, None).troubles if "interlock" in each.text]
        both = "interlock door_shut: input door_closed is false; input door_open is true"
        assert noticed == [f"its motion was ended by {both}"]
        (said,) = await events(rig, "interlock")
        assert said == f"axis rotor: {both}; reaction: {reaction}"
        (*_, ended) = await events(rig, "move_velocity")
        assert ended.endswith(f", because of {both}"), ended
        verb = "power" if reaction == "power_off" else "halt"
        assert state.last_error == f"move_velocity: aborted by {verb}, because of {both}"


async def test_a_stop_under_way_that_an_interlock_takes_over_has_not_failed():
    async with running_machine(machine(DOOR_SHUT)) as rig:
        await spinning(rig)
        await rig.client.stop("rotor")
        rig.door(closed=False)
        await rig.until("rotor", lambda state: bool(state.interlock))
        braking = await rig.client.state("rotor")
        state = await rig.until("rotor", lambda state: state.moving == "no")
        told = await events(rig, "interlock")

    assert braking.state is AxisState.STOPPING
    assert len(told) == 1
    assert state.interlock == "door_shut: input door_closed is false; input door_open is true"
    assert state.last_error == "move_velocity: aborted by stop"


@pytest.mark.long
async def test_a_motion_goes_on_where_the_rule_has_no_reaction():
    async with running_machine(machine(DOOR_SHUT | {"reaction": "none"})) as rig:
        await spinning(rig)
        rig.door(closed=False)
        await asyncio.sleep(1.0)
        assert rig.speed() == pytest.approx(5.0, rel=0.05)


async def test_other_gains_are_refused_where_a_motion_of_any_speed_would_be_and_the_loop_is_closed():
    async with running_machine(machine(DOOR_SHUT)) as rig:
        rig.door(closed=False)
        await rig.named(door_closed=False)
        await rig.client.command("rotor", SetGains(kd=700))
        await power(rig)
        await refused(rig, "rotor", SetGains(kd=800), "interlock door_shut")
        rig.door(closed=True)
        await rig.client.ask(LOCKED)
        await rig.named(door_closed=True, lock=True)
        await rig.client.command("rotor", SetGains(kd=800))


async def test_a_slow_motion_goes_on_when_only_fast_ones_are_bound():
    async with running_machine(machine(DOOR_SHUT)) as rig:
        await locked(rig)
        await power(rig)
        await rig.client.command("rotor", MoveVelocity(velocity=0.8))
        rig.door(closed=False)
        await asyncio.sleep(1.0)
        assert rig.speed() == pytest.approx(0.8, rel=0.1)


@pytest.mark.promise("interlock-asked-and-watched")
async def test_a_motion_is_ended_within_the_bound_when_the_module_falls_silent():
    async with running_machine(machine(DOOR_SHUT | {"within_ms": 200})) as rig:
        await spinning(rig)
        rig.io.power(on=False, at_s=asyncio.get_running_loop().time())
        await asyncio.sleep(0.25)
        assert rig.speed() < 5.0 * 0.99
        await asyncio.sleep(1.0)
        assert rig.speed() == 0


async def test_a_motion_is_ended_within_the_bound_when_a_debounced_contact_bounces():
    # each reading shows another level than the one before: no one of them tells whether the door is shut
    inputs = {"door_closed": {"line": CLOSED, "debounce_ms": 1}, "door_open": {"line": OPEN}}
    config = machine(DOOR_SHUT | {"within_ms": 234}, module={"rate": 20, "inputs": inputs})
    async with running_machine(config) as rig:
        await spinning(rig)
        loop, cabinet = asyncio.get_running_loop(), rig.daemon.rig.modules["cabinet"]
        proven_at_s = cabinet.read_at_s

        async def shake() -> None:
            for at in range(40):
                rig.io.drive_line(CLOSED, high=bool(at % 2), at_s=loop.time())
                read_at_s = cabinet.read_at_s
                while cabinet.read_at_s == read_at_s:
                    await asyncio.sleep(0.001)

        shaking = asyncio.create_task(shake())
        await rig.until_speed(below=4.5)
        assert loop.time() - proven_at_s < 0.234 + 0.5 / 20 + 0.02  # what the ramp takes until then, and the line
        await shaking
        assert rig.speed() == 0
        assert "input door_closed is not known" in (await events(rig, INTERLOCK))[0]


@pytest.mark.parametrize(("rate", "debounce_ms"), [(5, 20), (20, 1), (20, 50), (20, 120), (50, 20)])
async def test_a_motion_goes_on_over_one_disturbed_reading_of_a_debounced_input_in_the_least_bound(rate, debounce_ms):
    inputs = {"door_closed": {"line": CLOSED, "debounce_ms": debounce_ms}, "door_open": {"line": OPEN}}
    requires = [{"input": "door_closed"}]
    rule, module = DOOR_SHUT | {"requires": requires}, {"rate": rate, "inputs": inputs}
    with pytest.raises(
        ValidationError, match="less than a disturbed poll and the debouncing of door_closed"
    ) as refusal:
        machine(rule | {"within_ms": 20}, module=module)
    (least_ms,) = re.findall(r"allow (\d+)", str(refusal.value))
    async with running_machine(machine(rule | {"within_ms": int(least_ms)}, module=module)) as rig:
        await spinning(rig)
        cabinet = rig.daemon.rig.modules["cabinet"]
        for closed in (True, False, True, True, True, True, True, True):
            rig.io.drive_line(CLOSED, high=closed, at_s=asyncio.get_running_loop().time())
            read_at_s = cabinet.read_at_s
            while cabinet.read_at_s == read_at_s:
                await asyncio.sleep(0.001)

        assert rig.speed() == pytest.approx(5.0, rel=0.05)
        assert await events(rig, INTERLOCK) == []


async def test_a_drive_that_was_only_read_too_long_ago_is_not_said_to_be_silent():
    table = Requirement(axis="table")
    async with running_machine(machine()) as rig:
        loop, axis = asyncio.get_running_loop(), rig.daemon.rig.axes["table"]
        late = lack_of_axis(axis, table, loop.time() + 1.0, 0.1, lambda _: False)
        rig.chain.mute(2, on=True)
        await rig.until("table", lambda state: state.link is LinkState.DOWN)
        silent = lack_of_axis(axis, table, loop.time(), 0.1, lambda _: False)

    assert late.text == "is not known: it was read longer ago than the interlock allows"
    assert silent.text == "is not known: its drive does not answer"


async def test_a_motion_is_ended_although_its_drive_is_not_heard():
    async with running_machine(machine(DOOR_SHUT)) as rig:
        await spinning(rig)
        rig.chain.mute(1, on=True)
        await rig.until("rotor", lambda state: state.link is LinkState.DOWN)
        assert rig.speed() == pytest.approx(5.0, rel=0.05)
        rig.door(closed=False)
        await asyncio.sleep(2.0)
        assert rig.speed() == 0


@pytest.mark.parametrize(
    ("request_", "refused_"), [(UNLOCKED, True), (LOCKED, False), (SetIo(module="cabinet", pwm1=0.5), False)]
)
@pytest.mark.sweep(2)
async def test_to_write_an_output_ends_no_motion_that_requires_it_as_it_stays(request_, refused_):
    async with running_machine(machine(DOOR_SHUT, DOOR_OPENS)) as rig:
        await spinning(rig)
        for _ in range(10):
            with contextlib.nullcontext() if not refused_ else pytest.raises(InterlockViolated):
                await rig.client.ask(request_)
            await asyncio.sleep(0.01)
        await asyncio.sleep(0.5)

        assert rig.speed() == pytest.approx(5.0, rel=0.05)
        assert not await events(rig, "interlock")


# -- power -------------------------------------------------------------------------------------------------------------

HANGING = {"name": "brake", "of": "table", "kind": ["power_off"], "requires": [{"output": "lock"}]}


@pytest.mark.promise("interlock-never-a-stop")
async def test_a_hanging_load_is_held_until_its_brake_is_set_and_stops_are_never_refused():
    async with running_machine(machine(HANGING)) as rig:
        await power(rig)
        await rig.client.command("table", MoveVelocity(velocity=2.0))
        await refused(rig, "table", Power(on=False), "interlock brake: output lock is not known")
        await rig.until("table", lambda state: state.state is AxisState.STANDSTILL)  # its motion has ended, it holds
        await rig.client.command("rotor", Power(on=False))
        await rig.client.ask(LOCKED)
        await rig.named(lock=True)
        await rig.client.command("table", Power(on=False))
        await rig.until("table", lambda state: state.state is AxisState.DISABLED)
        await rig.client.ask(UNLOCKED)
        await rig.named(lock=False)
        await rig.client.command("table", Power(on=True))
        reply = await rig.client.stop()

        assert set(reply.confirmed) == {"rotor", "table"}


async def test_a_reset_does_not_drop_a_load_that_its_loop_holds():
    unsettled = {"settle": {"window": 1e-9, "time_s": 0.01, "timeout_s": 0.05, "unsettled": "fault"}}
    async with running_machine(machine(HANGING, axis=unsettled)) as rig:
        await power(rig)
        await rig.client.command("table", MoveRelative(distance=0.1))
        await rig.until("table", lambda state: state.state is AxisState.ERROR_STOP)
        # whether it stands no reading proves, and a reset would switch its motor off
        with pytest.raises(WrongState, match="still moves, or may"):
            await rig.client.command("table", Reset())
        await refused(rig, "table", Power(on=False), "interlock brake")
        await locked(rig)
        await rig.client.command("table", Power(on=False))
        await rig.client.command("table", Reset())


@pytest.mark.promise("interlock-never-a-stop")
@pytest.mark.parametrize("command", [Halt(), Stop()])
@pytest.mark.sweep(2)
async def test_what_takes_energy_out_is_asked_no_interlock(command):
    rules = [
        {"name": f"n{at}", "of": axis, "kind": ["position", "velocity", "home", "power_on", "power_off"]}
        | {"requires": [{"input": "door_closed"}], "reaction": "none"}
        for at, axis in enumerate(("rotor", "table"))
    ]
    async with running_machine(machine(*rules)) as rig:
        await spinning(rig)
        rig.door(closed=False)
        await rig.named(door_closed=False)
        await rig.client.command("rotor", command)
        await asyncio.sleep(1.5)
        assert rig.speed() == 0


# -- said --------------------------------------------------------------------------------------------------------------


async def test_why_and_preview_name_the_interlock():
    async with running_machine(machine(DOOR_SHUT)) as rig:
        await locked(rig)
        await power(rig)
        assert (await rig.client.ask(Why(absolute=False), "rotor")).can_move
        rig.door(closed=False)
        await rig.named(door_closed=False)

        why = await rig.client.ask(Why(absolute=False, each_command=True), "rotor")
        slow = await rig.client.ask(Preview(velocity=0.5), "rotor")
        fast = await rig.client.ask(Preview(distance=3.0), "rotor")

        assert [cause.code for cause in why.causes] == ["interlock_violated"]
        (hindered,) = [each for each in why.commands if "move_velocity" in each.verbs]
        assert "input door_closed is false" in hindered.causes[0].text
        assert not slow.obstacles
        assert "interlock door_shut" in fast.obstacles[0]


async def test_all_requirements_that_do_not_hold_are_named():
    async with running_machine(machine(DOOR_SHUT)) as rig:
        await power(rig)
        rig.door(closed=False)
        await rig.named(door_closed=False)
        parts = "input door_closed is false; input door_open is true; output lock is not known"
        await refused(rig, "rotor", SPIN, f"interlock door_shut: {parts}$")
        (cause,) = (await rig.client.ask(Why(absolute=False), "rotor")).causes
        assert cause.text.endswith(parts)
        assert cause.remedy.startswith("set output lock high, then see to it that the rest holds; for service")

        rig.io.power(on=False, at_s=asyncio.get_running_loop().time())
        await asyncio.sleep(0.5)
        gone = "input door_closed, input door_open, output lock are not known: module cabinet does not answer$"
        await refused(rig, "rotor", SPIN, f"interlock door_shut: {gone}")


def test_the_refusal_names_what_makes_an_output_known(monkeypatch):
    with virtual_rig(monkeypatch, machine(DOOR_SHUT), {"line": chain_of_machine()}) as rig:
        rig.wait(rig.rig.until("rotor", lambda state: state.link is LinkState.UP))
        rig.wait(asyncio.sleep(1.0))
        rig.run("power on rotor")
        refused = rig.run("move rotor 3 --at-velocity")
        way_out = "ldcnd bus set-io cabinet lock=high"
        assert (refused.code, f"  {way_out}; for service" in refused.errors) == (1, True)
        assert f": {way_out}; for service" in rig.run("why rotor").printed
        assert rig.run(way_out.removeprefix("ldcnd ")).code == 0
        rig.wait(asyncio.sleep(0.2))
        assert rig.run("move rotor 3 --at-velocity").code == 0


# -- overridden --------------------------------------------------------------------------------------------------------


def lift(seconds: float, lease: str) -> OverrideInterlock:
    return OverrideInterlock(interlock="door_shut", seconds=seconds, reason="adjusting the door", lease=lease)


async def test_an_override_holds_for_its_time_and_its_lease_and_is_recorded():
    async with running_machine(machine(DOOR_SHUT)) as rig:
        await power(rig)
        rig.door(closed=False)
        await rig.named(door_closed=False)
        with pytest.raises(LeaseUnknown):
            await rig.client.ask(lift(60.0, "made up"))
        table = await rig.client.ask(Acquire(client="bob", axes=("table",), lease_s=60.0))
        with pytest.raises(LeaseHeld):
            await rig.client.ask(lift(60.0, table.lease))
        lease = await rig.client.ask(Acquire(client="ann", axes=("rotor",), lease_s=60.0))
        spin = SPIN.model_copy(update={"lease": lease.lease})
        await rig.client.ask(lift(3.0, lease.lease))

        await rig.client.command("rotor", spin)
        await asyncio.sleep(2.0)
        assert rig.speed() == pytest.approx(5.0, rel=0.05)
        await asyncio.sleep(2.0)
        assert rig.speed() == 0
        await refused(rig, "rotor", spin, "door_shut")
        await rig.client.ask(lift(60.0, lease.lease))
        await rig.client.ask(Release(lease=lease.lease))
        await refused(rig, "rotor", SPIN, "door_shut")

        assert await events(rig, "override_interlock") == [
            "interlock door_shut overridden for 3 s: adjusting the door",
            "interlock door_shut binds again: its time is over",
            "interlock door_shut overridden for 60 s: adjusting the door",
            "interlock door_shut binds again: the lease of its client has ended",
        ]


def test_the_command_line_says_that_a_rule_binds_again_whose_override_is_taken_back(monkeypatch):
    with virtual_rig(monkeypatch, machine(DOOR_SHUT), {"line": chain_of_machine()}) as rig:
        rig.wait(rig.rig.until("rotor", lambda state: state.link is LinkState.UP))
        lease = rig.wait(rig.rig.client.ask(Acquire(client="ann", axes=("rotor",), lease_s=60.0))).lease
        lifts = f"bus override-interlock door_shut --reason service --lease {lease} --seconds"
        said = [rig.run(f"{lifts} {seconds}").printed.splitlines()[-1] for seconds in (60, 0)]

    assert said == ["interlock door_shut is overridden for 60 s by ann", "interlock door_shut binds"]


# -- configuration -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"of": "spindle"}, "no axis or output 'spindle'"),
        ({"kind": ["high"]}, "rotor takes no kind 'high'"),
        ({"of": "lock", "kind": ["home"], "above": None}, "lock takes no kind 'home'"),
        ({"of": "lock"}, "above is of the motion of an axis"),
        ({"requires": [{"input": "dor"}]}, "no input 'dor'; there are: door_closed, door_open"),
        ({"requires": [{"axis": "table", "input": "door_open"}]}, "exactly one"),
        ({"requires": [{"input": "door_open", "below": 1.0}]}, "are of an axis"),
        ({"requires": [{"module": "cabinet", "value": False}]}, "only an input or an output"),
        ({"within_ms": 30}, "less than two polls"),
    ],
)
def test_impossible_interlocks_are_refused_in_the_configuration(change, said):
    with pytest.raises(ValidationError, match=said):
        machine(DOOR_SHUT | change)


# -- taken over --------------------------------------------------------------------------------------------------------


async def test_a_machine_that_another_host_has_left_in_mid_spin_is_taken_over_and_brought_to_rest_in_order():
    chain = chain_of_machine()
    async with rig_on(chain, machine(axis={"loss": {"daemon": "run_to_target"}})) as before:
        await before.until("rotor", lambda state: state.link == "up")
        await before.client.ask(LOCKED)
        await before.client.command("rotor", Power(on=True))
        await before.client.command("rotor", SPIN)
        await asyncio.sleep(1.0)
        await before.kill()
    rotor, table, io = chain.modules
    rotor.items = table.items = StatusItem(0x1F)
    io.items = StatusItem(0x03)
    rotor.group = table.group = 0x85
    latch = io.latch

    by_contacts = DOOR_SHUT | {"requires": [{"input": "door_closed"}, {"input": "door_open", "value": False}]}
    async with running_machine(machine(by_contacts, DOOR_OPENS, start="adopt"), chain) as rig:
        await rig.named(lock=None, door_closed=True)
        await asyncio.sleep(3.0)
        assert rig.speed() == pytest.approx(5.0, rel=0.05)
        assert (rig.io.latch, rig.io.outputs) == (latch, 1 << 9)
        with pytest.raises(InterlockViolated):
            await rig.client.ask(SetIo(module="cabinet", low=("lock",), pwm1=0.0, pwm2=0.0))
        await rig.client.command("rotor", Halt())
        await rig.until("rotor", lambda state: state.state is AxisState.STANDSTILL)
        await rig.client.ask(UNLOCKED)
        assert rig.io.latch == 0


async def test_a_machine_that_is_taken_over_with_its_door_open_is_brought_to_rest():
    chain = chain_of_machine()
    async with rig_on(chain, machine()) as before:
        await before.until("rotor", lambda state: state.link == "up")
        await before.client.command("rotor", Power(on=True))
        await before.client.command("rotor", SPIN)
        await asyncio.sleep(1.0)
        await before.kill()
    chain.modules[2].drive_line(CLOSED, high=False, at_s=asyncio.get_running_loop().time())
    async with running_machine(machine(DOOR_SHUT, start="adopt"), chain) as rig:
        await asyncio.sleep(1.0)
        assert rig.speed() == 0
        state = await rig.client.state("rotor")
        assert state.interlock == "door_shut: input door_closed is false; output lock is not known"


@pytest.mark.promise("outputs-by-command")
@pytest.mark.parametrize("lost", [1, 2])
@pytest.mark.parametrize("end", ["stop", "force"])
@pytest.mark.sweep(2)
async def test_an_output_whose_packet_was_lost_is_not_written_again_after_what_forbids_it(lost, end, monkeypatch):
    def request(self, data, at_s):
        if data[1:2] == b"\x03" and data[2] & 0x0F == CommandCode.SET_GAIN and left:
            left.pop()
            if not left:
                last_lost.set()
            return FaultyRequest((None,) * len(data))
        return sent(self, data, at_s)

    sent, left, last_lost = FaultInjector.request, [], asyncio.Event()
    async with running_machine(machine()) as rig:
        held = await rig.client.ask(Acquire(client="ann", axes=("rotor", "table"), lease_s=60.0))
        await rig.client.ask(UNLOCKED.model_copy(update={"lease": held.lease}))  # it is an output from now on
        monkeypatch.setattr(FaultInjector, "request", request)
        left += [True] * lost
        writing = asyncio.create_task(rig.client.ask(LOCKED.model_copy(update={"lease": held.lease})))
        await last_lost.wait()
        if end == "stop":
            await rig.client.stop()
        else:
            await rig.client.ask(Acquire(client="bob", axes=("rotor", "table"), lease_s=60.0, force=True))
        with pytest.raises(LdcndError, match="sent once, in vain or with its reply lost"):
            await writing
        await asyncio.sleep(1.0)

        assert rig.io.latch == 0


@pytest.mark.parametrize(("line", "axis"), [("line0", "rotor"), ("line1", "x")])
async def test_a_line_is_served_by_itself_where_another_line_has_rules(tmp_path, line, axis):
    async with running_rig(single_line(two_lines(tmp_path), line)) as rig:
        await rig.until(axis, lambda state: state.link is LinkState.UP)
