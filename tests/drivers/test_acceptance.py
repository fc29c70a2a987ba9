"""The sequence that tries real drives, on simulated ones that are as the documents say, or are not."""

import asyncio
import threading
from dataclasses import replace
from pathlib import Path

import pytest
from click.testing import CliRunner

from ldcnd.bench.cli.examine import accept as accept_command
from ldcnd.bench.cli.examine import capture_of
from ldcnd.bench.family import TrialMove
from ldcnd.bench.known import BENCHES
from ldcnd.bench.ldcn.acceptance import ASSUMPTIONS, accept, trial_bus
from ldcnd.contract.health import Finding, Verdict
from ldcnd.drives.driver import Gains
from ldcnd.line.capture import Capture, parse_capture
from ldcnd.sim.chain import Chain
from ldcnd.sim.faults import FaultInjector, FaultKind, FaultPlan, LineFault
from ldcnd.sim.ldcn.chain import ChainSpec, ModuleSpec, build_chain
from ldcnd.sim.ldcn.servo import ServoLoop
from ldcnd.sim.pty import PtyLine
from ldcnd.sim.smartstep.cable import smartstep_chain
from ldcnd.sim.smartstep.simulation import SimulatedUnitConfig, simulated_units
from ldcnd.testing.jumping_loop import JumpingLoop
from tests.support.chain_rig import drive, rig_on, simulated_config
from tests.support.plugged_rig import MODELS
from tests.support.recorded_line import Replay
from tests.support.serial_adapter import Plug

GAINS = Gains(kp=350, kd=3000, ki=400, il=400, ol=250, el=4000, cl=0, sr=1, deadband=0)
MOVE = TrialMove(1, GAINS, 2000, 4000.0, 40_000.0)
MOVING = {"loop", "forward", "move_done", "smooth_stop"}


async def addressed(chain: Chain) -> Chain:
    async with rig_on(chain, simulated_config()) as rig:
        await rig.kill()
    return chain


def fresh() -> Chain:
    return build_chain(ChainSpec(tuple(ModuleSpec(model) for model in MODELS)))


def replayed(capture: Capture) -> tuple[Finding, ...]:
    """Play a capture without a move to the sequence again; return what it finds."""

    async def play() -> tuple[Finding, ...]:
        replay = Replay(capture.records, capture.header.until_s, lambda _text: None, slow_host=True)
        (line,) = capture.header.config["bus"] if capture.header.config else [{"axis": []}]
        units = [axis["address"] for axis in line["axis"]]
        trial = BENCHES[capture.header.family].trial("/dev/replayed", units, None, lambda: False, replay.open)
        async with asyncio.TaskGroup() as group:
            owner = group.create_task(trial.bus.run(), name="bus accept")
            await trial.bus.wait_opened()
            found = tuple([finding async for finding in trial.findings])
            owner.cancel()
        replay.close()
        return found

    with asyncio.Runner(loop_factory=lambda: JumpingLoop(capture.header.started_s)) as runner:
        return runner.run(play())


async def tried(chain: Chain, move: TrialMove | None = None, held=lambda: True) -> tuple[list[Finding], Capture]:
    bus = trial_bus(Plug(chain).open)
    async with asyncio.TaskGroup() as group:
        owner = group.create_task(bus.run(), name="bus")
        await bus.wait_opened()
        found = [finding async for finding in accept(bus, move, held)]
        owner.cancel()
    return found, capture_of(bus, "ldcn", "/dev/ttyUSB0", 0)


async def test_drives_that_are_as_the_documents_say_confirm_every_assumption_that_reading_can():
    chain = await addressed(fresh())

    found, _ = await tried(chain)

    assert {finding.verdict for finding in found} == {Verdict.FINE}
    assert {finding.verifies for finding in found} == {each.key for each in ASSUMPTIONS} - MOVING
    assert {finding.axis for finding in found} == {"1", "2", "3", "4"}
    assert [drive(chain, address).loop.servo_on for address in (1, 2, 3, 4)] == [False] * 4
    assert [drive(chain, address).loop.position for address in (1, 2, 3, 4)] == [0] * 4


async def test_trial_move_confirms_the_rest_and_leaves_the_loop_open():
    chain = await addressed(fresh())

    found, _ = await tried(chain, MOVE)

    moved = {finding.what: finding for finding in found if finding.what in MOVING}
    assert {finding.verdict for finding in moved.values()} == {Verdict.FINE}, moved
    assert set(moved) == MOVING
    assert not drive(chain, 1).loop.servo_on
    assert 0 < drive(chain, 1).loop.position < 2000


async def test_drive_is_stopped_and_switched_off_when_the_dead_man_is_released():
    chain = await addressed(fresh())
    loop = asyncio.get_running_loop()
    released_at_s: list[float] = []

    def held() -> bool:
        started = drive(chain, 1).loop.position > 100
        if started:
            released_at_s.append(loop.time())
        return not started

    found, _ = await tried(chain, replace(MOVE, counts=50_000), held)

    assert found[-1].text == "ended: the dead-man was released"
    assert loop.time() - released_at_s[0] < 1.0
    assert not drive(chain, 1).loop.servo_on
    assert drive(chain, 1).loop.position < 2000


async def test_a_drive_of_which_the_dead_man_was_never_held_gets_no_voltage(monkeypatch):
    chain = await addressed(fresh())
    closed: list[ServoLoop] = []

    def close(loop: ServoLoop) -> None:
        closed.append(loop)

    monkeypatch.setattr(ServoLoop, "close", close)

    found, _ = await tried(chain, MOVE, lambda: False)

    assert found[-1].text == "ended: the dead-man was released"
    assert closed == []


async def test_what_a_trial_move_has_shown_is_told_once_its_motor_is_off():
    chain = await addressed(fresh())
    bus = trial_bus(Plug(chain).open)
    async with asyncio.TaskGroup() as group:
        owner = group.create_task(bus.run(), name="bus")
        await bus.wait_opened()
        told = [(each.what, drive(chain, 1).loop.servo_on) async for each in accept(bus, MOVE, lambda: True)]
        owner.cancel()

    assert {what for what, _ in told} >= MOVING
    assert not any(on for _, on in told)


async def test_a_drive_that_has_not_confirmed_that_its_motor_is_off_is_named():
    chain = await addressed(fresh())

    def held() -> bool:
        if started := drive(chain, 1).loop.position > 100:
            chain.injector = FaultInjector(FaultPlan((LineFault(FaultKind.REQUEST_LOST),)))
        return not started

    found, _ = await tried(chain, replace(MOVE, counts=50_000), held)

    (off,) = [finding for finding in found if finding.what == "off"]
    assert (off.verdict, "NOT confirmed" in off.text) == (Verdict.WRONG, True)


@pytest.mark.parametrize("presses", [1, 2, 3])
async def test_however_often_it_is_interrupted_a_trial_move_ends_with_its_motor_off(presses):
    chain = await addressed(fresh())
    trial = asyncio.create_task(tried(chain, replace(MOVE, counts=50_000)), name="trial")
    while drive(chain, 1).loop.position < 100:
        await asyncio.sleep(0.005)
    for _ in range(presses):
        trial.cancel()
        await asyncio.sleep(0.004)
    with pytest.raises(asyncio.CancelledError):
        await trial

    assert not drive(chain, 1).loop.servo_on


@pytest.mark.parametrize(("address", "counts"), [(9, 100), (1, 1_000_000), (1, 0)])
@pytest.mark.sweep(2)
async def test_move_out_of_bounds_is_not_begun(address: int, counts: int):
    chain = await addressed(fresh())

    found, _ = await tried(chain, replace(MOVE, address=address, counts=counts))

    assert (found[-1].what, found[-1].verdict) == ("move", Verdict.WRONG)
    assert not drive(chain, 1).loop.servo_on


async def test_drives_without_addresses_are_left_as_they_are():
    chain = fresh()

    found, _ = await tried(chain)

    assert [finding.what for finding in found] == ["drives"]
    assert "no address yet" in found[0].text
    assert [module.address for module in chain.modules] == [0] * 4


def test_capture_of_a_trial_plays_back_to_the_same_findings():
    async def trial() -> tuple[list[Finding], Capture]:
        return await tried(await addressed(fresh()))

    with asyncio.Runner(loop_factory=JumpingLoop) as runner:
        found, capture = runner.run(trial())

    assert list(replayed(capture)) == found


@pytest.mark.system
@pytest.mark.real_time
def test_smartsteps_are_tried_and_their_capture_plays_back_to_the_same_findings(tmp_path: Path):
    units = simulated_units([SimulatedUnitConfig(number=1), SimulatedUnitConfig(number=2)], 0.0)
    stopped = threading.Event()
    with PtyLine(smartstep_chain(units)) as line:
        thread = threading.Thread(target=line.run, args=(stopped.is_set,), name="line")
        thread.start()
        arguments = [str(line.path), "--family", "smartstep", "--units", "1,2", "--out", str(tmp_path)]
        done = CliRunner().invoke(accept_command, arguments)
        stopped.set()
        thread.join(5)

    report = (tmp_path / "report.jsonl").read_text(encoding="utf-8").splitlines()
    found = [Finding.model_validate_json(finding) for finding in report]
    assert (done.exit_code, {finding.axis for finding in found}) == (0, {"unit1", "unit2"}), done.output
    assert len(found) > 10
    capture = parse_capture((tmp_path / "line.capture").read_text(encoding="utf-8"))
    assert [finding.text for finding in replayed(capture)] == [finding.text for finding in found]


def test_assumptions_are_listed_without_a_port():
    done = CliRunner().invoke(accept_command, ["--list"])

    assert done.exit_code == 0
    assert done.output.count("confirmed_by") == len(ASSUMPTIONS)


@pytest.mark.parametrize(
    "arguments", [[], ["/dev/x", "--move", "1"], ["/dev/x", "--move", "1", "--gains", "1,2,3,4,5,6"]]
)
def test_command_refuses_to_move_without_gains_or_a_dead_man(arguments: list[str]):
    assert CliRunner().invoke(accept_command, arguments).exit_code == 2
