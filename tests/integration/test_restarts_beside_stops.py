"""What the faces say of stops that an earlier daemon has left, while the line comes up and no drive was read yet.

Before the drive is read it may have been moved: its stop is sent again, and nothing is known to have failed.
"""

import asyncio
from collections.abc import Iterable
from pathlib import Path

import pytest
from structlog.testing import capture_logs

from ldcnd.cli.log import _line
from ldcnd.cli.looking import axes_table
from ldcnd.client.history import beginning, history
from ldcnd.client.overview import overview
from ldcnd.contract.commands import QuickStop
from ldcnd.contract.errors import TransportLost
from ldcnd.contract.questions import Why
from ldcnd.contract.samples import LinkState
from ldcnd.line.transport import Transport
from ldcnd.sim.chain import Chain
from ldcnd.sim.faults import FaultInjector, FaultKind, FaultPlan, LineFault
from tests.integration.test_kept_latches import end, jogging, settled, up
from tests.integration.test_kept_references import chain_of, keeping
from tests.support.chain_rig import ChainRig, rig_on

pytestmark = pytest.mark.promise("latch-outlasts-daemon")
LOOK_S = 0.01
ALARMS = ("NOT CONFIRMED", "NOT confirmed", "has not confirmed", "may move")
UNREAD = "the drive was not read yet"


async def no_adapter() -> Transport:
    raise TransportLost("cannot open /dev/ldcn-x: it is not there")


async def shown(rig: ChainRig, axis: str = "x") -> str:
    """Return what `ldcnd list` and `ldcnd why` say of an axis."""
    rows = {row.split()[0]: row for row in axes_table(await overview(rig.client))}
    reply = await rig.client.ask(Why(), axis)
    return "\n".join((rows[axis], *(cause.text for cause in reply.causes)))


async def shown_until_up(rig: ChainRig, axis: str = "x") -> list[str]:
    """Return all that is said of an axis until its drive was read and has confirmed what it was sent."""
    await rig.daemon.wait_serving()
    said: list[str] = []
    async with asyncio.timeout(10.0):
        while True:
            status = rig.daemon.rig.axes[axis].tracker.status
            said.append(await shown(rig, axis))
            if status.link is LinkState.UP and status.stop is None:
                return said
            await asyncio.sleep(LOOK_S)


async def logged(rig: ChainRig, axis: str = "x") -> list[str]:
    """Return the rows of `ldcnd log`."""
    return [_line(row) for row in await history(rig.client, await beginning(rig.client), axis)]


def alarms(said: Iterable[str]) -> list[str]:
    return [each for each in said if any(alarm in each for alarm in ALARMS)]


async def latched(chain: Chain, folder: Path, scope: str = "axis") -> int:
    """Have a daemon stop x, which its drive confirms, and die; return the instant before the stop."""
    async with rig_on(chain, keeping(folder)) as rig:
        await jogging(rig)
        before_ns = rig.daemon._dispatcher._clock.now_ns()
        if scope == "quick_stop":
            await rig.client.command("x", QuickStop(client="panel"))
        else:
            reply = await rig.client.stop("x" if scope == "axis" else None, client="panel")
            assert "x" in reply.confirmed
        await rig.kill()
    return before_ns


def lost(share: float) -> FaultInjector:
    return FaultInjector(FaultPlan((LineFault(FaultKind.REQUEST_LOST, share),)))


@pytest.mark.parametrize("baud", [19_200, 115_200])
@pytest.mark.parametrize("scope", ["axis", "rig", "quick_stop"])
async def test_a_confirmed_stop_is_no_alarm_in_the_next_daemons_which_say_who_has_latched_it(tmp_path, scope, baud):
    chain, config = chain_of(), keeping(tmp_path, baud=baud)
    await latched(chain, tmp_path, scope)
    said = []
    for life in ("killed before its line is up", "killed", "ends"):
        async with rig_on(chain, config, up=False) as rig:
            await rig.daemon.wait_serving()
            if life == "killed before its line is up":
                said.append(await shown(rig))
                await rig.kill()
                continue
            said += await shown_until_up(rig)
            rows = await logged(rig)
            await settled(rig)
            if life == "killed":
                await rig.kill()

    assert alarms(said) == []
    assert "stop latched" in said[0]
    assert UNREAD in said[0]
    assert "stop latched" in said[-1]
    assert UNREAD not in said[-1]
    (told,) = [row for row in rows if " latch " in row]
    assert "by panel" in told
    assert "its drive had confirmed it" in told


async def test_the_log_tells_when_a_stop_was_latched_by_whom_across_two_restarts(tmp_path):
    chain, config = chain_of(), keeping(tmp_path)
    async with rig_on(chain, config) as rig:
        await jogging(rig)
        await rig.client.stop("x", client="panel")
        await rig.client.stop("x", client="somebody else")
        first = rig.daemon.rig.axes["x"].tracker.status.latched_by
        await rig.kill()
    for _ in range(2):
        async with rig_on(chain, config) as rig:
            await settled(rig)
            again = rig.daemon.rig.axes["x"].tracker.status.latched_by
            await rig.kill()

    assert first
    assert first.client == "panel"
    assert again == first


@pytest.mark.parametrize("how", ["SIGKILL", "SIGTERM"])
async def test_a_stop_that_was_not_confirmed_is_an_alarm_from_the_first_moment_on(tmp_path, how):
    chain, config = chain_of(), keeping(tmp_path)
    async with rig_on(chain, config) as rig:
        await jogging(rig)
        chain.injector = lost(1.0)
        reply = await rig.client.stop("x", client="panel")
        assert (reply.confirmed, reply.kept) == ((), ("x",))
        await end(rig, how)
    chain.injector = FaultInjector(FaultPlan())
    async with rig_on(chain, config, up=False) as rig:
        said = await shown_until_up(rig)
        rows = await logged(rig)

    # its drive confirms it before the line is up: it is sent at the rate of the configuration first
    told = ["NOT CONFIRMED" in each for each in said]
    assert told == sorted(told, reverse=True)
    assert (told[0], told[-1]) == (True, False)
    assert any(" latch " in row and "by panel" in row and "not known to have confirmed" in row for row in rows)


async def test_a_stop_on_its_way_to_the_drive_when_the_daemon_is_killed_is_not_taken_for_confirmed(tmp_path):
    chain, config = chain_of(), keeping(tmp_path)
    async with rig_on(chain, config) as rig:
        await jogging(rig)
        chain.injector = lost(1.0)
        stopping = asyncio.create_task(rig.client.stop("x"))
        async with asyncio.timeout(1.0):
            while not rig.daemon.rig.axes["x"].stops.latch_is_kept:
                await asyncio.sleep(0.001)
        await rig.kill()
        stopping.cancel()
    chain.injector = FaultInjector(FaultPlan())
    async with rig_on(chain, config, up=False) as rig:
        await rig.daemon.wait_serving()
        said = await shown(rig)

    assert "NOT CONFIRMED" in said


async def test_quick_restarts_claim_of_no_disabled_axis_that_a_stop_has_failed(tmp_path):
    chain, config = chain_of(), keeping(tmp_path)
    async with rig_on(chain, config) as rig:
        await up(rig)
        await rig.kill()
    said = []
    with capture_logs() as logs:
        for _ in range(3):  # ended before the line is up
            async with rig_on(chain, config, up=False) as rig:
                await rig.daemon.wait_serving()
                said.append(await shown(rig))
                await end(rig, "SIGTERM")
        async with rig_on(chain, config, up=False) as rig:
            said += await shown_until_up(rig)

    assert alarms(said) == []
    assert alarms(line["event"] for line in logs) == []


async def test_the_log_names_a_damaged_file_as_what_has_latched_an_axis(tmp_path):
    (tmp_path / "latches.json").write_text("?")
    async with rig_on(chain_of(), keeping(tmp_path)) as rig:
        (told,) = [row for row in await logged(rig) if " latch " in row]

    assert "because the kept latches are not to be trusted" in told
    assert " by " not in told


async def test_a_line_that_never_comes_up_makes_a_stop_an_alarm_within_seconds(tmp_path):
    chain, config = chain_of(), keeping(tmp_path)
    await latched(chain, tmp_path)
    async with rig_on(chain, config, up=False, opener=no_adapter) as rig:
        await rig.daemon.wait_serving()
        at_once = await shown(rig)
        await asyncio.sleep(7.0)  # virtual
        later, state = await shown(rig), await rig.client.state("x")
        await rig.kill()
    async with rig_on(chain, config, up=False, opener=no_adapter) as rig:
        await rig.daemon.wait_serving()
        again = await shown(rig)
    async with rig_on(chain, config, up=False) as rig:
        said = await shown_until_up(rig)

    assert UNREAD in at_once
    assert alarms([at_once]) == []
    assert "stop NOT CONFIRMED by the drive" in later
    assert (state.stop_latched, state.stop_pending) == (True, True)
    assert "stop NOT CONFIRMED by the drive" in again  # it has failed before the restart
    assert alarms(said[-1:]) == []


async def test_a_drive_that_does_not_answer_makes_a_stop_an_alarm_and_the_others_none(tmp_path):
    chain, config = chain_of(), keeping(tmp_path)
    async with rig_on(chain, config) as rig:
        await jogging(rig)
        await rig.client.stop(client="panel")
        await rig.kill()
    silent = chain.modules[3]
    silent.power(on=False, at_s=asyncio.get_running_loop().time())
    async with rig_on(chain, config, up=False) as rig:
        await rig.daemon.wait_serving()
        at_once = await shown(rig, "c")
        await asyncio.sleep(7.0)  # virtual
        later, other = await shown(rig, "c"), await shown(rig)

    assert alarms([at_once]) == []
    assert "stop NOT CONFIRMED by the drive" in later
    assert "NOT CONFIRMED" not in other  # it has answered, and has taken its stop
