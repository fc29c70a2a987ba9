"""frappy's own client, unmodified, with a daemon and a SECoP node in processes of their own."""

import asyncio
import json
import socket
import time
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager, closing, suppress
from pathlib import Path
from typing import Self, TypeVar

import pytest
from frappy.client import SecopClient
from frappy.errors import CommunicationFailedError, ImpossibleError, RangeError

from ldcnd.client.rig import Rig
from ldcnd.contract.commands import MoveVelocity, Power
from ldcnd.contract.samples import Moving, PositionSample
from ldcnd.lab.secop.node import serve
from ldcnd.listen_address import ListenAddress
from tests.support.lost_answers import losing
from tests.support.process import ROOT, answering, client, daemon, free_port, process
from tests.support.rig import RunningRig, running_rig, two_axes

pytestmark = [pytest.mark.edges, pytest.mark.real_time, pytest.mark.timeout(200)]

LONGEST_S = 30.0
DISABLED, IDLE, BUSY, ERROR = 0, 100, 300, 400


@asynccontextmanager
async def node(*options: str) -> AsyncIterator[tuple[str, str]]:
    """Run a daemon and a node; yields the daemon's endpoint, and the node's address."""
    port = free_port()
    async with daemon(ROOT / "config" / "simulated.toml") as endpoint:
        async with process("secop", "x", "y", "-e", endpoint, "--address", f"127.0.0.1:{port}", *options) as running:
            assert running.stdout
            assert b"SECoP modules {x,y}" in await running.stdout.readline()
            yield endpoint, f"tcp://127.0.0.1:{port}"


class Client(SecopClient):
    """A client that is used by a test."""

    def __enter__(self) -> Self:
        self.connect(10)
        return self

    def __exit__(self, *_: object) -> None:
        self.disconnect()

    def until(self, module: str, parameter: str, holds: Callable[[object], bool]) -> object:
        until_s = time.monotonic() + LONGEST_S
        while not holds(value := self.cache[module, parameter].value):
            assert time.monotonic() < until_s, (module, parameter, value)
            time.sleep(0.02)
        return value

    def cleared(self, module: str) -> None:
        """Clear errors; a latch is told before its stop is sent, and until that is over the refusal says to wait."""
        until_s = time.monotonic() + LONGEST_S
        while True:
            try:
                self.execCommand(module, "clear_errors")
            except ImpossibleError as error:
                if "wait" not in str(error) or time.monotonic() > until_s:
                    raise
                time.sleep(0.02)
            else:
                return

    def rests(self, module: str) -> None:
        self.until(module, "status", lambda status: status[0] == IDLE)


async def test_an_axis_is_a_drivable_that_is_sent_stopped_and_reset():
    def use(uri: str, stop: Callable[[], None]) -> None:
        with Client(uri, log=None) as there:
            described = there.modules["x"]
            assert described["properties"]["interface_classes"] == ["Drivable"]
            assert there.modules["x_velocity"]["properties"]["interface_classes"] == ["Readable"]
            assert "communicate" not in {each for module in there.modules.values() for each in module["commands"]}
            there.until("x", "status", lambda status: status[0] == DISABLED)
            there.setParameter("x", "enabled", value=True)
            there.rests("x")
            there.setParameter("x", "target", 3.0)
            assert there.cache["x", "status"].value[0] == BUSY  # before the reply
            there.rests("x")
            assert abs(there.cache["x", "value"].value - 3) < 0.02
            assert abs(there.cache["x", "value"].timestamp - time.time()) < 5
            _, _, (_, qualifiers) = there.request("read", "x:value")
            assert 0.001 <= qualifiers["e"] < 0.1
            with pytest.raises(RangeError):
                there.setParameter("x", "target", 1000.0)
            there.setParameter("x", "speed", 5.0)
            there.setParameter("x", "target", 60.0)
            there.until("x", "value", lambda value: value > 5)
            there.execCommand("x", "stop")
            there.rests("x")
            assert there.cache["x", "value"].value < 55
            assert abs(there.cache["x", "target"].value - there.cache["x", "value"].value) < 0.5
            stop()
            there.until("x", "status", lambda status: status[0] == ERROR and "latched" in status[1])
            with pytest.raises(ImpossibleError, match="latch"):
                there.setParameter("x", "target", 1.0)
            there.cleared("x")
            there.until("x", "status", lambda status: status[0] in (IDLE, DISABLED))
            there.setParameter("x", "enabled", value=True)
            there.execCommand("x", "home")
            there.until("x", "status", lambda status: status[0] == BUSY)
            while "e" in there.request("read", "x:value")[2][1]:  # a search for the reference has no known place
                assert there.cache["x", "status"].value[0] == BUSY
            there.rests("x")
            assert "e" in there.request("read", "x:value")[2][1]

    async with node("--moves") as (endpoint, uri), client(endpoint) as rig:
        loop = asyncio.get_running_loop()
        await asyncio.to_thread(use, uri, lambda: asyncio.run_coroutine_threadsafe(rig.stop("x"), loop).result(10))
        assert (await rig.state("x")).moving is Moving.NO


@pytest.mark.parametrize("command", ["stop", "power off"])
async def test_a_stopped_axis_is_busy_until_it_rests(command: str):
    def use(uri: str, stop: Callable[[], None]) -> tuple[float, float]:
        with Client(uri, log=None) as there:
            there.setParameter("x", "enabled", value=True)
            there.rests("x")
            there.setParameter("x", "speed", 50.0)
            there.setParameter("x", "target", 90.0)
            there.until("x_velocity", "value", lambda value: value > 45)
            stop()
            there.until("x", "status", lambda status: status[0] != BUSY)
            at_end = there.cache["x", "value"].value
            there.until("x_velocity", "value", lambda value: value == 0)
            there.until("x", "status", lambda status: status[0] == (ERROR if command == "stop" else DISABLED))
            return at_end, there.cache["x", "value"].value

    async with node("--moves") as (endpoint, uri), client(endpoint) as rig:
        loop = asyncio.get_running_loop()

        def stop() -> None:
            sent = rig.stop("x") if command == "stop" else rig.command("x", Power(on=False))
            asyncio.run_coroutine_threadsafe(sent, loop).result(10)

        at_end, at_rest = await asyncio.to_thread(use, uri, stop)

    assert abs(at_end - at_rest) < 0.1, (at_end, at_rest)


PREDEFINED = {
    *("value", "status", "target", "pollinterval", "ramp", "setpoint", "mode"),
    *("stop", "reset", "clear_errors", "go", "hold", "shutdown", "communicate"),
}
"""Accessibles that SECoP 1.0 names; names of others begin with an underscore."""
CODES = {0, 100, 200, 300, 400}
"""Status codes of SECoP 1.0 that an axis uses."""


async def test_the_node_keeps_the_rules_of_the_protocol_line_by_line():
    """What is asked here is what "SECoP Specification 1.0" says of messages, errors and descriptions."""

    def use(port: int) -> None:
        def ask(line: str) -> tuple[str, str, object]:
            node.sendall(line.encode() + b"\n")
            while True:  # what is active sends updates in between
                action, _, rest = lines.readline().decode().rstrip("\n").partition(" ")
                if action not in {"update", "error_update"}:
                    specifier, _, data = rest.partition(" ")
                    return action, specifier, json.loads(data) if data[:1] in ("[", "{") else data

        def refused(line: str) -> str:
            action, specifier, report = ask(line)
            asked, name = line.split(" ")[:2]
            assert (action, specifier) == (f"error_{asked}", name), line
            assert isinstance(report, list)
            assert len(report) == 3
            assert isinstance(report[1], str)
            return str(report[0])

        with socket.create_connection(("127.0.0.1", port), 10) as node, node.makefile("rb") as lines:
            node.sendall(b"*IDN?\n")
            assert lines.readline().decode().startswith("ISSE")
            action, specifier, described = ask("describe")
            assert (action, specifier) == ("describing", ".")
            assert isinstance(described, dict)
            assert {"modules", "equipment_id", "description"} <= set(described)
            for name, module in described["modules"].items():
                assert {"accessibles", "description", "interface_classes"} <= set(module), name
                accessibles = module["accessibles"]
                assert {"value", "status"} <= set(accessibles), name
                assert {each for each in accessibles if each[0] != "_"} <= PREDEFINED, name
                for accessible, described_as in accessibles.items():
                    assert {"description", "datainfo"} <= set(described_as), (name, accessible)
                    assert ("readonly" in described_as) is (described_as["datainfo"]["type"] != "command"), accessible
                status = accessibles["status"]["datainfo"]
                assert [status["type"], *(member["type"] for member in status["members"])] == [
                    "tuple",
                    "enum",
                    "string",
                ]
                assert set(status["members"][0]["members"].values()) >= {100, 400}
            x = described["modules"]["x"]["accessibles"]
            assert {"target", "stop"} <= set(x)
            assert x["target"]["datainfo"]["type"] == x["value"]["datainfo"]["type"]
            assert x["target"]["datainfo"]["unit"] == x["value"]["datainfo"]["unit"] == "mm"
            _, _, (value, qualifiers) = ask("read x:value")
            assert isinstance(value, float)
            assert abs(qualifiers["t"] - time.time()) < 5
            _, _, ((code, text), _) = ask("read x:status")
            assert code in CODES
            assert isinstance(text, str)
            action, specifier, (nothing, qualifiers) = ask("ping 17")
            assert (action, specifier, nothing) == ("pong", "17", None)
            assert "t" in qualifiers
            assert refused("read nobody:value") == "NoSuchModule"
            assert refused("read x:nothing") == "NoSuchParameter"
            assert refused("do x:nothing") == "NoSuchCommand"
            assert refused("change x:value 3.0") == "ReadOnly"
            assert refused('change x:target "far"') in ("WrongType", "RangeError")
            assert refused("change x:target 1e6") == "RangeError"
            for value in ("true", "false", "Infinity", "-Infinity", "NaN", "1e999"):
                for parameter in ("target", "_speed"):
                    assert refused(f"change x:{parameter} {value}") == "WrongType", value
            assert ask("activate")[0] == "active"
            assert ask("deactivate")[0] == "inactive"

    port = free_port()
    async with daemon(ROOT / "config" / "simulated.toml") as endpoint:
        async with process("secop", "x", "-e", endpoint, "--address", f"127.0.0.1:{port}", "--moves") as running:
            assert running.stdout
            await running.stdout.readline()
            async with client(endpoint) as rig:
                await rig.command("x", Power(on=True))
                await asyncio.to_thread(use, port)
                assert (await rig.state("x")).moving is Moving.NO


async def test_a_read_only_node_has_readables():
    def use(uri: str) -> None:
        with Client(uri, log=None) as there:
            assert {module["properties"]["interface_classes"][0] for module in there.modules.values()} == {"Readable"}
            there.until("x", "value", lambda value: value is not None)
            assert not any(module["commands"] for module in there.modules.values())

    async with node() as (endpoint, uri), client(endpoint) as rig:
        await rig.command("x", Power(on=True))
        await asyncio.to_thread(use, uri)


async def test_what_is_read_of_a_silent_axis_is_an_error_and_no_value_of_before():
    def follow(there: Client) -> None:
        until_s = time.monotonic() + LONGEST_S
        while there.cache["x", "value"].readerror is None:
            assert time.monotonic() < until_s
            time.sleep(0.1)
        assert isinstance(there.getParameter("x", "value").readerror, CommunicationFailedError)

    config = str(ROOT / "config" / "simulated.toml")
    endpoint, port = f"tcp/127.0.0.1:{free_port()}", free_port()
    async with process("run", "--config", config, "--listen", endpoint) as daemon:
        await answering(daemon, endpoint)
        async with process("secop", "x", "-e", endpoint, "--address", f"127.0.0.1:{port}") as node:
            assert node.stdout
            await node.stdout.readline()
            there = Client(f"tcp://127.0.0.1:{port}", log=None)
            await asyncio.to_thread(there.connect, 10)
            daemon.terminate()
            await daemon.wait()
            await asyncio.to_thread(follow, there)
            await asyncio.to_thread(there.disconnect)


ClientT = TypeVar("ClientT")


async def reconfigured(
    folder: Path,
    begin: Callable[[int], ClientT],
    follow: Callable[[ClientT], None],
    change: tuple[str, str] = ('unit = "mm"', 'unit = "um"'),
) -> PositionSample:
    """Start the daemon again, with another unit say, behind a node that has clients; return where its axis is then.

    Args:
        folder: for the configuration.
        begin: connects a client to a port of this machine, in a thread.
        follow: does what that client does afterwards, likewise.
        change: of the configuration: what stands there, and what instead of it.
    """
    config, port = folder / "rig.toml", free_port()
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    text = (ROOT / "config" / "simulated.toml").read_text()
    config.write_text(text)
    run = ("run", "--config", str(config), "--listen", endpoint)
    async with process(*run) as first:
        await answering(first, endpoint)
        async with process("secop", "x", "-e", endpoint, "--address", f"127.0.0.1:{port}", "--moves") as node:
            assert node.stdout
            assert b"SECoP modules {x}" in await node.stdout.readline()
            there = await asyncio.to_thread(begin, port)
            first.terminate()
            await first.wait()
            config.write_text(text.replace(*change))
            async with process(*run) as second:
                await answering(second, endpoint)
                await asyncio.to_thread(follow, there)
                async with client(endpoint) as rig:
                    return await rig.position("x")


async def test_a_client_that_only_listens_is_told_when_the_node_describes_itself_anew(tmp_path):
    def listens(port: int) -> socket.socket:
        listening = socket.create_connection(("127.0.0.1", port), 10)
        listening.sendall(b"activate\n")
        while b"active\n" not in listening.recv(1 << 20):
            pass
        return listening

    def ends(listening: socket.socket) -> None:
        with listening:
            listening.settimeout(LONGEST_S)
            while listening.recv(1 << 20):
                pass

    await reconfigured(tmp_path, listens, ends)


async def test_a_daemon_with_another_unit_is_described_anew_and_not_moved_by_numbers_of_the_former_one(tmp_path):
    def connected(port: int) -> Client:
        there = Client(f"tcp://127.0.0.1:{port}", log=None)
        there.connect(10)
        return there

    def follow(there: Client) -> None:
        until_s = time.monotonic() + LONGEST_S
        while there.modules["x"]["parameters"]["value"]["datatype"].unit != "um":
            assert time.monotonic() < until_s
            with suppress(Exception):  # while the node is away, and until it is described anew
                there.setParameter("x", "target", 50.0)
            time.sleep(0.2)
        there.until("x", "status", lambda status: "its unit is um now and was mm" in status[1])
        with pytest.raises(ImpossibleError, match="restart its session"):  # of a client that goes on with mm
            there.setParameter("x", "target", 50.0)
        there.execCommand("x", "reset")
        there.until("x", "status", lambda status: status[0] == DISABLED)
        there.disconnect()

    position = await reconfigured(tmp_path, connected, follow)

    assert position.unit == "um"
    assert abs(position.value) < 1


async def test_the_speed_that_a_client_has_set_outlasts_another_limit(tmp_path):
    def connected(port: int) -> Client:
        there = Client(f"tcp://127.0.0.1:{port}", log=None)
        there.connect(10)
        there.setParameter("x", "speed", 2.0)
        return there

    def follow(there: Client) -> None:
        until_s = time.monotonic() + LONGEST_S
        while there.modules["x"]["parameters"]["target"]["datatype"].max != 90:
            assert time.monotonic() < until_s
            time.sleep(0.2)
        assert there.getParameter("x", "speed").value == 2.0
        there.disconnect()

    await reconfigured(tmp_path, connected, follow, ("position_max = 100", "position_max = 90"))


class Raw:
    """A client that sends lines and does not wait."""

    def __init__(self, port: int) -> None:
        self._socket = socket.create_connection(("127.0.0.1", port), 10)
        self._lines = self._socket.makefile("rb")
        self.send("*IDN?")
        self.reply("ISSE")

    def send(self, *lines: str) -> None:
        self._socket.sendall("".join(f"{line}\n" for line in lines).encode())

    def reply(self, *starts: str) -> str:
        """Return the next line that begins so."""
        while not (line := self._lines.readline().decode()).startswith(starts):
            assert line, "the connection has ended"
        return line

    def close(self) -> None:
        self._lines.close()
        self._socket.close()


@asynccontextmanager
async def node_here() -> AsyncIterator[tuple[RunningRig, int]]:
    """Run a daemon and a node in this process, with both axes enabled."""
    port, ready = free_port(), asyncio.Event()
    async with running_rig(two_axes()) as running, asyncio.TaskGroup() as group:
        rig = Rig(running.client, await running.client.daemon())
        node = group.create_task(serve(rig, ListenAddress("127.0.0.1", port), (), ("x", "y"), ready))
        await ready.wait()
        await running.power_on("x", "y")
        try:
            yield running, port
        finally:
            node.cancel()


@pytest.mark.parametrize("whose", ["own", "another's"])
@pytest.mark.parametrize("ending", ["do x:stop", "change x:_enabled false", "do y:stop"])
async def test_what_takes_energy_out_waits_for_no_request_that_has_no_answer(whose: str, ending: str):
    """A lost answer to a move holds a request up for seconds."""
    async with node_here() as (running, port):
        one = await asyncio.to_thread(Raw, port)
        other = one if whose == "own" else await asyncio.to_thread(Raw, port)
        with closing(one), closing(other), losing(running.session, answers={"move_absolute"}):
            await running.client.command("y", MoveVelocity(velocity=1.0))
            await asyncio.to_thread(one.send, "change x:target 90")
            moved = await running.until("x", lambda state: state.moving is Moving.YES)
            before_s = time.monotonic()
            await asyncio.to_thread(other.send, ending, "ping")
            replied = await asyncio.to_thread(other.reply, "done ", "changed x:_enabled")
            took_s = time.monotonic() - before_s
            axis = ending[ending.index(" ") + 1]
            await running.until(axis, lambda state: state.has_ended)
            await asyncio.to_thread(one.reply, "changed x:target", "error_change x:target")

        assert moved.enabled
        assert ending.split()[1] in replied
        assert took_s < 3


@pytest.mark.parametrize("asked", ["change x:target 80", "do x:_home", "do x:clear_errors", "change x:_enabled true"])
async def test_nothing_begins_behind_a_stop_that_was_read_after_it(asked: str):
    async with node_here() as (running, port):
        one = await asyncio.to_thread(Raw, port)
        with closing(one):
            with losing(running.session, answers={"move_absolute"}):
                await asyncio.to_thread(one.send, "change x:target 90")
                await running.until("x", lambda state: state.moving is Moving.YES)
                await asyncio.to_thread(one.send, asked, "do x:stop")
                first = await asyncio.to_thread(one.reply, "changed x:target", "error_change x:target")
                refused = await asyncio.to_thread(one.reply, "done ", "error_", "changed")
                await running.until("x", lambda state: state.has_ended)
            await asyncio.to_thread(one.send, "change x:target 2")
            moved = await asyncio.to_thread(one.reply, "changed x:target", "error_change x:target")

        assert "no answer" in first
        assert refused.startswith("error_")
        assert "stopped before it began" in refused
        assert moved.startswith("changed")
