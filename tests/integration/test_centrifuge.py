"""The centrifuge of `config/centrifuge.toml` cannot be operated against its rules; each row of them is needed."""

import asyncio
import getpass
import json
import re
from collections.abc import Callable
from contextlib import suppress

import pytest

from ldcnd.client.events import latest_events
from ldcnd.client.sequences import SequenceRun
from ldcnd.config.rig import load_config
from ldcnd.contract.errors import ErrorCode, InterlockViolated, LdcndError, LeaseExpired, NotReferenced, WrongState
from ldcnd.contract.leases import Acquire
from ldcnd.contract.rig_commands import OverrideInterlock
from ldcnd.contract.samples import Moving, Quality
from ldcnd.drives.axis_config import PwmConfig
from ldcnd.drives.network import AdoptFallback, StartPolicy
from ldcnd.sim.ldcn.drive import SimulatedDrive
from ldcnd.sim.ldcn.io import SimulatedIo
from ldcnd.sim.ldcn.power import FaultCondition
from ldcnd.testing import run, simulated_rig
from tests.support.command_line import virtual_rig
from tests.support.process import ROOT

CENTRIFUGE = load_config(ROOT / "config" / "centrifuge.toml")
(CABINET,) = CENTRIFUGE.bus[0].module
WIRES = {name: each.line for name, each in CABINET.inputs.items()}
CABLES = (("door_closed", "door_ajar", "door_open"), ("locked", "unlocked"), ("balanced", "unbalanced"), tuple(WIRES))
"""Wires that may break together."""
BREAKS = {"cut": True, "grounded": False}
"""What a wire does to a sensor, and the level that it leaves: lines are pulled up."""
FAST = 10.0
PLAY = 0.002
"""Share of its way by which a door or a bolt that is in has not arrived."""
CREEPS = 0.2
"""Revolutions a second; faster than the hunting of a rotor that stands."""


class Centrifuge:
    """Its simulated machine, and a client that has the rotor."""

    def __init__(self, rig, rotor):
        self.rig, self.rotor = rig, rotor
        self.drive, self.io = rig.lines["line0"].modules
        assert isinstance(self.drive, SimulatedDrive)
        assert isinstance(self.io, SimulatedIo)

    async def high(self, *names):
        await self.rig.client.set_io("cabinet", high=names)

    async def low(self, *names):
        await self.rig.client.set_io("cabinet", low=names)

    async def spin(self):
        motion = await self.rotor.move_velocity(FAST, acceleration=10, duration_s=60)
        await self.rig.until(lambda: self.speed > FAST - 0.5)
        return motion

    async def shut_door_opens(self):
        await self.high("unlock")
        await self.sees(locked=False)
        await self.high("door")
        await self.sees(door_open=True)

    async def sees(self, **wanted):
        async with asyncio.timeout(5), self.rig.client.samples("cabinet", "io") as samples:
            async for _, sample in samples:
                if all(sample.named[name] is value for name, value in wanted.items()):
                    return

    def breaks(self, wire, how):
        self.io.drive_line(WIRES[wire], high=BREAKS[how], at_s=asyncio.get_running_loop().time())

    def jam(self, part, *, jammed=True):
        self.io.jam(part, jammed=jammed, at_s=asyncio.get_running_loop().time())

    async def tries_to_spin(self):
        """Try it for long enough; return whether the rotor has turned."""
        with suppress(LdcndError):
            await self.rotor.move_velocity(FAST, acceleration=10, duration_s=2)
        await asyncio.sleep(0.7)
        turned = self.speed > CREEPS
        with suppress(LdcndError):
            await (await self.rotor.halt()).done()
        return turned

    @property
    def open_or_unlocked(self):
        return self.part("door") > PLAY or self.part("lock") < 1.0 - PLAY

    @property
    def speed(self) -> float:
        return abs(self.rig.truth("rotor").velocity)

    def part(self, name) -> float:
        self.io.catch_up(asyncio.get_running_loop().time())
        return self.io.around.at(name)


async def made_ready(rig, rotor):
    """Return the machine, with its rotor homed behind a locked door."""
    found = Centrifuge(rig, rotor)
    await found.sees(locked=True, door_closed=True, pin=False, door=False, unlock=False)
    await rotor.power(on=True)
    await (await rotor.home()).done()
    return found


def shutting(rig):
    """Return a run of the sequence that shuts the door."""
    sequence = next(each for each in CENTRIFUGE.sequence if each.name == "shut")
    return SequenceRun(rig.client, sequence, {}, lambda _: None, lambda: 0)


def operated(what: Callable, without: str | None = None, rules=CENTRIFUGE.interlock):
    """Return what an operation returns on the centrifuge, of whose rules one may be left away."""

    async def program():
        kept = tuple(each for each in rules if each.name != without)
        async with (
            simulated_rig(CENTRIFUGE.model_copy(update={"interlock": kept})) as rig,
            rig.client.control("rotor", client="test") as rotor,
        ):
            found = await made_ready(rig, rotor)
            result = await what(found)
            await (await rotor.halt()).done()
            await rig.at_rest("rotor")
            return result

    return run(program())


def alone(what, config=CENTRIFUGE):
    """Return what an operation returns on the centrifuge; its rotor is left as it is."""

    async def program():
        async with simulated_rig(config) as rig, rig.client.control("rotor", client="test") as rotor:
            return await what(await made_ready(rig, rotor))

    return run(program())


async def turns_with_an_open_door(machine):
    await machine.shut_door_opens()
    with suppress(InterlockViolated):
        await (await machine.rotor.move_velocity(1.0, duration_s=1)).done()
        return True
    return False


async def goes_on_out_of_balance(machine):
    now_s = asyncio.get_running_loop().time
    machine.drive.set_condition(FaultCondition.UNBALANCED, present=True, at_s=now_s())
    with suppress(LdcndError, TimeoutError):
        await machine.rotor.move_velocity(20, acceleration=10, duration_s=10)
        await machine.rig.until(lambda: machine.speed > 19, within_s=5)
    return machine.speed > 19


async def opens_against_its_lock(machine):
    with suppress(InterlockViolated):
        await machine.high("door")
        return True
    return False


async def unlocks_in_a_spin(machine):
    await machine.spin()
    with suppress(InterlockViolated):
        await machine.high("unlock")
    await asyncio.sleep(1.0)
    return machine.part("lock") < 1.0


async def drops_its_pin_into_a_spin(machine):
    await machine.spin()
    with suppress(InterlockViolated):
        await machine.high("pin")
    await asyncio.sleep(1.0)
    return machine.part("pin") > 0.0


async def drives_its_bolt_out_beside_an_open_door(machine):
    await machine.shut_door_opens()
    with suppress(InterlockViolated):
        await machine.low("unlock")
    await asyncio.sleep(1.0)
    return machine.part("lock") > 0.0


async def drives_its_bolt_in_as_it_drives_its_door(machine):
    return await bolt_beside_the_door(machine, [(("door",), ("unlock",))])


async def drives_its_bolt_in_behind_its_door(machine):
    return await bolt_beside_the_door(machine, [(("door",), ()), ((), ("unlock",))])


async def drives_its_door_behind_its_bolt(machine):
    return await bolt_beside_the_door(machine, [((), ("unlock",)), (("door",), ())])


async def bolt_beside_the_door(machine, requests):
    """Send requests to a door that is shut and unlocked; return whether it is driven, or has moved, at a bolt."""
    await machine.high("unlock")
    await machine.rig.until(lambda: machine.part("lock") == 0.0)
    for high, low in requests:
        with suppress(InterlockViolated):
            await machine.rig.client.set_io("cabinet", high=high, low=low)
    for _ in range(40):
        await asyncio.sleep(0.05)
        driven = machine.rig.module_truth("cabinet").outputs["door"]
        if machine.part("lock") > 0.0 and (driven or machine.part("door") > 0.0):
            return True
    return False


TOGETHER = (
    drives_its_bolt_in_as_it_drives_its_door,
    drives_its_bolt_in_behind_its_door,
    drives_its_door_behind_its_bolt,
)


@pytest.mark.parametrize("requests", TOGETHER, ids=lambda each: each.__name__)
def test_a_bolt_never_falls_in_beside_a_door_that_is_driven(requests):
    assert not operated(requests)


@pytest.mark.parametrize(("row", "requests"), [*zip(("lock_closes", "door_opens"), TOGETHER[1:], strict=True)])
def test_an_output_that_a_row_requires_is_what_keeps_bolt_and_door_apart(row, requests):
    rules = [
        each.model_copy(update={"requires": tuple(one for one in each.requires if not one.output)})
        if each.name == row
        else each
        for each in CENTRIFUGE.interlock
    ]
    assert operated(requests, rules=tuple(rules))


def test_outputs_are_judged_by_what_is_so_behind_the_request_that_sets_them():
    async def sets(machine):
        await unlocked(machine)
        await machine.low("unlock", "door")
        await machine.sees(locked=True)
        await unlocked(machine)
        await machine.high("unlock", "door")  # one that is high already counts as it will be
        await machine.sees(door_open=True)
        await machine.low("door")
        await machine.sees(door_closed=True)
        await machine.low("door")
        await machine.low("unlock")  # directly behind what it requires: that is read back first
        await machine.sees(locked=True)
        return machine.open_or_unlocked

    assert not operated(sets)


NEEDS = {
    "door_shut": turns_with_an_open_door,
    "balance": goes_on_out_of_balance,
    "door_opens": opens_against_its_lock,
    "lock_opens": unlocks_in_a_spin,
    "lock_closes": drives_its_bolt_out_beside_an_open_door,
    "pin_goes_in": drops_its_pin_into_a_spin,
}


def test_each_row_is_asked_below():
    assert set(NEEDS) == {each.name for each in CENTRIFUGE.interlock}


@pytest.mark.parametrize("row", NEEDS)
@pytest.mark.sweep(3)
def test_what_a_row_forbids_happens_only_without_it(row):
    assert not operated(NEEDS[row])
    assert operated(NEEDS[row], without=row)


async def shut(_machine):
    """Begin behind a locked door."""


async def unlocked(machine):
    await machine.high("unlock")
    await machine.sees(unlocked=True)


async def drawn_bolt_jams(machine):
    await unlocked(machine)
    machine.jam("lock")
    await machine.low("unlock")


async def bolt_jams_half_way(machine):
    await machine.high("unlock")
    await asyncio.sleep(0.15)
    machine.jam("lock")
    await machine.low("unlock")


async def open_door_jams_before_its_bolt(machine):
    await machine.shut_door_opens()
    await open_door_jams(machine)


async def door_jams_half_way_before_its_bolt(machine):
    await machine.high("unlock")
    await machine.sees(unlocked=True)
    await machine.high("door")
    await asyncio.sleep(0.8)
    await open_door_jams(machine)


async def open_door_jams(machine):
    machine.jam("door")
    await machine.rig.client.override_interlock("lock_closes", 1.0, reason="a door with its bolt beside it")
    await machine.low("door", "unlock")
    await asyncio.sleep(0.5)


STATES = (shut, unlocked, Centrifuge.shut_door_opens, drawn_bolt_jams, bolt_jams_half_way)
STATES += (open_door_jams_before_its_bolt, door_jams_half_way_before_its_bolt)


BROKEN = [*((each,) for each in WIRES), *CABLES]


@pytest.mark.parametrize("wires", BROKEN, ids="+".join)
@pytest.mark.parametrize("how", BREAKS)
@pytest.mark.parametrize("state", STATES, ids=lambda each: each.__name__)
@pytest.mark.sweep(27)
def test_no_wires_that_break_let_the_rotor_turn_with_an_open_door_or_a_drawn_bolt(state, how, wires):
    async def breaks(machine):
        await state(machine)
        levels = machine.io.levels
        for wire in wires:
            machine.breaks(wire, how)
        shows = machine.io.levels != levels
        await asyncio.sleep(0.5)
        open_or_unlocked = machine.open_or_unlocked
        assert open_or_unlocked is (state is not shut)
        return await machine.tries_to_spin(), open_or_unlocked, shows

    turned, open_or_unlocked, shows = operated(breaks)

    assert turned is not (open_or_unlocked or shows)


@pytest.mark.parametrize("wires", BROKEN, ids="+".join)
@pytest.mark.parametrize("how", BREAKS)
@pytest.mark.sweep(9)
def test_the_sequence_that_shuts_the_door_does_not_let_broken_wires_tell_it_that_it_has(how, wires):
    async def program():
        async with simulated_rig(CENTRIFUGE) as rig:
            async with rig.client.control("rotor", client="test") as rotor:
                machine = await made_ready(rig, rotor)
                await machine.shut_door_opens()
                for wire in wires:
                    machine.breaks(wire, how)
            with suppress(LdcndError):
                await shutting(rig).run()
                assert not machine.open_or_unlocked
            assert machine.part("door") <= PLAY or machine.part("lock") == 0.0, "the bolt went in beside the door"
            async with rig.client.control("rotor", client="test") as machine.rotor:
                return machine.open_or_unlocked and await machine.tries_to_spin()

    assert not run(program())


@pytest.mark.long
def test_outputs_that_a_cabinet_lost_beside_an_open_door_leave_its_bolt_alone_until_the_door_is_shut():
    async def program():
        now_s = asyncio.get_running_loop().time
        async with simulated_rig(CENTRIFUGE) as rig:
            async with rig.client.control("rotor", client="test") as rotor:
                machine = await made_ready(rig, rotor)
                await machine.shut_door_opens()
                machine.io.power(on=False, at_s=now_s())
                await asyncio.sleep(3)
                machine.io.power(on=True, at_s=now_s())
                await machine.sees(door_open=True, door=False)
                await asyncio.sleep(2)
                written = bool(machine.io.outputs & 1 << CABINET.outputs["unlock"].line - 1)
                told = await latest_events(rig.client.client, 1000, "cabinet")
                refused = [each.reason for each in told if each.verb == "reset" and each.status == "refused"]
            await shutting(rig).run()
            async with rig.client.control("rotor", client="test") as machine.rotor:
                return written, refused, machine.open_or_unlocked, await machine.tries_to_spin()

    written, (refused,), *after = run(program())
    assert not written
    assert "output unlock low, its level of reset" in refused
    assert "interlock lock_closes: input door_closed is false" in refused
    assert after == [False, True]


def test_lines_that_float_move_no_part_of_a_cabinet_that_loses_its_power_in_a_spin():
    async def loses_power(machine):
        now_s = asyncio.get_running_loop().time
        await machine.spin()
        machine.io.power(on=False, at_s=now_s())
        await asyncio.sleep(0.2)
        machine.io.power(on=True, at_s=now_s())
        floating = machine.io.levels & sum(1 << each.line - 1 for each in CABINET.outputs.values())
        moved = False
        for _ in range(100):
            await asyncio.sleep(0.05)
            moved |= machine.open_or_unlocked or machine.part("pin") > 0.0
        return floating, moved

    assert operated(loses_power) == (0, False)


@pytest.mark.long
def test_the_sequence_that_shuts_the_door_shuts_it_where_no_wire_breaks():
    async def program():
        async with simulated_rig(CENTRIFUGE) as rig:
            async with rig.client.control("rotor", client="test") as rotor:
                machine = await made_ready(rig, rotor)
                await machine.shut_door_opens()
            await shutting(rig).run()
            async with rig.client.control("rotor", client="test") as machine.rotor:
                return machine.open_or_unlocked, await machine.tries_to_spin()

    assert run(program()) == (False, True)


@pytest.mark.parametrize("wire", WIRES)
@pytest.mark.sweep(3)
def test_a_wire_that_breaks_in_a_spin_and_shows_it_brings_the_rotor_to_rest_behind_the_locked_door(wire):
    async def falls_out(machine):
        motion = await machine.spin()
        is_high = bool(machine.io.levels & 1 << WIRES[wire] - 1)
        machine.breaks(wire, "grounded" if is_high else "cut")
        with pytest.raises(LdcndError):
            await motion.done()
        with pytest.raises(InterlockViolated):
            await machine.high("unlock")
        await machine.rig.at_rest("rotor")
        return machine.part("door"), machine.part("lock")

    assert operated(falls_out) == (0.0, 1.0)


@pytest.mark.parametrize("fault", ["encoder_stuck", "jam"])
def test_the_sequence_does_not_open_the_door_of_a_rotor_that_did_not_come_to_its_bucket(fault):
    spin = next(each for each in CENTRIFUGE.sequence if each.name == "spin")
    positions = {each.name: each for each in CENTRIFUGE.position}

    async def program():
        async with simulated_rig(CENTRIFUGE) as rig:
            async with rig.client.control("rotor", client="test") as rotor:
                machine = await made_ready(rig, rotor)
                await (await rotor.move_absolute(0.4)).done()
            getattr(rig.faults, fault)("rotor")
            with pytest.raises(LdcndError):
                await SequenceRun(rig.client, spin, positions, lambda _: None, lambda: 0).run(6)
            with pytest.raises(LdcndError):
                await machine.high("unlock")
            await asyncio.sleep(5.0)
            return machine.open_or_unlocked

    assert not run(program())


@pytest.mark.parametrize("after_s", [0.0, 0.2, 0.35, 1.0, 3.0])
def test_a_counter_that_stands_still_in_a_spin_opens_no_lock(after_s):
    async def freezes(machine):
        await machine.spin()
        machine.rig.faults.encoder_stuck("rotor")
        await asyncio.sleep(after_s)
        written_at = []
        for _ in range(40):
            with suppress(LdcndError):
                await machine.high("unlock")
                written_at.append(machine.speed)
            await asyncio.sleep(0.05)
        return written_at

    assert alone(freezes) == []


async def jogged(rotor):
    async with rotor.jogging(0.2):
        await asyncio.sleep(0.6)
    return await rotor.halt()


async def jogged_on(rotor):
    async with rotor.jogging(0.5) as jog:
        for _ in range(15):
            await asyncio.sleep(0.2)
            await jog.held()


@pytest.mark.parametrize(
    "sent",
    [
        lambda rotor: rotor.home(),
        lambda rotor: rotor.move_relative(0.05),
        lambda rotor: rotor.move_relative(-0.3),
        lambda rotor: rotor.move_velocity(0.2, acceleration=1, duration_s=0.8),
        jogged,
        jogged_on,
    ],
    ids=["home", "a short move", "a move", "velocity", "jog", "a long jog"],
)
@pytest.mark.parametrize("unsettled", ["fault", "report"])
@pytest.mark.sweep(3)
def test_a_motion_in_which_no_count_is_seen_ends_with_the_motor_off_and_proves_no_rest(sent, unsettled):
    (line,) = CENTRIFUGE.bus
    settle = line.axis[0].settle.model_copy(update={"unsettled": unsettled})
    axis = line.axis[0].model_copy(update={"settle": settle})
    config = CENTRIFUGE.model_copy(update={"bus": (line.model_copy(update={"axis": (axis,)}),)})

    async def program():
        async with simulated_rig(config) as rig:
            async with rig.client.control("rotor", client="test") as rotor:
                machine = await made_ready(rig, rotor)
                rig.faults.encoder_stuck("rotor")
                with suppress(LdcndError):
                    await (await sent(rotor)).done()
                await asyncio.sleep(4)
                before = machine.speed
                opened = []
                for output in ("unlock", "pin"):
                    with suppress(LdcndError):
                        await machine.high(output)
                        opened.append(output)
                state = rotor.state.sample
                await asyncio.sleep(2)
                slows_down = machine.speed < max(before, CREEPS)
                return slows_down, state.enabled, state.moving, state.quality, opened

    slows_down, enabled, *shown = run(program())
    assert shown == [Moving.UNKNOWN, Quality.UNCERTAIN, []]
    # "report" says that an axis may end elsewhere and push on; a search is believed of no such encoder
    assert (unsettled, sent) == ("report", sent) or (slows_down, enabled) == (True, False)


@pytest.mark.parametrize("stop", ["halt", "stop", "the end of a run"])
@pytest.mark.parametrize("speed", [8.0, 5.0, 2.0, 1.0])
@pytest.mark.sweep(3)
def test_a_counter_that_stands_still_while_the_rotor_brakes_opens_no_lock(stop, speed):
    async def freezes(machine):
        await machine.rotor.move_velocity(FAST, acceleration=10, duration_s=1 if stop == "the end of a run" else 60)
        await machine.rig.until(lambda: machine.speed > FAST - 0.5)
        if stop != "the end of a run":
            await getattr(machine.rotor, stop)()
        await machine.rig.until(lambda: machine.speed < speed)
        machine.rig.faults.encoder_stuck("rotor")
        written_at = []
        for _ in range(80):
            with suppress(LdcndError):
                await machine.high("unlock")
                written_at.append(machine.speed)
            await asyncio.sleep(0.1)
        state = machine.rotor.state.sample
        return [each for each in written_at if each > CREEPS], state.enabled, state.moving

    assert alone(freezes) == ([], False, Moving.UNKNOWN)


@pytest.mark.parametrize("rpm", [300, 1200, 2400, 3000])
@pytest.mark.parametrize("ended", ["quick_stop", "halt", "stop"])
@pytest.mark.sweep(3)
def test_a_healthy_rotor_that_is_stopped_at_speed_has_no_fault(rpm, ended):
    async def stops(machine):
        await machine.rotor.move_velocity(rpm / 60, acceleration=10, duration_s=60)
        await machine.rig.until(lambda: machine.speed > 0.98 * rpm / 60)
        with suppress(LdcndError):
            await getattr(machine.rotor, ended)()
        await machine.rig.until(lambda: machine.rotor.state.sample.moving is Moving.NO)
        faults = await machine.rig.client.client.last("rotor", "fault")
        return faults.active

    assert not alone(stops)


def test_a_healthy_rotor_has_no_fault_that_the_gains_of_a_client_leave_where_friction_holds_it():
    async def stops(machine):
        await machine.rotor.set_gains(kp=5, kd=100, ki=0, il=0, ol=253, el=16000, gain_set="spin")
        await machine.rotor.move_velocity(5.0, acceleration=10, duration_s=60)
        await machine.rig.until(lambda: machine.speed > 4.9)
        await machine.rotor.halt()
        await machine.rig.until(lambda: machine.rotor.state.sample.moving is Moving.NO)
        await asyncio.sleep(3.0)
        faults = await machine.rig.client.client.last("rotor", "fault")
        return faults.active, machine.rotor.state.sample.referenced

    assert alone(stops) == ((), True)


@pytest.mark.parametrize("lost", ["cable_cut", "mute", "power_loss"])
@pytest.mark.parametrize("for_s", [0.5, 3.0])
@pytest.mark.sweep(2)
def test_the_steps_that_why_names_lead_out_of_a_loss_in_a_spin(lost, for_s):
    async def goes_on(machine):
        await machine.spin()
        getattr(machine.rig.faults, lost)("rotor", for_s=for_s)
        await asyncio.sleep(for_s + 5.0)
        for _ in range(40):
            causes = (await machine.rotor.why()).causes
            if [each.code for each in causes] == ["not_referenced"]:
                break
            verb = causes[0].steps[0].verb if causes and causes[0].steps else ""
            with suppress(LdcndError):
                await (machine.rotor.power(on=True) if verb == "power" else machine.rotor.reset())
            await asyncio.sleep(2.0)
        await (await machine.rotor.home()).done()
        return (await machine.rotor.why()).causes

    assert not alone(goes_on)


@pytest.mark.parametrize("start", ["reset", "adopt"])
@pytest.mark.parametrize("off", [False, True])
@pytest.mark.parametrize(("speed", "dead_s"), [(2.0, 0.3), (2.0, 0.6), (5.0, 0.85), (10.0, 0.45), (25.0, 0.1)])
@pytest.mark.parametrize("then", [None, "cable", "silence", "noise", "power"])
@pytest.mark.sweep(7)
def test_a_daemon_that_begins_beside_a_rotor_whose_encoder_has_died_opens_no_lock(start, off, speed, dead_s, then):
    (line,) = CENTRIFUGE.bus
    config = CENTRIFUGE.model_copy(
        update={"bus": (line.model_copy(update={"start": StartPolicy(start), "adopt_fallback": AdoptFallback.RESET}),)}
    )

    async def program():
        async with simulated_rig(config) as rig, rig.client.watch("rotor") as rotor:
            await asyncio.sleep(1.0)
            await rig.client.set_io("cabinet", low=("door", "unlock", "pin"))
            await asyncio.sleep(1.0)
            machine = await made_ready(rig, rotor)
            await rotor.move_velocity(speed, acceleration=10, duration_s=60)
            await rig.until(lambda: machine.speed > 0.95 * speed)
            if off:
                await rotor.power(on=False)
            rig.faults.daemon_killed(for_s=0.5)
            rig.faults.encoder_stuck("rotor", after_s=dead_s)
            if then:  # what was not seen to count before is not known to stand behind that either
                lost = {
                    "cable": lambda: rig.faults.cable_cut("rotor", after_s=4.0, for_s=2.0),
                    "silence": lambda: rig.faults.mute("rotor", after_s=4.0, for_s=2.0),
                    "noise": lambda: rig.faults.noise(1.0, after_s=4.0, for_s=2.0),
                    "power": lambda: rig.faults.power_loss("rotor", after_s=4.0, for_s=2.0),
                }
                lost[then]()
            written_at = []
            for _ in range(600):
                await asyncio.sleep(0.1)
                with suppress(LdcndError, TimeoutError):
                    await rig.client.set_io("cabinet", high=("unlock",), low=("door", "pin"))
                    written_at.append(machine.speed)
            return [each for each in written_at if each > CREEPS]

    assert run(program()) == []


@pytest.mark.parametrize("rpm", [1, 3, 5])
def test_a_slow_motion_beside_a_rotor_that_turns_unseen_opens_no_lock(rpm):
    async def program():
        async with simulated_rig(CENTRIFUGE) as rig, rig.client.watch("rotor") as rotor:
            await asyncio.sleep(1.0)
            await rig.client.set_io("cabinet", low=("door", "unlock", "pin"))
            await asyncio.sleep(1.0)
            machine = await made_ready(rig, rotor)
            await rotor.move_velocity(10.0, acceleration=10, duration_s=60)
            await rig.until(lambda: machine.speed > 9.5)
            rig.faults.daemon_killed(for_s=0.5)
            rig.faults.encoder_stuck("rotor", after_s=0.45)
            await asyncio.sleep(6.0)
            with suppress(LdcndError):  # the first command tells a client that there is another daemon
                await rotor.reset()
            await rotor.power(on=True)
            await rotor.move_velocity(rpm / 60, acceleration=1, duration_s=5)
            written_at = []
            for _ in range(200):
                with suppress(LdcndError, TimeoutError):
                    await rig.client.set_io("cabinet", high=("unlock",), low=("door", "pin"))
                    written_at.append(machine.speed)
                await asyncio.sleep(0.01)
            return [each for each in written_at if each > CREEPS]

    assert run(program()) == []


@pytest.mark.parametrize("after_s", [0.0, 0.03, 0.06, 0.1, 0.3, 1.0])
@pytest.mark.parametrize("speed", [10.0, 3.0])
@pytest.mark.sweep(3)
def test_a_counter_that_stands_still_while_the_rotor_coasts_opens_no_lock(speed, after_s):
    async def freezes(machine):
        await machine.rotor.move_velocity(speed, acceleration=10, duration_s=60)
        await machine.rig.until(lambda: machine.speed > 0.95 * speed)
        await machine.rotor.power(on=False)
        await asyncio.sleep(after_s)
        machine.rig.faults.encoder_stuck("rotor")
        written_at = []
        for _ in range(40):
            with suppress(LdcndError):
                await machine.high("unlock")
                written_at.append(machine.speed)
            await asyncio.sleep(0.1)
        with pytest.raises(LdcndError, match="may turn with its motor off"):
            await machine.rotor.power(on=True)
        moving = machine.rotor.state.sample.moving
        await machine.rig.until(lambda: machine.speed < CREEPS)
        await machine.rotor.reset()
        await machine.rotor.power(on=True)
        return written_at, moving

    assert alone(freezes) == ([], Moving.UNKNOWN)


@pytest.mark.parametrize("begun_at", [None, 2.0])
@pytest.mark.parametrize(
    ("speed", "cut_s"),
    [
        (50.0, 0.15),
        (50.0, 1.0),
        (5.0, 1.0),
        (5.0, 0.12),
        (1.0, 0.12),
        (0.3, 0.3),
        (50.0, 0.06),
    ],
)
@pytest.mark.sweep(3)
def test_an_encoder_that_was_cut_for_a_while_in_a_spin_costs_the_reference(speed, cut_s, begun_at):
    async def cut(machine):
        if begun_at is not None:
            await machine.rotor.move_velocity(begun_at, acceleration=10, duration_s=60)
            await machine.rig.until(lambda: machine.speed > 0.95 * begun_at)
        await machine.rotor.move_velocity(speed, acceleration=10, duration_s=60)
        await machine.rig.until(lambda: 0.95 * speed < machine.speed < 1.05 * speed)
        await asyncio.sleep(0.5)
        fault = machine.rig.faults.encoder_stuck("rotor")
        await asyncio.sleep(cut_s)
        fault.end()
        await machine.rig.until(lambda: machine.speed < CREEPS)
        await asyncio.sleep(1.0)
        with suppress(LdcndError):
            await machine.rotor.power(on=False)
        while (await machine.rotor.why()).causes and not machine.rotor.state.sample.enabled:
            with suppress(LdcndError):
                await machine.rotor.reset()
            with suppress(LdcndError):
                await machine.rotor.power(on=True)
            await asyncio.sleep(0.5)
        with pytest.raises(NotReferenced):
            await machine.rotor.move_absolute(0.1)
        return machine.rotor.state.sample.referenced

    assert alone(cut) is False


def test_why_names_what_is_in_the_way_of_homing_before_the_homing_that_is_wanted():
    async def program():
        async with simulated_rig(CENTRIFUGE) as rig, rig.client.control("rotor", client="test") as rotor:
            machine = Centrifuge(rig, rotor)
            await rig.until(lambda: rotor.state.sample.moving is Moving.NO)
            await rotor.power(on=True)
            await machine.shut_door_opens()
            return [each.code for each in (await rotor.why()).causes]

    *before, last = run(program())
    assert ({*before}, last) == ({"interlock_violated"}, "not_referenced")


async def follows(machine, told):
    """Carry out what a cause or a refusal names, wait behind each step; return what was refused."""
    refused = []
    for each in told.steps if hasattr(told, "steps") else told.remedy.steps:
        given = dict(each.arguments)
        try:
            match each.verb:
                case "set_io":
                    await machine.rig.client.set_io(**given)
                case "power":
                    await machine.rotor.power(on=given["on"])
                case "home":
                    await (await machine.rotor.home()).done()
                case "reset":
                    await machine.rotor.reset()
                case "set_position":  # instead of homing
                    continue
                case _:
                    pytest.fail(f"{each.verb} in {told}")
        except LdcndError as error:
            refused.append(f"{each}: {error}")
        await asyncio.sleep(45.0 if each.verb == "power" else 3.0)
    return refused


async def led_out(machine):
    """Follow why until the rotor can move; return what was refused of that."""
    for _ in range(6):
        if not (causes := (await machine.rotor.why()).causes):
            await (await machine.rotor.move_absolute(0.1)).done()
            return []
        if refused := await follows(machine, causes[0]):
            return refused
    return causes


def test_steps_that_why_names_beside_an_open_door_say_what_to_wait_for_between_them():
    async def shuts(machine):
        await machine.shut_door_opens()
        (cause,) = (await machine.rotor.why()).causes
        return cause.remedy, await led_out(machine)

    remedy, refused = operated(shuts)
    assert remedy.startswith(
        "set output door low, then wait until input door_closed is true, input door_ajar is false and input door_open"
        " is false, then set output unlock low"
    )
    assert not refused


@pytest.mark.parametrize("opening_s", [0.5, 0.7, 0.9])
@pytest.mark.parametrize("asked", ["why", "the bolt", "the door"])
@pytest.mark.sweep(3)
def test_what_is_named_leads_out_of_a_bolt_that_has_sprung_in_beside_an_open_door(asked, opening_s):
    async def springs(machine):
        await machine.high("unlock")
        await asyncio.sleep(0.6)
        await machine.high("door")
        await asyncio.sleep(opening_s)
        machine.rig.faults.module_power_loss("cabinet", for_s=2)
        await asyncio.sleep(8)
        assert machine.part("lock") == 1.0
        assert machine.part("door") > PLAY
        if asked == "why":
            return await led_out(machine)
        with pytest.raises(InterlockViolated) as refused:
            await (machine.low("unlock") if asked == "the bolt" else machine.high("door"))
        if asked == "the door":
            return [*await follows(machine, refused.value), *([] if machine.part("door") == 1.0 else ["door"])]
        return [*await follows(machine, refused.value), *(["open"] if machine.open_or_unlocked else [])]

    assert operated(springs) == []


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_why_names_no_output_to_write_beside_a_rotor_that_a_killed_daemon_has_left_before_its_cabinet_is_read(seed):
    async def program():
        async with simulated_rig(CENTRIFUGE, seed=seed) as rig:
            with suppress(LeaseExpired):  # with the daemon
                async with rig.client.control("rotor", client="test") as rotor:
                    await (await made_ready(rig, rotor)).spin()
                    await rig.kill_daemon()
                    await asyncio.sleep(0.3)
                    await rig.start_daemon()
            named = []
            async with rig.client.watch("rotor") as rotor:
                for _ in range(60):
                    with suppress(LdcndError):
                        named += [each.remedy for each in (await rotor.why()).causes]
                    await asyncio.sleep(0.005)
            return named

    named = run(program())
    assert any("module cabinet answers" in each for each in named)
    assert [each for each in named if "set output" in each] == []


@pytest.mark.parametrize(
    ("open_s", "asked"),
    [
        (0.7, None),
        (3.0, None),
        (3.0, {"low": ("door",)}),
        (3.0, {"low": ("unlock",)}),
        (3.0, {"low": ("pin", "door"), "high": ("unlock",)}),
    ],
)
def test_what_is_named_leads_out_of_a_daemon_that_was_killed_beside_an_open_door(open_s, asked):
    (line,) = CENTRIFUGE.bus
    config = CENTRIFUGE.model_copy(
        update={"bus": (line.model_copy(update={"start": StartPolicy.ADOPT, "adopt_fallback": AdoptFallback.RESET}),)}
    )

    async def program():
        async with simulated_rig(config) as rig:
            await asyncio.sleep(45.0)
            await rig.client.set_io("cabinet", low=("door", "unlock", "pin"))
            async with rig.client.control("rotor", client="test") as rotor:
                machine = await made_ready(rig, rotor)
                await machine.high("unlock")
                await asyncio.sleep(0.6)
                await machine.high("door")
            await asyncio.sleep(open_s)
            await rig.kill_daemon()
            await asyncio.sleep(2.0)
            await rig.start_daemon()
            await asyncio.sleep(2.0)
            async with rig.client.control("rotor", client="test") as rotor:
                machine = Centrifuge(rig, rotor)
                if asked is None:
                    (cause, *_) = (await rotor.why()).causes
                    return cause.remedy, await led_out(machine)
                with pytest.raises(LdcndError) as error:
                    await rig.client.set_io("cabinet", **asked)
                return error.value.remedy, await follows(machine, error.value)

    remedy, refused = run(program())
    assert remedy.startswith('send power {"on": false} and wait until it stands')
    assert "home" not in remedy
    assert refused == []


@pytest.mark.parametrize("lost", ["power_loss", "motor_supply_lost", "mute"])
@pytest.mark.parametrize("after_s", [6.0, 60.0])
def test_why_names_no_homing_that_would_be_refused_behind_the_steps_that_are_named_before_it(lost, after_s):
    async def goes_on(machine):
        await machine.spin()
        getattr(machine.rig.faults, lost)("rotor", for_s=3.0)
        await asyncio.sleep(after_s)
        for _ in range(6):
            causes = (await machine.rotor.why()).causes
            for each in causes:
                if refused := await follows(machine, each):
                    return refused
            if not causes:
                break
        return causes

    assert not alone(goes_on)


def test_who_waits_for_the_homing_under_way_as_a_refusal_says_moves_behind_it():
    async def homes(machine):
        await machine.rotor.set_position(0.5)
        homing = await machine.rotor.home()
        with pytest.raises(WrongState) as refused:
            await machine.rotor.move_absolute(0.1)
        causes = (await machine.rotor.why()).causes
        await homing.done()
        await (await machine.rotor.move_absolute(0.1)).done()
        return {refused.value.remedy, *(each.remedy for each in causes)}

    assert operated(homes) == {"wait until it is homed"}


@pytest.mark.parametrize("ramp_s", [2.0, 5.0, 12.0])
@pytest.mark.parametrize("speed", [0.3, 1.0, 5.0, 20.0])
@pytest.mark.sweep(3)
def test_a_healthy_rotor_whose_speed_is_changed_time_and_again_has_no_fault(speed, ramp_s):
    acceleration = speed / ramp_s

    async def changes(machine):
        for each in (speed, speed / 5, -speed / 3, -speed, speed / 2):
            await machine.rotor.move_velocity(each, acceleration=acceleration, duration_s=600)
            await machine.rig.until(lambda each=each: abs(machine.rig.truth("rotor").velocity - each) < 0.1 * abs(each))
            for percent in (50, 10, 100):
                await machine.rig.client.set_speed_override(percent)
                await asyncio.sleep(ramp_s / 4)
        await machine.rotor.halt()
        await machine.rig.until(lambda: machine.rotor.state.sample.moving is Moving.NO)
        assert not (await machine.rig.client.client.last("rotor", "fault")).active
        await (await machine.rotor.move_relative(0.7, acceleration=acceleration)).done()
        return (await machine.rig.client.client.last("rotor", "fault")).active

    assert not alone(changes)


def test_a_program_that_waits_for_so_long_at_most_learns_of_a_killed_daemon_by_one_error():
    async def spins(rig):
        async with rig.client.control("rotor", client="test") as rotor:
            await made_ready(rig, rotor)
            motion = await rotor.move_velocity(FAST, acceleration=10, duration_s=10)
            await asyncio.wait_for(motion.done(), 200)

    async def program():
        async with simulated_rig(CENTRIFUGE) as rig:
            spinning = asyncio.create_task(spins(rig))
            await rig.until(lambda: abs(rig.truth("rotor").velocity) > FAST - 0.5)
            await rig.kill_daemon()
            with pytest.raises(LeaseExpired):
                await spinning

    run(program())


@pytest.mark.parametrize("rpm", [10.0, 60.0])
def test_a_motor_is_switched_off_that_runs_away_beside_a_slow_motion(rpm):
    async def runs_away(machine):
        machine.rig.faults.encoder_stuck("rotor")
        await machine.rotor.move_velocity(rpm / 60, acceleration=1, duration_s=60)
        await machine.rig.until(lambda: not machine.rotor.state.sample.enabled)
        begun_s = asyncio.get_running_loop().time()
        await machine.rig.until(lambda: machine.rotor.state.sample.motion_hidden_by)
        return begun_s

    async def timed(machine):
        at_s = asyncio.get_running_loop().time()
        return await runs_away(machine) - at_s

    assert alone(timed) < 2.5


@pytest.mark.parametrize("rpm", [3.0, 5.5])
def test_a_counter_that_stands_still_in_a_slow_motion_opens_no_lock(rpm):
    async def creeps(machine):
        machine.rig.faults.encoder_stuck("rotor")
        await machine.rotor.move_velocity(rpm / 60, acceleration=1, duration_s=60)
        written_at = []
        for _ in range(60):
            await asyncio.sleep(0.1)
            with suppress(LdcndError):
                await machine.high("unlock")
                written_at.append(machine.speed)
        return [each for each in written_at if each > 1.0]

    assert alone(creeps) == []


@pytest.mark.parametrize("acceleration", [1.0, 5.0])
@pytest.mark.parametrize("share", [0.95, 0.8])
@pytest.mark.sweep(3)
def test_a_counter_that_stands_still_while_a_slow_rotor_brakes_is_found(acceleration, share):
    async def freezes(machine):
        await machine.rotor.move_velocity(0.5, acceleration=acceleration, duration_s=60)
        await asyncio.sleep(2)
        await machine.rotor.halt()
        await machine.rig.until(lambda: machine.speed < 0.5 * share)
        machine.rig.faults.encoder_stuck("rotor")
        await asyncio.sleep(4)
        state = machine.rotor.state.sample
        return machine.speed > CREEPS and state.moving is not Moving.UNKNOWN

    assert not alone(freezes)


def test_a_rotor_whose_counter_stands_still_may_move_on_every_face_until_somebody_has_looked(monkeypatch):
    with virtual_rig(monkeypatch, CENTRIFUGE) as machine:
        machine.wait(asyncio.sleep(1))
        for each in ("power on rotor", "home rotor --wait", "move rotor 600 --at-velocity --for 60"):
            assert machine.run(each).code == 0
        machine.wait(asyncio.sleep(5))
        machine.rig.lives.faults.encoder_stuck("rotor")
        machine.wait(machine.rig.until("rotor", lambda state: state.moving is Moving.UNKNOWN))
        speed = abs(machine.rig.lives.truth("rotor").velocity)
        text, why = machine.run("list").printed, machine.run("why rotor").printed
        seen = json.loads(machine.run("list --json").printed)
        halted = machine.run("halt rotor --wait")
        reset = machine.run("reset rotor")
        machine.wait(machine.rig.until("rotor", lambda state: state.moving is Moving.NO))
        machine.wait(asyncio.sleep(0.2))  # a position comes ten times a second
        after = json.loads(machine.run("list --json").printed)

    assert speed > CREEPS
    assert "moving unknown" in text
    assert "may move" in text
    assert "may move unseen" in why
    assert (seen["moving"], seen["quality"], seen["referenced"]) == ("unknown", "uncertain", False)
    assert halted.code != 0
    assert "it is not known whether it stands" in halted.errors
    assert reset.code == 0
    assert (after["moving"], after["quality"]) == ("no", "good")


@pytest.mark.parametrize("part", ["lock", "door", "pin"])
@pytest.mark.sweep(2)
def test_an_output_that_is_high_refuses_a_spin_though_its_part_has_jammed(part):
    output = {"lock": "unlock", "door": "door", "pin": "pin"}[part]

    async def jams(machine):
        if part == "door":
            await unlocked(machine)
        machine.jam(part)
        await machine.high(output)
        await asyncio.sleep(0.5)
        with pytest.raises(InterlockViolated, match=f"output {output} is high"):
            await machine.rotor.move_velocity(FAST, acceleration=10, duration_s=2)
        machine.jam(part, jammed=False)
        await asyncio.sleep(1.0)
        return machine.speed

    assert operated(jams) < CREEPS


@pytest.mark.promise("stop-until-confirmed")
def test_a_lock_behind_an_unconfirmed_stop_is_refused_with_that_and_opens_once_the_drive_has_power_again():
    async def loses_power(machine):
        now_s = asyncio.get_running_loop().time
        await machine.spin()
        machine.drive.power(on=False, at_s=now_s())
        told = set()
        for _ in range(20):
            await asyncio.sleep(0.1)
            latched = machine.rotor.state.sample.stop_latched
            with pytest.raises(LdcndError) as refusal:
                await machine.high("unlock")
            told.add((refusal.value.code, latched))
        machine.drive.power(on=True, at_s=now_s())
        async with asyncio.timeout(60):
            while machine.part("lock") > 0.0:
                with suppress(LdcndError):
                    await machine.high("unlock")
                await asyncio.sleep(0.5)
        return told

    told = operated(loses_power)
    assert (ErrorCode.STOP_UNCONFIRMED, False) in told
    assert not [code for code, latched in told if code is ErrorCode.STOP_LATCHED and not latched]


def test_an_output_that_is_written_the_level_that_it_has_stays_known():
    async def writes(machine):
        for _ in range(5):
            await machine.low("unlock", "door", "pin")
            await (await machine.rotor.move_velocity(1.0, acceleration=10, duration_s=0.5)).done()
        return True

    assert operated(writes)


def test_why_names_the_outputs_of_a_cabinet_that_was_taken_over_in_one_command_that_sets_them(tmp_path, monkeypatch):
    file, text = tmp_path / "rig.toml", (ROOT / "config" / "centrifuge.toml").read_text(encoding="utf-8")
    file.write_text(
        text.replace("baud = 115200", 'baud = 115200\nstart = "adopt"\nadopt_fallback = "reset"'), encoding="utf-8"
    )
    with virtual_rig(monkeypatch, load_config(file)) as machine:
        machine.wait(asyncio.sleep(1))
        _, io = machine.rig.lives.lines["line0"].modules
        for each in ("bus set-io cabinet pin=low door=low unlock=low", "power on rotor"):
            assert machine.run(each).code == 0
        levels = io.outputs & io.latch
        machine.wait(machine.rig.begin_anew(1.0, killed=True))
        machine.wait(asyncio.sleep(2))
        assert machine.run("power on rotor").code == 0
        why = machine.run("why rotor move_velocity").printed
        print(why)
        (command,) = set(re.findall(r"ldcnd (bus set-io cabinet [a-z= ]+[a-z])", why))
        done = machine.run(command)
        machine.wait(asyncio.sleep(1))
        after = machine.run("why rotor move_velocity").printed

    assert done.code == 0
    assert io.outputs & io.latch == levels
    assert "is not known" in why
    assert "is not known" not in after


@pytest.mark.long
def test_of_a_spin_and_an_unlocking_at_one_instant_at_most_one_passes():
    async def race(machine):
        for apart_s in (-0.02, -0.005, -0.001, 0.0, 0.001, 0.003, 0.006, 0.01, 0.02, 0.05, 0.2):

            async def spin(after_s=-apart_s):
                await asyncio.sleep(max(after_s, 0.0))
                await machine.rotor.move_velocity(FAST, acceleration=10, duration_s=5)

            async def unlock(after_s=apart_s):
                await asyncio.sleep(max(after_s, 0.0))
                await machine.high("unlock")

            went = await asyncio.gather(spin(), unlock(), return_exceptions=True)
            refused = [each for each in went if each is not None]
            assert refused
            assert all(isinstance(each, InterlockViolated) for each in refused)
            for _ in range(50):
                await asyncio.sleep(0.02)
                assert not (machine.speed > CREEPS and machine.part("lock") < 1.0)
            await (await machine.rotor.halt()).done()
            await machine.rig.at_rest("rotor")
            await machine.low("unlock")
            await machine.sees(locked=True, unlocked=False, unlock=False)
        return True

    assert operated(race)


@pytest.mark.long
def test_a_client_that_dies_in_a_spin_leaves_a_rotor_that_comes_to_rest_behind_its_locked_door():
    async def dies(machine):
        await machine.spin()
        ends.append(machine)
        machine.rig.faults.client_lost()
        await asyncio.sleep(60)

    ends: list[Centrifuge] = []
    with pytest.raises(LeaseExpired):
        operated(dies)
    (machine,) = ends
    assert (machine.io.around.at("door"), machine.io.around.at("lock")) == (0.0, 1.0)


def test_who_wrote_outputs_is_in_the_events_done_and_refused_and_the_same_again_is_no_flood():
    async def program():
        async with simulated_rig(CENTRIFUGE) as rig:
            async with rig.client.control("rotor", client="test") as rotor:
                machine = await made_ready(rig, rotor)
                for _ in range(50):
                    with suppress(LdcndError):
                        await machine.high("door")
            await shutting(rig).run()
            await rig.client.set_io("cabinet", low=[9])
            return await latest_events(rig.client.client, 1000, "cabinet")

    refused, *done, last = (each for each in run(program()) if each.verb == "set_io")

    assert (refused.status, refused.client, refused.code) == ("refused", "test", "interlock_violated")
    assert refused.reason.startswith("door high: output door: interlock door_opens: ")
    assert [each.reason for each in done] == ["unlock high, pin low, door low", "unlock low"]
    assert {(each.status, each.client) for each in done} == {("done", "sequence shut")}
    assert (last.reason, last.client) == ("pin low", None)


def test_the_command_line_shows_who_wrote_outputs(monkeypatch):
    with virtual_rig(monkeypatch, CENTRIFUGE) as machine:
        machine.wait(asyncio.sleep(45))
        codes = [
            machine.run(f"bus set-io cabinet {each}").code for each in ("unlock=high 12=input", "door=low", "pin=hig")
        ]
        shown = machine.run("log").printed
        now = machine.run("bus set-io cabinet").printed

    assert codes == [0, 0, 2]
    assert re.search(r"cabinet: .*\bpin=low .*\bunlock=high\b.*; outputs: (\w+, )*unlock\b", now)
    assert re.search(r"cabinet: 1=.* 3=.* 5=", now), "the level of a pin passes for the value of an input"
    assert f"cabinet  set_io           done       by {getpass.getuser()} (ldcnd)" in shown
    assert "unlock high, door_ajar input" in shown or "unlock high, line 12 input" in shown


@pytest.mark.parametrize("end", ["halt", "quick_stop"])
def test_a_closed_loop_that_is_closed_again_does_not_move_the_rotor(end: str):
    async def program():
        async with simulated_rig(CENTRIFUGE) as rig, rig.client.control("rotor", client="test") as rotor:
            machine = await made_ready(rig, rotor)
            await (await rotor.home()).done()
            await rotor.move_velocity(3.0, acceleration=10.0)
            await asyncio.sleep(2.0)
            await (rotor.halt() if end == "halt" else rotor.quick_stop())
            await asyncio.sleep(3.0)
            await rotor.reset()
            for output in ("unlock", "door"):
                await machine.high(output)
                await asyncio.sleep(2.0)
            before, most = rig.truth("rotor").counts, 0.0
            await rotor.power(on=True)
            for _ in range(400):
                await asyncio.sleep(0.002)
                most = max(most, abs(rig.truth("rotor").counts - before))
            return most

    assert run(program()) < 1.0


def test_list_says_how_fast_a_rotor_turns_in_its_unit_and_for_how_long(monkeypatch):
    with virtual_rig(monkeypatch, CENTRIFUGE) as machine:
        machine.wait(asyncio.sleep(1))
        for each in ("power on rotor", "home rotor --wait", "move rotor 300 --at-velocity --for 30"):
            assert machine.run(each).code == 0
        machine.wait(asyncio.sleep(10))
        text = machine.run("list").printed
        seen = json.loads(machine.run("list --json").printed)
        why = machine.run("why rotor").printed
        halted = machine.run("halt rotor --wait")
        stands = machine.run("halt rotor --wait")
        at_rest = json.loads(machine.run("list --json").printed)

    speed, rest = re.search(r"moving yes about (\S+) rpm \(.+ g\) for another (\S+) s", text).groups()
    assert (float(speed), float(rest)) == (pytest.approx(300, abs=16), pytest.approx(seen["rest_s"], abs=1))
    assert 20 < seen["rest_s"] < 35
    assert "rotor: cannot move to a position now, only at a velocity" in why
    assert seen["velocity"] == pytest.approx(5, abs=0.3)
    assert halted.code == 0
    assert halted.printed.endswith("rotor: halt done\n")
    assert stands.code == 0
    assert (at_rest["moving"], at_rest["rest_s"], abs(at_rest["velocity"]) < 0.5) == ("no", None, True)


def test_a_halt_that_is_waited_for_returns_when_a_rotor_that_nothing_drives_stands(monkeypatch):
    with virtual_rig(monkeypatch, CENTRIFUGE) as machine:
        machine.wait(asyncio.sleep(1))
        for each in ("power on rotor", "home rotor --wait", "move rotor 600 --at-velocity --for 300"):
            assert machine.run(each).code == 0
        machine.wait(asyncio.sleep(10))
        assert machine.run("power off rotor").code == 0
        halted = machine.run("halt rotor --wait")
        at_rest = json.loads(machine.run("list --json").printed)

    assert halted.printed.endswith("rotor: halt done\n")
    assert (at_rest["moving"], abs(at_rest["velocity"]) < 0.5) == ("no", True)


@pytest.mark.parametrize("then", ["halted", "seen to turn", "switched off", "silent"])
def test_no_halt_that_is_waited_for_hangs_on_a_rotor_that_was_taken_over(monkeypatch, then):
    (line,) = CENTRIFUGE.bus
    config = CENTRIFUGE.model_copy(
        update={"bus": (line.model_copy(update={"start": StartPolicy.ADOPT, "adopt_fallback": AdoptFallback.RESET}),)}
    )

    with virtual_rig(monkeypatch, config) as machine:
        machine.wait(asyncio.sleep(41))
        for each in ("bus set-io cabinet door=low unlock=low pin=low", "power on rotor", "home rotor --wait"):
            assert machine.run(each).code == 0
        assert machine.run("move rotor 600 --at-velocity --for 60").code == 0
        machine.wait(asyncio.sleep(5))
        machine.wait(machine.rig.begin_anew(0.5, killed=True))
        machine.wait(asyncio.sleep(0.3 if then == "seen to turn" else 6.0))
        if then == "switched off":
            machine.run("power off rotor")
        if then == "silent":
            machine.rig.lives.faults.mute("rotor")
            machine.wait(asyncio.sleep(1.0))
        begun_s = machine.wait(_now_s())
        halted = machine.run("halt rotor --wait")
        took_s = machine.wait(_now_s()) - begun_s

    assert took_s < (60.0 if then == "switched off" else 15.0)
    assert ("this waits on until it stands" in halted.errors) is (took_s > 10.0)
    if then == "switched off":
        assert halted.code == 0
    elif then == "silent":
        assert "check the power of the drive and its line" in halted.errors
    else:
        assert "\n  ldcnd power off rotor and wait until it stands, or ldcnd home rotor" in halted.errors


def test_a_command_that_is_waited_for_ends_with_what_to_do_when_its_daemon_was_killed(monkeypatch):
    with virtual_rig(monkeypatch, CENTRIFUGE) as machine:
        machine.wait(asyncio.sleep(1))
        for each in ("power on rotor", "home rotor --wait"):
            assert machine.run(each).code == 0

        async def killed():
            await asyncio.sleep(3)
            await machine.rig.lives.kill_daemon()

        killing = machine.wait(_begun(killed()))
        begun_s = machine.wait(_now_s())
        moved = machine.run("move rotor 600 --at-velocity --for 60 --wait")
        took_s = machine.wait(_now_s()) - begun_s
        machine.wait(killing)
        machine.wait(machine.rig.lives.start_daemon())

    assert 10.0 < took_s < 30.0
    assert "nothing was received from it for 10 s" in moved.errors
    assert "look whether it moves" in moved.errors


async def _begun(work):
    return asyncio.create_task(work)


async def _now_s():
    return asyncio.get_running_loop().time()


@pytest.mark.long
def test_an_override_is_shown_by_list_and_why_with_its_rule_its_client_and_its_end(monkeypatch):
    with virtual_rig(monkeypatch, CENTRIFUGE) as machine:
        machine.wait(asyncio.sleep(1))
        lease = machine.wait(machine.rig.client.ask(Acquire(client="Bert", axes=("rotor",), lease_s=60.0))).lease
        lifts = OverrideInterlock(interlock="door_shut", seconds=12.0, reason="service", lease=lease)
        machine.wait(machine.rig.client.ask(lifts))
        machine.wait(asyncio.sleep(1.5))
        during = [machine.run(line).printed for line in ("list", "why rotor")]
        machine.wait(asyncio.sleep(13))
        after = [machine.run(line).printed for line in ("list", "why rotor")]

    assert all(
        re.search(r"interlock door_shut is overridden by Bert for (9|10|11|12) s still", each) for each in during
    )
    assert not any("overridden" in each for each in after)


@pytest.mark.parametrize("rpm", [300, 900, 3000])
@pytest.mark.parametrize("first", [None, "motor_supply_lost", "power_loss", "power off"])
@pytest.mark.sweep(3)
def test_a_reset_that_comes_too_soon_opens_no_lock(rpm, first):
    async def resets(machine):
        rotor, faults = machine.rotor, machine.rig.faults
        await (await rotor.home()).done()
        await rotor.move_velocity(rpm / 60, acceleration=10, duration_s=60)
        await machine.rig.until(lambda: machine.speed > 0.95 * rpm / 60)
        if first == "power off":
            await rotor.power(on=False)
        elif first:
            getattr(faults, first)("rotor", for_s=2.0)
        faults.encoder_stuck("rotor", after_s=0.3 if first else 0.0)
        written_at = []
        for _ in range(600):
            await asyncio.sleep(0.033)
            with suppress(LdcndError):
                await rotor.reset()
            with suppress(LdcndError):
                await machine.high("unlock")
                written_at.append(machine.speed)
        return [each for each in written_at if each > CREEPS], rotor.state.sample.referenced

    assert alone(resets) == ([], False)


@pytest.mark.parametrize("percent", [100, 40])
@pytest.mark.parametrize("first", [None, 0.5, 7.0, 25.0])
@pytest.mark.parametrize("second", [0.5, 16.0, 40.0])
@pytest.mark.sweep(4)
def test_a_healthy_run_that_goes_over_into_another_ends_by_itself_without_a_fault(first, second, percent):
    async def runs(machine):
        if first is not None:
            await machine.rotor.move_velocity(first, acceleration=10)
            await machine.rig.until(lambda: machine.speed > 0.95 * first)
        motion = await machine.rotor.move_velocity(second, acceleration=10, duration_s=5)
        await asyncio.sleep(1.0)
        await machine.rig.client.set_speed_override(percent)
        await motion.done()
        await (await machine.rotor.move_relative(3.3, velocity=2.0, acceleration=4.0)).done()
        return (await machine.rig.client.client.last("rotor", "fault")).active

    assert not alone(runs)


@pytest.mark.parametrize("after_s", [0.0, 0.01, 0.02, 0.03, 0.04, 0.05])
@pytest.mark.parametrize("rpm", [300, 950])
@pytest.mark.sweep(3)
def test_power_that_comes_as_an_encoder_dies_closes_no_loop_beside_a_rotor_that_coasts(rpm, after_s):
    async def switches_on(machine):
        await machine.rotor.move_velocity(rpm / 60, acceleration=10, duration_s=60)
        await machine.rig.until(lambda: machine.speed > 0.95 * rpm / 60)
        await machine.rotor.power(on=False)
        await asyncio.sleep(0.5)
        machine.rig.faults.encoder_stuck("rotor")
        await asyncio.sleep(after_s)
        closed_at, written_at = [], []
        for _ in range(100):
            with suppress(LdcndError):
                await machine.rotor.power(on=True)
                closed_at.append(machine.speed)
            with suppress(LdcndError):
                await machine.high("unlock")
                written_at.append(machine.speed)
            await asyncio.sleep(0.05)
        return [each for each in (*closed_at, *written_at) if each > CREEPS]

    assert alone(switches_on) == []


async def turns(machine, how):
    """Turn the rotor fast: by one motion, by one that has replaced another, or by a raw duty."""
    if how == "duty":
        await machine.rotor.set_pwm(0.2, duration_s=10)
        await machine.rig.until(lambda: machine.speed > 5)
        return
    await machine.rotor.move_velocity(16.0, acceleration=8)
    await machine.rig.until(lambda: machine.speed > 15)
    if how == "replaced":
        await machine.rotor.move_velocity(16.0, acceleration=4, buffer_mode="aborting")
        await asyncio.sleep(1.0)


@pytest.mark.parametrize("dead_s", [-0.2, -0.06, -0.02, 0.0, 0.01, 0.02])
@pytest.mark.parametrize("how", ["one motion", "replaced", "duty"])
@pytest.mark.parametrize("ends", ["power off", "no supply", "quick stop"])
@pytest.mark.sweep(4)
def test_an_encoder_that_dies_as_its_motor_loses_its_voltage_opens_no_lock_and_closes_no_loop(ends, how, dead_s):
    async def loses(machine):
        await turns(machine, how)
        machine.rig.faults.encoder_stuck("rotor", after_s=max(dead_s, 0.0))
        await asyncio.sleep(max(-dead_s, 0.0))
        if ends == "no supply":
            machine.rig.faults.motor_supply_lost("rotor", for_s=5.0)
        with suppress(LdcndError):
            await (machine.rotor.quick_stop() if ends == "quick stop" else machine.rotor.power(on=False))
        at = []
        for _ in range(100):
            if machine.rotor.state.sample.moving is Moving.NO:
                at.append(machine.speed)
            with suppress(LdcndError):  # a reset is believed for power, and for nothing else
                await (machine.rotor.reset() if ends == "quick stop" else machine.rotor.power(on=True))
                at.append(machine.speed if ends != "quick stop" else 0.0)
            with suppress(LdcndError):
                await machine.high("unlock")
                at.append(machine.speed)
            await asyncio.sleep(0.02)
        return [each for each in at if each > CREEPS]

    rotor = CENTRIFUGE.bus[0].axis[0].model_copy(update={"pwm": PwmConfig(duty=0.5)})
    line = CENTRIFUGE.bus[0].model_copy(update={"axis": (rotor,)})
    assert alone(loses, CENTRIFUGE.model_copy(update={"bus": (line,)})) == []


@pytest.mark.parametrize("speed", [0.65, 0.8, 1.5, 2.5])
@pytest.mark.parametrize("seed", [1, 2])
@pytest.mark.sweep(3)
def test_an_encoder_that_dies_beside_a_rotor_that_has_coasted_down_opens_no_lock(speed, seed):
    async def coasts(machine):
        await machine.rotor.move_velocity(5.0, acceleration=10)
        await asyncio.sleep(1.0 + 0.013 * seed)
        await machine.rotor.power(on=False)
        await machine.rig.until(lambda: machine.speed < speed)
        machine.rig.faults.encoder_stuck("rotor")
        at = []
        while machine.speed > CREEPS:
            if machine.rotor.state.sample.moving is Moving.NO:
                at.append(machine.speed)
            with suppress(LdcndError):
                await machine.high("unlock")
                at.append(machine.speed)
            await asyncio.sleep(0.02)
        return at, machine.rotor.state.sample.referenced

    assert alone(coasts) == ([], False)


@pytest.mark.parametrize(
    ("acceleration", "speed", "cut_s"), [(1, 0.3, 0.25), (3, 0.5, 0.16), (10, 0.6, 0.35), (10, 1.0, 0.25)]
)
@pytest.mark.parametrize("seed", [1, 2])
@pytest.mark.sweep(3)
def test_an_encoder_that_was_cut_as_a_spin_is_reversed_costs_the_reference(acceleration, speed, cut_s, seed):
    async def reverses(machine):
        await machine.rotor.move_velocity(5.0, acceleration=acceleration)
        await machine.rig.until(lambda: machine.speed > 4.9)
        await asyncio.sleep(0.3 + 0.017 * seed)
        await machine.rotor.move_velocity(-5.0, acceleration=acceleration, buffer_mode="aborting")
        await machine.rig.until(lambda: machine.speed < speed)
        machine.rig.faults.encoder_stuck("rotor", for_s=cut_s)
        await asyncio.sleep(cut_s + 2.0)
        return machine.rotor.state.sample.referenced

    assert alone(reverses) is False


@pytest.mark.parametrize("end", ["halt", "timed", "override"])
@pytest.mark.parametrize(
    ("acceleration", "speed"), [(1, 0.1), (1, 0.3), (1, 0.6), (1, 1.0), (10, 0.4), (10, 0.6), (10, 1.0)]
)
@pytest.mark.sweep(4)
def test_an_encoder_that_dies_at_the_end_of_a_ramp_opens_no_lock_beside_a_shaft_that_its_loop_pushes(
    end, acceleration, speed
):
    async def stands(machine):
        duration = {"duration_s": 6.0} if end == "timed" else {}
        await machine.rotor.move_velocity(5.0, acceleration=acceleration, **duration)
        await machine.rig.until(lambda: machine.speed > 4.9)
        if end == "halt":
            await machine.rotor.halt()
        elif end == "override":
            await machine.rig.client.set_speed_override(0)
        await machine.rig.until(lambda: machine.speed < speed)
        machine.rig.faults.encoder_stuck("rotor")
        at = []
        for _ in range(200):
            await asyncio.sleep(0.02)
            if machine.speed > 2 * CREEPS and machine.rotor.state.sample.moving is Moving.NO:
                at.append(machine.speed)
            with suppress(LdcndError):
                await machine.high("unlock")
                at += [machine.speed] if machine.speed > 2 * CREEPS else []
        return at, machine.rotor.state.sample.referenced

    assert alone(stands) == ([], False)


@pytest.mark.parametrize("bucket", [0.1, 0.33, 0.6])
def test_a_lock_opens_as_soon_as_a_healthy_rotor_has_reached_its_bucket(bucket):
    async def unlocks(machine):
        await (await machine.rotor.move_velocity(5.0, acceleration=10, duration_s=2)).done()
        for place in (bucket, bucket + 0.2, bucket + 0.35, bucket):
            await (await machine.rotor.move_absolute(place)).done()
            await machine.high("unlock")
            await machine.sees(locked=False)
            await machine.low("unlock")
            await machine.sees(locked=True)

    alone(unlocks)


@pytest.mark.parametrize("verb", ["move", "home"])
@pytest.mark.parametrize("later_s", [0.03, 0.06, 0.09, 0.12])
def test_a_lock_opens_at_whichever_instant_behind_a_motion_of_a_healthy_rotor(verb, later_s):
    async def unlocks(machine):
        for number in range(6):
            await (await (machine.rotor.home() if verb == "home" else machine.rotor.move_relative(0.1))).done()
            await asyncio.sleep(later_s + 0.007 * number)
            await machine.high("unlock")
            await machine.sees(locked=False)
            await machine.low("unlock")
            await machine.sees(locked=True)

    alone(unlocks)


@pytest.mark.parametrize("ended", ["stop", "unplugged"])
def test_the_reset_that_why_names_beside_a_rotor_that_turns_comes_behind_what_brings_it_to_rest(ended):
    async def named(machine):
        await machine.spin()
        if ended == "stop":
            await machine.rotor.stop()
            await asyncio.sleep(0.5)
        else:
            pulled = machine.rig.faults.unplug()
            await asyncio.sleep(6.0)
            pulled.end()
            await asyncio.sleep(2.0)
        assert machine.speed > 1.0
        first, *_ = (await machine.rotor.why()).causes
        return first.remedy

    waits = "wait until it stands, then send reset"
    assert alone(named) == (waits if ended == "stop" else f"send halt, {waits}")


def test_why_names_power_behind_what_a_row_wants_of_a_rotor_that_may_coast():
    async def program():
        async with simulated_rig(CENTRIFUGE) as rig:
            async with rig.client.control("rotor", client="test") as rotor:
                machine = await made_ready(rig, rotor)
                await machine.high("unlock")
                await machine.sees(locked=False)
                await machine.high("door")
                await machine.sees(door_open=True)
            await rig.kill_daemon()
            await asyncio.sleep(2.0)
            await rig.start_daemon()
            await asyncio.sleep(2.0)
            async with rig.client.watch("rotor") as rotor:
                return [each.code for each in (await rotor.why()).causes]

    first, *others = run(program())
    assert first == "interlock_violated"
    assert "wrong_state" in others
