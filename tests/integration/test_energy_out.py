"""What takes energy out passes every gate: a table of gates, for each of its verbs, judged by the shaft."""

import asyncio
import contextlib
import json
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from typing import NoReturn

import pytest

from ldcnd.client.lease import control
from ldcnd.contract.commands import (
    Halt,
    MoveAbsolute,
    MoveVelocity,
    Power,
    QuickStop,
    Reset,
    SetGains,
    SetPosition,
    Stop,
)
from ldcnd.contract.errors import CommandIdReused, LeaseExpired, OutcomeUnknown, TransportLost
from ldcnd.contract.keys import RIG_ITSELF, Keys
from ldcnd.contract.leases import Acquire, Release
from ldcnd.contract.rig_commands import SetSpeedOverride
from ldcnd.contract.samples import LinkState
from ldcnd.daemon.assembly import build_daemon
from ldcnd.daemon.ledger import Ledger
from ldcnd.daemon.requests import PENDING_REQUESTS
from ldcnd.drives.ldcn.registers import RESET_BAUD
from ldcnd.sim.chain import Chain
from ldcnd.sim.faults import FaultInjector, FaultKind, FaultPlan, LineFault
from ldcnd.sim.line import open_simulated_line
from tests.integration.test_kept_references import chain_of
from tests.support.chain_rig import ChainRig, drive, rig_on, simulated_config
from tests.support.rig import EPOCH_NS

pytestmark = pytest.mark.promise("energy-out-always-sent")
KEYS = Keys("sim")
VERBS = ("halt", "stop", "quick_stop", "power", "@stop")
AT_ZERO = "set_speed_override"
OFF = {"power": {"on": False}, AT_ZERO: {"percent": 0}}
"""What a verb needs in its request to take energy out; nothing for the others."""
CRAWL = 40
"""Counts that a closed loop at rest goes in 0.2 s; the motions here are of 5000 counts/s."""


def now_ns() -> int:
    return EPOCH_NS + round(asyncio.get_running_loop().time() * 1e9)


@asynccontextmanager
async def leased_rig(**axes: object) -> AsyncIterator[tuple[ChainRig, Chain, str]]:
    """Run a rig whose x is under the lease of ann."""
    chain = chain_of()
    settings = simulated_config(axes).model_copy(update={"authority": "leased"})
    async with rig_on(chain, settings) as rig:
        await rig.until("x", lambda state: state.link is LinkState.UP)
        lease = await rig.client.ask(Acquire(client="ann", axes=("x",), lease_s=60.0))
        yield rig, chain, lease.lease


async def run(rig: ChainRig, lease: str) -> None:
    """Let x run, whatever was done to it before."""
    await rig.until("x", lambda state: state.moving == "no" and not state.stop_pending)
    if (await rig.client.state("x")).speed_override < 100.0:
        others = await rig.client.ask(Acquire(client="ann", axes=("y", "z", "c"), lease_s=5.0))
        await rig.client.ask(SetSpeedOverride(percent=100.0, leases=(lease, others.lease)))
        await rig.client.ask(Release(lease=others.lease))
    for command in (Reset(lease=lease), Power(on=True, lease=lease), MoveVelocity(velocity=5.0, lease=lease)):
        await rig.client.command("x", command)
    await asyncio.sleep(0.3)


async def ask(rig: ChainRig, verb: str, payload: bytes | dict[str, object]) -> tuple[str | None, str]:
    """Send bytes to a verb of x; return the code and the message of the error, None and nothing without one."""
    key = KEYS.stop("x") if verb == "@stop" else KEYS.command(RIG_ITSELF if verb == AT_ZERO else "x", verb)
    data = payload if isinstance(payload, bytes) else json.dumps(payload).encode()
    (answer,) = await rig.session.query(key, data, encoding="application/json", timeout_s=5.0)
    error = json.loads(answer.payload) if answer.is_error else {}
    return error.get("code"), error.get("message", "")


async def rests(chain: Chain, verb: str) -> bool:
    """Tell whether the shaft does what a verb means soon: stands, or has no voltage."""
    await asyncio.sleep(0.5)
    one = drive(chain, 1)
    if verb == "power":
        return not one.loop.servo_on
    before = one.shaft.position_counts
    await asyncio.sleep(0.2)
    return abs(drive(chain, 1).shaft.position_counts - before) < CRAWL


NO_GATE = {
    "no lease": {},
    "a lease that never was": {"lease": "none"},
    "another's client name": {"client": "ann"},
    "an old sequence": {"lease": "LEASE", "sequence": 0},
    "another run of the daemon": {"instance": "another"},
    "a deadline that has passed": {"not_after": 1},
    "stops of another number": {"after_stops": 99},
    "the id of another command": {"command_id": "taken"},
}
"""Fields that would have another command refused; what takes energy out is carried out and says nothing about them."""
FLAWS: dict[str, object] = {
    "another field": {"speed": 3},
    "a number for a text": {"client": 7},
    "an empty id": {"command_id": ""},
    "a negative deadline": {"not_after": -5},
    "a control character": {"client": "a\u0007b"},
    "a long name": {"client": "a" * 65},
    "a long payload": {"client": "a" * 20_000},
    "a payload that is cut short": b'{"on": false, "client": "an',
    "a number that no field takes": b'{"on": false, "sequence": NaN}',
}
NONSENSE = {"no object": b"[1]", "no text": b"\xff\xfe", "words": b"now!", "null": b"null"}


@pytest.mark.parametrize("verb", VERBS)
@pytest.mark.sweep(3)
async def test_what_would_have_another_command_refused_has_no_say(verb):
    async with leased_rig() as (rig, chain, lease):
        await rig.client.command("x", SetGains(kp=300, lease=lease, sequence=5, command_id="taken"))
        for name, fields in NO_GATE.items():
            await run(rig, lease)
            payload = {key: lease if value == "LEASE" else value for key, value in fields.items()}
            answer = await ask(rig, verb, payload | ({"on": False} if verb == "power" else {}))
            assert await rests(chain, verb), name
            assert answer == (None, ""), name


@pytest.mark.parametrize("verb", VERBS)
@pytest.mark.sweep(5)
async def test_what_is_wrong_with_a_request_is_told_after_it_was_carried_out(verb):
    async with leased_rig() as (rig, chain, lease):
        flaws = FLAWS | (NONSENSE if verb != "power" else {"a word": {"on": "off"}, "a number": {"on": 0}})
        for name, fields in flaws.items():
            await run(rig, lease)
            answer = await ask(
                rig, verb, {"on": False} | fields if isinstance(fields, dict) and verb == "power" else fields
            )
            assert await rests(chain, verb), name
            if verb == "@stop":
                assert answer == (None, ""), name
            else:
                assert answer[0] in ("malformed_request", "payload_too_large"), name
                assert f"axis x: {verb} was carried out, but" in answer[1], name


FLAWED_ZEROS = (
    {"percent": 0, "speed": 3}, {"percent": 0.0, "client": 7}, {"percent": 0, "leases": "abc"},
    {"percent": 0, "client": "a" * 20_000}, b'{"percent": 0, "client": "an', {"percent": "0"}, {"percent": False},
)  # fmt: skip


async def test_what_is_wrong_with_a_speed_override_of_0_is_told_after_it_was_carried_out():
    async with leased_rig() as (rig, chain, lease):
        for payload in FLAWED_ZEROS:
            await run(rig, lease)
            code, message = await ask(rig, AT_ZERO, payload)
            assert await rests(chain, AT_ZERO), payload
            assert code in ("malformed_request", "payload_too_large"), payload
            assert message.startswith(f"{AT_ZERO} was carried out, but"), payload
        await run(rig, lease)
        for payload in ({"percent": 0.5, "speed": 3}, {"percent": 10, "client": "percent 0", "speed": 3}, {"speed": 0}):
            code, message = await ask(rig, AT_ZERO, payload)
            assert (code, "carried out" in message) == ("malformed_request", False), payload
        assert not await rests(chain, AT_ZERO)


async def test_a_speed_override_of_0_that_comes_before_a_drive_was_read_halts_what_an_earlier_daemon_has_left_moving():
    chain, left = chain_of(), {"loss": {"daemon": "run_to_target"}}
    async with rig_on(chain, simulated_config(left)) as rig:
        await rig.power_on("x")
        await rig.client.command("x", MoveAbsolute(position=100.0, velocity=5.0))
        await asyncio.sleep(0.3)
    async with rig_on(chain, simulated_config(left, start="adopt"), up=False) as rig:
        reply = await rig.client.ask(SetSpeedOverride(percent=0.0))
        assert "x" in reply.halted
        await asyncio.sleep(3.0)
        assert await rests(chain, AT_ZERO)


@pytest.mark.parametrize("on", [True, 1, "on", "yes", None, "?", [], {}])
@pytest.mark.sweep(2)
async def test_power_that_does_not_mean_off_switches_nothing(on):
    async with leased_rig() as (rig, chain, lease):
        await run(rig, lease)
        code, message = await ask(rig, "power", {"on": on, "speed": 3})
        await asyncio.sleep(0.5)

        assert drive(chain, 1).loop.servo_on
        assert (code, "was carried out" in message) == ("malformed_request", False)


@pytest.mark.parametrize("verb", [*VERBS, AT_ZERO])
@pytest.mark.sweep(2)
async def test_neither_another_daemon_nor_a_flood_nor_a_line_that_is_busy_is_in_the_way(verb):
    off = OFF.get(verb, {})
    async with leased_rig() as (rig, chain, lease):
        await run(rig, lease)
        rival = await rig.session.declare_token(KEYS.alive("rival"))
        await asyncio.sleep(0.1)
        answer = await ask(rig, verb, off)
        assert (await rests(chain, verb), answer) == (True, (None, ""))
        await rival.close()
        await asyncio.sleep(0.1)

        await run(rig, lease)
        key, gains = KEYS.command("x", "set_gains"), json.dumps({"kp": 300, "lease": lease}).encode()
        flood = [
            asyncio.create_task(rig.session.query(key, gains, encoding="application/json", timeout_s=5.0))
            for _ in range(4 * PENDING_REQUESTS)
        ]
        await asyncio.sleep(0)
        answer = await ask(rig, verb, off)
        assert (await rests(chain, verb), answer) == (True, (None, ""))
        refused = [json.loads(each.result()[0].payload).get("code") for each in flood if each.done()]
        assert "too_many_requests" in refused
        await asyncio.gather(*flood)


@pytest.mark.parametrize(
    "command",
    [Halt(), Stop(), QuickStop(), Power(on=False), None, SetSpeedOverride(percent=0.0)],
    ids=["halt", "stop", "quick_stop", "power", "@stop", AT_ZERO],
)
@pytest.mark.sweep(3)
async def test_it_reaches_the_one_of_two_daemons_that_has_the_line(command):
    chain, run_on = chain_of(), {"loss": {"bus": "run_to_target"}}
    async with rig_on(chain, simulated_config(run_on)) as rig, rig.broker.session() as session:
        await rig.power_on("x")
        await rig.client.command("x", MoveAbsolute(position=100.0, velocity=5.0))
        second = build_daemon(simulated_config(run_on, start="adopt"), session, now_ns, "2nd")
        bus, other = (each.rig.buses[0].bus for each in (rig.daemon, second))
        other._opener = lambda: open_simulated_line(chain, RESET_BAUD)

        async def in_use() -> NoReturn:
            raise TransportLost("the port is in use")

        bus._opener = in_use
        chain.unplug(asyncio.get_running_loop().time(), 0.01)
        serving = asyncio.create_task(second.run(), name="second")
        await second.wait_up()
        assert not await rests(chain, "halt")

        with contextlib.suppress(OutcomeUnknown):  # says the one that has no line
            if isinstance(command, SetSpeedOverride):
                await rig.client.ask(command)
            else:
                await (rig.client.command("x", command) if command else rig.client.stop("x"))
        try:
            assert await rests(chain, "power" if isinstance(command, Power) else "halt")
        finally:
            second.end()
            await asyncio.wait([serving])


@pytest.mark.parametrize("verb", ["halt", "power", AT_ZERO])
async def test_what_comes_while_the_daemon_ends_is_sent_as_long_as_it_serves(verb):
    async with leased_rig(loss={"daemon": "halt"}) as (rig, chain, lease):
        await run(rig, lease)
        now_s = asyncio.get_running_loop().time()
        lost = LineFault(FaultKind.REQUEST_LOST, 1.0, now_s, until_s=now_s + 1.0)
        chain.injector = FaultInjector(FaultPlan((lost,)))
        rig.daemon.end()
        await asyncio.sleep(0.2)
        await ask(rig, verb, OFF.get(verb, {}))
        await asyncio.wait([rig.running])

        assert await rests(chain, verb)


async def test_a_client_that_has_lost_control_still_halts_and_switches_off():
    async with leased_rig() as (rig, chain, lease):
        await run(rig, lease)
        async with control(rig.client, "bob", "x", force=True) as held:
            await rig.client.ask(Acquire(client="ann", axes=("x",), lease_s=60.0, force=True))
            held.lost = LeaseExpired("taken by force by ann")
            await held.command("x", Power(on=False))
            with pytest.raises(LeaseExpired):
                await held.command("x", Power(on=True))

        assert await rests(chain, "power")


async def test_ids_that_the_daemon_has_yet_to_give_are_nobody_elses(monkeypatch):
    """Whoever took them beforehand had the commands of others refused, and in the end every halt."""
    monkeypatch.setattr("ldcnd.daemon.ledger.ANSWERS_PER_SENDER", 8)
    async with leased_rig() as (rig, _, lease):
        first = await rig.client.command("x", SetPosition(position=0.0, lease=lease))
        run_of, _, serial = first.command_id.rpartition("-")
        theirs = SetPosition(position=0.0, lease=lease, client="mallory")
        for number in range(int(serial) + 1, int(serial) + 9):
            with pytest.raises(CommandIdReused):
                await rig.client.command("x", theirs.model_copy(update={"command_id": f"{run_of}-{number}"}))
        await rig.client.command("x", SetPosition(position=5.0, lease=lease))
        assert await ask(rig, "@stop", {}) == (None, "")
        for number in range(10):
            await rig.client.command("x", theirs.model_copy(update={"command_id": f"mallory {number}"}))
        for _ in range(10):
            await rig.client.command("x", Halt(command_id=f"{run_of}-{serial}"))


async def test_a_halt_that_cannot_be_entered_is_sent_all_the_same(monkeypatch):
    def fails(*_: object) -> NoReturn:
        raise KeyError

    async with leased_rig() as (rig, chain, lease):
        await run(rig, lease)
        monkeypatch.setattr(Ledger, "open", fails)
        await rig.client.command("x", Halt())
        await asyncio.sleep(1.0)

        assert drive(chain, 1).loop.trajectory.at_rest
