"""Group starts and stops on drives of which some do not do as they are told; exchanges go straight into the chain."""

from types import SimpleNamespace

import pytest

from ldcnd.contract.errors import DriveFault, NotSupported, OutcomeUnknown, ReplyTimeout, StopLatched, WrongState
from ldcnd.drives.driver import AxisSpec, CountsMotion, Gains, StopMode
from ldcnd.drives.ldcn.commands import LeaderlessGroup, save_home
from ldcnd.drives.ldcn.group_plan import EVERYBODY, GroupPlan
from ldcnd.drives.ldcn.groups import Groups
from ldcnd.drives.ldcn.packet import CommandCode
from ldcnd.drives.ldcn.profiles import PIC_SERVO_SC, PIC_SERVO_V4
from ldcnd.drives.ldcn.servo import LdcnAxis
from ldcnd.drives.line_config import GroupConfig
from ldcnd.sim.ldcn.chain import ChainSpec, ModuleSpec, build_chain
from tests.support.direct_bus import DirectBus
from tests.support.simulated_host import SimulatedHost

GAINS = Gains(kp=350, kd=3000, ki=400, il=400, ol=250, cl=0, el=4000, sr=1, deadband=0)
GROUP = 0x81
THERE = CountsMotion(20_000, 20_000.0, 100_000.0)
MOTIONS = {"a": THERE, "b": THERE}


class Addressing:
    """Tells drives their group, in one packet each."""

    def __init__(self, host: SimulatedHost) -> None:
        self.host = host
        self.rate = SimpleNamespace(spaced=b"".join, cycle_s=0.000512)
        self.regrouped: list[int] = []
        self.untold: set[int] = set()
        self.succeeds = True

    async def regroup(self, address: int) -> bool:
        self.regrouped.append(address)
        self.host.send(address, CommandCode.SET_ADDRESS, address, GROUP)
        return self.succeeds


class Pair:
    """Two powered drives in one group."""

    def __init__(self, plan: GroupPlan | None = None, *, snapshots: bool = False) -> None:
        self.host = SimulatedHost(build_chain(ChainSpec((ModuleSpec("picservo-v4"), ModuleSpec("picservo-v4")))))
        self.host.address_all()
        self.bus = DirectBus(self.host)
        self.drives = {
            name: LdcnAxis(AxisSpec(name, address, "any", GAINS), PIC_SERVO_V4, self.bus)
            for address, name in ((1, "a"), (2, "b"))
        }
        names = {1: "a", 2: "b"}
        self.addressing = Addressing(self.host)
        plan = plan or GroupPlan((GroupConfig(name="pair", axes=("a", "b")),), names)
        self.groups = Groups(self.bus, plan, self.addressing, self.drives, snapshots=snapshots)

    async def up(self, *, power: bool = True, proven: bool = True) -> "Pair":
        for drive in self.drives.values():
            drive.forget()
            if power:
                await drive.power(on=True)
        for module in self.host.chain.modules:
            module.group = GROUP
        self.groups.proven = proven
        self.bus.sent.clear()
        self.bus.packets.clear()
        return self

    def run_on(self) -> list[bool]:
        """Return which drives move on."""
        before = self._positions()
        self.host.wait(0.5)
        return [abs(now - then) > 50 for now, then in zip(self._positions(), before, strict=True)]

    def _positions(self) -> list[float]:
        for module in self.host.chain.modules:
            module.catch_up(self.host.now_s)
        return [module.shaft.position_counts for module in self.host.chain.modules]


def wanted() -> None:
    """Nothing has overtaken the motion."""


async def test_a_group_starts_by_one_packet():
    pair = await Pair().up()

    await pair.groups.start(MOTIONS, wanted)

    assert pair.bus.commands().count(CommandCode.START_MOTION) == 1
    assert pair.run_on() == [True, True]


async def test_members_that_have_started_are_stopped_when_another_has_not():
    pair = await Pair().up()
    pair.host.chain.modules[1].group = 0x99  # it does not take the packet

    with pytest.raises(OutcomeUnknown, match="b did not start"):
        await pair.groups.start(MOTIONS, wanted)

    pair.host.wait(0.5)
    assert pair.run_on() == [False, False]
    assert pair.bus.commands().count(CommandCode.START_MOTION) == 1


@pytest.mark.parametrize("error", [ReplyTimeout("no reply"), StopLatched("a stop came")])
async def test_a_group_whose_start_cannot_be_proven_is_stopped_whole(error):
    pair = await Pair().up()

    def meanwhile() -> None:
        def fail() -> None:
            raise error

        pair.bus.instead[CommandCode.READ_STATUS] = fail

    pair.bus.after[CommandCode.START_MOTION] = meanwhile
    with pytest.raises(OutcomeUnknown, match="all were commanded to stop"):
        await pair.groups.start(MOTIONS, wanted)

    pair.host.wait(0.5)
    assert pair.run_on() == [False, False]


async def test_each_member_is_stopped_by_itself_when_the_packet_for_all_fails_or_one_of_them_does_not_answer():
    pair = await Pair().up()
    pair.host.chain.modules[1].group = 0x99
    failures = iter([ReplyTimeout("not sent"), ReplyTimeout("no reply")])

    def fail() -> None:
        if error := next(failures, None):
            pair.bus.instead[CommandCode.STOP_MOTOR] = fail
            raise error

    pair.bus.instead[CommandCode.STOP_MOTOR] = fail
    with pytest.raises(OutcomeUnknown):
        await pair.groups.start(MOTIONS, wanted)

    stops = [packet.address for packet in pair.bus.packets if packet.command is CommandCode.STOP_MOTOR]
    assert stops == [GROUP, 1, 2]


async def test_a_stop_between_load_and_start_keeps_all_at_rest():
    pair = await Pair().up()

    def overtaken() -> None:
        raise StopLatched("a stop came")

    with pytest.raises(StopLatched):
        await pair.groups.start(MOTIONS, overtaken)

    assert CommandCode.START_MOTION not in pair.bus.commands()


async def test_a_group_whose_members_are_not_proven_gets_no_packet_and_is_proven_before_it_starts():
    pair = await Pair().up(proven=False)

    await pair.groups.stop(StopMode.SMOOTH, frozenset({"a", "b"}))
    assert pair.bus.sent == []

    await pair.groups.start(MOTIONS, wanted)
    assert pair.addressing.regrouped == [1, 2]
    await pair.groups.stop(StopMode.SMOOTH, frozenset({"a", "b"}))
    assert pair.bus.packets[-1].address == GROUP
    pair.host.wait(0.5)
    assert pair.run_on() == [False, False]


async def test_a_drive_that_does_not_take_its_group_keeps_all_at_rest():
    pair = await Pair().up(proven=False)
    pair.addressing.succeeds = False

    with pytest.raises(ReplyTimeout, match="group address"):
        await pair.groups.start(MOTIONS, wanted)

    assert pair.bus.sent == []
    assert not pair.groups.proven


async def test_only_whole_groups_are_stopped_by_one_packet():
    pair = await Pair().up()

    await pair.groups.stop(StopMode.SMOOTH, frozenset({"a"}))

    assert pair.bus.sent == []


@pytest.mark.promise("stop-closes-no-loop")
async def test_no_packet_for_all_closes_the_loop_of_a_member_that_was_switched_off():
    pair = await Pair().up()
    await pair.drives["a"].stop(StopMode.OFF)
    pair.bus.sent.clear()

    await pair.groups.stop(StopMode.SMOOTH, frozenset({"a", "b"}))

    assert pair.bus.sent == []


async def test_the_group_of_everybody_is_used_only_where_there_is_nothing_but_axes():
    pair = await Pair(GroupPlan((), {1: "a", 2: "b"})).up()
    for module in pair.host.chain.modules:
        module.group = EVERYBODY
    with pytest.raises(NotSupported):
        await pair.groups.start(MOTIONS, wanted)
    await pair.groups.stop(StopMode.SMOOTH, frozenset({"a", "b"}))
    assert pair.bus.sent == []

    pair.groups.start_barred = ""
    await pair.groups.start(MOTIONS, wanted)
    assert pair.run_on() == [True, True]


async def test_a_member_with_an_open_loop_or_in_motion_keeps_all_at_rest():
    pair = await Pair().up(power=False)
    with pytest.raises(DriveFault, match="loop is open"):
        await pair.groups.start(MOTIONS, wanted)

    pair = await Pair().up()
    await pair.drives["a"].load(THERE)
    await pair.drives["a"].start()
    with pytest.raises(WrongState, match="moves already"):
        await pair.groups.start(MOTIONS, wanted)

    assert pair.bus.commands().count(CommandCode.START_MOTION) == 1


async def test_members_that_are_there_already_have_started():
    pair = await Pair().up()
    here = CountsMotion(0, 20_000.0, 100_000.0)

    await pair.groups.start({"a": here, "b": THERE}, wanted)

    assert pair.run_on() == [False, True]


async def test_a_snapshot_of_a_line_with_other_modules_names_the_group_and_never_everybody():
    pair = await Pair(snapshots=True).up()
    sent = []

    async def freeze(exchange):
        sent.append(exchange.request)
        raise ReplyTimeout("that is enough")

    pair.bus.execute_timed = freeze
    with pytest.raises(ReplyTimeout, match="enough"):
        await pair.groups.snapshot(lambda: None)

    assert sent == [save_home(LeaderlessGroup(GROUP)).request]


async def test_a_path_that_is_refused_when_its_turn_on_the_line_comes_is_no_unknown_outcome():
    pair = await Pair().up()
    asked = []

    async def refuse(exchange, *_lane):
        asked.append(exchange)
        raise StopLatched("axis a: a stop is latched")

    pair.drives["a"].profile = PIC_SERVO_SC
    pair.bus.execute = refuse
    with pytest.raises(StopLatched):
        await pair.groups.start_path(frozenset(MOTIONS), lambda: None)

    assert len(asked) == 1
