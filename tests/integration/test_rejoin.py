"""Drives that lose power and come back, while the others work on."""

import asyncio
from itertools import chain as chained
from itertools import pairwise

import pytest

from ldcnd.client.overview import overview
from ldcnd.config.rig import RigConfig, load_config
from ldcnd.contract.commands import MoveAbsolute, MoveVelocity, Power, Reset
from ldcnd.contract.errors import WrongState
from ldcnd.contract.keys import Keys
from ldcnd.contract.questions import Why
from ldcnd.contract.samples import AxisState, LinkState, Moving, TelemetryItem
from ldcnd.drives.ldcn.addressing import WAITING_ADDRESSES
from ldcnd.drives.ldcn.packet import CommandCode
from ldcnd.sim.faults import FaultInjector, FaultKind, FaultPlan, FaultyReply, FaultyRequest, LineFault
from ldcnd.sim.ldcn.chain import ChainSpec, ModuleSpec, build_chain
from ldcnd.testing import run, simulated_rig
from tests.support.chain_rig import UNSEEN_MOTIONS_END, drive, rig_on, simulated_config
from tests.support.process import ROOT

MODELS = ("ls182ap", "ls182ap", "picservo-v4", "picservo-v4")
NAMES = ("x", "y", "z", "c")
MARGINS_MS = (5, 50)
CENTRIFUGE = load_config(ROOT / "config" / "centrifuge.toml")
CALM_S = 0.5
"""After a spoilt answer the module answers everything else for so long: what would be sent to it is sent."""
IDENTITY_QUESTION = b"\x13\x20"
"""Read Status with the module's identity, without header and address."""


def chain_of(*models):
    return build_chain(ChainSpec(tuple(ModuleSpec(model) for model in models or MODELS)))


def set_power(chain, address, *, on):
    chain.modules[address - 1].power(on=on, at_s=asyncio.get_running_loop().time())


async def power_all(rig):
    for name in NAMES:
        await rig.until(name, lambda state: state.link is LinkState.UP)
        await rig.client.command(name, Power(on=True))


async def arrivals(rig, axis, item):
    """Return the instants, in loop time, at which samples arrive from now on."""
    at_s = []
    loop = asyncio.get_running_loop()
    await rig.session.subscribe(Keys("sim").telemetry(axis, item), lambda _sample: at_s.append(loop.time()))
    return at_s


def moved_since(rig, seen):
    """Return the packets sent since `seen` that are not known to move and reset nothing."""
    arranging = {CommandCode.SET_BAUD_RATE, CommandCode.SET_ADDRESS, CommandCode.DEFINE_STATUS}
    harmless = {CommandCode.READ_STATUS, CommandCode.NO_OPERATION, *arranging}
    return [packet for packet in rig.sent[seen:] if packet.command not in harmless]


@pytest.mark.parametrize("margin_ms", MARGINS_MS)
@pytest.mark.sweep(2)
async def test_a_drive_that_lost_power_is_back_within_3_s_and_the_others_finish_without_a_reset(margin_ms):
    chain = chain_of()
    loop = asyncio.get_running_loop()
    async with rig_on(chain, simulated_config(UNSEEN_MOTIONS_END, margin_ms=margin_ms)) as rig:
        await power_all(rig)
        await rig.client.command("x", MoveAbsolute(position=90.0, velocity=10.0))
        await rig.client.command("z", MoveAbsolute(position=-40.0, velocity=5.0))
        await rig.client.command("c", MoveAbsolute(position=900.0))
        await asyncio.sleep(1)
        seen = len(rig.sent)
        polled_at_s = await arrivals(rig, "x", TelemetryItem.POSITION)

        set_power(chain, 2, on=False)
        await asyncio.sleep(2.5)
        dark = await rig.client.state("y")
        seeing = [await rig.client.state(name) for name in ("x", "c")]
        set_power(chain, 2, on=True)
        powered_at_s = loop.time()
        back = await rig.until("y", lambda state: state.link is LinkState.UP)
        took_s = loop.time() - powered_at_s
        heard = await rig.until("z", lambda state: state.link is LinkState.UP)
        await asyncio.sleep(12)
        (bus,) = await rig.client.buses()
        meanwhile = moved_since(rig, seen)

    assert dark.link is LinkState.DOWN
    assert [(state.link, state.state) for state in seeing] == [(LinkState.UP, AxisState.DISCRETE_MOTION)] * 2
    assert took_s < 3.0
    assert max(later - earlier for earlier, later in pairwise(polled_at_s)) < 0.1 + 8 * margin_ms / 1000
    assert (back.state, back.enabled, back.referenced) == (AxisState.ERROR_STOP, False, False)
    assert not heard.referenced  # cut off by its neighbour: it went on unseen
    assert meanwhile == []
    assert bus.baud == 115_200
    assert [drive(chain, address).baud for address in (1, 2, 3, 4)] == pytest.approx([113_636] * 4, rel=1e-4)
    assert abs(drive(chain, 1).loop.position - 90_000) <= 1
    assert abs(drive(chain, 3).loop.position + 80_000) <= 1
    assert abs(drive(chain, 4).loop.position - 90_000) <= 1
    assert [drive(chain, address).loop.servo_on for address in (1, 2, 3, 4)] == [True, False, True, True]
    assert drive(chain, 2).loop.position == 0


def rig_of(*models):
    """Return a rig of the axes a1, a2, ... of these models."""
    gains = {"kp": 350, "kd": 3000, "ki": 400, "il": 400, "ol": 250, "el": 4000}
    axis = {"unit": "mm", "counts_per_unit": 1000, "velocity": 10, "acceleration": 100, "gains": gains}
    axes = [{**axis, "name": f"a{at}", "address": at, "model": model} for at, model in enumerate(models, 1)]
    bus = {"name": "line0", "port": "sim:line0", "baud": 115_200, "margin_ms": 5, "axis": axes}
    sim = {"name": "line0", "module": [{"model": model} for model in models]}
    return RigConfig.model_validate({"rig": "sim", "bus": [bus], "sim": [sim]})


@pytest.mark.promise("address-only-of-its-place")
@pytest.mark.parametrize(
    "order",
    [
        (("mute", 5.0), ("off", 2.0), ("on", 10.0)),
        (("off", 1.0), ("mute", 1.0), ("on", 10.0)),
        (("mute", 0.0), ("off", 0.0), ("on", 10.0)),
    ],
    ids=["before", "while the other is dark", "at the same instant"],
)
@pytest.mark.parametrize(("count", "mute"), [(2, 1), (3, 1), (4, 2)])
async def test_a_drive_that_restarts_behind_one_that_hears_and_is_not_heard_does_not_get_its_address(
    count, mute, order
):
    models = ["ls-182ap"] * count
    chain = chain_of(*models)
    async with rig_on(chain, rig_of(*models)) as rig:
        for at in range(1, count + 1):
            await rig.until(f"a{at}", lambda state: state.link is LinkState.UP)
        for what, lasts_s in order:
            if what == "mute":
                chain.mute(mute, on=True)
            else:
                set_power(chain, mute + 1, on=what == "on")
            await asyncio.sleep(lasts_s)
        addresses = [drive(chain, at).address for at in range(1, count + 1)]
        said = rig.line.problem
        chain.mute(mute, on=False)
        for at in range(1, count + 1):
            await rig.until(f"a{at}", lambda state: state.link is LinkState.UP)
        healed = [drive(chain, at).address for at in range(1, count + 1)]

    assert addresses[mute - 1] == mute
    if mute + 1 < count:  # the one behind it shows its place
        assert addresses[mute] == mute + 1
    else:
        assert addresses[mute] in WAITING_ADDRESSES
        assert "which is which is not proven" in said
    assert healed == list(range(1, count + 1))


@pytest.mark.promise("address-only-of-its-place")
@pytest.mark.parametrize("models", [("ls-182ap", "pic-servo-sc"), ("ls-182ap", "ls-182ap", "pic-servo-sc")])
async def test_drives_that_were_exchanged_while_they_were_dark_do_not_get_the_addresses_of_their_old_places(models):
    chain = chain_of(*models)
    async with rig_on(chain, rig_of(*models)) as rig:
        for at in range(1, len(models) + 1):
            await rig.until(f"a{at}", lambda state: state.link is LinkState.UP)
        for address in (1, len(models)):
            set_power(chain, address, on=False)
        await asyncio.sleep(2.0)
        chain.modules = chain.modules[::-1]
        chain.join()
        for address in (1, len(models)):
            set_power(chain, address, on=True)
        await asyncio.sleep(10.0)
        first, last = chain.modules[0].address, chain.modules[-1].address
        said = rig.line.problem

    assert {first, last} <= {*WAITING_ADDRESSES}
    assert "address 1 (axis a1): expected Logosol LS-182AP, found PIC-SERVO SC" in said
    assert f"address {len(models)} (axis a{len(models)}): expected PIC-SERVO SC, found Logosol LS-182AP" in said


async def test_a_drive_behind_one_without_power_names_that_one_on_every_face():
    chain = chain_of()
    async with rig_on(chain, simulated_config()) as rig:
        await power_all(rig)
        set_power(chain, 2, on=False)
        await rig.until("z", lambda state: state.link is LinkState.DOWN)
        async with asyncio.timeout(30):
            while "axis y, address 2" not in (await rig.client.faults())["z"].active[0].text:
                await asyncio.sleep(0.1)
        said = {now.info.axis: [each.text for each in now.condition.troubles] for now in await overview(rig.client)}
        why = await rig.client.ask(Why(), "z")
        set_power(chain, 2, on=True)
        for name in ("y", "z"):
            await rig.until(name, lambda state: state.link is LinkState.UP)
        after = await rig.client.ask(Why(), "z")

    assert "nor does axis y, address 2" in said["z"][0]
    assert "nor does" not in said["y"][0]
    assert (why.causes[0].code, why.causes[0].remedy) == (
        "axis_unreachable",
        "check the power of axis y, address 2 first",
    )
    assert not any("address 2" in cause.text for cause in after.causes)


async def test_the_axis_works_again_once_it_is_powered():
    chain = chain_of()
    async with rig_on(chain, simulated_config()) as rig:
        await power_all(rig)
        set_power(chain, 2, on=False)
        await rig.until("y", lambda state: state.link is LinkState.DOWN)
        set_power(chain, 2, on=True)
        await rig.until("y", lambda state: state.link is LinkState.UP)

        await rig.until("y", lambda state: state.moving is Moving.NO)  # until then it may coast, and is stopped
        with pytest.raises(WrongState, match="error stop"):
            await rig.client.command("y", Power(on=True))  # its module was initialised again, its axis was not reset
        await rig.client.command("y", Reset())
        await rig.client.command("y", Power(on=True))
        state = await rig.until("y", lambda state: state.state is AxisState.STANDSTILL)

    assert not state.referenced
    assert drive(chain, 2).loop.gains.kp == 350
    assert drive(chain, 2).loop.servo_on


async def test_a_drive_that_lost_power_with_its_loop_open_needs_no_reset():
    chain = chain_of()
    async with rig_on(chain, simulated_config()) as rig:
        await rig.until("y", lambda state: state.link is LinkState.UP)
        set_power(chain, 2, on=False)
        await rig.until("y", lambda state: state.link is LinkState.DOWN)
        set_power(chain, 2, on=True)
        back = await rig.until("y", lambda state: state.link is LinkState.UP and state.moving is Moving.NO)
        await rig.client.command("y", Power(on=True))

    assert back.state is AxisState.DISABLED


async def test_several_neighbours_that_lost_power_come_back_in_order():
    chain = chain_of()
    async with rig_on(chain, simulated_config()) as rig:
        await power_all(rig)
        for address in (2, 3):
            set_power(chain, address, on=False)
        await asyncio.sleep(2)
        for address in (3, 2):
            set_power(chain, address, on=True)
        for name in NAMES:
            await rig.until(name, lambda state: state.link is LinkState.UP, 3.0)

    assert [module.address for module in chain.modules] == [1, 2, 3, 4]
    assert [drive(chain, address).loop.servo_on for address in (1, 2, 3, 4)] == [True, False, False, True]


async def test_a_whole_chain_that_lost_power_comes_back():
    chain = chain_of()
    async with rig_on(chain, simulated_config()) as rig:
        await power_all(rig)
        for address in (1, 2, 3, 4):
            set_power(chain, address, on=False)
        await asyncio.sleep(2)
        for address in (1, 2, 3, 4):
            set_power(chain, address, on=True)
        states = [await rig.until(name, lambda state: state.link is LinkState.UP, 3.0) for name in NAMES]

    assert [(state.state, state.enabled) for state in states] == [(AxisState.ERROR_STOP, False)] * 4
    assert [module.address for module in chain.modules] == [1, 2, 3, 4]


@pytest.mark.long
async def test_a_module_that_is_no_axis_comes_back_too():
    chain = chain_of("ls182ap", "ls182ap", "picservo-v4", "picservo-v4", "picio")
    async with rig_on(chain, simulated_config(module=[{"address": 5, "model": "pic-io"}])) as rig:
        await power_all(rig)
        set_power(chain, 5, on=False)
        await asyncio.sleep(6)
        (dark,) = await rig.client.buses()
        set_power(chain, 5, on=True)
        await asyncio.sleep(3)
        (bus,) = await rig.client.buses()

    assert (dark.modules[4].status, bus.modules[4].status) == (None, 0)
    assert [drive(chain, address).loop.servo_on for address in (1, 2, 3, 4)] == [True] * 4


@pytest.mark.long
async def test_a_stop_works_while_a_drive_is_dark():
    chain = chain_of()
    async with rig_on(chain, simulated_config()) as rig:
        await power_all(rig)
        await rig.client.command("x", MoveAbsolute(position=90.0, velocity=5.0))
        set_power(chain, 4, on=False)
        loop = asyncio.get_running_loop()
        slowest_s = 0.0
        for _ in range(40):
            await asyncio.sleep(0.0973)
            began_s = loop.time()
            reply = await rig.client.stop("x")
            slowest_s = max(slowest_s, loop.time() - began_s)
            assert reply.confirmed == ("x",)

    assert slowest_s < 0.05
    assert drive(chain, 1).loop.servo_on


@pytest.mark.long
async def test_stops_of_a_dark_axis_do_not_disturb_the_search_for_it():
    chain = chain_of()
    async with rig_on(chain, simulated_config()) as rig:
        await power_all(rig)
        set_power(chain, 2, on=False)
        await rig.until("y", lambda state: state.link is LinkState.DOWN)

        async with asyncio.TaskGroup() as group:
            for number in range(300):
                group.create_task(rig.client.stop("y"), name=f"stop {number}")
                await asyncio.sleep(0.0137)
        set_power(chain, 2, on=True)
        back = await rig.until("y", lambda state: state.link is LinkState.UP, 3.0)

    assert (back.state, back.enabled, back.stop_latched) == (AxisState.ERROR_STOP, False, True)


async def test_axes_that_are_out_of_reach_and_to_be_stopped_come_back_as_soon_as_others():
    """A drive behind one without power hears nothing either: each stop is sent in vain until they are back."""
    chain = chain_of()
    async with rig_on(chain, simulated_config(margin_ms=50)) as rig:
        await power_all(rig)
        for axis in ("y", "z"):
            await rig.client.command(axis, MoveVelocity(velocity=2.0))
        set_power(chain, 2, on=False)
        await rig.until("y", lambda state: state.link is LinkState.DOWN)
        async with asyncio.TaskGroup() as group:
            for axis in ("y", "z"):
                for number in range(3):
                    group.create_task(rig.client.stop(axis), name=f"stop {number} of {axis}")
            await asyncio.sleep(0.5)
            set_power(chain, 2, on=True)
            for axis in ("y", "z"):
                await rig.until(axis, lambda state: state.link is LinkState.UP and not state.stop_pending, 3.0)


async def test_a_foreign_module_in_place_of_the_old_one_gets_no_address():
    chain = chain_of()
    async with rig_on(chain, simulated_config()) as rig:
        await power_all(rig)
        set_power(chain, 4, on=False)
        await rig.until("c", lambda state: state.link is LinkState.DOWN)
        module = chain.modules[3]
        module.settings = type(module.settings)(version=1)
        set_power(chain, 4, on=True)
        await asyncio.sleep(5)
        state = await rig.client.state("c")

    assert state.link is LinkState.DOWN
    assert chain.modules[3].address in WAITING_ADDRESSES


@pytest.mark.long
async def test_members_of_a_group_with_a_leader_come_back_to_their_group():
    chain = chain_of()
    config = simulated_config(UNSEEN_MOTIONS_END, group=[{"name": "pair", "axes": ["y", "z"], "leader": "z"}])
    async with rig_on(chain, config) as rig:
        await power_all(rig)
        await rig.client.command("z", MoveAbsolute(position=-40.0, velocity=5.0))
        set_power(chain, 2, on=False)
        await rig.until("y", lambda state: state.link is LinkState.DOWN)
        await asyncio.sleep(1)
        set_power(chain, 2, on=True)
        for name in NAMES:
            await rig.until(name, lambda state: state.link is LinkState.UP, 3.0)
        await asyncio.sleep(10)
        (bus,) = await rig.client.buses()

    assert [module.group for module in chain.modules] == [0xFF, 0x81, 0x81, 0xFF]
    assert [module.leader for module in chain.modules] == [False, False, True, False]
    assert abs(drive(chain, 3).loop.position + 80_000) <= 1
    assert bus.baud == 115_200


NOISE = tuple(
    LineFault(kind, 0.01, from_s=5.0, longest_s=0.01)
    for kind in (
        FaultKind.REQUEST_LOST,
        FaultKind.REQUEST_BIT_FLIPPED,
        FaultKind.REPLY_LOST,
        FaultKind.REPLY_BIT_FLIPPED,
        FaultKind.REPLY_DELAYED,
    )
)


@pytest.mark.parametrize("seed", [1, *(pytest.param(seed, marks=pytest.mark.soak) for seed in (2, 11))])
@pytest.mark.long
async def test_drives_come_back_and_lines_are_taken_over_through_noise(seed):
    print(f"seed {seed}")
    chain = build_chain(
        ChainSpec(tuple(ModuleSpec(model) for model in MODELS), faults=FaultPlan(NOISE, seed), seed=seed)
    )
    async with rig_on(chain, simulated_config(UNSEEN_MOTIONS_END)) as rig:
        await power_all(rig)
        await rig.client.command("x", MoveAbsolute(position=90.0, velocity=2.0))
        await asyncio.sleep(5 - asyncio.get_running_loop().time())
        for _ in range(5):
            set_power(chain, 3, on=False)
            await rig.until("z", lambda state: state.link is LinkState.DOWN)
            await asyncio.sleep(2.0)
            set_power(chain, 3, on=True)
            await rig.until("z", lambda state: state.link is LinkState.UP, 10.0)
        await asyncio.sleep(2.0)
        await rig.kill()
    assert [module.address for module in chain.modules] == [1, 2, 3, 4]
    at = drive(chain, 1).loop.position

    async with rig_on(chain, simulated_config(UNSEEN_MOTIONS_END, start="adopt")) as rig:
        (bus,) = await rig.client.buses()
        await asyncio.sleep(40)

    assert bus.started_by == "adoption"
    assert abs(at) > 10_000
    assert abs(drive(chain, 1).loop.position - 90_000) <= 1


@pytest.mark.parametrize("silent_s", [0.6, 1.0, 1.5, 2.0, 2.5, 3.0])
@pytest.mark.parametrize("questions", ["unanswered", "damaged", "another's"])
@pytest.mark.sweep(4)
async def test_an_sc_whose_replies_fail_for_a_while_is_not_reset_where_the_port_passes_no_rates_on(questions, silent_s):
    """Neither without an answer at the rate of power-up, nor for a damaged one, nor for one of another model."""
    spec = ChainSpec((ModuleSpec("ls182ap"), ModuleSpec("picservo-sc")), baud_check=False)
    chain = build_chain(spec)
    gains = {"kp": 350, "kd": 3000, "ki": 400, "il": 400, "ol": 250, "el": 4000}
    common = {"unit": "mm", "counts_per_unit": 1000.0, "velocity": 20.0, "acceleration": 200.0, "gains": gains}
    document = simulated_config().model_dump(mode="json", exclude_unset=True)
    document["bus"][0]["axis"] = [
        {"name": "x", "address": 1, "model": "ls-182ap"} | common,
        {"name": "s", "address": 2, "model": "pic-servo-sc"} | common,
    ]
    document["bus"][0].pop("module", None)
    async with rig_on(chain, RigConfig.model_validate(document)) as rig:
        await rig.until("s", lambda state: state.link == "up")
        await rig.client.command("s", Power(on=True))
        now_s, sent = asyncio.get_running_loop().time(), len(rig.sent)
        chain.injector = FailingModule(2, now_s + silent_s, questions)
        await asyncio.sleep(8.0)

        resets = {packet.address for packet in rig.sent[sent:] if packet.command is CommandCode.HARD_RESET}
        assert not resets & {2, 0xFF, 0x81}
        assert drive(chain, 2).loop.servo_on


class FailingModule(FaultInjector):
    """Loses the replies of one module until an instant, or spoils those to questions of who it is."""

    def __init__(self, address: int, until_s: float, questions: str) -> None:
        super().__init__(FaultPlan())
        self._address, self._until_s, self._questions = address, until_s, questions
        self._fails = self._asks = False
        self._spoilt_s = -CALM_S

    def request(self, data: bytes, at_s: float) -> FaultyRequest:
        packet = data[data.rfind(b"\xaa") :]
        self._asks = packet[2:4] == IDENTITY_QUESTION
        ours = at_s < self._until_s and len(packet) > 2 and packet[1] == self._address
        self._fails = ours and (self._asks or at_s > self._spoilt_s + CALM_S)
        if self._fails and self._asks and self._questions != "unanswered":
            self._spoilt_s = at_s
        return FaultyRequest(tuple(data))

    def reply(self, data: bytes, at_s: float) -> FaultyReply:
        if not self._fails:
            return FaultyReply(data)
        if not self._asks or self._questions == "unanswered":
            return FaultyReply(b"")
        if self._questions == "damaged":
            return FaultyReply(data[:-1] + bytes((data[-1] ^ 0x55,)))
        identity = bytes((data[1] ^ 0x55,))
        return FaultyReply(data[:1] + identity + data[2:-1] + bytes(((sum(data[:1] + identity + data[2:-1])) & 0xFF,)))


def servos(count):
    """Return a rig of equal drives, whose margin is that of a USB adapter."""
    gains = {"kp": 100, "kd": 1000, "ki": 0, "il": 0, "ol": 255, "cl": 0, "el": 4000, "sr": 1, "deadband": 0}
    axis = {"model": "pic-servo-sc", "unit": "mm", "counts_per_unit": 1000, "velocity": 10, "acceleration": 100}
    axes = [{**axis, "name": f"a{at}", "address": at, "gains": gains} for at in range(1, count + 1)]
    bus = {"name": "line0", "port": "sim:line0", "baud": 115_200, "margin_ms": 50, "axis": axes}
    sim = {"name": "line0", "module": [{"model": "pic-servo-sc"}] * count}
    return RigConfig.model_validate({"rig": "sim", "bus": [bus], "sim": [sim]})


@pytest.mark.promise("address-only-of-its-place")
@pytest.mark.parametrize(
    "off", [((0.0, 2.0),) * 3, ((0.0, 0.2), (0.6, 0.8), (0.6, 2.1)), ((0.6, 2.6), (0.2, 2.2), (0.2, 1.2))]
)
def test_a_stop_that_waits_does_not_keep_a_chain_without_power_from_coming_back(off):
    """Nobody answers for a while: what is asked of each drive before its stop is asked of silence."""

    async def program():
        loop = asyncio.get_running_loop()
        async with (
            simulated_rig(servos(len(off))) as rig,
            rig.client.control(*(f"a{at}" for at in range(1, len(off) + 1)), client="test") as axes,
        ):
            for axis in axes:
                await axis.power(on=True)
                await axis.move_relative(20.0, velocity=4)
            await asyncio.sleep(1.0)
            began_s, modules = loop.time(), rig.lines["line0"].modules
            ends = [((off_s, place, False), (on_s, place, True)) for place, (off_s, on_s) in enumerate(off)]
            async with asyncio.TaskGroup() as tasks:
                stopping = tasks.create_task(rig.client.stop())
                for at_s, place, on in sorted(chained.from_iterable(ends)):
                    await asyncio.sleep(began_s + at_s - loop.time())
                    modules[place].power(on=on, at_s=loop.time())
                async with asyncio.timeout(8.0):
                    while any(state.link is not LinkState.UP for state in (await rig.client.states()).values()):
                        await asyncio.sleep(0.1)
                await stopping

    run(program())


@pytest.mark.promise("address-only-of-its-place")
@pytest.mark.parametrize(("margin_ms", "within_s"), [(50, 8.0), (300, 20.0), (1000, 60.0)])
@pytest.mark.sweep(2)
def test_a_drive_whose_stop_waits_comes_back_though_nobody_answers(margin_ms, within_s):
    """It turned when it lost its power, and the module behind it is deaf: each question to either costs a time-out."""
    line = CENTRIFUGE.bus[0].model_copy(update={"margin_ms": margin_ms})

    async def program():
        async with (
            simulated_rig(CENTRIFUGE.model_copy(update={"bus": (line,)})) as rig,
            rig.client.control("rotor", client="test") as rotor,
        ):
            await rotor.power(on=True)
            await asyncio.sleep(1.0)  # its outputs are written and read
            await (await rotor.home()).done()
            await rotor.move_velocity(10, acceleration=10, duration_s=60)
            await asyncio.sleep(3.0)
            set_power(rig.lines["line0"], 1, on=False)
            await asyncio.sleep(3.0)
            set_power(rig.lines["line0"], 1, on=True)

            async with asyncio.timeout(within_s):
                while (await rig.client.states())["rotor"].link is not LinkState.UP:
                    await asyncio.sleep(0.5)
            await rig.at_rest("rotor")

    run(program())
