"""Which rigs the console shows, and what it says of those that are away."""

import asyncio
import contextlib
from contextlib import asynccontextmanager

import pytest

from ldcnd.console.latest_values import LatestValues
from ldcnd.console.rig_watch import RigWatch
from ldcnd.console.rigs import MOST_RIGS, Endpoint, Rigs
from ldcnd.contract.codec import Encoding, encode
from ldcnd.contract.errors import UnknownAxis
from ldcnd.contract.health import CertificateHealth, DaemonHealth
from ldcnd.contract.keys import Keys
from ldcnd.contract.meta import DaemonInfo
from ldcnd.net.session import Qos
from ldcnd.net.zenoh_settings import ZenohSettings
from ldcnd.testing.memory_session import MemoryBroker

DAY_NS = 86_400 * 10**9
HERE, THERE = Endpoint("here", ZenohSettings()), Endpoint("there", ZenohSettings())


class Site:
    """Two networks with daemons, and a console that looks at them."""

    def __init__(self, rigs):
        self.rigs = rigs
        self.brokers = {HERE.name: MemoryBroker(), THERE.name: MemoryBroker()}

    @asynccontextmanager
    async def daemon(self, rig, instance="i1", endpoint=HERE, *, mute=False):
        """Run what looks like a daemon; a mute one shows its token and answers nothing."""
        keys = Keys(rig)
        info = DaemonInfo(
            rig=rig, version="1", api=1, instance=instance, started=1, encoding="msgpack", axes=(), buses=()
        )  # fmt: skip
        async with self.brokers[endpoint.name].session() as session:
            await session.declare_token(keys.alive(instance))
            if not mute:
                await session.serve(keys.daemon, lambda query: query.reply(*encode(info, Encoding.JSON)), complete=True)
            yield session

    async def shown(self, rig, *, connected):
        """Wait until a rig is shown so."""
        async with asyncio.timeout(30):
            while True:
                for reply in await self.rigs.described():
                    if (reply.name, reply.connected) == (rig, connected):
                        return reply
                await asyncio.sleep(0.05)

    async def problem(self):
        """Wait until an endpoint has a problem."""
        async with asyncio.timeout(30):
            while not (problems := [each.problem for each in self.rigs.endpoints if each.problem]):
                await asyncio.sleep(0.05)
        return problems[0]


@asynccontextmanager
async def watching(*wanted):
    rigs = Rigs(LatestValues(), wanted)
    async with asyncio.TaskGroup() as group:
        site = Site(rigs)
        async with site.brokers["here"].session() as here, site.brokers["there"].session() as there:
            tasks = [group.create_task(rigs.watch(s, e), name=e.name) for s, e in ((here, HERE), (there, THERE))]
            yield site
            for task in tasks:
                task.cancel()


async def test_a_rig_appears_with_its_daemon_and_stays_listed_without_it():
    async with watching() as site:
        async with site.daemon("sim"):
            there = await site.shown("sim", connected=True)
        away = await site.shown("sim", connected=False)

    assert (there.problem, there.daemon.instance) == (None, "i1")
    assert "daemon offline" in away.problem
    assert away.daemon.instance == "i1"


async def test_another_run_of_the_daemon_is_told_apart():
    async with watching() as site:
        async with site.daemon("sim", "i1"):
            await site.shown("sim", connected=True)
        async with site.daemon("sim", "i2"):
            await site.shown("sim", connected=True)
            async with asyncio.timeout(30):
                while site.rigs.instance("sim") != "i2":
                    await asyncio.sleep(0.05)


async def test_two_daemons_of_one_rig_are_a_problem_until_one_goes():
    async with watching() as site, site.daemon("sim", "i1"):
        await site.shown("sim", connected=True)
        async with site.daemon("sim", "i2"):
            async with asyncio.timeout(30):
                while "two daemons" not in ((await site.shown("sim", connected=True)).problem or ""):
                    await asyncio.sleep(0.05)
        async with asyncio.timeout(30):
            while (await site.shown("sim", connected=True)).problem:
                await asyncio.sleep(0.05)


async def test_what_is_to_be_seen_to_of_a_daemon_is_told_until_it_is_done():
    ends = CertificateHealth(name="bench", ends=5 * DAY_NS)
    report = DaemonHealth(t=0, seq=0, loop_lag_s=0, published=0, missed_reports=0, certificate=ends)
    full = report.model_copy(update={"not_kept": ("latches.json: No space left on device",), "certificate": None})
    told = []
    async with watching() as site, site.daemon("sim") as session:
        await site.shown("sim", connected=True)
        for health in (report, full, report.model_copy(update={"certificate": None})):
            payload, encoding = encode(health, Encoding.MSGPACK)
            session.publish(Keys("sim").health, payload, encoding=encoding, qos=Qos.EVENT)
            await asyncio.sleep(1)
            told.append((await site.shown("sim", connected=True)).attention)

    assert "certificate of bench ends on 1970-01-06" in told[0]
    assert "latches.json" in told[1]
    assert told[2] == ""


async def test_a_daemon_that_does_not_answer_is_asked_again_until_it_does():
    async with watching() as site, site.daemon("sim", mute=True) as session:
        async with asyncio.timeout(30):
            while not (await site.shown("sim", connected=False)).problem.startswith("no daemon serves"):
                await asyncio.sleep(0.05)
        info = DaemonInfo(
            rig="sim", version="1", api=1, instance="i1", started=1, encoding="json", axes=(), buses=()
        )  # fmt: skip
        await session.serve(Keys("sim").daemon, lambda query: query.reply(*encode(info, Encoding.JSON)), complete=True)

        assert (await site.shown("sim", connected=True)).problem is None


async def test_a_namesake_behind_another_endpoint_is_never_mixed_up_with_the_rig():
    async with watching() as site, site.daemon("sim", "real"):
        await site.shown("sim", connected=True)
        async with site.daemon("sim", "namesake", THERE):
            problem = await site.problem()
            shown = await site.shown("sim", connected=True)

    assert "shown as here has it" in problem
    assert (shown.endpoint, shown.daemon.instance) == ("here", "real")


async def test_only_wanted_rigs_are_shown_and_those_even_before_they_come():
    async with watching("sim", "later") as site, site.daemon("sim"), site.daemon("other"):
        await site.shown("sim", connected=True)
        described = await site.rigs.described()

    assert [(rig.name, rig.connected) for rig in described] == [("later", False), ("sim", True)]
    assert described[0].problem == "it was not seen yet"
    with pytest.raises(UnknownAxis, match="no rig other"):
        site.rigs.client("other")


async def test_more_rigs_than_anybody_has_are_left_out_and_that_is_told():
    async with watching() as site, site.brokers["here"].session() as session:
        for number in range(MOST_RIGS + 1):
            await session.declare_token(Keys(f"rig{number}").alive("i1"))

        assert f"rig{MOST_RIGS} is left out" in await site.problem()
        assert len(site.rigs.names) == MOST_RIGS


async def test_what_forbids_the_commands_of_an_axis_is_asked_now_and_then_whatever_another_axis_does():
    """A door that is shut changes no state of its axis; what an axis under way does keeps nothing from being asked."""
    asked = []

    class Client:
        rig, keys = "sim", Keys("sim")

        def watch_rivals(self, _stirred):
            """No other daemon."""

        async def ask(self, _command, axis):
            asked.append(axis)
            raise UnknownAxis("not asked here")

    class Watch(RigWatch):
        axes, connected = frozenset({"x", "y"}), True

        async def _watch(self):
            while True:
                self.want_why("x")
                await asyncio.sleep(0.5)

    values = LatestValues()
    values.watchers.append(lambda *_: None)
    with contextlib.suppress(TimeoutError):
        async with asyncio.timeout(21.0):
            await Watch(Client(), "here", values).run()

    assert asked.count("y") >= 3
    assert asked.count("x") > 20
