"""A line from whatever state to drives that can be polled."""

import asyncio
import contextlib

import pytest

from ldcnd.contract.commands import HomeMethod
from ldcnd.contract.errors import BusError, NetworkMismatch, NotSupported, ReplyTimeout, StopLatched
from ldcnd.drives.driver import CountsMotion, HomeCapture, StopMode
from ldcnd.drives.ldcn.addressing import WAITING_ADDRESSES
from ldcnd.drives.ldcn.adoption import Found
from ldcnd.drives.ldcn.commands import Node, read_status
from ldcnd.drives.ldcn.config import LineSpec, ModuleConfig
from ldcnd.drives.ldcn.controls import StopControl
from ldcnd.drives.ldcn.gathering import Gathering
from ldcnd.drives.ldcn.identity import Expected, Identity, differences
from ldcnd.drives.ldcn.packet import CommandCode, StatusItem
from ldcnd.drives.ldcn.profiles import LS_182AP, PIC_SERVO_SC, PIC_SERVO_V4
from ldcnd.drives.ldcn.registers import actual_baud
from ldcnd.drives.line_config import GroupConfig
from ldcnd.drives.network import AdoptFallback, StartPolicy
from ldcnd.sim.chain import Chain
from ldcnd.sim.faults import FaultInjector, FaultPlan, FaultyReply
from ldcnd.sim.ldcn.chain import ChainSpec, ModuleSpec, build_chain
from ldcnd.sim.ldcn.drive import SimulatedDrive
from ldcnd.sim.ldcn.quirks import ModuleSettings
from ldcnd.sim.plant import MotorPlant
from tests.support.bare_network import BareNetwork, bare_network, specs

ADOPT = LineSpec(start=StartPolicy.ADOPT)
ADOPT_OR_RESET = LineSpec(start=StartPolicy.ADOPT, adopt_fallback=AdoptFallback.RESET)
PAIR = specs("ls-182ap", "pic-servo-v4")


def chain_of(*models):
    return build_chain(ChainSpec(tuple(ModuleSpec(model) for model in models)))


class StuckRate(SimulatedDrive):
    """A drive that ignores Set Baud Rate, as behind a bad crystal."""

    baud = property(lambda _self: actual_baud(0x3F), lambda _self, _value: None)


class DeafOnce(SimulatedDrive):
    """A drive to which the first Set Baud Rate to the working rate was noise."""

    _missed = False
    _rate = 0.0

    def _follow(self, rate):
        if rate == actual_baud(0x0A) and not self._missed:
            self._missed = True
        else:
            self._rate = rate

    baud = property(lambda self: self._rate, _follow)


@pytest.mark.parametrize(
    ("baud", "alternate", "code"),
    [
        (9600, False, 0x81),
        (9600, True, 127),
        (57_600, False, 0x14),
        (57_600, True, 21),
        (115_200, False, 0x0A),
        (115_200, True, 0x0A),
    ],
)
async def test_both_families_of_divisors_reach_the_working_rate(baud, alternate, code):
    chain = chain_of("ls182ap", "picservo-v4")
    async with bare_network(chain, PAIR, baud, LineSpec(alternate_divisors=alternate)) as line:
        report = await line.network.bring_up()
        codes = [packet.data for packet in line.sent() if packet.command is CommandCode.SET_BAUD_RATE]

    assert (report.baud, report.reset) == (baud, True)
    assert codes[-1] == bytes([code])  # those before call stray modules to the rate of a reset
    assert [module.baud for module in chain.modules] == pytest.approx([actual_baud(code)] * 2, rel=1e-4)


async def test_the_highest_rate_is_reached_where_every_module_has_it():
    chain = build_chain(ChainSpec((ModuleSpec("picservo-sc"), ModuleSpec("picservo-sc"))))
    async with bare_network(chain, specs("pic-servo-sc", "pic-servo-sc"), 230_400) as line:
        report = await line.network.bring_up()

    assert (report.baud, report.remarks) == (230_400, ())


async def test_a_module_that_does_not_follow_takes_everybody_back_by_reset():
    follower = SimulatedDrive(LS_182AP, ModuleSettings(version=20, always_obeys_global_reset=True), MotorPlant())
    chain = Chain([follower, StuckRate(PIC_SERVO_V4, ModuleSettings(version=4), MotorPlant())])
    async with bare_network(chain, PAIR) as line:
        report = await line.network.bring_up()

    assert report.baud == 19_200
    assert report.remarks == ("address 2 does not answer at 115200 baud; the line stays at 19200",)
    assert [module.address for module in chain.modules] == [1, 2]
    assert follower.baud == actual_baud(0x3F)


@pytest.mark.parametrize("alternate", [False, True])
async def test_a_drive_whose_clock_is_fast_follows_57600_with_the_divisor_that_makes_it_slower(alternate):
    fast = ModuleSpec("picservo-v4", settings=ModuleSettings(version=4, drift_ppm=-20_000.0))
    chain = build_chain(ChainSpec((ModuleSpec("ls182ap"), fast)))
    async with bare_network(chain, PAIR, 57_600, LineSpec(alternate_divisors=alternate)) as line:
        report = await line.network.bring_up()
        packets = [(packet.address, packet.command, packet.data) for packet in line.sent()]

    changes = [data for _, command, data in packets if command is CommandCode.SET_BAUD_RATE]
    last = max(at for at, packet in enumerate(packets) if packet[1] is CommandCode.SET_BAUD_RATE)
    after = {command for _, command, _ in packets[last + 1 :]}
    if alternate:  # 56,818 of a clock that is 2 % fast
        assert (report.baud, report.remarks) == (57_600, ())
        assert changes[-1] == b"\x15"
        assert after == {CommandCode.READ_STATUS}
    else:  # 59,524 of it are 60,739
        assert (report.baud, len(report.remarks)) == (19_200, 1)
        assert "address 2 does not answer at 57600 baud; the line stays at 19200" in report.remarks[0]
        assert changes.count(b"\x14") >= 2  # it may have been noise the first time
        assert {CommandCode.HARD_RESET, CommandCode.SET_ADDRESS} <= after
        assert [module.address for module in chain.modules] == [1, 2]


async def test_a_lost_change_of_the_rate_is_tried_once_more():
    chain = Chain([DeafOnce(PIC_SERVO_V4, ModuleSettings(version=4), MotorPlant()) for _ in PAIR])
    async with bare_network(chain, specs("pic-servo-v4", "pic-servo-v4")) as line:
        report = await line.network.bring_up()

    assert (report.baud, report.remarks) == (115_200, ())


@pytest.mark.parametrize("left_at", [9600, 57_600, 115_200])
async def test_a_reset_reaches_drives_that_were_left_at_any_rate(left_at):
    chain = chain_of("ls182ap", "picservo-v4")
    async with bare_network(chain, PAIR, left_at) as line:
        await line.network.bring_up()
    async with bare_network(chain, PAIR, 19_200) as line:
        report = await line.network.bring_up()

    assert (report.baud, report.reset) == (19_200, True)


async def test_a_reset_reaches_drives_that_were_left_in_a_group():
    chain = chain_of("picservo-v4", "picservo-v4")
    spec = LineSpec(groups=(GroupConfig(name="both", axes=("a1", "a2"), leader="a2"),))
    for _ in range(2):
        async with bare_network(chain, specs("pic-servo-v4", "pic-servo-v4"), line=spec) as line:
            report = await line.network.bring_up()

    assert report.reset
    assert [(module.group, module.leader) for module in chain.modules] == [(0x81, False), (0x81, True)]


async def test_a_reset_reaches_a_drive_in_a_group_behind_one_that_obeys_everybody():
    """A Logosol drive obeys the reset of 255 in any group, and makes a PIC-SERVO behind it deaf to that of its own."""
    chain = chain_of("ls182ap", "picservo-v4", "ls182ap")
    spec = LineSpec(groups=(GroupConfig(name="all", axes=("a1", "a2", "a3")),))
    for _ in range(2):
        async with bare_network(chain, specs("ls-182ap", "pic-servo-v4", "ls-182ap"), line=spec) as line:
            report = await line.network.bring_up()

    assert report.reset
    assert [module.address for module in chain.modules] == [1, 2, 3]


async def test_a_configured_identity_overrides_the_table():
    odd = ModuleSpec("picservo-v4", settings=ModuleSettings(version=77))
    chain = build_chain(ChainSpec((odd,)))
    (known,) = specs("pic-servo-v4")
    overridden = type(known)(known.name, known.address, known.model, known.gains, (0, 77))

    async with bare_network(chain, (overridden,)) as line:
        report = await line.network.bring_up()
        await line.network.axes["a1"].power(on=True)

    assert report.identities == {"a1": "Logosol LS-173/LS-174 family (id 0, version 77)"}
    async with bare_network(chain, (known,)) as line:
        with pytest.raises(NetworkMismatch, match=r"expected PIC-SERVO version 4, .* \(id 0, version 77\)"):
            await line.network.bring_up()


async def test_an_unknown_device_is_described_with_its_identity_and_never_moved():
    chain = build_chain(ChainSpec((ModuleSpec("picservo-v4"), ModuleSpec("picio", settings=ModuleSettings(version=9)))))
    chain.modules[1].profile = type(chain.modules[1].profile)("toaster", "Toaster", 123, range(256), "identify")
    described = LineSpec(modules=(ModuleConfig(address=2, model="pic-step", identity=(123, 9)),))
    async with bare_network(chain, specs("pic-servo-v4")) as line:
        with pytest.raises(NetworkMismatch, match=r"address = 2 and model = \"pic-step\", identity = \[123, 9\]"):
            await line.network.bring_up()
    async with bare_network(chain, specs("pic-servo-v4"), line=described) as line:
        await line.network.bring_up()
        (_, unknown) = line.network.modules
        before = len(line.sent())

        with pytest.raises(NotSupported):
            await line.network.start_group({"a1": CountsMotion(100, 100.0, 100.0)}, lambda: None)

        assert line.sent(before) == []
    assert (unknown.address, unknown.axis, unknown.device_id, unknown.version) == (2, None, 123, 9)
    assert unknown.title == "an unknown device (id 123, version 9)"


async def test_a_missing_module_is_named():
    chain = chain_of("ls182ap", "picservo-v4")
    expecting_io = LineSpec(modules=(ModuleConfig(address=3, model="pic-io"),))
    async with bare_network(chain, PAIR, line=expecting_io) as line:
        with pytest.raises(NetworkMismatch, match=r"address 3 \(module\): expected PIC-I/O.*found nothing"):
            await line.network.bring_up()


async def test_an_adopted_homing_is_disarmed_by_a_stop():
    chain = chain_of("ls182ap", "picservo-v4")
    async with bare_network(chain, PAIR) as line:
        await line.network.bring_up()
        axis = line.network.axes["a2"]
        await axis.power(on=True)
        await axis.load(CountsMotion(None, 50.0, 5000.0), home=HomeCapture(HomeMethod.FORWARD_LIMIT))
        await axis.start()
    async with bare_network(chain, PAIR, line=ADOPT) as line:
        await line.network.bring_up()
        armed = chain.modules[1].loop.search

        await line.network.axes["a2"].stop(StopMode.SMOOTH)

    assert armed is not None
    assert chain.modules[1].loop.search is None


async def test_powering_an_adopted_closed_loop_starts_nothing():
    chain = chain_of("ls182ap", "picservo-v4")
    async with bare_network(chain, PAIR) as line:
        await line.network.bring_up()
        await line.network.axes["a1"].power(on=True)
    async with bare_network(chain, PAIR, line=ADOPT) as line:
        await line.network.bring_up()
        await line.network.axes["a1"].power(on=True)
        commands = {packet.command for packet in line.sent()}

    assert CommandCode.LOAD_TRAJECTORY not in commands
    assert chain.modules[0].loop.servo_on


async def test_a_question_that_a_stop_took_off_the_queue_is_asked_again():
    chain = chain_of("ls182ap", "picservo-v4")
    async with bare_network(chain, PAIR) as line:
        await line.network.bring_up()
        async with asyncio.TaskGroup() as group:
            group.create_task(line.network._rate.who_is(1), name="first on the wire")
            asked = group.create_task(line.network._rate.who_is(2), name="behind it")
            await asyncio.sleep(0)
            line.bus.withdraw(2, StopLatched("a stop came"))

    assert asked.result() == Identity(0, 4)


@pytest.mark.parametrize("items", [0x01, 0x1F, 0xFF], ids=hex)
async def test_adoption_bares_the_replies_that_another_host_has_extended(items):
    chain = chain_of("ls182ap", "picservo-v4")
    async with bare_network(chain, PAIR) as line:
        await line.network.bring_up()
    chain.modules[1].items = StatusItem(items)
    async with bare_network(chain, PAIR, line=ADOPT) as line:
        report = await line.network.bring_up()
        sent = {packet.command for packet in line.sent()}

    assert "address 2: another host had it add to its replies" in report.remarks
    assert sent == {CommandCode.READ_STATUS, CommandCode.NO_OPERATION, CommandCode.DEFINE_STATUS}
    assert chain.modules[1].items == StatusItem(0)


async def test_adoption_refuses_a_drive_that_keeps_its_extended_replies():
    chain = chain_of("ls182ap", "picservo-v4")
    async with bare_network(chain, PAIR) as line:
        await line.network.bring_up()
    deaf = chain.modules[1]
    type(deaf).__setattr__(deaf, "items", StatusItem.POSITION)
    deaf.__class__ = type("Deaf", (type(deaf),), {"items": property(lambda _: StatusItem.POSITION, lambda *_: None)})
    async with bare_network(chain, PAIR, line=ADOPT) as line:
        with pytest.raises(NetworkMismatch, match=r"address 2 \(axis a2\) does not answer No Operation"):
            await line.network.bring_up()


async def test_adoption_refuses_drives_at_different_rates():
    chain = chain_of("ls182ap", "picservo-v4")
    async with bare_network(chain, PAIR) as line:
        await line.network.bring_up()
    chain.modules[0].baud = actual_baud(0x3F)
    async with bare_network(chain, PAIR, line=ADOPT) as line:
        with pytest.raises(NetworkMismatch, match="address 1 is at 19200 baud; address 2 is at 115200 baud"):
            await line.network.bring_up()

        assert {packet.command for packet in line.sent()} <= {CommandCode.READ_STATUS, CommandCode.NO_OPERATION}


@pytest.mark.parametrize("codes", [(0x14, 0x81), (0x0A, 0x81), (0x14, 0x3F), (0x3F, 0x0A)])
async def test_drives_at_rates_of_their_own_are_brought_together_where_more_than_reading_is_allowed(codes):
    chain = chain_of("ls182ap", "picservo-v4")
    async with bare_network(chain, PAIR) as line:
        await line.network.bring_up()
    for module, code in zip(chain.modules, codes, strict=True):
        module.baud = actual_baud(code)
    async with bare_network(chain, PAIR, line=ADOPT_OR_RESET) as line:
        report = await line.network.bring_up()

        assert (report.baud, report.reset, len(report.remarks)) == (115_200, False, 1)
        assert [module.baud for module in chain.modules] == pytest.approx([actual_baud(0x0A)] * 2, rel=1e-4)
        assert CommandCode.HARD_RESET not in {packet.command for packet in line.sent()}


async def test_a_module_of_unknown_kind_may_move_for_all_that_is_known():
    chain = chain_of("ls182ap", "picservo-v4")
    async with bare_network(chain, PAIR) as line:
        adoption = line.network._adoption
        adoption.found = {address: Found(19_200, Identity(77, 1)) for address in (1, 2)}

        assert ["its status is unknown" in each for each in await adoption.not_standing()] == [True, True]


async def test_a_drive_that_may_move_keeps_the_fallback_from_resetting():
    chain = chain_of("ls182ap", "picservo-v4")
    async with bare_network(chain, PAIR) as line:
        await line.network.bring_up()
        axis = line.network.axes["a1"]
        await axis.power(on=True)
        await axis.load(CountsMotion(None, 5000.0, 50_000.0))
        await axis.start()
    chain.modules[1].power(on=False, at_s=asyncio.get_running_loop().time())
    async with bare_network(chain, PAIR, line=ADOPT_OR_RESET) as line:
        with pytest.raises(NetworkMismatch, match=r"not reset either: address 1, .* moves"):
            await line.network.bring_up()

        assert CommandCode.HARD_RESET not in {packet.command for packet in line.sent()}


async def test_a_port_that_cannot_change_its_rate_takes_over_what_is_at_that_rate():
    chain = chain_of("ls182ap", "picservo-v4")
    async with bare_network(chain, PAIR) as line:
        await line.network.bring_up()
    async with bare_network(chain, PAIR, line=ADOPT, fixed_baud=115_200) as line:
        report = await line.network.bring_up()

    assert (report.baud, report.reset) == (115_200, False)


async def test_a_port_that_cannot_change_its_rate_never_loses_drives_by_a_reset():
    chain = chain_of("ls182ap", "picservo-v4")
    async with bare_network(chain, PAIR) as line:
        await line.network.bring_up()
    async with bare_network(chain, PAIR, fixed_baud=115_200) as line:
        with pytest.raises(NetworkMismatch, match="would restart at 19200"):
            await line.network.bring_up()

        assert line.sent() == []


async def test_a_port_fixed_at_the_rate_of_power_up_serves_at_that_rate():
    chain = chain_of("ls182ap", "picservo-v4")
    async with bare_network(chain, PAIR, fixed_baud=19_200) as line:
        report = await line.network.bring_up()

    assert (report.baud, report.reset) == (19_200, True)


def test_differences_are_told_by_address():
    expected = (
        Expected(1, "axis x", LS_182AP),
        Expected(2, "axis y", PIC_SERVO_V4),
        Expected(3, "axis z", PIC_SERVO_SC, Identity(0, 11)),
    )

    told = differences(expected, {1: Identity(90, 1), 3: Identity(0, 11)})

    assert told == (
        "address 1 (axis x): expected Logosol LS-182AP, found Logosol LS-173AP (id 90, version 1)",
        "address 2 (axis y): expected PIC-SERVO version 4, found nothing",
    )


# -- modules that lost power -------------------------------------------------------------------------------------------


async def restart(chain: Chain, line: BareNetwork, address: int) -> None:
    """Switch a drive off and on, and notice that it does not answer."""
    now_s = asyncio.get_running_loop().time()
    chain.modules[address - 1].power(on=False, at_s=now_s)
    chain.modules[address - 1].power(on=True, at_s=now_s)
    with contextlib.suppress(ReplyTimeout):
        await line.bus.execute(read_status(Node(address, PIC_SERVO_V4), StatusItem.AUX))
    assert line.bus.misses(address)


async def test_a_line_that_was_taken_over_at_another_rate_has_the_configured_one_after_a_reset():
    chain = chain_of("ls182ap", "picservo-v4")
    async with bare_network(chain, PAIR, 57_600) as line:
        await line.network.bring_up()
    async with bare_network(chain, PAIR, 115_200, ADOPT_OR_RESET) as line:
        taken_over = await line.network.bring_up()
        assert taken_over.baud == 57_600
        assert "the configuration asks for 115200 baud; the line stays at 57600" in taken_over.remarks
        for address in (1, 2):
            await restart(chain, line, address)

        report = await line.network.bring_up()

    assert (report.baud, report.reset) == (115_200, True)


@pytest.mark.parametrize("fails", [True, False])
async def test_after_a_search_for_newcomers_all_are_at_the_working_rate_also_when_it_failed(fails):
    chain = chain_of("ls182ap", "picservo-v4")

    def restarted(name: str) -> None:
        assert name == "a2"
        if fails:
            raise ReplyTimeout("the line failed")

    async with bare_network(chain, PAIR) as line:
        await line.network.bring_up()
        await restart(chain, line, 2)
        if fails:
            with pytest.raises(ReplyTimeout):
                await line.network.rejoin(restarted)
        else:
            assert await line.network.rejoin(restarted) == {"a2"}

        assert line.bus.baud == 115_200
        assert chain.modules[0].baud == pytest.approx(actual_baud(0x0A), rel=1e-4)
        assert await line.bus.execute(read_status(Node(1, LS_182AP), StatusItem.AUX))


async def test_a_drive_at_a_waiting_address_is_not_forgotten_when_a_late_reply_passes_for_its_own(monkeypatch):
    chain, answers, late = chain_of("ls182ap", "picservo-v4"), Gathering._answers, [2]

    async def answered(gathering: Gathering, address: int) -> bool:
        if address in late:
            late.remove(address)
            return True
        return await answers(gathering, address)

    monkeypatch.setattr(Gathering, "_answers", answered)
    async with bare_network(chain, PAIR) as line:
        await line.network.bring_up()
        await restart(chain, line, 2)
        await line.network.rejoin(lambda _: None)
        assert chain.modules[1].address == WAITING_ADDRESSES[0]
        with contextlib.suppress(ReplyTimeout):
            await line.bus.execute(read_status(Node(2, PIC_SERVO_V4), StatusItem.AUX))

        assert await line.network.rejoin(lambda _: None) == {"a2"}
        assert chain.modules[1].address == 2


@pytest.mark.parametrize("after_ms", range(0, 1000, 40))
async def test_drives_that_got_one_waiting_address_come_back_whenever_the_one_between_them_loses_its_power(after_ms):
    chain = chain_of("ls182ap", "picservo-v4", "ls173ap")
    async with bare_network(chain, specs("ls-182ap", "pic-servo-v4", "ls-173ap")) as line:
        await line.network.bring_up()
        loop = asyncio.get_running_loop()
        chain.modules[2].power(on=False, at_s=loop.time())
        chain.modules[2].power(on=True, at_s=loop.time())
        await restart(chain, line, 1)

        async def lose_power() -> None:
            await asyncio.sleep(after_ms / 1000)
            chain.modules[1].power(on=False, at_s=loop.time())
            await asyncio.sleep(1.5)
            chain.modules[1].power(on=True, at_s=loop.time())

        lost = asyncio.create_task(lose_power())
        async with asyncio.timeout(30.0):
            while line.network.incomplete() or not lost.done():
                await line.network.rejoin(lambda _: None)
                await asyncio.sleep(0.1)
                for address in (1, 2, 3):
                    with contextlib.suppress(BusError):
                        await line.bus.execute(read_status(Node(address, PIC_SERVO_V4), StatusItem.AUX))

    assert [module.address for module in chain.modules] == [1, 2, 3]


async def test_a_line_is_not_taken_down_again_and_again_for_a_drive_that_stays_dark():
    chain = chain_of("ls182ap", "picservo-v4", "picservo-v4")
    async with bare_network(chain, specs("ls-182ap", "pic-servo-v4", "pic-servo-v4")) as line:
        await line.network.bring_up()
        chain.modules[2].power(on=False, at_s=asyncio.get_running_loop().time())
        await restart(chain, line, 2)
        with contextlib.suppress(ReplyTimeout):
            await line.bus.execute(read_status(Node(3, PIC_SERVO_V4), StatusItem.AUX))
        for _ in range(9):
            assert await line.network.rejoin(lambda _: None) == set()
            # the second and the third look alike where one waits: the second may be the one that is not heard
            assert chain.modules[1].address in WAITING_ADDRESSES
            assert "which is which is not proven" in line.network.problem
        seen = len(line.sent())

        for _ in range(8):
            assert await line.network.rejoin(lambda _: None) == set()

        assert CommandCode.SET_BAUD_RATE not in {packet.command for packet in line.sent(seen)}


@pytest.mark.parametrize(("baud", "hears"), [(19_200, True), (57_600, False)])
async def test_on_a_port_with_one_rate_newcomers_are_looked_for_only_at_the_rate_of_power_up(baud, hears):
    chain = chain_of("ls182ap", "picservo-v4")
    async with bare_network(chain, PAIR, baud, fixed_baud=baud) as line:
        if hears:
            await line.network.bring_up()
            await restart(chain, line, 2)
        else:
            line.bus._schedule.mute.missed(2)
        seen = len(line.sent())

        found = await line.network.rejoin(lambda _: None)

        assert found == ({"a2"} if hears else set())
        assert bool(line.sent(seen)) is hears


@pytest.mark.promise("address-only-of-its-place")
@pytest.mark.parametrize("mute", [1, 2])
async def test_a_module_that_hears_and_is_not_heard_shares_its_address_with_none_behind_it(mute):
    """Where the configuration leaves it out, as many are heard as are configured."""
    chain = chain_of(*["ls182ap"] * 3)
    chain.mute(mute, on=True)
    async with bare_network(chain, specs("ls-182ap", "ls-182ap")) as line:
        with pytest.raises(NetworkMismatch, match=rf"address {mute} \(axis a{mute}\): .* found nothing"):
            await line.network.bring_up()

    held = [module.address for module in chain.modules if module.address]
    assert len(held) == len(set(held))


async def test_a_module_that_is_not_heard_for_a_while_is_numbered_in_its_place():
    chain = chain_of(*["ls182ap"] * 3)
    chain.mute(1, on=True)

    async def heal() -> None:
        await asyncio.sleep(1.0)
        chain.mute(1, on=False)

    async with bare_network(chain, specs(*["ls-182ap"] * 3)) as line:
        healed = asyncio.create_task(heal())
        report = await line.network.bring_up()
        await healed

    assert set(report.identities) == {"a1", "a2", "a3"}
    assert [module.address for module in chain.modules] == [1, 2, 3]


FOUR = specs(*["ls-182ap"] * 4)


async def seconds_to_bring_up(chain, spec=None, baud=115_200):
    loop = asyncio.get_running_loop()
    async with bare_network(chain, FOUR, baud, spec) as line:
        began_s = loop.time()
        report = await line.network.bring_up()
        return loop.time() - began_s, report, line


async def test_drives_that_were_powered_on_are_up_in_half_a_second():
    took_s, report, line = await seconds_to_bring_up(chain_of(*["ls182ap"] * 4))

    assert took_s < 0.48
    assert report.reset
    assert line.bus.statistics.timeouts == 2  # whether one more module waits behind the last one, asked twice


async def test_where_drives_stand_is_asked_only_for_axes_that_use_it():
    took_s, report, _ = await seconds_to_bring_up(chain_of(*["ls182ap"] * 4))
    proven_s, proven, _ = await seconds_to_bring_up(chain_of(*["ls182ap"] * 4), LineSpec(proves_places=True))

    assert report.placed == frozenset()
    assert proven.placed == {"a1", "a2", "a3", "a4"}
    assert 0.08 < proven_s - took_s < 0.16


@pytest.mark.parametrize("restart_s", [0.0, 0.02, 0.099, 0.25, 1.0])
async def test_drives_that_take_long_to_restart_are_addressed_when_they_have(restart_s):
    chain = build_chain(ChainSpec(tuple(ModuleSpec("ls182ap") for _ in FOUR)))
    for module in chain.modules:
        module.settings = module.settings.model_copy(update={"reset_dead_s": restart_s})

    took_s, report, line = await seconds_to_bring_up(chain)

    assert len(report.identities) == 4
    assert (line.bus.statistics.timeouts == 2) is (restart_s <= 0.1)
    assert took_s < 0.43 + max(0.0, restart_s - 0.1) + 0.05


@pytest.mark.promise("address-only-of-its-place")
@pytest.mark.parametrize("baud", [19_200, 57_600])
@pytest.mark.parametrize(
    "restarts_s",
    [
        *(tuple(slow_s if place == slow else 0.0 for place in range(4)) for slow in range(4) for slow_s in (0.3, 1.9)),
        (0.0, 0.3, 0.6, 0.9),
        (0.9, 0.6, 0.3, 0.0),
        (0.3, 0.0, 0.9, 0.15),
        (0.0, 0.9, 0.0, 1.9),
    ],
)
async def test_drives_that_do_not_restart_equally_fast_are_numbered_in_their_places(restarts_s, baud):
    chain = chain_of(*["ls182ap"] * 4)
    await seconds_to_bring_up(chain, baud=baud)  # with addresses, they all hear the next reset
    for module, restart_s in zip(chain.modules, restarts_s, strict=True):
        module.settings = module.settings.model_copy(update={"reset_dead_s": restart_s})

    took_s, report, _ = await seconds_to_bring_up(chain, baud=baud)

    assert (set(report.identities), report.baud) == ({"a1", "a2", "a3", "a4"}, baud)
    assert [module.address for module in chain.modules] == [1, 2, 3, 4]
    assert took_s < 1.5 + 2 * max(restarts_s)


class MissesFirstAddress(SimulatedDrive):
    """A drive to which the first Set Address after each reset is noise."""

    _misses = False

    def restart(self):
        super().restart()
        self._misses = True

    def _obey(self, packet, at_s):
        if packet.command is CommandCode.SET_ADDRESS and self._misses:
            self._misses = False
            return None
        return super()._obey(packet, at_s)


@pytest.mark.promise("address-only-of-its-place")
async def test_modules_of_which_one_always_comes_late_stay_at_waiting_addresses_and_it_is_said_why():
    drives = [SimulatedDrive(LS_182AP, ModuleSettings(version=20), MotorPlant()) for _ in range(3)]
    chain = Chain([*drives, MissesFirstAddress(LS_182AP, ModuleSettings(version=20), MotorPlant())])

    with pytest.raises(ExceptionGroup) as raised:
        await seconds_to_bring_up(chain)

    (refused,) = raised.value.exceptions
    assert isinstance(refused, NetworkMismatch)
    assert "4 module(s) answer, as configured, but behind each of 3 resets one came later" in refused.message
    assert {module.address for module in chain.modules} < set(WAITING_ADDRESSES)


class MumblesOnce(SimulatedDrive):
    """A drive whose first reply while it waits for an address is lost."""

    _mumbled = False

    def _obey(self, packet, at_s):
        reply = super()._obey(packet, at_s)
        if packet.command is CommandCode.READ_STATUS and self.address == 0 and not self._mumbled:
            self._mumbled = True
            return None
        return reply


async def test_one_lost_reply_does_not_hide_a_module_behind_the_configured_ones():
    drives = [SimulatedDrive(LS_182AP, ModuleSettings(version=20), MotorPlant()) for _ in FOUR]
    chain = Chain([*drives, MumblesOnce(PIC_SERVO_V4, ModuleSettings(version=4), MotorPlant())])

    with pytest.raises(ExceptionGroup) as raised:
        await seconds_to_bring_up(chain)

    (refused,) = raised.value.exceptions
    assert isinstance(refused, NetworkMismatch)
    assert "5 module(s) found within 2 s of the reset, 4 configured; address 5: PIC-SERVO version 4" in str(refused)
    assert [module.address for module in chain.modules] == [0] * 5


class MuteForAWhile(FaultInjector):
    """Loses every reply while `mute`."""

    mute = False

    def reply(self, data, at_s):
        return FaultyReply(b"" if self.mute else data)


async def test_an_sc_that_has_kept_its_power_is_not_reset_although_it_answers_at_the_rate_of_power_up_too():
    """Its replies were lost for a while, and a pseudo-terminal passes no rates on, and its replies on a little late."""
    late = ModuleSpec("picservo-sc", adjust=lambda known: known.model_copy(update={"reply_latency_s": 0.005}))
    chain = build_chain(ChainSpec((ModuleSpec("ls182ap"), late), baud_check=False))
    injector = chain.injector = MuteForAWhile(FaultPlan())
    async with bare_network(chain, specs("ls-182ap", "pic-servo-sc")) as line:
        await line.network.bring_up()
        await line.network.axes["a2"].power(on=True)
        before, injector.mute = len(line.sent()), True
        with pytest.raises(ReplyTimeout):
            await line.bus.execute(line.network.axes["a2"].reading(frozenset()))
        injector.mute = False

        await line.network.rejoin(lambda _: None)

        assert CommandCode.HARD_RESET not in {packet.command for packet in line.sent(before)}
        assert chain.modules[1].loop.servo_on


@pytest.mark.promise("stop-closes-no-loop")
@pytest.mark.parametrize("mode", [StopMode.SMOOTH, StopMode.ABRUPT])
async def test_a_stop_that_is_sent_again_on_a_line_out_of_step_never_follows_the_packet_that_switches_the_motor_off(
    mode,
):
    chain = chain_of("ls182ap", "picservo-v4")
    async with bare_network(chain, PAIR) as line:
        await line.network.bring_up()
        axis = line.network.axes["a1"]
        await axis.power(on=True)
        before = len(line.sent())
        line.bus.distrust()
        async with asyncio.TaskGroup() as both:
            both.create_task(axis.stop(mode), name="stop")
            both.create_task(axis.stop(StopMode.OFF), name="off")
        stops = [packet.data[0] for packet in line.sent(before) if packet.command is CommandCode.STOP_MOTOR]

    off = next(place for place, control in enumerate(stops) if control & StopControl.MOTOR_OFF)
    assert not [control for control in stops[off:] if control & StopControl.AMP_ENABLE]
    assert not chain.modules[0].loop.servo_on


async def test_stops_that_are_not_acknowledged_never_close_the_loop_of_a_drive_that_was_reset():
    chain = chain_of("ls182ap", "picservo-v4")
    async with bare_network(chain, PAIR) as line:
        await line.network.bring_up()
        before = len(line.sent())
        for place, axis in enumerate(line.network.axes.values(), 1):
            chain.mute(place, on=True)
            for _ in range(3):
                with pytest.raises(BusError):
                    await axis.stop(StopMode.SMOOTH)
            chain.mute(place, on=False)
            await axis.stop(StopMode.SMOOTH)
        stops = [packet for packet in line.sent(before) if packet.command is CommandCode.STOP_MOTOR]

    assert {packet.address for packet in stops} == {1, 2}
    assert not [packet for packet in stops if packet.data[0] & StopControl.AMP_ENABLE]
    assert not any(module.loop.servo_on for module in chain.modules)
