"""`ldcnd scan`: what it finds on lines in any state, and that it moves, resets and addresses nothing to find it."""

import random

import pytest

from ldcnd.bench.begun import begun_with, write
from ldcnd.bench.known import BENCHES, with_line
from ldcnd.config.rig import load_config
from ldcnd.contract.errors import ConfigError
from ldcnd.contract.health import Verdict
from ldcnd.drives.driver import Gains
from ldcnd.drives.ldcn.line_rate import NULLS
from ldcnd.drives.ldcn.packet import CommandCode, PacketReader
from ldcnd.drives.ldcn.registers import RESET_BAUD
from ldcnd.line.flight_recorder import WireEvent
from ldcnd.sim.chain import Chain, Delivery
from ldcnd.sim.faults import FaultKind, FaultPlan, LineFault
from ldcnd.sim.ldcn.chain import ChainSpec, ModuleSpec, build_chain
from ldcnd.sim.ldcn.drive import SimulatedDrive
from ldcnd.sim.ldcn.power import Trip
from ldcnd.sim.line import open_simulated_line
from ldcnd.sim.plant import MotorPlant

SERVOS = ("ls-182ap", "ls-173ap", "pic-servo-v4", "pic-servo-sc")
OTHERS = ("pic-io", "pic-step")
HARMLESS = {CommandCode.READ_STATUS, CommandCode.NO_OPERATION}
ADDRESSING = {CommandCode.SET_BAUD_RATE, CommandCode.HARD_RESET, CommandCode.SET_ADDRESS}
PORT = "socket://127.0.0.1:4001"
LONG = MotorPlant(reverse_limit_counts=-(10**7), forward_limit_counts=10**7)
GAINS = Gains(kp=100, kd=1000, ki=50, il=200, ol=255, cl=0, el=4000, sr=1, deadband=0)


async def scanned(chain: Chain, *, give_addresses: bool = False):
    """Scan a line; returns the drives, the findings, and the packets that were sent."""
    look = BENCHES["ldcn"].scan(
        PORT, give_addresses=give_addresses, opener=lambda: open_simulated_line(chain, RESET_BAUD)
    )
    findings = await with_line(look.bus, PORT, lambda: gathered(look.findings))
    sent = [record.data for record in look.bus.wire_log.records() if record.event is WireEvent.SENT]
    return look.drives, findings, sent


async def gathered(findings):
    return [finding async for finding in findings]


def packets(sent):
    """Cut what was sent into packets; what is in none is nulls."""
    found = []
    for data in sent:
        if set(data) == {0}:
            assert data == NULLS
            continue
        reader = PacketReader()
        cut = [received for received in map(reader.feed, data) if received]
        assert cut
        assert not reader.in_packet
        found += [received.packet for received in cut]
    return found


def runs(drive: SimulatedDrive) -> None:
    drive.loop.set_gains(GAINS)
    drive.stage.enable(on=True)
    drive.loop.close()
    drive.loop.trajectory.run_at(200_000, 3000)


def random_chain(dice: random.Random) -> tuple[Chain, dict[int, tuple[str, int, str]], bool]:
    """Return a line in some state; what of it can be found, and whether a module without an address can."""
    names = [dice.choice((*SERVOS, *SERVOS, *OTHERS)) for _ in range(dice.randint(1, 6))]
    noise = dice.choice((0.0, 0.0, 0.01))
    faults = FaultPlan((LineFault(FaultKind.REPLY_BIT_FLIPPED, noise),) if noise else (), dice.randrange(1000))
    spec = ChainSpec(
        tuple(ModuleSpec(name, plant=LONG) for name in names),
        baud_check=True,
        seed=dice.randrange(1000),
        faults=faults,
        delivery=Delivery.BYTEWISE if noise else Delivery.WHOLE,
    )
    chain = build_chain(spec)
    addressed = dice.choice((0, len(names), len(names), dice.randint(0, len(names))))
    rates = [dice.choice((9600, RESET_BAUD, 57_600, 115_200)) for _ in range(2)]
    mixed = dice.random() < 0.2
    expected = {}
    for number, module in enumerate(chain.modules[:addressed], start=1):
        module.address, module.address_out = number, True
        module.baud = dice.choice(rates) if mixed else rates[0]
        state = "stands"
        if isinstance(module, SimulatedDrive):
            match dice.choice(("fresh", "runs", "tripped")):
                case "runs":
                    runs(module)
                    state = "moves"
                case "tripped":
                    runs(module)
                    module.loop._give_up(Trip.POSITION_ERROR)
        expected[number] = (names[number - 1], module.baud, state)
    return chain, expected, addressed < len(names)


@pytest.mark.parametrize("seed", [*range(10), *(pytest.param(seed, marks=pytest.mark.soak) for seed in range(10, 40))])
@pytest.mark.sweep(2)
async def test_a_chain_in_any_state_is_told_as_it_is_and_left_as_it_was(seed):
    dice = random.Random(seed)
    chain, expected, waiting = random_chain(dice)
    before = [(module.address, module.baud, module.items) for module in chain.modules]
    closed = [module.loop.servo_on for module in chain.modules if isinstance(module, SimulatedDrive)]

    drives, findings, sent = await scanned(chain)

    found = {drive.address: (drive.model, drive.baud) for drive in drives}
    assert found == {address: (model, baud) for address, (model, baud, _) in expected.items()}, seed
    for drive in drives:
        if drive.is_axis:
            assert f"; {expected[drive.address][2]}" in drive.text, (seed, drive)
    assert any(finding.what == "addresses" for finding in findings) == waiting, seed
    rates = {baud for _, baud, _ in expected.values()}
    assert any(finding.what == "rates" for finding in findings) == (len(rates) > 1), seed
    assert {CommandCode(packet.command) for packet in packets(sent)} <= HARMLESS
    assert [(module.address, module.baud, module.items) for module in chain.modules] == before
    assert [module.loop.servo_on for module in chain.modules if isinstance(module, SimulatedDrive)] == closed


async def test_nothing_is_sent_to_a_line_that_another_host_uses():
    chain = build_chain(ChainSpec((ModuleSpec("ls-182ap"),)))
    chain.modules[0].address = 1
    look = BENCHES["ldcn"].scan(PORT, give_addresses=True, opener=lambda: open_simulated_line(chain, RESET_BAUD))

    async def scan_beside_another():
        look.bus._line.data_received(bytes((0x09, 0x09)))
        return await gathered(look.findings)

    *_, finding = await with_line(look.bus, PORT, scan_beside_another)

    assert finding.verdict is Verdict.WRONG
    assert "another host" in finding.text
    assert not [record for record in look.bus.wire_log.records() if record.event is WireEvent.SENT]


async def test_a_fresh_line_gets_addresses_when_asked():
    chain = build_chain(ChainSpec(tuple(ModuleSpec(name) for name in ("ls-182ap", "pic-io", "pic-servo-sc"))))

    drives, _, sent = await scanned(chain, give_addresses=True)

    assert [(drive.address, drive.model) for drive in drives] == [(1, "ls-182ap"), (2, "pic-io"), (3, "pic-servo-sc")]
    assert {CommandCode(packet.command) for packet in packets(sent)} == HARMLESS | ADDRESSING


@pytest.mark.parametrize(
    ("names", "said", "verdict"),
    [
        (("ls-182ap", "ls-173ap"), {"next to the host"}, Verdict.FINE),
        (("ls-182ap", "ls-182ap"), {"next to the host"}, Verdict.LOOK),
        (("pic-servo-v4", "pic-io"), {"furthest from the host"}, Verdict.FINE),
        (("pic-servo-sc", "pic-servo-sc"), {"furthest from the host"}, Verdict.LOOK),
        (("ls-182ap", "pic-step"), {"next to the host", "furthest from the host"}, Verdict.FINE),
    ],
)
@pytest.mark.sweep(2)
async def test_a_scan_says_from_which_end_the_chain_is_numbered(names, said, verdict):
    chain = build_chain(ChainSpec(tuple(ModuleSpec(name) for name in names)))

    _, findings, _ = await scanned(chain, give_addresses=True)

    (order,) = (finding for finding in findings if finding.what == "order")
    ends = {"next to the host", "furthest from the host"}
    assert {end for end in ends if end in order.text} == said
    assert order.verdict is verdict


@pytest.mark.parametrize("addressed", [1, 2])
@pytest.mark.sweep(2)
async def test_nothing_is_reset_while_a_drive_moves_or_may(addressed):
    chain = build_chain(ChainSpec((ModuleSpec("ls-182ap"), ModuleSpec("ls-182ap", plant=LONG))))
    for number, module in enumerate(chain.modules[:addressed], start=1):
        module.address, module.address_out = number, True
    if addressed == 2:
        runs(chain.modules[1])

    _, findings, sent = await scanned(chain, give_addresses=True)

    assert any(finding.verdict is Verdict.WRONG and "no addresses given" in finding.text for finding in findings)
    assert {CommandCode(packet.command) for packet in packets(sent)} <= HARMLESS


async def test_a_silent_line_is_not_reset():
    chain = build_chain(ChainSpec((ModuleSpec("ls-182ap", plant=LONG),)))
    chain.modules[0].address, chain.modules[0].address_out = 40, True  # another host has given it, and moves it
    runs(chain.modules[0])

    _, findings, sent = await scanned(chain, give_addresses=True)

    assert any(finding.verdict is Verdict.WRONG for finding in findings)
    assert {CommandCode(packet.command) for packet in packets(sent)} <= HARMLESS
    assert chain.modules[0].loop.servo_on


async def test_a_configuration_is_begun_and_continued_and_what_a_person_wrote_stays(tmp_path):
    chain = build_chain(ChainSpec(tuple(ModuleSpec(name) for name in ("ls-182ap", "pic-io", "pic-servo-sc"))))
    drives, _, _ = await scanned(chain, give_addresses=True)
    file = tmp_path / "rig.new"

    write(begun_with(file, "ldcn", PORT, drives[:2]))
    begun = file.read_text().replace('name = "axis1"', 'name = "x" # the long one').replace("# gains", "gains")
    file.write_text(begun)
    said = write(begun_with(file, "ldcn", PORT, drives))

    rig = load_config(file)
    assert [axis.name for axis in rig.bus[0].axis] == ["x", "axis3"]
    assert rig.bus[0].axis[0].gains.kp == 100
    assert [module.model for module in rig.bus[0].module] == ["pic-io"]
    assert file.read_text().startswith(begun.rstrip("\n"))
    assert "1 of 3 added" in said[-1]
    assert (
        write(begun_with(file, "ldcn", PORT, drives[1:]))[0]
        == "address 1 is configured as ls-182ap; nothing answers there"
    )
    assert load_config(file) == rig
    late = begun_with(file, "ldcn", PORT, drives)
    changed = file.read_text() + "# changed while that was looked at\n"
    file.write_text(changed)
    with pytest.raises(ConfigError, match="changed meanwhile"):
        write(late)
    assert file.read_text() == changed
    assert list(tmp_path.iterdir()) == [file]


async def test_a_line_of_which_no_axis_can_be_made_leaves_the_file_as_it_was(tmp_path):
    chain = build_chain(ChainSpec((ModuleSpec("pic-io"),)))
    drives, _, _ = await scanned(chain, give_addresses=True)

    with pytest.raises(ConfigError, match="not written"):
        write(begun_with(tmp_path / "rig.toml", "ldcn", PORT, drives))

    assert list(tmp_path.iterdir()) == []
