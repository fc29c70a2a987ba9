"""A lease belongs to its token, not to a name: a second client of the same name takes nothing away."""

import asyncio
import os
import sys
from asyncio.subprocess import PIPE, Process, create_subprocess_exec
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

import pytest

from ldcnd.client.lease import control
from ldcnd.client.rig import Rig
from ldcnd.client.rig_client import RigClient
from ldcnd.config.rig import load_config
from ldcnd.contract.commands import MoveVelocity, Power
from ldcnd.contract.errors import LeaseExpired, LeaseHeld
from ldcnd.contract.leases import Acquire, LeaseReply, Renew
from ldcnd.drives.line_config import GroupConfig
from tests.support.process import ROOT, client, daemon
from tests.support.rig import SIMULATED, RunningRig, running_rig

BOTH = ("x", "y")
SPEED = 5.0
FOR_S = 0.5


@asynccontextmanager
async def gantry() -> AsyncIterator[RunningRig]:
    config = load_config(SIMULATED)
    bus = config.bus[0].model_copy(update={"group": (GroupConfig(name="gantry", axes=BOTH),)})
    async with running_rig(config.model_copy(update={"bus": (bus,)})) as rig:
        yield rig


async def acquired(sender: RigClient, *axes: str, **fields: object) -> LeaseReply:
    return await sender.ask(Acquire.model_validate({"client": "scan", "axes": axes, "lease_s": 60.0, **fields}))


async def running(rig: RunningRig, lease: LeaseReply) -> None:
    for axis in lease.axes:
        await rig.until(axis, lambda state: state.link == "up")
        await rig.client.command(axis, Power(on=True, lease=lease.lease))
        await rig.client.command(axis, MoveVelocity(velocity=SPEED, lease=lease.lease))
    await asyncio.sleep(1.0)


async def turns_on(rig: RunningRig, *axes: str) -> list[bool]:
    """Tell whether shafts go on as they were told; those that do not rest soon."""
    await asyncio.sleep(0.2)
    before = [rig.lives.truth(axis).position for axis in axes]
    await asyncio.sleep(FOR_S)
    ways = [rig.lives.truth(axis).position - was for axis, was in zip(axes, before, strict=True)]
    assert all(way == pytest.approx(SPEED * FOR_S, abs=0.1) or abs(way) < 0.01 for way in ways), ways
    return [way > 1.0 for way in ways]


@pytest.mark.promise("loss-of-control")
@pytest.mark.parametrize("wanted", [("x",), BOTH, ("gantry",), ()])
@pytest.mark.sweep(2)
async def test_a_second_client_of_the_same_name_is_refused_and_the_shaft_goes_on(wanted):
    async with gantry() as rig:
        held = await acquired(rig.client, "gantry")
        await running(rig, held)

        with pytest.raises(LeaseHeld, match=r"axis x is controlled by scan, for 5\d\.\d s more unless renewed") as no:
            await acquired(RigClient(rig.session, "sim"), *wanted)

        for way_out in ("wait", "force", "LDCND_LEASE"):
            assert way_out in no.value.remedy
        assert await turns_on(rig, *BOTH) == [True, True]
        assert (await rig.client.ask(Renew(lease=held.lease))).axes == BOTH


@pytest.mark.parametrize("name", ["scan", "another name"])
async def test_who_has_the_token_replaces_the_lease_and_what_moves_goes_on(name):
    async with gantry() as rig:
        held = await acquired(rig.client, "gantry")
        await running(rig, held)
        other = RigClient(rig.session, "sim")

        new = await acquired(other, "x", "y", client=name, replaces=(held.lease,))

        assert await turns_on(rig, *BOTH) == [True, True]
        with pytest.raises(LeaseExpired, match="replaced"):
            await rig.client.ask(Renew(lease=held.lease))
        fewer = await acquired(other, "y", client=name, replaces=(new.lease,))
        assert fewer.axes == ("y",)
        assert await turns_on(rig, *BOTH) == [False, True]  # control of x was given up


async def test_the_token_of_one_lease_replaces_no_other():
    async with gantry() as rig:
        x, y = await acquired(rig.client, "x"), await acquired(rig.client, "y")
        await running(rig, x)
        await running(rig, y)

        for tokens in ((), (x.lease,), ("0123456789abcdef",)):
            with pytest.raises(LeaseHeld, match="controlled by scan"):
                await acquired(rig.client, "gantry", replaces=tokens)
        assert await turns_on(rig, *BOTH) == [True, True]

        await acquired(rig.client, "gantry", replaces=(x.lease, y.lease))
        assert await turns_on(rig, *BOTH) == [True, True]


async def test_a_token_whose_lease_was_taken_by_force_gives_no_right_any_more():
    async with gantry() as rig:
        held = await acquired(rig.client, "gantry")
        await running(rig, held)

        await acquired(RigClient(rig.session, "sim"), "x", force=True)

        assert await turns_on(rig, *BOTH) == [False, False]
        with pytest.raises(LeaseHeld):
            await acquired(rig.client, "x", replaces=(held.lease,))
        await acquired(rig.client, "y", replaces=(held.lease,))  # nobody has it


async def test_a_client_whose_answer_was_lost_replaces_what_it_was_given():
    async with gantry() as rig:
        held = await acquired(rig.client, "gantry")
        await running(rig, held)

        await acquired(rig.client, "gantry", replaces=(held.lease,))  # it never learns the token of this one
        await acquired(rig.client, "gantry", replaces=(held.lease,))

        assert await turns_on(rig, *BOTH) == [True, True]


async def test_a_lease_that_nobody_renews_is_free_for_its_name_once_it_ends():
    async with gantry() as rig:
        await acquired(rig.client, "x", lease_s=1.0)
        again = RigClient(rig.session, "sim")
        with pytest.raises(LeaseHeld):
            await acquired(again, "x")
        await asyncio.sleep(1.0)
        await acquired(again, "x")


async def test_a_program_that_takes_control_again_inside_replaces_its_own_and_no_namesake_does():
    async with gantry() as rig:
        robot = Rig(rig.client, await rig.client.daemon())
        namesake = RigClient(rig.session, "sim")
        await rig.until("x", lambda state: state.link == "up")
        async with control(rig.client, "scan", "x", lease_s=60.0):
            with pytest.raises(LeaseHeld):
                async with control(namesake, "scan", "x"):
                    pass
            with pytest.raises(LeaseHeld):
                async with robot.control("x", client="another part of the program"):
                    pass
            async with robot.control("x", "y", client="scan") as (x, _):
                await x.power(on=True)


async def test_a_program_that_could_not_give_control_back_has_it_again_at_once(monkeypatch):
    async with gantry() as rig:
        robot = Rig(rig.client, await rig.client.daemon())
        with monkeypatch.context() as cut:
            async with robot.control("x", client="scan", lease_s=60.0) as x:
                cut.setattr(x.control, "release", _lost)
        async with robot.control("x", client="scan"):
            pass


async def _lost(**_: object) -> None:
    """Stand for a release that has not reached the daemon."""


PROGRAM = """
import asyncio, sys, ldcnd

async def main():
    async with ldcnd.connect(sys.argv[1]) as rig:
        async with rig.control("x", client="scan", lease_s=10, force="force" in sys.argv) as x:
            print("controls", x.control.lease.lease, flush=True)
            if "move" in sys.argv:
                await x.move_velocity(5, buffer_mode="aborting")
                print("runs", flush=True)
            loop = asyncio.get_running_loop()
            over = asyncio.Event()
            loop.add_reader(sys.stdin, over.set)
            await over.wait()

try:
    asyncio.run(main())
except ldcnd.LdcndError as error:
    print(error.code.value, error, flush=True)
"""


@asynccontextmanager
async def program(endpoint: str, *options: str, lease: str = "") -> AsyncIterator[Process]:
    """Run a client in a process of its own until the context ends; each calls itself alike."""
    environment = {**os.environ, "LDCND_LEASE": lease}
    started = await create_subprocess_exec(
        sys.executable,
        "-c",
        PROGRAM,
        endpoint,
        *options,
        stdin=PIPE,
        stdout=PIPE,
        stderr=PIPE,
        cwd=ROOT,
        env=environment,
    )
    try:
        yield started
    finally:
        if started.returncode is None:
            await started.communicate(b"")


async def said(running: Process, what: str) -> str:
    async with asyncio.timeout(30):
        while (line := (await running.stdout.readline()).decode()) and not line.startswith(what):
            pass
    return line.removeprefix(what).strip()


async def way_mm(rig: RigClient) -> float:
    before = await rig.last("x", "position")
    await asyncio.sleep(0.3)
    return (await rig.last("x", "position")).value - before.value


@pytest.mark.real_time
async def test_of_two_live_programs_of_one_name_the_second_is_refused_over_zenoh():
    async with daemon(SIMULATED) as endpoint, client(endpoint) as rig:
        await rig.command("x", Power(on=True))
        async with program(endpoint, "move") as first:
            await _tried_by_namesakes(endpoint, rig, first)


async def _tried_by_namesakes(endpoint: str, rig: RigClient, first: Process) -> None:
    token = await said(first, "controls")
    await said(first, "runs")

    async with program(endpoint) as second:
        assert (await said(second, "lease_held")).startswith("axis x is controlled by scan")
    assert await way_mm(rig) > 0.5

    async with program(endpoint, lease=token) as sharing:  # control is shared: neither takes it from the other
        assert await said(sharing, "controls") == token
    assert first.returncode is None

    async with program(endpoint, "move", "force") as second:
        await said(second, "runs")
        assert "was taken by scan" in await said(first, "lease_expired")
        assert await way_mm(rig) > 0.5
