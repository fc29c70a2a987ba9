"""Named lines of a PIC-I/O: debounced and inverted inputs, outputs with a level for each situation, read back."""

import asyncio
import contextlib
import itertools

import pytest

from ldcnd.client.rig import Rig
from ldcnd.contract.commands import MoveVelocity, Power
from ldcnd.contract.errors import InterlockViolated, LdcndError, RegisterUnknown, ValueOutOfRange
from ldcnd.contract.events import LINK_BACK, LINK_LOST, ReadEvents
from ldcnd.contract.leases import Acquire, Release
from ldcnd.contract.rig_commands import SetIo
from ldcnd.contract.samples import TelemetryItem
from ldcnd.daemon.modules import NamedInput
from ldcnd.drives.line_config import InputConfig
from ldcnd.sim.chain import Chain
from ldcnd.sim.faults import FaultInjector, FaultPlan, FaultyRequest
from tests.support.chain_rig import taken_away
from tests.support.machine_rig import (
    CLOSED,
    DOOR_OPENS,
    LOCK,
    SAFE,
    Machine,
    chain_of_machine,
    machine,
    running_machine,
)

HIGH, LOW = 1 << LOCK - 1, 0


def with_lock(**levels: object) -> dict[str, object]:
    return {"outputs": {"lock": {"line": LOCK, **levels}}}


async def events(rig: Machine) -> list[tuple[str, str | None]]:
    """Return what the daemon tells of the outputs of the module besides who has written to it."""
    page = await rig.client.ask(ReadEvents(axis="cabinet", count=100))
    return [(event.verb, event.reason) for event in page.events if event.verb not in (SetIo.verb, LINK_LOST, LINK_BACK)]


def driven(rig: Machine) -> int | None:
    """Return the level of the lock as the simulated module drives it; None when it does not."""
    return rig.io.latch & HIGH if rig.io.outputs & HIGH else None


async def power_cycle(rig: Machine, off_s: float = 1.0) -> None:
    rig.io.power(on=False, at_s=asyncio.get_running_loop().time())
    await asyncio.sleep(off_s)
    rig.io.power(on=True, at_s=asyncio.get_running_loop().time())
    await asyncio.sleep(5.0)


async def test_a_line_is_set_and_shown_by_its_name():
    async with running_machine(machine()) as rig:
        client = Rig(rig.client, await rig.client.daemon())
        assert (await rig.named(door_closed=True)).named == {"door_closed": True, "door_open": False, "lock": None}
        await client.set_io("cabinet", high=["lock"])
        assert (await rig.named(lock=True)).outputs == (LOCK,)
        await client.set_io("cabinet", low=[LOCK])
        await rig.named(lock=False)
        with pytest.raises(ValueOutOfRange, match="no line 'loc'; its names are door_closed, door_open, lock"):
            await client.set_io("cabinet", high=["loc"])
        assert driven(rig) == LOW


async def test_an_inverted_input_is_true_while_its_level_is_low():
    inputs = {"door_closed": {"line": 3, "inverted": True}, "door_open": {"line": 4, "inverted": True}}
    async with running_machine(machine(module={"inputs": inputs})) as rig:
        await rig.named(door_closed=False, door_open=True)


READINGS = [
    ("a level counts once it has stayed", [(0.0, 1), (0.05, 1), (0.1, 1)], [None, None, True]),
    ("a short change does not", [(0.0, 1), (0.1, 1), (0.15, 0), (0.2, 1), (0.3, 1)], [None, True, True, True, True]),
    ("a lasting one does", [(0.0, 1), (0.1, 1), (0.15, 0), (0.2, 0), (0.25, 0)], [None, True, True, True, False]),
    (
        "one that goes on changing is unknown, until it stays",
        [(0.0, 1), (0.1, 1), *((0.1 + at / 20, at % 2) for at in range(1, 9)), (0.55, 0), (0.6, 0), (0.65, 0)],
        [None, *[True] * 8, None, None, False, False],
    ),
]


@pytest.mark.parametrize(("_what", "readings", "values"), READINGS, ids=[each[0] for each in READINGS])
def test_an_input_is_debounced(_what, readings, values):
    found = NamedInput(InputConfig(line=1, debounce_ms=100), 0.05)
    shown = []
    for at_s, level in readings:
        found.take(bool(level), at_s + 1e-9 * at_s)
        shown.append(found.value)

    assert shown == values


@pytest.mark.promise("outputs-by-command")
async def test_an_output_has_its_level_at_the_start_and_after_a_loss_of_power():
    async with running_machine(machine(module=with_lock(start="high", reset="low"))) as rig:
        await rig.named(lock=True)
        assert driven(rig) == HIGH
        await power_cycle(rig)
        assert driven(rig) == LOW

        assert await events(rig) == [
            ("start", "output lock high, its level of start"),
            ("reset", "output lock low, its level of reset"),
        ]


async def test_an_output_that_is_set_as_soon_as_its_module_is_back_keeps_what_it_was_set_to():
    # first the levels of a situation, then those of commands, whichever instant a command finds
    async with running_machine(machine(module=with_lock(start="low", reset="low") | {"rate": 2})) as rig:
        await rig.named(lock=False)
        address = rig.io.address
        for off_s in (0.1, 0.23, 0.41, 0.57):
            rig.io.power(on=False, at_s=asyncio.get_running_loop().time())
            await asyncio.sleep(off_s)
            rig.io.power(on=True, at_s=asyncio.get_running_loop().time())
            async with asyncio.timeout(30):
                while rig.io.address != address:
                    await asyncio.sleep(0.002)
                while True:
                    with contextlib.suppress(LdcndError):
                        await rig.client.ask(SetIo(module="cabinet", high=("lock",)))
                        break
                    await asyncio.sleep(0.01)
            await asyncio.sleep(3.0)
            assert driven(rig) == HIGH, off_s


async def adopted(chain: Chain, **levels: object) -> int | None:
    async with running_machine(machine(module=with_lock()), chain) as rig:
        await rig.client.ask(SetIo(module="cabinet", high=("lock",)))
        await rig.named(lock=True)
    async with running_machine(machine(module=with_lock(**levels), start="adopt"), chain) as rig:
        await rig.named(lock=None, door_closed=True)  # that its pin is high does not prove that it is driven
        return driven(rig)


async def test_a_module_that_is_taken_over_keeps_its_outputs():
    assert await adopted(chain_of_machine(), start="low", reset="low", loss={"bus": "low"}) == HIGH


async def test_an_output_has_its_level_after_the_loss_of_its_client_and_keeps_it_after_a_release():
    async with running_machine(machine(module=with_lock(loss={"client": "low"}))) as rig:
        lease = (await rig.client.ask(Acquire(client="ann", axes=("rotor", "table")))).lease
        await rig.client.ask(SetIo(module="cabinet", high=("lock",), lease=lease))
        await rig.client.ask(Release(lease=lease))
        await asyncio.sleep(2.0)
        assert driven(rig) == HIGH
        await rig.client.ask(Acquire(client="ann", axes=("rotor",)))
        await asyncio.sleep(2.0)
        assert driven(rig) == LOW


LAMP_FIRST = {"name": "lamp_first", "of": "lock", "kind": ["low"]}
LAMP = HIGH << 1
UNLOCKS = {"name": "unlocks", "of": "lock", "kind": ["low"], "requires": [{"input": "door_closed"}]}


@pytest.mark.parametrize("situation", ["client", "bus", "daemon"])
@pytest.mark.parametrize("rules", [(), (LAMP_FIRST | {"requires": [{"output": "lamp"}]},)], ids=["free", "bound"])
async def test_an_output_of_a_module_that_was_taken_over_has_its_level_and_the_others_keep_theirs(situation, rules):
    lamp, chain = {"line": LOCK + 1}, chain_of_machine()
    async with running_machine(machine(module={"outputs": {"lock": {"line": LOCK}, "lamp": lamp}}), chain) as rig:
        await rig.client.ask(SetIo(module="cabinet", high=("lock", "lamp")))
    outputs = with_lock(loss={situation: "low"})["outputs"] | {"lamp": lamp}
    async with running_machine(machine(*rules, module={"outputs": outputs}, start="adopt"), chain) as rig:
        if situation == "client":
            await rig.client.ask(Acquire(client="ann", axes=("rotor",), lease_s=2.0))
        elif situation == "bus":
            rig.daemon.rig.lines["line"].bus.drop("a cable that comes loose")
        await asyncio.sleep(10.0)

    io = chain.modules[2]
    assert (io.outputs, io.latch) == (HIGH | LAMP, LAMP)


async def test_the_levels_of_a_situation_are_judged_by_what_all_of_them_set():
    outputs = {name: {"line": line, "loss": {"client": "low"}} for name, line in (("lock", LOCK), ("lamp", LOCK + 1))}
    rule = LAMP_FIRST | {"requires": [{"output": "lamp", "value": False}]}
    async with running_machine(machine(rule, module={"outputs": outputs})) as rig:
        lease = (await rig.client.ask(Acquire(client="ann", axes=("rotor", "table"), lease_s=2.0))).lease
        await rig.client.ask(SetIo(module="cabinet", high=("lock", "lamp"), lease=lease))
        await asyncio.sleep(5.0)

        assert (rig.io.outputs, rig.io.latch) == (HIGH | LAMP, LOW)


@pytest.mark.parametrize("lock", [{}, {"client": "high"}], ids=["unnamed", "of the situation"])
async def test_no_level_of_a_situation_lets_a_line_that_may_be_no_output_become_what_is_forbidden(lock):
    """Its pin is high because it floats, and as an output it is low first."""
    outputs = {"lock": {"line": LOCK, "loss": lock}, "lamp": {"line": LOCK + 1, "loss": {"client": "low"}}}
    chain = chain_of_machine()
    chain.modules[2].drive_line(LOCK, high=True, at_s=0.0)
    async with running_machine(machine(module={"outputs": outputs}), chain):
        pass
    async with running_machine(machine(DOOR_OPENS, module={"outputs": outputs}, start="adopt"), chain) as rig:
        execute, low_at = rig.io.execute, []

        def watched(command: object) -> None:
            execute(command)
            low_at.extend([rig.speed()] if driven(rig) == LOW else [])

        rig.io.execute = watched
        lease = (await rig.client.ask(Acquire(client="ann", axes=("rotor", "table"), lease_s=2.0))).lease
        await rig.client.command("rotor", Power(on=True, lease=lease))
        await rig.client.command("rotor", MoveVelocity(velocity=10.0, lease=lease))
        await asyncio.sleep(8.0)

        assert [each for each in low_at if each > SAFE] == []
        assert (rig.io.outputs, rig.io.latch) == (HIGH | LAMP, HIGH)
        told = (
            "not set: output lamp low, its level of loss.client: output lock, as it becomes one: interlock door_opens"
        )
        assert any((reason or "").startswith(told) for _, reason in await events(rig))


async def test_an_output_that_was_taken_over_has_its_level_though_a_rule_of_another_one_forbids_to_tell_directions():
    """What holds a lock keeps no brake from falling: Set Output alone makes nothing an output."""
    outputs = {"lock": {"line": LOCK}, "lamp": {"line": LOCK + 1, "loss": {"client": "low"}}}
    chain = chain_of_machine()
    async with running_machine(machine(module={"outputs": outputs}), chain) as rig:
        await rig.client.ask(SetIo(module="cabinet", high=("lock", "lamp")))
    async with running_machine(machine(DOOR_OPENS, module={"outputs": outputs}, start="adopt"), chain) as rig:
        execute, told = rig.io.execute, set[str]()

        def watched(command: object) -> None:
            before = rig.io.latch
            execute(command)
            if rig.io.latch != before:
                told.add(rig.daemon.rig.modules["cabinet"].why_unknown("lamp"))

        rig.io.execute = watched
        lease = (await rig.client.ask(Acquire(client="ann", axes=("rotor", "table"), lease_s=2.0))).lease
        await rig.client.command("rotor", Power(on=True, lease=lease))
        await rig.client.command("rotor", MoveVelocity(velocity=10.0, acceleration=0.5, lease=lease))
        async with asyncio.timeout(10.0):
            while rig.io.latch & LAMP:
                await asyncio.sleep(0.01)

        assert rig.speed() > SAFE
        assert told == {"it is being written"}  # so no motion that asks for it passes beside that
        assert (rig.io.outputs, rig.io.latch) == (HIGH | LAMP, HIGH)


async def test_what_a_person_has_kept_as_its_pin_shows_is_no_change_after_a_take_over():
    """Nobody could write it otherwise, nor what is written with it."""
    outputs, chain = {"lock": {"line": LOCK}, "lamp": {"line": LOCK + 1}}, chain_of_machine()
    chain.modules[2].drive_line(CLOSED, high=False, at_s=0.0)
    async with running_machine(machine(module={"outputs": outputs}), chain) as rig:
        await rig.client.ask(SetIo(module="cabinet", high=("lock", "lamp")))
    async with running_machine(machine(UNLOCKS, module={"outputs": outputs}, start="adopt"), chain) as rig:
        await rig.client.ask(SetIo(module="cabinet", high=("lock",), low=("lamp",)))

    io = chain.modules[2]
    assert (io.outputs, io.latch) == (HIGH | LAMP, HIGH)


async def test_an_output_has_its_level_beside_a_line_that_was_let_go_and_changes_all_the_time():
    """Two replies never agree about that one, and no output waits for it."""
    outputs = {"lock": {"line": LOCK}, "lamp": {"line": LOCK + 1, "loss": {"client": "low"}}}
    chain, module = chain_of_machine(), {"outputs": outputs, "rate": 1}
    async with running_machine(machine(module=module), chain) as rig:
        await rig.client.ask(SetIo(module="cabinet", high=("lock", "lamp")))
    async with running_machine(machine(module=module, start="adopt"), chain) as rig:
        await rig.client.ask(SetIo(module="cabinet", high=("lamp",), inputs=("lock",)))
        status, levels = rig.io.status, itertools.cycle((True, False))

        def toggling(*args: object, **more: object) -> bytes:
            rig.io.drive_line(LOCK, high=next(levels), at_s=asyncio.get_running_loop().time())
            return status(*args, **more)

        rig.io.status = toggling
        await rig.client.ask(Acquire(client="ann", axes=("rotor", "table"), lease_s=2.0))
        await asyncio.sleep(5.0)
        assert (rig.io.outputs, rig.io.latch & LAMP) == (LAMP, LOW)


SET_OUTPUT = 6


class DeafModule(FaultInjector):
    """Loses what sets outputs of the module for a while from the first time on."""

    def __init__(self) -> None:
        super().__init__(FaultPlan())
        self.since_s: float | None = None

    def request(self, data: bytes, at_s: float) -> FaultyRequest:
        packet = data[data.rfind(b"\xaa") :]
        if packet[1:2] != b"\x03" or packet[2] & 15 != SET_OUTPUT:  # a flush has no header
            return FaultyRequest(tuple(data))
        self.since_s = at_s if self.since_s is None else self.since_s
        return FaultyRequest(tuple(data) if at_s > self.since_s + 0.7 else (None,) * len(data))


async def test_an_output_has_its_level_at_the_end_of_a_daemon_whose_packets_are_lost_for_a_while():
    chain = chain_of_machine()
    async with running_machine(machine(module=with_lock(loss={"daemon": "low"})), chain) as rig:
        await rig.client.ask(SetIo(module="cabinet", high=("lock",)))
        await rig.named(lock=True)
        chain.injector = deaf = DeafModule()

    assert deaf.since_s is not None
    assert driven(rig) == LOW


@pytest.mark.parametrize("lamp", [{}, {"bus": "high"}], ids=["alone", "before another situation"])
async def test_an_output_has_its_level_after_the_loss_of_its_client_while_its_line_was_down(lamp):
    """It was refused once, as out of reach, and forgotten."""
    outputs = {"lock": {"line": LOCK, "loss": {"client": "low"}}, "lamp": {"line": LOCK + 1, "loss": lamp}}
    chain = chain_of_machine()
    async with running_machine(machine(module={"outputs": outputs}), chain) as rig:
        lease = (await rig.client.ask(Acquire(client="ann", axes=("rotor", "table"), lease_s=2.0))).lease
        await rig.client.ask(SetIo(module="cabinet", high=("lock",), low=("lamp",), lease=lease))
        chain.unplug(asyncio.get_running_loop().time(), 5.0)
        await asyncio.sleep(15.0)
        assert driven(rig) == LOW
        assert bool(rig.io.latch & 1 << LOCK) == bool(lamp)


@pytest.mark.long
async def test_an_output_has_its_level_after_a_loss_of_the_line_and_at_the_end_of_the_daemon():
    chain = chain_of_machine()
    async with running_machine(machine(module=with_lock(loss={"bus": "high", "daemon": "low"})), chain) as rig:
        await rig.client.ask(SetIo(module="cabinet", low=("lock",)))
        rig.daemon.rig.lines["line"].bus.drop("a cable that comes loose")
        await asyncio.sleep(10.0)
        assert driven(rig) == HIGH
    assert chain.modules[2].latch & HIGH == LOW


@pytest.mark.promise("outputs-by-command")
@pytest.mark.parametrize("of", ["client", "bus"])
async def test_outputs_that_others_have_set_while_the_line_was_lost_are_not_set_back(of):
    """Beside the level of another output, which a client asks for, or the policy of a loss."""
    lines = {"lock": {"line": LOCK}, "lamp": {"line": LOCK + 1}, "fan": {"line": LOCK + 2}}
    module, chain = {"outputs": lines}, chain_of_machine()
    own = {"outputs": lines | {"fan": lines["fan"] | {"loss": {"bus": "high"}}}} if of == "bus" else module
    async with running_machine(machine(module=own), chain) as rig:
        await rig.client.ask(SetIo(module="cabinet", high=("lock", "lamp"), low=("fan",)))
        await rig.named(lock=True, lamp=True, fan=False)
        async with (
            taken_away(rig.daemon.rig.lines["line"].bus),
            running_machine(machine(module=module, start="adopt"), chain) as other,
        ):
            await other.client.ask(SetIo(module="cabinet", low=("lock", "lamp", "fan")))
        await rig.named(lock=None, lamp=None, fan=of == "bus")
        if of == "client":
            await rig.client.ask(SetIo(module="cabinet", high=("fan",)))
        await rig.named(lock=None, lamp=None, fan=True)

        assert (rig.io.outputs, rig.io.latch) == (HIGH | LAMP | LAMP << 1, LAMP << 1)
        with pytest.raises(RegisterUnknown, match="what was written to outputs lamp"):
            await rig.client.ask(SetIo(module="cabinet", high=("lock",)))
        await asyncio.sleep(2.0)
        page = await rig.client.ask(ReadEvents(axis="cabinet", count=100))
        (back,) = [event.reason for event in page.events if event.verb == LINK_BACK]
        assert "output lock, which was high, may have another level by now" in back


async def test_outputs_that_nobody_has_set_while_the_line_was_lost_are_known_by_their_pins():
    """An output that was never driven is not driven either, though another one gets its level of the loss."""
    lines = {"lock": {"line": LOCK}, "lamp": {"line": LOCK + 1, "loss": {"bus": "high"}}, "fan": {"line": LOCK + 2}}
    async with running_machine(machine(module={"outputs": lines})) as rig:
        await rig.client.ask(SetIo(module="cabinet", high=("lock",), low=("lamp",), pwm1=0.5))
        await rig.named(lock=True, lamp=False)
        async with taken_away(rig.daemon.rig.lines["line"].bus):
            await asyncio.sleep(1.0)
        await rig.named(lock=True, lamp=True, fan=None)

        assert (rig.io.outputs, rig.io.latch) == (HIGH | LAMP, HIGH | LAMP)
        with pytest.raises(RegisterUnknown, match="pwm 1"):
            await rig.client.ask(SetIo(module="cabinet", pwm2=0.5))


async def test_a_level_that_an_interlock_forbids_is_not_written():
    async with running_machine(machine(DOOR_OPENS, module=with_lock(loss={"client": "low"}))) as rig:
        lease = (await rig.client.ask(Acquire(client="ann", lease_s=2.0))).lease
        await rig.client.ask(SetIo(module="cabinet", high=("lock",), lease=lease))
        await rig.client.command("rotor", Power(on=True, lease=lease))
        await rig.client.command("rotor", MoveVelocity(velocity=5.0, lease=lease))
        cabinet, read_at_s = rig.daemon.rig.modules["cabinet"], set[float]()
        for _ in range(150):
            await asyncio.sleep(0.02)
            read_at_s.add(cabinet.read_at_s)

        assert driven(rig) == HIGH
        assert max(later - earlier for earlier, later in itertools.pairwise(sorted(read_at_s))) < 0.03  # at 50 Hz
        ((verb, reason),) = await events(rig)
        assert verb == "loss.client"
        assert "not set: output lock low, its level of loss.client: output lock: interlock door_opens" in reason


@pytest.mark.parametrize(("pulled", "written"), [("up", None), ("down", HIGH)])
async def test_a_line_becomes_no_output_where_the_level_that_it_has_first_is_forbidden(pulled, written):
    chain = chain_of_machine()
    chain.modules[2].drive_line(CLOSED, high=False, at_s=0.0)
    chain.modules[2].drive_line(LOCK, high=pulled == "up", at_s=0.0)
    async with running_machine(machine(UNLOCKS, module=with_lock(start="high", reset="high")), chain) as rig:
        await asyncio.sleep(1.0)
        assert driven(rig) == written
        await power_cycle(rig)
        assert driven(rig) == written
        if written is None:
            told = "output lock, as it becomes one: interlock unlocks: input door_closed is false"
            with pytest.raises(InterlockViolated, match=told) as refused:
                await rig.client.ask(SetIo(module="cabinet", high=("lock",)))
            assert refused.value.remedy.startswith("wait until input door_closed is true, then set output lock high")

        rig.door(closed=True)
        await rig.named(door_closed=True)
        await rig.client.ask(SetIo(module="cabinet", high=("lock",)))
        assert driven(rig) == HIGH


DIFFERS = ("output_differs", "output lock was set high and its pin shows low: check what it drives")


@pytest.mark.parametrize(("readings", "told"), [(1, []), (2, [DIFFERS]), (5, [DIFFERS])])
async def test_an_output_whose_pin_shows_another_level_is_unknown_at_once_and_reported_in_the_second_reading(
    readings, told
):
    rule = {"name": "lock_open", "of": "rotor", "requires": [{"output": "lock", "value": False}]}
    async with running_machine(machine(rule)) as rig:
        await rig.client.ask(SetIo(module="cabinet", high=("lock",)))
        await rig.named(lock=True)
        await rig.client.command("rotor", Power(on=True))
        shown = []
        async with rig.client.samples("cabinet", TelemetryItem.IO) as samples:
            rig.io.latch = LOW  # as a short circuit, another host or a dip of its supply has it
            while len(shown) < readings:
                _, found = await anext(samples)
                shown += [found.named["lock"]] if not found.levels[LOCK - 1] else []
        with pytest.raises(InterlockViolated, match="output lock is not known: it was set high and its pin shows low"):
            await rig.client.command("rotor", MoveVelocity(velocity=1.0))
        rig.io.latch = HIGH
        await rig.named(lock=True)

        assert shown == [None] * readings
        assert await events(rig) == told
