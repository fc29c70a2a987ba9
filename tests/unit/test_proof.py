"""What is sent to whom: the gate of a line, at the turn of a packet."""

import asyncio
from dataclasses import replace

import pytest

from ldcnd.contract.errors import AxisUnreachable, LdcndError, NotIdentified
from ldcnd.line.exchange import Lane, PacketEffect
from ldcnd.line.proof import MISSES_UNTIL_LOST, bringing_up
from tests.support import toy_family as toy
from tests.support.bus_rig import Rig, running
from tests.support.scripted_line import Say

NODE, OTHER, GROUP = 1, 2, 0x81


def packet(effect: PacketEffect, node: int = NODE, number: int = 7):
    return replace(toy.exchange(number, node), effect=effect)


async def sent(rig: Rig, effect: PacketEffect, node: int = NODE, lane: Lane = Lane.COMMAND) -> type[LdcndError] | None:
    try:
        await rig.bus.execute(packet(effect, node), lane)
    except LdcndError as error:
        assert rig.sent() == []
        return type(error)
    return None


@pytest.mark.parametrize("lane", [Lane.STOP, Lane.COMMAND, Lane.BACKGROUND])
@pytest.mark.parametrize("effect", PacketEffect)
async def test_to_a_node_without_proof_goes_only_what_reads_or_takes_energy_out(effect, lane):
    rig = Rig()
    async with running(rig):
        rig.bus.proofs.expect(NODE, "axis x", "x")

        refused = await sent(rig, effect, lane=lane)

    assert refused is (None if effect in (PacketEffect.READS, PacketEffect.RELIEVES) else AxisUnreachable)


async def test_to_a_proven_node_goes_everything_and_to_one_that_is_not_configured_nothing_that_changes_it():
    rig = Rig()
    async with running(rig):
        rig.bus.proofs.expect(NODE, "axis x", "x").prove()

        assert await sent(rig, PacketEffect.CHANGES, OTHER) is NotIdentified
        for effect in PacketEffect:
            await rig.bus.execute(packet(effect))


async def test_what_is_sent_to_a_group_concerns_all_its_members():
    rig = Rig()
    async with running(rig):
        proofs = rig.bus.proofs
        proofs.expect(NODE, "axis x", "x").prove()
        other = proofs.expect(OTHER, "axis y", "y")
        proofs.expect_group(GROUP, (NODE, OTHER))
        other.lose("address 2 (axis y): expected PIC-SERVO v4, PIC-I/O", silent=False)

        with pytest.raises(NotIdentified, match=r"axis y .* expected PIC-SERVO v4, PIC-I/O") as refused:
            await rig.bus.execute(packet(PacketEffect.CHANGES, GROUP))
        assert refused.value.axis == "y"

        other.prove()
        assert await sent(rig, PacketEffect.CHANGES, GROUP) is None


@pytest.mark.promise("proven-before-changed")
async def test_proof_is_asked_when_the_turn_comes_and_not_before():
    rig = Rig()
    async with running(rig) as callers:
        proof = rig.bus.proofs.expect(NODE, "axis x", "x")
        proof.prove()
        callers.create_task(rig.bus.execute(toy.exchange(1)), name="on the wire")
        await asyncio.sleep(0)
        waiting = callers.create_task(sent_or_error(rig, packet(PacketEffect.CHANGES)), name="waits")
        await asyncio.sleep(0)
        proof.lose("it has restarted")

    assert isinstance(waiting.result(), AxisUnreachable)
    assert rig.sent() == [1]


async def sent_or_error(rig: Rig, exchange) -> object:
    try:
        return await rig.bus.execute(exchange)
    except LdcndError as error:
        return error


async def test_a_node_that_stops_answering_loses_its_proof_and_gets_it_by_no_reply():
    mute = True

    def script(request: bytes) -> list[Say]:
        return [] if mute and request != toy.FLUSH and toy.node_of(request) == NODE else toy.answer(request)

    rig = Rig(script)
    async with running(rig):
        proof = rig.bus.proofs.expect(NODE, "axis x", "x")
        proof.prove()
        for _ in range(MISSES_UNTIL_LOST):
            await sent_or_error(rig, replace(toy.exchange(1, NODE), repeatable=False))
        assert not proof.holds

        mute = False
        await rig.bus.execute(toy.exchange(2, NODE))
        assert rig.bus.proofs.heard_again.is_set()
        with pytest.raises(AxisUnreachable, match="stopped answering"):
            await rig.bus.execute(packet(PacketEffect.CHANGES))


async def test_a_lost_line_has_lost_all_proofs():
    rig = Rig()
    async with running(rig):
        proof = rig.bus.proofs.expect(NODE, "axis x", "x")
        proof.prove()
        rig.bus.drop("unplugged")
        assert not proof.holds


async def test_the_pass_of_a_bring_up_lets_addresses_through_and_no_motion_and_ends_with_it():
    rig = Rig()
    async with running(rig) as callers:
        begun = asyncio.Event()

        async def outlives() -> object:
            await begun.wait()
            return await sent_or_error(rig, packet(PacketEffect.ARRANGES, number=3))

        rig.bus.proofs.expect(NODE, "axis x", "x")
        with bringing_up():
            late = callers.create_task(outlives(), name="outlives")
            await rig.bus.execute(packet(PacketEffect.ARRANGES, number=1))
            assert isinstance(await sent_or_error(rig, packet(PacketEffect.CHANGES, number=2)), AxisUnreachable)
        begun.set()

    assert isinstance(late.result(), AxisUnreachable)
    assert rig.sent() == [1]
