"""A level of an output that could not be written at once is written later only if it is still what is wanted."""

import asyncio
from contextlib import suppress

import pytest
from typing_extensions import override

from ldcnd.contract.errors import AxisUnreachable, CommandAborted, OutcomeUnknown
from ldcnd.contract.events import CommandStatus, ReadEvents
from ldcnd.contract.leases import Acquire
from ldcnd.contract.rig_commands import SetIo
from ldcnd.daemon.modules import Situation
from ldcnd.sim.chain import Chain
from ldcnd.sim.ldcn.io import SimulatedIo
from ldcnd.sim.ldcn.module import Packet
from tests.support.machine_rig import Machine, chain_of_machine, machine, running_machine

LINES = (1, 2, 5, 6, 7, 8, 9, 10, 11, 12)
"""Outputs of the module; the rest are the door's contacts."""
LAST = LINES[-1]


class WitnessedIo(SimulatedIo):
    """A module that keeps what its outputs were set to, one after the other, and whose replies to that can be lost."""

    history: list[tuple[int, int]]
    losses: int
    spared: int

    @override
    def _set_latch(self, levels: int) -> None:
        super()._set_latch(levels)
        self.history.append((self.outputs, self.latch))

    @override
    def _obey(self, packet: Packet, at_s: float) -> bytes | None:
        before = len(self.history)
        reply = super()._obey(packet, at_s)
        if len(self.history) == before or not self.losses:
            return reply
        if self.spared:
            self.spared -= 1
            return reply
        self.losses -= 1
        return None

    def had(self, line: int) -> list[bool]:
        """Return the levels that a driven line has had, without repetitions."""
        seen: list[bool] = []
        for outputs, latch in self.history:
            level = bool(latch >> line - 1 & 1)
            if outputs >> line - 1 & 1 and (not seen or seen[-1] is not level):
                seen.append(level)
        return seen


def witnessed() -> tuple[Chain, WitnessedIo]:
    chain = chain_of_machine()
    io = chain.modules[2]
    assert isinstance(io, SimulatedIo)
    io.__class__ = WitnessedIo
    io.history, io.losses, io.spared = [], 0, 0
    return chain, io


def rig_of(**levels: object):
    """Return a machine all of whose outputs have these levels in situations."""
    outputs = {f"out{line}": {"line": line, **levels} for line in LINES}
    return machine(module={"outputs": outputs})


def out(line: int) -> str:
    return f"out{line}"


async def set_all(rig: Machine, level: str, lease: str | None = None) -> None:
    await rig.client.ask(SetIo(module="cabinet", **{level: tuple(map(out, LINES))}, lease=lease))


async def back(rig: Machine) -> None:
    """Wait until the module answers again that was out of reach, to the reading."""
    module = rig.daemon.rig.modules["cabinet"]
    async with asyncio.timeout(30.0):
        while module.read_at_s < 0:
            await asyncio.sleep(0.001)


async def lose_client_out_of_reach(rig: Machine, chain: Chain, out_s: float = 8.0) -> None:
    """Let a lease end while the line is unplugged; the outputs are high."""
    lease = (await rig.client.ask(Acquire(client="ann", axes=("rotor", "table"), lease_s=2.0))).lease
    await set_all(rig, "high", lease)
    chain.unplug(asyncio.get_running_loop().time(), out_s)
    await asyncio.sleep(out_s - 1.0)
    assert rig.daemon.rig.modules["cabinet"].read_at_s < 0


async def test_an_output_that_was_acknowledged_once_is_not_said_to_be_refused():
    """It is told twice: of the second time no answer comes."""
    chain, io = witnessed()
    async with running_machine(rig_of(), chain) as rig:
        await set_all(rig, "low")
        io.losses, io.spared = 100, 1
        with pytest.raises(OutcomeUnknown, match="acknowledged once, but no intact reply"):
            await rig.client.ask(SetIo(module="cabinet", high=(out(LAST),)))
        assert io.latch >> LAST - 1 & 1
        io.losses = 0
        events = (await rig.client.ask(ReadEvents(count=20))).events
        assert [each.status for each in events if each.verb == "set_io"][-1] is CommandStatus.UNKNOWN


@pytest.mark.promise("outputs-by-command")
async def test_what_a_client_sets_after_the_return_is_not_undone_by_the_loss_of_an_earlier_one():
    chain, io = witnessed()
    async with running_machine(rig_of(loss={"client": "low"}), chain) as rig:
        await lose_client_out_of_reach(rig, chain)
        await back(rig)
        lease = (await rig.client.ask(Acquire(client="bob", axes=("rotor", "table"), lease_s=60.0))).lease
        await rig.client.ask(SetIo(module="cabinet", high=(out(LAST),), lease=lease))  # while the others are written
        io.history.clear()
        await asyncio.sleep(5.0)

        assert [io.latch >> line - 1 & 1 for line in LINES] == [0] * (len(LINES) - 1) + [1]
        assert False not in io.had(LAST)


async def test_what_a_client_sets_while_the_daemon_tries_again_stays():
    """Writes whose packets are lost are tried again half a second later."""
    chain, io = witnessed()
    async with running_machine(rig_of(loss={"client": "low"}), chain) as rig:
        lease = (await rig.client.ask(Acquire(client="ann", axes=("rotor", "table"), lease_s=2.0))).lease
        await set_all(rig, "high", lease)
        io.losses = 3
        async with asyncio.timeout(5.0):
            while io.losses:
                await asyncio.sleep(0.001)
        taken = (await rig.client.ask(Acquire(client="bob", axes=("rotor", "table"), lease_s=60.0))).lease
        async with asyncio.timeout(0.4):  # before it is tried again
            while True:
                with suppress(AxisUnreachable):
                    await rig.client.ask(SetIo(module="cabinet", high=(out(LINES[0]),), lease=taken))
                    break
                await asyncio.sleep(0.01)
        io.history.clear()
        await asyncio.sleep(3.0)

        assert [io.latch >> line - 1 & 1 for line in LINES] == [1] + [0] * (len(LINES) - 1)
        assert False not in io.had(LINES[0])


@pytest.mark.parametrize("newer", ["bus", "reset"])
async def test_of_what_happened_out_of_reach_only_the_last_word_is_written(newer):
    chain, io = witnessed()
    levels = {"reset": "high"} if newer == "reset" else {}
    loss = {"client": "low"} | ({"bus": "high"} if newer == "bus" else {})
    async with running_machine(rig_of(loss=loss, **levels), chain) as rig:
        await lose_client_out_of_reach(rig, chain)
        if newer == "reset":
            io.power(on=False, at_s=asyncio.get_running_loop().time())
            io.power(on=True, at_s=asyncio.get_running_loop().time())
        io.history.clear()
        await back(rig)
        await asyncio.sleep(5.0)

        assert [io.had(line) for line in LINES] == [[True]] * len(LINES)


async def test_a_situation_without_a_level_leaves_that_of_the_one_before():
    chain, io = witnessed()
    async with running_machine(rig_of(loss={"client": "low"}), chain) as rig:
        await lose_client_out_of_reach(rig, chain)
        await back(rig)  # its line was lost, too, and the outputs have no level for that
        await asyncio.sleep(5.0)

        assert [io.latch >> line - 1 & 1 for line in LINES] == [0] * len(LINES)


async def test_what_a_client_asked_for_before_a_loss_is_not_written_after_it():
    """Without leases nothing else tells that it is not wanted any more."""
    chain, io = witnessed()
    async with running_machine(rig_of(loss={"client": "low"}), chain) as rig:
        await set_all(rig, "high")
        module = rig.daemon.rig.modules["cabinet"]
        first = [asyncio.create_task(set_all(rig, "high")) for _ in range(6)]  # they keep the line busy
        late = asyncio.create_task(rig.client.ask(SetIo(module="cabinet", high=(out(LAST),))))
        await asyncio.sleep(0.001)
        module.enter(Situation.CLIENT)
        with pytest.raises(CommandAborted, match=r"loss\.client has called for output out12 low"):
            await late
        await asyncio.gather(*first, return_exceptions=True)
        await asyncio.sleep(3.0)

        assert [io.latch >> line - 1 & 1 for line in LINES] == [0] * len(LINES)
        assert io.had(LAST) == [True, False]
