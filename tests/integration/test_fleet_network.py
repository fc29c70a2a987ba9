"""A site of three hosts and two routers, each in a network namespace of its own, with mutual TLS on every link.

    mill - gate1 - gate2 - lathe
                     \
                      desk

The tests are a console at the second router, through its Unix socket; people sit at the desk.
"""

import asyncio
import datetime as dt
import json
import subprocess
from asyncio.subprocess import PIPE, STDOUT
from collections.abc import AsyncIterator, Awaitable, Callable, Iterator, Mapping
from contextlib import ExitStack, asynccontextmanager
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType
from typing import TypeVar

import pytest

from ldcnd.client.events import Events, follow_events
from ldcnd.client.fleet import RigReport, survey
from ldcnd.client.lease import control
from ldcnd.client.rig_client import RigClient, Samples
from ldcnd.contract.commands import CommandReply, MoveRelative, MoveVelocity, Power, Reset, Role
from ldcnd.contract.errors import LeaseExpired, OutcomeUnknown, SessionError
from ldcnd.contract.events import CommandStatus
from ldcnd.contract.samples import AxisState, PositionSample, StateSample
from ldcnd.contract.troubles import SOON_DAYS
from ldcnd.net.session import Session
from ldcnd.net.zenoh_session import open_zenoh_session
from ldcnd.net.zenoh_settings import ZenohSettings
from ldcnd.ops.pki.site import Site, new_login, set_up
from tests.support.network import Network, NoNamespaces, router_config, router_words
from tests.support.process import LDCND
from tests.support.rig import SIMULATED

pytestmark = [pytest.mark.system, pytest.mark.real_time, pytest.mark.timeout(240)]

NOW = dt.datetime.now(dt.UTC)
LINKS = (("mill", "gate1"), ("gate1", "gate2"), ("lathe", "gate2"), ("desk", "gate2"))
PORT = 7447
WITHIN_S = 60.0
"""For everything that happens by itself: links end after their lease of 2 s and are looked for each second."""
LASTS_DAYS = 3 * SOON_DAYS
"""How long logins last: the end of a certificate that ends soon is reported, and no rig is well."""
MOVES = 8
STEP = 0.5
ALL_AXES = ["x", "y", "z", "c"]
NOTHING: Mapping[str, object] = MappingProxyType({})

AnswerT = TypeVar("AnswerT")
Process = subprocess.Popen[bytes]


@dataclass
class SiteNetwork:
    """The running site.

    Attributes:
        running: daemons by their rig, routers by their name.
    """

    network: Network
    folder: Path
    stack: ExitStack
    running: dict[str, Process] = field(default_factory=dict)

    @property
    def console(self) -> Path:
        """Where the operator of the second router connects."""
        return self.folder / "console.sock"

    def endpoint(self, host: str, seen_from: str) -> str:
        """Return where a host is found."""
        return f"tls/{self.network.address[host, seen_from]}:{PORT}"

    def start_daemon(self, rig: str, host: str, gate: str, port: int = PORT) -> None:
        """Serve a rig on a host, behind a router, with the host's login."""
        file = self.folder / f"{rig}.toml"
        zenoh = f'connect = ["{self.endpoint(gate, host)}"]\nconfig_file = "{host}.json5"'
        text = SIMULATED.read_text().replace('rig = "sim"', f'rig = "{rig}"')
        file.write_text(text.replace('listen = ["tcp/127.0.0.1:7447"]', zenoh))
        self._start(rig, host, (*LDCND, "run", "--config", str(file), "--listen", f"tls/127.0.0.1:{port}"))

    def start_router(self, name: str) -> None:
        """Run a router."""
        self._start(name, name, router_words(self.folder / f"running-{name}.json5"))

    def kill(self, name: str) -> None:
        """Kill a daemon or a router."""
        self.running[name].kill()
        self.running[name].wait()

    def _start(self, name: str, host: str, words: tuple[str, ...]) -> None:
        log = self.folder / f"{name}.log"
        self.running[name] = self.stack.enter_context(self.network.running(host, words, log))


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Iterator[SiteNetwork]:
    network = Network()
    with ExitStack() as stack:
        stack.callback(network.remove)
        try:
            for host in dict.fromkeys(host for link in LINKS for host in link):
                network.add_host(host)
            for one, other in LINKS:
                network.add_link(one, other)
        except NoNamespaces as error:
            pytest.skip(f"{error}; this test needs root, CAP_NET_ADMIN and iproute2")
        site = SiteNetwork(network, tmp_path_factory.mktemp("site"), stack)
        make_logins(set_up(site.folder, "test site", NOW), network)
        gate2 = [site.endpoint("gate2", other) for other in ("gate1", "lathe", "desk")]
        router_config(site.folder / "gate2.json5", gate2, (), site.console)
        router_config(site.folder / "gate1.json5", [site.endpoint("gate1", "mill")], gate2[:1], None)
        site.start_router("gate2")
        site.start_router("gate1")
        site.start_daemon("mill", "mill", "gate1")
        site.start_daemon("lathe", "lathe", "gate2")
        yield site


def make_logins(site: Site, network: Network) -> None:
    for host, role in (
        ("mill", Role.DAEMON),
        ("lathe", Role.DAEMON),
        ("gate1", Role.ROUTER),
        ("gate2", Role.ROUTER),
    ):
        addresses = tuple(address for (here, _), address in network.address.items() if here == host)
        site.add(new_login(host, role, (*addresses, "127.0.0.1")), NOW, LASTS_DAYS)
    site.add(new_login("vic", Role.VIEWER, ()), NOW, LASTS_DAYS)
    site.add(new_login("ada", Role.OPERATOR, ()), NOW, LASTS_DAYS)


@asynccontextmanager
async def console(site: SiteNetwork) -> AsyncIterator[Session]:
    """Connect to the second router as its operator."""
    endpoint = f"unixsock-stream/{site.console}"

    async def there() -> bool:
        return site.console.exists()

    await until(there, site)
    async with open_zenoh_session(ZenohSettings(mode="client", connect=(endpoint,))) as session:
        yield session


async def until(ready: Callable[[], Awaitable[bool]], site: SiteNetwork, seen: Mapping[str, object] = NOTHING) -> None:
    """Look again until it is so; says what was seen, and what all programs have said, when it never is."""
    try:
        async with asyncio.timeout(WITHIN_S):
            while not await ready():
                await asyncio.sleep(0.1)  # nobody tells what other hosts have come to know
    except TimeoutError:
        said = "\n".join(f"{log.name}: {log.read_text()[-1500:]}" for log in site.folder.glob("*.log"))
        pytest.fail(f"not within {WITHIN_S} s: {dict(seen)}\n{said}")


async def well(session: Session, site: SiteNetwork, *rigs: str) -> dict[str, RigReport]:
    """Wait until exactly these rigs are seen, with nothing wrong and a report of how they are."""
    found: dict[str, RigReport] = {}

    async def ready() -> bool:
        views = await survey(session)
        found.clear()
        found.update({view.rig: view for view in views})
        complete = all([axis.info.axis for axis in view.axes if axis.state] == ALL_AXES for view in views)
        complete = complete and all(view.health for view in views)
        return [view.rig for view in views] == sorted(rigs) and complete and not any(view.problems for view in views)

    await until(ready, site, found)
    return found


async def insist(ask: Callable[[], Awaitable[AnswerT]]) -> AnswerT:
    """Ask until there is an answer: what a careful client does while the way is broken."""
    async with asyncio.timeout(WITHIN_S):
        while True:
            try:
                return await ask()
            except (OutcomeUnknown, SessionError):
                await asyncio.sleep(0.05)  # the way is broken


async def ready(client: RigClient) -> float:
    """Clear the latch of x, close its loop, and return where it stands."""
    await insist(lambda: client.command("x", Reset()))
    await insist(lambda: client.command("x", Power(on=True)))
    async with asyncio.timeout(WITHIN_S), client.samples("x", "*") as samples:
        standing = False
        async for _, sample in samples:
            standing |= isinstance(sample, StateSample) and sample.state is AxisState.STANDSTILL
            if standing and isinstance(sample, PositionSample):
                return sample.value
    raise AssertionError


async def next_position(positions: Samples, after_seq: int) -> PositionSample:
    async with asyncio.timeout(WITHIN_S):
        while True:
            _, sample = await anext(positions)
            assert isinstance(sample, PositionSample)
            if sample.seq > after_seq:
                return sample


async def at_the_desk(site: SiteNetwork, who: str, *words: str) -> tuple[int | None, str]:
    """Run a command of somebody who sits at the desk; return its exit code and what it printed."""
    login = ("--config", str(site.folder / f"{who}.json5"), "--connect", site.endpoint("gate2", "desk"))
    process = await asyncio.create_subprocess_exec(
        *site.network.command("desk", *LDCND, *words, *login), stdout=PIPE, stderr=STDOUT
    )
    async with asyncio.timeout(WITHIN_S):
        printed, _ = await process.communicate()
    return process.returncode, printed.decode()


async def test_the_whole_fleet_is_seen_across_routers(site: SiteNetwork) -> None:
    async with console(site) as session:
        await well(session, site, "mill", "lathe")

        code, printed = await at_the_desk(site, "vic", "fleet", "--json")

    assert code == 0, printed
    rigs = [json.loads(line) for line in printed.splitlines()]
    assert [rig["rig"] for rig in rigs] == ["lathe", "mill"]
    assert [[axis["info"]["axis"] for axis in rig["axes"]] for rig in rigs] == [ALL_AXES] * 2
    assert all(rig["daemon"]["version"] and rig["health"] for rig in rigs)


async def test_roles_hold_across_routers(site: SiteNetwork) -> None:
    async with console(site) as session:
        await well(session, site, "mill", "lathe")
        client = RigClient(session, "mill")
        await ready(client)

        off = ("power", "off", "x", "--rig", "mill")
        refused, why = await at_the_desk(site, "vic", *off)
        untouched = await client.state("x")
        done, printed = await at_the_desk(site, "ada", *off)
        opened = await client.state("x")
        stopped, told = await at_the_desk(site, "vic", "stop", "x", "--rig", "mill")
        latched = await client.state("x")
        await client.command("x", Reset())  # the tests that follow find the fleet well

    assert untouched
    assert opened
    assert latched
    assert (refused != 0, untouched.enabled) == (True, True), why
    assert "not permitted to command" in why
    assert (done, opened.enabled) == (0, False), printed
    assert (stopped, latched.stop_latched) == (0, True), told


async def test_a_cut_link_ends_a_lease_and_what_happened_meanwhile_is_told_afterwards(site: SiteNetwork) -> None:
    async with console(site) as session:
        await well(session, site, "mill", "lathe")
        client = RigClient(session, "mill")
        await ready(client)
        async with follow_events(client, "x") as events:
            async with control(client, "console", "x", lease_s=1.0) as held:
                jog = MoveVelocity(velocity=2.0, command_id="jog")
                await held.command("x", jog)
                site.network.cut("gate1", "gate2")
                try:
                    await well(session, site, "lathe")
                finally:
                    site.network.restore("gate1", "gate2")
                await well(session, site, "mill", "lathe")
                again = MoveVelocity(velocity=2.0)
                with pytest.raises(LeaseExpired):
                    await insist(lambda: held.command("x", again))
            state = await client.state("x")
            told = await events_of(events, "jog", CommandStatus.ABORTED)

    assert state
    assert state.state is AxisState.STANDSTILL
    assert told == [CommandStatus.ACCEPTED, CommandStatus.EXECUTING, CommandStatus.ABORTED]
    assert (events.lost, events.restarts) == (0, 0)


async def events_of(events: Events, command_id: str, last: CommandStatus) -> list[CommandStatus]:
    """Return what became of a command, up to a status."""
    told: list[CommandStatus] = []
    async with asyncio.timeout(WITHIN_S):
        while last not in told:
            event = await anext(events)
            told += [event.status] if event.command_id == command_id else []
    return told


async def test_a_router_killed_under_load_costs_no_event_and_repeats_no_move(site: SiteNetwork) -> None:
    async with console(site) as session:
        await well(session, site, "mill", "lathe")
        client = RigClient(session, "mill")
        run = (await client.daemon()).instance
        began = await ready(client)

        async def moved(number: int) -> CommandReply:
            request = MoveRelative(distance=STEP, command_id=f"load-{run}-{number}", instance=run)
            reply = await insist(lambda: client.command("x", request, timeout_s=0.5))
            await insist(lambda: client.wait_for_end("x", reply.command_id))
            return reply

        async def all_moves() -> list[CommandReply]:
            return [await moved(number) for number in range(MOVES)]

        async with (
            follow_events(client, "x") as events,
            client.samples("x", "position") as positions,
            asyncio.TaskGroup() as group,
        ):
            before = await next_position(positions, 0)
            moves = group.create_task(all_moves(), name="moves")
            await next_position(positions, before.seq + 2)
            site.kill("gate1")
            assert not moves.done()
            site.start_router("gate1")
            await next_position(positions, before.seq + 20)
            replies = await moves
            async with client.samples("x", "position") as fresh:
                reached = await next_position(fresh, before.seq + 20)
            told: dict[str, list[CommandStatus]] = {reply.command_id: [] for reply in replies}
            async with asyncio.timeout(WITHIN_S):
                while CommandStatus.DONE not in told[replies[-1].command_id]:
                    event = await anext(events)
                    told.get(event.command_id, []).append(event.status)

    # a move that has ended before its drive's acknowledgement was looked at is done at once
    once = (
        [CommandStatus.ACCEPTED, CommandStatus.EXECUTING, CommandStatus.DONE],
        [CommandStatus.ACCEPTED, CommandStatus.DONE],
    )
    assert all(statuses in once for statuses in told.values()), told
    assert (events.lost, events.restarts) == (0, 0)
    assert reached.value == pytest.approx(began + STEP * MOVES, abs=0.05)


async def test_a_rig_that_moves_to_another_host_keeps_its_keys(site: SiteNetwork) -> None:
    async with console(site) as session:
        before = (await well(session, site, "mill", "lathe"))["lathe"]
        client = RigClient(session, "lathe")
        async with client.samples("x", "position") as positions:
            await next_position(positions, 0)
            site.kill("lathe")  # its host has died
            await well(session, site, "mill")
            site.start_daemon("lathe", "mill", "gate1", port=PORT + 1)
            after = (await well(session, site, "mill", "lathe"))["lathe"]
            async with asyncio.timeout(WITHIN_S):
                while (await anext(positions))[1].t < after.daemon.started:
                    pass
        await ready(client)

    assert after.instance != before.instance
    assert [axis.info for axis in after.axes] == [axis.info for axis in before.axes]
