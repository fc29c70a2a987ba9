"""Simulated doors, locks, cylinders and imbalance switches: what a host sees of them at the lines of a PIC-I/O."""

import pytest
from pydantic import ValidationError

from ldcnd.drives.ldcn.packet import CommandCode
from ldcnd.drives.ldcn.pic_io import ALL_LINES, IoItem, SetDirection, SetOutput, decode_io_status, encode_io_command
from ldcnd.sim.ldcn.chain import build_chain
from ldcnd.sim.ldcn.io import SimulatedIo
from ldcnd.sim.ldcn.power import FaultCondition
from ldcnd.sim.ldcn.simulation import SimulationConfig
from tests.support.simulated_host import PATIENCE_S, SimulatedHost

IO = 2
SHUT, OPEN, UNBOLTED, STILL = 1, 2, 3, 4
"""Lines of the sensors and of the imbalance switch."""
BOLT_OUT, DOOR_OPENS = 9, 10
"""Lines of the outputs."""
LOCK = {
    "name": "lock",
    "module": IO,
    "output": BOLT_OUT,
    "inverted": True,
    "travel_s": 0.5,
    "sensors": [{"line": UNBOLTED, "between": [0, 0]}],
}
DOOR = {
    "name": "door",
    "module": IO,
    "output": DOOR_OPENS,
    "travel_s": 2.0,
    "held_by": "lock",
    "sensors": [{"line": SHUT, "between": [0, 0.1], "inverted": True}, {"line": OPEN, "between": [1, 1]}],
}
SWITCH = {"module": IO, "line": STILL, "drive": 1, "above_counts_per_s": 5000}


class Host(SimulatedHost):
    """A host of a PIC-SERVO and a PIC-I/O in a machine."""

    def __init__(self, *event, part=(LOCK, DOOR), imbalance=(SWITCH,), low=()):
        modules = [{"model": "pic-servo-sc"}, {"model": "pic-io", "io": {"low": low}}]
        table = {"module": modules, "part": part, "imbalance": imbalance, "event": event}
        super().__init__(build_chain(SimulationConfig.model_validate(table).spec()))
        self.address_all()
        outputs = 1 << BOLT_OUT - 1 | 1 << DOOR_OPENS - 1
        self.command(SetDirection(ALL_LINES & ~outputs))

    @property
    def drive(self):
        return self.chain.modules[0]

    def sees(self):
        levels = decode_io_status(IoItem.LEVELS, self.send(IO, CommandCode.READ_STATUS, IoItem.LEVELS)).levels
        return {line for line in (SHUT, OPEN, UNBOLTED, STILL) if levels & 1 << line - 1}

    def high(self, *lines):
        self.command(SetOutput(sum(1 << line - 1 for line in lines)))

    def command(self, command):
        self.chain.write(self.now_s, encode_io_command(IO, command))
        self.wait(PATIENCE_S)


def test_a_door_is_held_by_its_lock_and_takes_its_time():
    host = Host()
    host.high(DOOR_OPENS)
    host.wait(5.0)
    bolted = host.sees()

    host.high(DOOR_OPENS, BOLT_OUT)
    host.wait(0.3)
    unbolting = host.sees()
    host.wait(0.2)  # half a second for the bolt, then 0.2 s of 2 s for the first tenth of the door
    released = host.sees()
    host.wait(0.5)
    on_the_way = host.sees()
    host.wait(1.5)
    opened = host.sees()
    host.high(BOLT_OUT)
    host.wait(2.1)

    assert (bolted, unbolting) == ({STILL}, {STILL})  # the sensor of the shut door is low where it sees it
    assert (released, on_the_way) == ({UNBOLTED, STILL}, {SHUT, UNBOLTED, STILL})
    assert opened == {SHUT, OPEN, UNBOLTED, STILL}
    assert host.sees() == {UNBOLTED, STILL}


@pytest.mark.parametrize(
    ("low", "driven", "lock_and_door"),
    [
        ((), (), (0.0, 1.0)),
        ((BOLT_OUT, DOOR_OPENS), (BOLT_OUT, DOOR_OPENS), (1.0, 1.0)),  # the bolt was there before the door
    ],
    ids=["pulled up", "pulled down"],
)
def test_lines_of_a_module_that_was_reset_move_their_parts_as_they_are_pulled(low, driven, lock_and_door):
    host = Host(low=low)
    host.high(*driven)
    host.wait(3.0)

    host.send(IO, CommandCode.HARD_RESET)
    host.wait(5.0)

    io = host.chain.modules[1]
    assert isinstance(io, SimulatedIo)
    io.catch_up(host.now_s)
    assert io.levels >> BOLT_OUT - 1 & 0b11 == (0 if low else 0b11)
    assert (io.around.at("lock"), io.around.at("door")) == lock_and_door


def test_what_jams_stays_where_it_is_until_it_is_free_and_an_unplugged_sensor_says_what_its_line_is_pulled_to():
    host = Host(
        {"at_s": 3.0, "module": IO, "jams": "door"},
        {"at_s": 6.0, "module": IO, "frees": "door"},
        {"at_s": 9.0, "module": IO, "line": OPEN, "level": "low"},
    )
    host.wait(1.0 - host.now_s)
    host.high(DOOR_OPENS, BOLT_OUT)
    host.wait(5.9 - host.now_s)
    jammed = host.sees()
    host.wait(8.0 - host.now_s)
    freed = host.sees()
    host.wait(9.5 - host.now_s)

    assert OPEN not in jammed
    assert OPEN in freed
    assert OPEN not in host.sees()


@pytest.mark.parametrize("inverted", [False, True])
def test_a_rotor_out_of_balance_hits_the_switch_while_it_is_fast(inverted):
    host = Host(imbalance=({**SWITCH, "inverted": inverted},))
    host.drive.set_condition(FaultCondition.UNBALANCED, present=True, at_s=host.now_s)
    slow = host.sees()
    host.drive.catch_up(host.now_s)
    host.drive.shaft.velocity_counts = 6000 * host.drive.profile.servo_cycle_s

    fast = host.sees()
    host.drive.set_condition(FaultCondition.UNBALANCED, present=False, at_s=host.now_s)

    assert [STILL in each for each in (slow, fast, host.sees())] == [not inverted, inverted, not inverted]


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"part": [DOOR]}, "no part lock at module 2"),
        ({"part": [LOCK, LOCK]}, "two have one name"),
        ({"part": [LOCK | {"module": 1}]}, "module 1 is no pic-io"),
        ({"part": [LOCK, DOOR | {"sensors": LOCK["sensors"]}]}, "line 3 of module 2 is driven twice"),
        ({"part": [LOCK, DOOR, DOOR | {"name": "hatch", "held_by": "door", "sensors": []}]}, "is held itself"),
        ({"imbalance": [SWITCH | {"drive": 2}]}, "module 2 is no drive"),
        ({"event": [{"at_s": 0, "module": 2, "jams": "hatch"}]}, "module 2 has no part hatch"),
        ({"part": [LOCK | {"sensors": [{"line": 1, "between": [1, 0]}]}]}, "must not be above the second"),
    ],
)
def test_a_machine_that_cannot_be_is_refused(change, said):
    table = {"module": [{"model": "pic-servo-sc"}, {"model": "pic-io"}], **change}
    with pytest.raises(ValidationError, match=said):
        SimulationConfig.model_validate(table)
