"""What a port really is set to: rates that the driver does not make, direction control that it does not have."""

import asyncio
import errno
import os
import pty
import re
import tomllib
import tty
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import pytest

from ldcnd.config.rig import RigConfig, load_config, single_line
from ldcnd.contract.errors import ConfigError, NotSupported, TransportLost
from ldcnd.daemon.service import require_writable, state_held
from ldcnd.drives.ldcn.line_rate import LineRate, nulls
from ldcnd.drives.ldcn.registers import BaudCodes
from ldcnd.line.bus import Bus
from ldcnd.line.line_discipline import (
    ENABLED,
    RTS_AFTER_SEND,
    RTS_ON_SEND,
    RX_DURING_TX,
    TERMINATE_BUS,
    Rs485Config,
    actual_baud,
)
from ldcnd.line.port_url import port_opener
from ldcnd.line.rates import makes
from ldcnd.line.serial_port import SerialPort, SerialSettings, open_serial_port
from ldcnd.line.settings import BusSettings
from tests.support.recording_receiver import RecordingReceiver
from tests.support.rig import SIMULATED
from tests.support.serial_drivers import rs485_port, uart_8250
from tests.support.trace_rig import MIXED

pytestmark = pytest.mark.real_time


@pytest.fixture
def terminal() -> Iterator[str]:
    master, slave = pty.openpty()
    tty.setraw(slave)
    yield os.ttyname(slave)
    os.close(slave)
    os.close(master)


async def test_rate_that_a_uart_does_not_make_is_refused_with_its_neighbours(terminal, monkeypatch):
    uart_8250(monkeypatch)

    with pytest.raises(TransportLost, match="instead of 230400 baud, the nearest that it makes: 115200;") as refused:
        await open_serial_port(SerialSettings(terminal, 230_400))

    assert "9600, 19200, 38400, 57600, 115200" in refused.value.remedy


async def test_working_rate_that_a_uart_does_not_make_is_refused_before_a_drive_is_told_to_change_to_it(
    terminal, monkeypatch
):
    uart_8250(monkeypatch)

    with pytest.raises(TransportLost, match="instead of 230400 baud"):
        await open_serial_port(SerialSettings(terminal, 19_200, working_baud=230_400))


async def test_port_is_at_its_first_rate_once_it_is_open(terminal, monkeypatch):
    uart_8250(monkeypatch)
    port = await open_serial_port(SerialSettings(terminal, 19_200, working_baud=115_200))

    assert actual_baud(port._descriptor) == 19_200
    assert [baud for baud in (9600, 115_200, 230_400) if port.offers(baud)] == [9600, 115_200]
    await port.close()


async def test_change_to_a_rate_that_is_not_made_ends_the_port_and_names_the_one_that_is(terminal, monkeypatch):
    uart_8250(monkeypatch)
    port = await open_serial_port(SerialSettings(terminal, 19_200))
    receiver = RecordingReceiver()
    port.attach(receiver)

    with pytest.raises(TransportLost, match="sends at 19200 instead of 230400 baud"):
        port.set_baud(230_400)
    await receiver.wait_lost()
    await port.close()


async def test_port_that_fails_right_after_it_was_opened_is_free_again(terminal, monkeypatch):
    def is_gone(*_: object) -> None:
        raise OSError(errno.EIO, "Input/output error")

    with monkeypatch.context() as patched:
        patched.setattr(SerialPort, "__init__", is_gone)
        with pytest.raises(TransportLost):
            await open_serial_port(SerialSettings(terminal, 19_200))
    port = await open_serial_port(SerialSettings(terminal, 19_200))

    assert actual_baud(port._descriptor) == 19_200
    await port.close()


@pytest.mark.parametrize("steps", range(0, 400, 10))
@pytest.mark.sweep(2)
async def test_port_whose_opening_is_cancelled_at_any_step_is_free_again(terminal, steps):
    opening = asyncio.create_task(open_serial_port(SerialSettings(terminal, 19_200)))
    for _ in range(steps):
        await asyncio.sleep(0)
        if opening.done():
            break
    opening.cancel()
    with suppress(asyncio.CancelledError):
        await (await opening).close()
    async with asyncio.timeout(20):
        while True:  # what a worker thread has opened meanwhile is closed when it is done
            try:
                port = await open_serial_port(SerialSettings(terminal, 19_200))
            except TransportLost:
                await asyncio.sleep(0.01)
            else:
                break

    await port.close()


async def test_adapter_that_leaves_the_usb_is_named_as_such(monkeypatch):
    master, slave = pty.openpty()
    tty.setraw(slave)
    port = await open_serial_port(SerialSettings(os.ttyname(slave), 115_200))
    port._is_usb, port._is_pseudo = True, False
    receiver = RecordingReceiver()
    port.attach(receiver)

    os.close(slave)
    os.close(master)
    await receiver.wait_lost()
    with pytest.raises(TransportLost, match="USB adapter is gone"):
        port.write(b"\xaa")
    await port.close()

    assert "the USB adapter is gone, unplugged or reset" in receiver.losses[0]


@pytest.mark.parametrize(("made", "heard"), [(None, True), (57_692, True), (56_000, False), (9600, False)])
def test_rates_are_the_same_within_what_two_clocks_may_differ(made, heard):
    assert makes(57_600, made) is heard


async def test_drives_are_not_looked_for_at_rates_that_the_port_does_not_make(terminal, monkeypatch):
    uart_8250(monkeypatch)
    bus = Bus(BusSettings("line0", 19_200), port_opener(terminal, 19_200, working_baud=115_200))
    rate = LineRate(bus, 115_200, BaudCodes.MANUAL, (0xFF,), fastest=True)

    async with asyncio.TaskGroup() as group:
        owner = group.create_task(bus.run(), name="bus")
        await bus.wait_opened()
        assert rate.candidates == (115_200, 57_600, 9600, 19_200)
        assert not await rate.host_to(230_400)
        with pytest.raises(NotSupported, match="does not make 230400 baud"):
            await bus.change_baud(nulls(0.001), 230_400)
        assert bus.is_open
        owner.cancel()


async def test_kernel_switches_the_transmitter_as_configured(terminal, monkeypatch):
    driver = rs485_port(monkeypatch, ENABLED | RTS_ON_SEND | RTS_AFTER_SEND | RX_DURING_TX | TERMINATE_BUS)

    port = await port_opener(terminal, 9600, rs485=Rs485Config(rts_on_send=False, after_ms=2, terminate=True))()
    await port.close()

    assert driver.taken[:3] == [ENABLED | RTS_AFTER_SEND | TERMINATE_BUS, 0, 2]


async def test_driver_without_direction_control_is_refused(terminal):
    with pytest.raises(TransportLost, match="cannot switch the transmitter of an RS-485 line; leave `rs485` out"):
        await port_opener(terminal, 9600, rs485=Rs485Config())()


@pytest.mark.parametrize(
    ("supported", "wanted", "why"),
    [
        (0, Rs485Config(), "cannot switch the transmitter"),
        (ENABLED | RTS_AFTER_SEND, Rs485Config(), "cannot have RTS on while sending"),
        (ENABLED | RTS_ON_SEND, Rs485Config(rts_on_send=False), "cannot have RTS off while sending"),
        (ENABLED | RTS_ON_SEND, Rs485Config(receive_own=True), "cannot have the receiver on while sending"),
        (ENABLED | RTS_ON_SEND, Rs485Config(terminate=True), "no terminating resistor"),
    ],
)
async def test_what_a_driver_drops_silently_is_refused(terminal, monkeypatch, supported, wanted, why):
    rs485_port(monkeypatch, supported)

    with pytest.raises(TransportLost, match=why):
        await port_opener(terminal, 9600, rs485=wanted)()


def rig_with(**bus: object) -> RigConfig:
    document = load_config(SIMULATED).model_dump(mode="json", exclude_none=True)
    document["bus"][0] |= bus
    return RigConfig.model_validate(document)


def test_direction_control_is_for_ports_of_this_machine():
    assert rig_with(port="/dev/ttyS1", rs485={}).bus[0].rs485 == Rs485Config()
    for port in ("socket://there:7", "sim:line0"):
        with pytest.raises(ValueError, match="rs485: only a serial port of this machine has RTS"):
            rig_with(port=port, rs485={})


def test_direction_control_of_the_page_is_valid():
    page = (SIMULATED.parents[1] / "docs" / "how-to" / "choose-an-adapter.md").read_text(encoding="utf-8")
    (line,) = tomllib.loads(re.findall(r"(?ms)^```toml\n(.*?)^```$", page)[0])["bus"]

    assert rig_with(**line).bus[0].rs485 == Rs485Config(after_ms=1)


def test_place_where_nothing_can_be_written_is_refused_before_anything_is_opened(tmp_path: Path, monkeypatch):
    plain = tmp_path / "file"
    plain.write_text("")
    monkeypatch.setenv("STATE_DIRECTORY", "/var/lib/ldcnd/cell")

    with pytest.raises(ConfigError, match=r"state_dir: .* cannot be written") as refused:
        require_writable(load_config(SIMULATED).model_copy(update={"state_dir": plain / "ldcnd"}))

    assert refused.value.remedy.startswith('state_dir = "/var/lib/ldcnd/cell"')
    require_writable(load_config(SIMULATED).model_copy(update={"state_dir": tmp_path / "not" / "yet"}))


def test_a_second_daemon_gets_no_state_directory_that_another_one_uses(tmp_path: Path):
    """Each would replace the file of latches, with what it knows of alone; a killed one leaves no lock behind."""
    rig = load_config(SIMULATED).model_copy(update={"state_dir": tmp_path / "kept"})
    with state_held(rig):
        with pytest.raises(ConfigError, match=r"another daemon uses .*kept"), state_held(rig):
            pass
        with state_held(rig.model_copy(update={"state_dir": tmp_path / "own"})):
            pass
    with state_held(rig):
        pass


def test_the_daemons_of_a_rig_and_of_one_of_its_lines_keep_each_other_out(tmp_path):
    whole = load_config(MIXED).model_copy(update={"state_dir": tmp_path / "kept"})
    one, other = (single_line(whole, bus.name) for bus in whole.bus[:2])
    with state_held(one), state_held(other):
        with pytest.raises(ConfigError, match="another daemon uses"), state_held(whole):
            pytest.fail("both would command its axes")
    with state_held(whole):
        for line in (one, other):
            with pytest.raises(ConfigError, match="another daemon uses"), state_held(line):
                pytest.fail("both would command its axes")
    with state_held(one):
        pass
