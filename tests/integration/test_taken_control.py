"""A program from which control is taken says so where it waits, and does nothing to the axis of its new holder."""

import asyncio
import contextlib

import pytest

import ldcnd
from ldcnd.contract.errors import CommandExpired, LeaseExpired, OutcomeUnknown, SessionError, WrongState


async def moves_until_it_may_not(rig, out):
    """Move on and on; keep how it ended."""
    try:
        async with rig.control("x", client="first") as x:
            await x.power(on=True)
            for number in range(1000):
                await (await x.move_absolute(10.0 if number % 2 else -10.0)).done()
    except ldcnd.LdcndError as error:
        out.append(error)


@pytest.mark.parametrize("after_s", [0.3, 0.5, 0.9, 1.7])
@pytest.mark.sweep(2)
async def test_whoever_takes_control_moves_at_once_and_the_other_program_is_told(ldcnd_rig, after_s):
    ended = []
    first = asyncio.create_task(moves_until_it_may_not(ldcnd_rig.client, ended))
    await asyncio.sleep(after_s)
    async with ldcnd.connect() as other, other.control("x", client="second", force=True) as x:
        await (await x.move_absolute(25.0, buffer_mode="aborting")).done()
        await first
    (error,) = ended
    assert isinstance(error, LeaseExpired)
    assert "second" in error.message
    assert ldcnd_rig.truth("x").position == pytest.approx(25, abs=0.02)


@pytest.mark.parametrize("for_s", [0.1, 0.5])
@pytest.mark.parametrize("commands", [True, False])
@pytest.mark.sweep(2)
async def test_a_daemon_that_was_restarted_ends_control_in_the_documented_way(ldcnd_rig, for_s, commands):
    """Its next daemon has never heard of the lease."""

    async def first():
        async with ldcnd_rig.client.control("y", client="first") as y:
            await y.power(on=True)
            ldcnd_rig.faults.daemon_killed(for_s=for_s)
            while True:
                await asyncio.sleep(0.01)
                with contextlib.suppress(OutcomeUnknown, SessionError, WrongState, CommandExpired):
                    if commands:
                        await y.move_absolute(3.0)

    with pytest.raises(LeaseExpired, match="the daemon was restarted"):
        await first()
    assert ldcnd_rig.truth("y").at_rest
