"""The udev rules, tried by udev itself on adapters that umockdev pretends are there, on a machine of its own."""

import re
import shutil
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest

from tests.support.booted_machine import Machine, booted_machine, why_no_machine

RULES = Path(__file__).parents[2] / "deploy" / "udev" / "71-ldcnd.rules"
SYSUSERS = Path(__file__).parents[2] / "deploy" / "sysusers.d" / "ldcnd.conf"
why_not = why_no_machine() or (None if shutil.which("umockdev-run") else "no umockdev-run: apt-get install umockdev")
pytestmark = [pytest.mark.real_time, pytest.mark.skipif(why_not is not None, reason=why_not or "")]

PORT = "/devices/pci0000:00/0000:00:14.0/usb1/1-2/1-2:1.0/ttyUSB0"


@dataclass(frozen=True)
class Adapter:
    """What is plugged in."""

    driver: str
    vendor: str
    product: str
    serial: str | None

    def description(self) -> str:
        """Return it as umockdev reads it."""
        serial = f"A: serial={self.serial}\n" if self.serial else ""
        return f"""P: /devices/pci0000:00/0000:00:14.0/usb1/1-2
N: bus/usb/001/005
E: BUSNUM=001
E: DEVNUM=005
E: DEVNAME=/dev/bus/usb/001/005
E: DEVTYPE=usb_device
E: PRODUCT={self.vendor}/{self.product}/600
E: SUBSYSTEM=usb
A: idVendor={self.vendor}
A: idProduct={self.product}
A: manufacturer=Maker
A: product=Adapter
A: bcdDevice=0600
A: bNumInterfaces= 1
A: bConfigurationValue=1
A: bDeviceClass=00
{serial}
P: /devices/pci0000:00/0000:00:14.0/usb1/1-2/1-2:1.0
E: DEVTYPE=usb_interface
E: DRIVER={self.driver}
E: SUBSYSTEM=usb
L: driver=../../../../../../bus/usb/drivers/{self.driver}
A: bInterfaceClass=ff
A: bInterfaceSubClass=ff
A: bInterfaceProtocol=ff
A: bInterfaceNumber=00

P: {PORT}
E: DRIVER={self.driver}
E: SUBSYSTEM=usb-serial
L: driver=../../../../../../../bus/usb-serial/drivers/{self.driver}
A: latency_timer=16

P: {PORT}/tty/ttyUSB0
N: ttyUSB0
E: DEVNAME=/dev/ttyUSB0
E: MAJOR=188
E: MINOR=0
E: SUBSYSTEM=tty
L: device=../../../ttyUSB0
"""


FTDI = Adapter("ftdi_sio", "0403", "6001", "FT4ABCDE")
CP210X = Adapter("cp210x", "10c4", "ea60", "0001")
EXAR = Adapter("xr_serial", "04e2", "1411", "0002")
TI = Adapter("ti_usb_3410_5052", "0451", "3410", "0003")
MOXA = Adapter("mxuport", "110a", "1250", "0004")
CH340 = Adapter("ch341", "1a86", "7523", None)
MODEM = Adapter("option", "12d1", "1506", "MODEM1")


@pytest.fixture(scope="module")
def machine() -> Iterator[Machine]:
    with booted_machine() as machine:
        machine.write("/etc/sysusers.d/ldcnd.conf", SYSUSERS.read_text(encoding="utf-8"))
        machine.must("systemd-sysusers")
        machine.write("/etc/udev/rules.d/71-ldcnd.rules", RULES.read_text(encoding="utf-8"))
        yield machine


def tried(machine: Machine, adapter: Adapter, device: str) -> str:
    """Return what udev says about a device that is added; a trial run says what it writes, and writes it nowhere."""
    machine.write("/root/adapter.umockdev", adapter.description())
    script = f"udevadm test --action=add {device} 2>&1"
    return machine.must("umockdev-run", "--device", "/root/adapter.umockdev", "--", "sh", "-c", script)


def properties(report: str) -> dict[str, str]:
    return dict(re.findall(r"(?m)^([A-Z_]+)=(.*)$", report))


def test_ftdi_adapter_hands_over_replies_after_a_millisecond(machine: Machine):
    report = tried(machine, FTDI, PORT)

    assert re.search(rf"ATTR '/sys{PORT}/latency_timer' writing '1'", report)


def test_uart_on_board_hands_over_replies_after_each_byte(machine: Machine):
    port = "/devices/platform/serial8250/tty/ttyS1"
    machine.write(
        "/root/uart.umockdev",
        f"P: {port}\nN: ttyS1\nE: DEVNAME=/dev/ttyS1\nE: MAJOR=4\nE: MINOR=65\nE: SUBSYSTEM=tty\nA: rx_trig_bytes=8\n",
    )
    trial = f"udevadm test --action=add {port} 2>&1"

    report = machine.must("umockdev-run", "--device", "/root/uart.umockdev", "--", "sh", "-c", trial)

    assert re.search(rf"ATTR '/sys{port}/rx_trig_bytes' writing '1'", report)


@pytest.mark.parametrize("adapter", [CP210X, MODEM])
def test_other_chips_are_left_as_they_are(machine: Machine, adapter: Adapter):
    report = tried(machine, adapter, PORT)

    assert f"DEVPATH={PORT}" in report
    assert "latency_timer" not in report


@pytest.mark.parametrize(
    ("adapter", "link"),
    [
        (FTDI, "/dev/ldcn-FT4ABCDE-00"),
        (CP210X, "/dev/ldcn-0001-00"),
        (EXAR, "/dev/ldcn-0002-00"),
        (TI, "/dev/ldcn-0003-00"),
        (MOXA, "/dev/ldcn-0004-00"),
    ],
)
def test_adapter_has_a_name_that_stays_and_modem_manager_leaves_it_alone(machine: Machine, adapter: Adapter, link: str):
    found = properties(tried(machine, adapter, f"{PORT}/tty/ttyUSB0"))

    assert link in found["DEVLINKS"].split()
    assert found["ID_MM_PORT_IGNORE"] == "1"


def test_adapter_without_a_serial_number_gets_no_name_that_another_could_take(machine: Machine):
    found = properties(tried(machine, CH340, f"{PORT}/tty/ttyUSB0"))

    assert "ldcn-" not in found.get("DEVLINKS", "")
    assert found["ID_MM_PORT_IGNORE"] == "1"


def test_modem_stays_a_modem(machine: Machine):
    found = properties(tried(machine, MODEM, f"{PORT}/tty/ttyUSB0"))

    assert found["ID_USB_DRIVER"] == "option"
    assert "ID_MM_PORT_IGNORE" not in found
    assert "ldcn-" not in found.get("DEVLINKS", "")


def test_group_of_the_daemon_may_keep_the_processor_awake(machine: Machine):
    device = "/devices/virtual/misc/cpu_dma_latency"
    told = "N: cpu_dma_latency\nE: DEVNAME=/dev/cpu_dma_latency\nE: MAJOR=10\nE: MINOR=62\nE: SUBSYSTEM=misc\n"
    machine.write("/root/awake.umockdev", f"P: {device}\n{told}")
    group = machine.must("getent", "group", "ldcnd").split(":")[2]

    report = machine.must(
        "umockdev-run", "--device", "/root/awake.umockdev", "--", "sh", "-c", f"udevadm test -a add {device} 2>&1"
    )

    assert re.search(rf"71-ldcnd.rules:\d+ GROUP {group}\b", report)
    assert re.search(r"71-ldcnd.rules:\d+ MODE 0660", report)


@pytest.mark.long
def test_rules_are_understood_whole(machine: Machine):
    report = tried(machine, FTDI, PORT)

    complaints = [line for line in report.splitlines() if "71-ldcnd.rules" in line and "Reading rules" not in line]
    assert not [line for line in complaints if re.search(r"nvalid|nknown|ignor", line)]
