"""`ldcnd doctor`: what it finds out about adapters and lines, and what it says to type."""

import asyncio
from pathlib import Path

import pytest

from ldcnd.bench.ldcn.examination import LineAsConfigured, adapter_findings, examine
from ldcnd.contract.health import Finding, Verdict
from ldcnd.drives.ldcn.family import open_ldcn_line
from ldcnd.line.adapter import Adapter, LineErrors, adapter_of
from ldcnd.sim.chain import Chain, Delivery
from ldcnd.sim.ldcn.chain import ChainSpec, ModuleSpec, build_chain
from tests.support.chain_rig import drive, rig_on
from tests.support.plugged_rig import MODELS, slow_config
from tests.support.process import LDCND
from tests.support.rig import SIMULATED
from tests.support.serial_adapter import AT_ONCE, Fifo, Holding, LatencyTimer, Plug

LINE = LineAsConfigured("line0", "/dev/ldcn-FT4ABCDE-00", adapter_latency_ms=1.0, margin_ms=25.0, model="ls-182ap")
FTDI = Adapter("ttyUSB0", "ftdi_sio", "/dev/ldcn-FT4ABCDE-00", 1, None)
SLOW_FTDI = Adapter("ttyUSB3", "ftdi_sio", None, 16, None)
SLOW_UART = Adapter("ttyS1", "serial8250", None, None, 8)
UART = Adapter("ttyS1", "serial8250", None, None, 1)


async def addressed_chain() -> Chain:
    """Return drives as a daemon leaves them behind."""
    modules = tuple(ModuleSpec(model) for model in MODELS)
    chain = build_chain(ChainSpec(modules, baud_check=True, delivery=Delivery.BYTEWISE))
    async with rig_on(chain, slow_config()) as rig:
        await rig.kill()
    return chain


async def examined(chain: Chain, holding: Holding = AT_ONCE) -> dict[str, Finding]:
    config = slow_config()
    line = open_ldcn_line(config.bus[0], Plug(chain, holding).open)
    bus, network = line.bus, line.network
    async with asyncio.TaskGroup() as group:
        owner = group.create_task(bus.run(), name="bus")
        await bus.wait_opened()
        found = {finding.what: finding async for finding in examine(bus, network, LINE, lambda _path: FTDI)}
        owner.cancel()
    return found


@pytest.mark.parametrize(
    ("holding", "least_ms", "most_ms"),
    [
        (AT_ONCE, 0.0, 0.3),
        (LatencyTimer(0.001), 0.6, 1.3),
        (LatencyTimer(0.016), 13.0, 16.5),
        (Fifo(10 / 115_200, 8), 0.2, 0.6),
    ],
    ids=["at once", "FTDI 1 ms", "FTDI 16 ms", "16550A"],
)
@pytest.mark.sweep(2)
async def test_latency_of_an_adapter_is_measured_and_proposed(holding, least_ms, most_ms):
    found = await examined(await addressed_chain(), holding)

    measured_ms = float(found["turn-around"].text.split("keeps them back for ")[1].split(" ms")[0])
    assert least_ms <= measured_ms <= most_ms
    if abs(measured_ms - LINE.adapter_latency_ms) > 0.3:
        assert found["turn-around"].remedy == f"adapter_latency_ms = {measured_ms:.1f}"
    assert found["drives"].verdict is Verdict.FINE
    assert found["errors"].verdict is Verdict.FINE


@pytest.mark.long
async def test_what_a_slow_adapter_costs_is_told_in_polls_a_second():
    chain = await addressed_chain()

    slow, quick = await examined(chain, LatencyTimer(0.016)), await examined(chain)

    assert slow["cost"].verdict is Verdict.LOOK
    assert int(slow["cost"].text.split()[0]) < 70
    assert int(quick["cost"].text.split()[0]) > 200
    assert slow["margin"].remedy in [f"margin_ms = {margin_ms}" for margin_ms in range(42, 50)]


async def test_an_examination_touches_no_drive():
    chain = await addressed_chain()
    before = [module.address for module in chain.modules]

    await examined(chain)

    assert [module.address for module in chain.modules] == before
    assert [drive(chain, address).loop.servo_on for address in (1, 2, 3, 4)] == [False] * 4


async def test_drives_without_an_address_are_told_from_a_dead_line():
    fresh = build_chain(ChainSpec(tuple(ModuleSpec(model) for model in MODELS)))
    found = await examined(fresh)
    for module in fresh.modules:
        module.power(on=False, at_s=asyncio.get_running_loop().time())
    dead = await examined(fresh)

    assert "has no address yet" in found["line"].text
    assert dead["line"].verdict is Verdict.WRONG
    assert "swapped" in dead["line"].remedy


@pytest.mark.parametrize(
    ("adapter", "what", "remedy"),
    [
        (SLOW_FTDI, "latency timer", "echo 1 | sudo tee /sys/bus/usb-serial/devices/ttyUSB3/latency_timer;"),
        (SLOW_UART, "FIFO trigger", "echo 1 | sudo tee /sys/class/tty/ttyS1/rx_trig_bytes;"),
    ],
)
def test_adapter_that_keeps_replies_back_is_told_with_what_to_type(adapter, what, remedy):
    found = {finding.what: finding for finding in adapter_findings(LINE, adapter)}

    assert found[what].verdict is Verdict.LOOK
    assert found[what].remedy.startswith(remedy)


@pytest.mark.parametrize("adapter", [FTDI, UART, Adapter("3", "", None, None, None), None])
def test_adapter_that_passes_bytes_on_is_fine(adapter):
    assert {finding.verdict for finding in adapter_findings(LINE, adapter)} == {Verdict.FINE}


def test_name_that_may_change_is_told_with_one_that_stays():
    line = LineAsConfigured("line0", "/dev/ttyUSB0", 1.0, 5.0, "ls-182ap")

    found = {finding.what: finding for finding in adapter_findings(line, FTDI)}

    assert found["name"].remedy == 'port = "/dev/ldcn-FT4ABCDE-00"'


def test_adapter_is_read_from_what_the_kernel_shows(tmp_path: Path):
    device, driver = tmp_path / "devices" / "ttyUSB0", tmp_path / "drivers" / "ftdi_sio"
    for folder in (device, driver, tmp_path / "tty" / "ttyUSB0", tmp_path / "by-id", tmp_path / "dev"):
        folder.mkdir(parents=True)
    (device / "latency_timer").write_text("16\n")
    (device / "driver").symlink_to(driver)
    (tmp_path / "tty" / "ttyUSB0" / "device").symlink_to(device)
    node = tmp_path / "dev" / "ttyUSB0"
    node.write_text("")
    (tmp_path / "by-id" / "usb-FTDI-if00").symlink_to(node)

    assert adapter_of(node, tmp_path / "tty", tmp_path / "by-id") == Adapter(
        "ttyUSB0", "ftdi_sio", str(tmp_path / "by-id" / "usb-FTDI-if00"), 16, None
    )
    assert adapter_of(tmp_path / "dev" / "ttyUSB7", tmp_path / "tty", tmp_path / "by-id") is None


def test_errors_are_counted_from_the_examination_on():
    before, after = LineErrors(1, 2, 3, 4, 5), LineErrors(1, 2, 4, 6, 5)

    assert str(after.since(before)) == "0 frame, 1 parity, 0 overrun, 0 buffer overrun errors, 2 breaks"
    assert not after.since(after)


@pytest.mark.real_time
@pytest.mark.long
async def test_command_prints_findings_as_json_lines():
    running = await asyncio.create_subprocess_exec(
        *LDCND, "doctor", "--config", str(SIMULATED), "--bus", "line0", "--json", stdout=asyncio.subprocess.PIPE
    )
    output, _ = await running.communicate()

    found = [Finding.model_validate_json(line) for line in output.splitlines()]
    assert [finding.what for finding in found] == ["adapter", "drives", "line"]
    assert running.returncode == 0
