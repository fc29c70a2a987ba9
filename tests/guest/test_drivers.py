"""The installed package on the kernel's own ftdi_sio and 8250: `make test-drivers`.

One guest is booted for all of it; drives are simulated at the far ends of its ports, on the host, where what they truly
do can be seen. Clients are on the host, too.
"""

import asyncio
import contextlib
import json
import random
import re
import time
from collections.abc import AsyncIterator, Callable
from contextlib import AsyncExitStack, asynccontextmanager
from dataclasses import dataclass

import pytest

from ldcnd.client.rig_client import RigClient
from ldcnd.contract.commands import Halt, Home, MoveAbsolute, MoveVelocity, Power, Reset, SetPosition
from ldcnd.contract.errors import LdcndError, OutcomeUnknown
from ldcnd.contract.meta import BusInfo
from ldcnd.contract.samples import AxisState, LinkState, Moving, PositionSample, Quality, StateSample, TelemetryItem
from ldcnd.contract.traces import TakeTrace
from ldcnd.sim.chain import Chain
from ldcnd.sim.ldcn.drive import SimulatedDrive
from tests.guest.machine import Bench, Guest
from tests.guest.rigs import FAST, STEPS, USB, adapters, on_board
from tests.support.process import client

pytestmark = [pytest.mark.real_time, pytest.mark.guest, pytest.mark.timeout(900)]

SLOW = "[Service]\nTimeoutStartSec=300\nWatchdogSec=20\n"
"""For an emulated processor, which is also given away for seconds where the machine around it is busy."""
UNIT = "ldcnd.service"
ON_BOARD = "ldcnd@uart.service"
UP_S = 120.0
TRIES = 5
START_S = 300.0
"""An emulated processor takes half a minute of its time for the imports alone."""
REST_S = 1.5
COUNTS_PER_MM = 1000
FASTEST_MM_S = 50.0
SEEN_LATE_S = 1.0
POLLED_S = 120.0
UNPLUGS = 20
OPENING = """
import asyncio, sys
from ldcnd.contract.errors import TransportLost
from ldcnd.line.line_discipline import actual_baud
from ldcnd.line.serial_port import SerialSettings, open_serial_port

async def main(path, *bauds):
    try:
        port = await open_serial_port(SerialSettings(path, int(bauds[0])))
    except TransportLost as refused:
        print("refused", refused)
        return
    for baud in bauds[1:]:
        try:
            port.set_baud(int(baud))
        except TransportLost as refused:
            print("refused", refused)
    print("at", actual_baud(port._descriptor), "offers", port.offers(230400))
    await port.close()

asyncio.run(main(*sys.argv[1:]))
"""


@dataclass(frozen=True)
class Service:
    """A running service, and a client of it."""

    guest: Guest
    client: RigClient
    drives: dict[str, SimulatedDrive]

    async def until(self, axis: str, wanted: Callable[[StateSample], bool], within_s: float = UP_S) -> StateSample:
        """Wait for a state; asks again and again, as the connection may be lost meanwhile."""
        state = None
        try:
            async with asyncio.timeout(within_s):
                while True:
                    with contextlib.suppress(LdcndError):
                        state = await self.client.state(axis)
                        if state and wanted(state):
                            return state
                    await asyncio.sleep(0.05)
        except TimeoutError:
            raise AssertionError(f"axis {axis} stays as it is: {state}") from None

    async def up(self) -> None:
        """Wait until every drive answers."""
        for axis in self.drives:
            await self.until(axis, lambda state: state.link is LinkState.UP)

    async def bus(self, name: str) -> BusInfo:
        """Return a line."""
        return next(bus for bus in await self.client.buses() if bus.bus == name)

    async def ready(self, axis: str) -> None:
        """Clear what was before, and make this position 0; on a busy machine an answer may come too late."""
        for left in reversed(range(TRIES)):
            try:
                await self.client.stop(axis)
                await self.until(axis, lambda state: state.moving is Moving.NO)
                await self.client.command(axis, Reset())
                await self.client.command(axis, Power(on=True))
                await self.client.command(axis, SetPosition(position=0.0))
            except OutcomeUnknown:
                if not left:
                    raise
            else:
                return

    async def ended(self, axis: str, command_id: str | None) -> StateSample:
        """Wait for the end of a command."""
        assert command_id
        async with asyncio.timeout(UP_S):
            return await self.client.wait_for_end(axis, command_id)

    async def faults(self, axis: str) -> set[str]:
        """Return what is wrong with an axis now."""
        return {fault.code for fault in (await self.client.faults())[axis].active}

    def counts(self, axis: str) -> float:
        """Return where the shaft truly is."""
        return self.drives[axis].shaft.position_counts

    async def stands(self, *axes: str) -> bool:
        """Tell whether they truly stand."""
        before = [self.counts(axis) for axis in axes]
        await asyncio.sleep(0.5)
        return all(abs(self.counts(axis) - was) < 3 for axis, was in zip(axes, before, strict=True))

    async def outage(self, for_s: float, *, other_name: bool = False) -> None:
        """Pull the adapter of the drives, and push it in again, perhaps as another ttyUSB."""
        await asyncio.to_thread(self.guest.pull, USB)
        if other_name:
            await asyncio.to_thread(self.guest.pull, STEPS)
        await asyncio.sleep(for_s)
        for serial in (STEPS, USB) if other_name else (USB,):
            await asyncio.to_thread(self.guest.push, serial)


def drives_on(chain: Chain, *axes: str) -> dict[str, SimulatedDrive]:
    """Return the drives of a line by the names of their axes."""
    drives = [module for module in chain.modules if isinstance(module, SimulatedDrive)]
    return dict(zip(axes, drives, strict=True))


def start(guest: Guest, unit: str, path: str, config: str) -> None:
    """Start a unit where it does not run already."""
    if guest.run(f"cmp -s - {path}", given=config).returncode:
        guest.write(path, config)
    guest.must(f"systemctl start {unit}", timeout_s=START_S)


async def kill(guest: Guest) -> None:
    """End the daemon as a crash does; systemd starts it again."""
    restarts = int(guest.must(f"systemctl show -P NRestarts {UNIT}"))
    guest.must(f"systemctl kill -s KILL {UNIT}")
    await asyncio.to_thread(guest.until, f"systemctl show -P NRestarts {UNIT}", str(restarts + 1))


@asynccontextmanager
async def connected(port: int) -> AsyncIterator[RigClient]:
    """Use a daemon of the guest, which may take its time to answer."""
    async with AsyncExitStack() as stack:
        for left in reversed(range(TRIES)):
            try:
                rig = await stack.enter_async_context(client(f"tcp/127.0.0.1:{port}"))
            except (LdcndError, IndexError):  # no rig has said that it is there
                if not left:
                    raise
            else:
                break
        yield rig


@asynccontextmanager
async def usb(bench: Bench) -> AsyncIterator[Service]:
    """Use the service on the USB adapters; every drive answers."""
    await asyncio.to_thread(start, bench.guest, UNIT, "/etc/ldcnd/ldcnd.toml", adapters())
    async with connected(bench.guest.ports[7447]) as rig:
        service = Service(bench.guest, rig, drives_on(bench.usb, "x", "y", "z"))
        await service.up()
        yield service


@asynccontextmanager
async def uart(bench: Bench) -> AsyncIterator[Service]:
    """Use the service on the UART on board."""
    await asyncio.to_thread(start, bench.guest, ON_BOARD, "/etc/ldcnd/uart.toml", on_board())
    async with connected(bench.guest.ports[7448]) as rig:
        service = Service(bench.guest, rig, drives_on(bench.uart, "u", "v"))
        await service.up()
        yield service


@pytest.fixture(scope="session", autouse=True)
def opened(bench: Bench) -> None:
    """Let the units serve the host, as the shipped drop-in does for a cell's network."""
    for unit in (UNIT, "ldcnd@.service"):
        folder = f"/etc/systemd/system/{unit}.d"
        bench.guest.must(
            f"mkdir -p {folder} && sed 's|^IPAddressAllow=.*|IPAddressAllow=10.0.2.0/24|'"
            f" /usr/share/doc/ldcnd/examples/lan.conf > {folder}/lan.conf"
        )
        bench.guest.write(f"{folder}/slow.conf", SLOW)
    bench.guest.must("systemctl daemon-reload")


# -- names, permissions, settings ------------------------------------------------------------------------------------


@pytest.mark.parametrize("serial", [USB, FAST, STEPS])
def test_adapters_have_lasting_names_and_hand_over_at_once(bench, serial):
    node = bench.guest.must(f"readlink -f /dev/ldcn-{serial}-00")

    assert re.fullmatch(r"/dev/ttyUSB\d", node)
    assert bench.guest.must(f"stat -c %U:%G:%a {node}") == "root:dialout:660"
    assert bench.guest.must(f"cat /sys/bus/usb-serial/devices/{node[5:]}/latency_timer") == "1"
    assert serial in bench.guest.must("ls /dev/serial/by-id")


def test_the_uart_passes_on_every_byte(bench):
    assert bench.guest.must("cat /sys/class/tty/ttyS1/rx_trig_bytes") == "1"


def test_the_service_user_has_the_ports_and_nobody_else(bench):
    node = bench.guest.must(f"readlink -f /dev/ldcn-{USB}-00")

    assert "dialout" in bench.guest.must("id -nG ldcnd")
    assert bench.guest.run(f"setpriv --reuid=65534 --clear-groups head -c0 {node}").returncode != 0


@pytest.mark.parametrize(
    ("port", "bauds", "says"),
    [
        ("/dev/ttyS1", "19200 115200", "at 115200"),
        ("/dev/ttyS1", "230400", "refused .*instead of 230400 baud, the nearest that it makes: 115200"),
        ("/dev/ttyS1", "115200 19200 230400", "refused .*230400"),
        (f"/dev/ldcn-{FAST}-00", "19200 115200 230400", "at 230400 offers True"),
    ],
)
def test_rates_are_those_that_the_driver_makes(bench, port, bauds, says):
    said = bench.guest.must(f"/opt/ldcnd/bin/python - {port} {bauds}", given=OPENING, timeout_s=START_S)

    assert re.match(says, said), said
    assert "at 230400" not in said or port != "/dev/ttyS1"


# -- work ------------------------------------------------------------------------------------------------------------


async def test_the_unit_as_shipped_serves_all_adapters(bench, found):
    began_s = time.monotonic()
    async with usb(bench) as service:
        found(f"service up on three adapters {time.monotonic() - began_s:.1f} s after its start")
        lines = {bus.bus: bus for bus in await service.client.buses()}

        assert {name: bus.baud for name, bus in lines.items()} == {"usb": 115_200, "fast": 230_400, "steps": 9600}
        for axis in ("s", "feed", "spool"):
            await service.until(axis, lambda state: state.link is LinkState.UP)
        guest = service.guest
        status = f"systemctl show -P StatusText {UNIT}"  # published now and then
        await asyncio.to_thread(guest.until, status, "rig usb: 3/3 buses, 6/6 axes up")
        assert guest.must("stat -c %U:%a /var/lib/ldcnd") == "ldcnd:750"
        shipped = guest.must(f"grep -h ^WatchdogSec /lib/systemd/system/{UNIT}")
        assert (shipped, guest.must(f"systemctl show -P WatchdogUSec {UNIT}")) == ("WatchdogSec=5", "20s")
        pid = guest.must(f"systemctl show -P MainPID {UNIT}")
        assert guest.must(f"ps -o user= -p {pid}") == "ldcnd"


def test_framing_of_a_smartstep_line_is_seven_bits_and_even_parity(bench):
    settings = bench.guest.must(f"stty -a -F /dev/ldcn-{STEPS}-00")

    assert "speed 9600 baud" in settings
    assert {"cs7", "parenb", "-parodd", "-cstopb"} <= set(re.split(r"[\s;]+", settings))


async def test_a_port_in_use_is_refused_to_a_second_daemon(bench):
    async with usb(bench) as service:
        as_the_service = "setpriv --reuid=ldcnd --regid=ldcnd --init-groups /opt/ldcnd/bin/python -"
        said = service.guest.must(f"{as_the_service} /dev/ldcn-{USB}-00 19200", given=OPENING, timeout_s=START_S)

        assert re.match("refused .*fuser", said), said
        assert (await service.bus("usb")).up


@pytest.mark.parametrize(("which", "axis"), [(usb, "x"), (uart, "u")])
async def test_an_axis_moves_and_homes(bench, which, axis):
    async with which(bench) as service:
        await service.ready(axis)
        began = service.counts(axis)
        reply = await service.client.command(axis, MoveAbsolute(position=10.0, velocity=20.0))
        state = await service.ended(axis, reply.command_id)
        moved = service.counts(axis) - began
        reply = await service.client.command(axis, Home())
        homed = await service.ended(axis, reply.command_id)

    assert (state.state, state.last_error) == (AxisState.STANDSTILL, None)
    assert abs(moved - 10 * COUNTS_PER_MM) < 20
    assert (homed.referenced, homed.last_error) == (True, None)


@pytest.mark.parametrize(("which", "axis"), [(usb, "y"), (uart, "u")])
async def test_a_stop_is_obeyed_at_once(bench, found, which, axis):
    async with which(bench) as service:
        await service.ready(axis)
        await service.client.command(axis, MoveVelocity(velocity=20.0))
        await asyncio.sleep(0.5)
        began_s = time.monotonic()
        reply = await service.client.stop(axis)
        took_ms = (time.monotonic() - began_s) * 1000
        await asyncio.sleep(REST_S)

        assert reply.confirmed == (axis,)
        assert await service.stands(axis)
    found(f"stop of {axis} confirmed after {took_ms:.0f} ms")


async def test_breaks_are_survived(bench):
    async with uart(bench) as service:
        before = await service.bus("uart")
        for _ in range(20):
            service.guest.send_break("uart")
            await asyncio.sleep(0.1)
        await asyncio.sleep(2.0)
        after = await service.bus("uart")

        assert after.up
        assert after.losses == before.losses
        assert after.replies > before.replies
        assert after.stray_bytes + after.corrupt_replies > before.stray_bytes + before.corrupt_replies
        await service.up()


async def test_polls_go_on_for_minutes(bench, found):
    async with usb(bench) as on_usb, uart(bench) as on_uart:
        lines = (on_usb, "usb"), (on_usb, "fast"), (on_usb, "steps"), (on_uart, "uart")
        before = [await service.bus(name) for service, name in lines]
        began_s = time.monotonic()
        await asyncio.sleep(POLLED_S)
        took_s = time.monotonic() - began_s
        for (service, name), first in zip(lines, before, strict=True):
            last = await service.bus(name)
            exchanges, replies = last.exchanges - first.exchanges, last.replies - first.replies
            rate = f"{exchanges / took_s:.0f} a second"
            found(f"{name}: {replies} of {exchanges} exchanges answered in {took_s:.0f} s, {rate}")

            assert last.losses == first.losses
            assert exchanges > POLLED_S
            assert replies > 0.98 * exchanges  # late ones on a busy host count as lost


# -- outages ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("other_name", [False, True])
async def test_a_motion_is_halted_when_its_adapter_is_back(bench, found, other_name):
    async with usb(bench) as service:
        await service.ready("x")
        node = service.guest.must(f"readlink /dev/ldcn-{USB}-00")
        await service.client.command("x", MoveAbsolute(position=90.0, velocity=1.5))
        await service.outage(1.0, other_name=other_name)
        began_s = time.monotonic()
        await service.until("x", lambda state: state.link is LinkState.DOWN)
        await service.up()
        found(f"line back {time.monotonic() - began_s:.1f} s after the plug")
        await asyncio.sleep(REST_S)

        assert await service.stands("x")
        assert (await service.client.state("x")).moving is Moving.NO
        assert (await service.bus("usb")).started_by == "adoption"
        assert not (await service.client.state("x")).referenced
        assert (service.guest.must(f"readlink /dev/ldcn-{USB}-00") != node) == other_name
        assert (
            service.guest.must(f"cat /sys/bus/usb-serial/devices/$(readlink /dev/ldcn-{USB}-00)/latency_timer") == "1"
        )


async def test_a_stop_while_the_adapter_is_away_is_carried_out_when_it_is_back(bench):
    async with usb(bench) as service:
        for axis in ("x", "y"):
            await service.ready(axis)
            await service.client.command(axis, MoveVelocity(velocity=3.0))
        await asyncio.to_thread(service.guest.pull, USB)
        await service.until("x", lambda state: state.link is LinkState.DOWN)
        with contextlib.suppress(LdcndError):
            await service.client.stop()
        ran_on = not await service.stands("y")
        await asyncio.to_thread(service.guest.push, USB)
        await service.up()
        await asyncio.sleep(REST_S)

        assert ran_on
        assert await service.stands("x", "y")
        assert [(await service.client.state(axis)).stop_latched for axis in ("x", "y")] == [True, True]


@pytest.mark.parametrize("doing", ["halt", "stop", "home", "trace"])
async def test_the_adapter_is_pulled_in_the_middle(bench, doing):
    async with usb(bench) as service:
        await service.ready("x")
        await service.client.command("x", MoveAbsolute(position=60.0, velocity=40.0))
        await asyncio.sleep(0.5)
        match doing:
            case "halt":
                command = service.client.command("x", Halt())
            case "stop":
                command = service.client.stop("x")
            case "home":
                await service.ready("x")
                command = service.client.command("x", Home())
            case _:
                command = service.client.command("x", TakeTrace(channels=("position",)))
        doing_it = asyncio.ensure_future(command)
        await asyncio.sleep(0.02)
        await service.outage(0.5)
        with contextlib.suppress(LdcndError):
            await doing_it
        await service.up()
        await asyncio.sleep(REST_S)

        assert await service.stands("x")
        await service.ready("x")
        reply = await service.client.command("x", MoveAbsolute(position=1.0))
        assert (await service.ended("x", reply.command_id)).last_error is None


async def test_unplugged_at_random_nothing_is_lost_and_nothing_wrong_is_published(bench, found):
    seed = random.SystemRandom().randrange(1_000_000)
    print(f"seed {seed}")
    dice = random.Random(seed)
    back: list[float] = []
    moving = 0
    async with usb(bench) as service:
        wrong: list[str] = []
        judged = [0]

        async def judge() -> None:
            async with service.client.samples("*", TelemetryItem.POSITION) as samples:
                async for axis, sample in samples:
                    if isinstance(sample, PositionSample) and sample.quality is Quality.GOOD and axis in service.drives:
                        judged[0] += 1
                        true = service.drives[axis].loop.position
                        if abs(sample.counts - true) > FASTEST_MM_S * COUNTS_PER_MM * SEEN_LATE_S:
                            wrong.append(f"{axis}: {sample.counts} is {true}")

        judging = asyncio.create_task(judge(), name="judge")
        for number in range(UNPLUGS):
            what = f"seed {seed}, round {number}"
            for axis in ("x", "y"):
                await service.ready(axis)
                await service.client.command(axis, MoveVelocity(velocity=dice.choice([0.8, 5.0, 10.0])))
            await asyncio.sleep(dice.uniform(0.0, 0.4))
            stops_first = dice.random() < 0.3
            stopping = asyncio.ensure_future(service.client.stop()) if stops_first else None
            await asyncio.sleep(dice.uniform(0.0, 0.02))
            moving += sum(service.drives[axis].shaft.velocity_counts != 0 for axis in ("x", "y"))
            await asyncio.to_thread(service.guest.pull, USB)
            await asyncio.sleep(dice.choice([0.0, dice.uniform(0.1, 1.0)]))
            if stopping is None:
                stopping = asyncio.ensure_future(service.client.stop())
                await asyncio.sleep(dice.uniform(0.0, 0.05))
            await asyncio.to_thread(service.guest.push, USB)
            began_s = time.monotonic()
            with contextlib.suppress(LdcndError):
                await stopping
            await service.up()
            back.append(time.monotonic() - began_s)
            await asyncio.sleep(REST_S)
            assert await service.stands("x", "y"), what
            for axis in ("x", "y"):
                state = await service.client.state(axis)
                assert state.stop_latched, f"{what}, {axis}"
                assert not state.referenced, f"{what}, {axis}"
        judging.cancel()
        assert (wrong, judged[0] > UNPLUGS) == ([], True), f"seed {seed}"
        assert moving > UNPLUGS, f"seed {seed}: hardly anything moved when the plug was pulled"
    found(
        f"{UNPLUGS} unplugs, seed {seed}: {moving} axes moved, back within {max(back):.1f} s,"
        f" {judged[0]} good positions compared"
    )


# -- the daemon ends or hangs ----------------------------------------------------------------------------------------


async def test_a_killed_daemon_is_followed_by_one_that_knows_what_can_be_known(bench, found):
    async with usb(bench) as service:
        await service.ready("x")
        await service.ready("y")
        shaft = service.drives["x"].shaft
        shaft.stalled = True
        try:
            await service.client.command("y", MoveVelocity(velocity=0.8))
            with contextlib.suppress(LdcndError):
                await service.client.command("x", MoveAbsolute(position=40.0, velocity=40.0))
            await service.until("x", lambda state: state.state is AxisState.ERROR_STOP)
            before = await service.faults("x")
            await kill(service.guest)
        finally:
            shaft.stalled = False
    began_s = time.monotonic()
    async with usb(bench) as service:
        found(f"killed daemon back after {time.monotonic() - began_s:.0f} s")
        moving = not await service.stands("y")
        after = await service.faults("x")
        line = await service.bus("usb")
        await service.client.stop()
        await asyncio.sleep(REST_S)

        assert moving
        assert line.started_by == "adoption"
        assert await service.stands("y")
        assert before == {"position_error"}
        assert after == {"latched_fault"}  # never the name of a cause that it does not have
        await service.ready("x")


async def test_a_frozen_daemon_is_ended_by_the_watchdog(bench):
    async with usb(bench) as service:
        await service.ready("y")
        await service.client.command("y", MoveVelocity(velocity=0.8))
        guest = service.guest
        restarts = guest.must(f"systemctl show -P NRestarts {UNIT}")
        guest.must(f"systemctl kill -s STOP --kill-who=main {UNIT}")
        await asyncio.to_thread(guest.until, f"systemctl show -P NRestarts {UNIT}", str(int(restarts) + 1), START_S)
    async with usb(bench) as service:
        assert "Watchdog timeout" in guest.must(f"journalctl -q --no-pager -u {UNIT}")
        assert (await service.bus("usb")).started_by == "adoption"
        await service.client.stop()
        await asyncio.sleep(REST_S)
        assert await service.stands("y")


async def test_a_short_freeze_costs_nothing(bench):
    async with usb(bench) as service:
        guest = service.guest
        pid = guest.must(f"systemctl show -P MainPID {UNIT}")
        losses = (await service.bus("usb")).losses
        guest.must(f"kill -STOP {pid}; sleep 2; kill -CONT {pid}")
        await service.up()

        assert guest.must(f"systemctl show -P MainPID {UNIT}") == pid
        assert (await service.bus("usb")).losses == losses


async def test_reload_applies_a_limit_without_a_restart(bench):
    async with usb(bench) as service:
        guest = service.guest
        pid = guest.must(f"systemctl show -P MainPID {UNIT}")
        await reload(guest, adapters().replace("velocity = 50", "velocity = 45"))
        await service.ready("x")
        with pytest.raises(LdcndError, match="45"):
            await service.client.command("x", MoveAbsolute(position=1.0, velocity=48.0))
        await reload(guest, adapters())

        assert guest.must(f"systemctl show -P MainPID {UNIT}") == pid


async def reload(guest: Guest, config: str) -> None:
    """Have a changed configuration taken; before systemd 253 the unit is told, and its answer is in the journal."""
    reloads = f"journalctl -q -u {UNIT} | grep -c 'configuration reloaded'"
    before = int(guest.run(reloads).stdout)
    guest.write("/etc/ldcnd/ldcnd.toml", config)
    await asyncio.to_thread(guest.must, f"systemctl reload {UNIT}", timeout_s=START_S)
    await asyncio.to_thread(guest.until, reloads, str(before + 1), UP_S)


def test_the_doctor_names_the_driver_and_what_makes_it_slow(bench):
    guest = bench.guest
    guest.must(f"systemctl stop {ON_BOARD}", timeout_s=START_S)
    guest.must("echo 8 > /sys/class/tty/ttyS1/rx_trig_bytes")
    said = guest.run("ldcnd doctor --config /etc/ldcnd/uart.toml --bus uart --json", timeout_s=START_S).stdout
    guest.must("echo 1 > /sys/class/tty/ttyS1/rx_trig_bytes")

    findings = {finding["what"]: finding for finding in map(json.loads, said.splitlines())}
    assert "8250" in findings["adapter"]["text"] or "serial" in findings["adapter"]["text"]
    assert "echo 1 | sudo tee /sys/class/tty/ttyS1/rx_trig_bytes" in findings["FIFO trigger"]["remedy"]
    assert {"drives", "turn-around", "errors"} <= findings.keys()
