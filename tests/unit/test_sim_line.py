"""The chain as a byte pipe of the event loop."""

import asyncio

import pytest

from ldcnd.contract.errors import TransportLost
from ldcnd.sim.chain import Delivery
from ldcnd.sim.faults import FaultKind, FaultPlan, LineFault
from ldcnd.sim.ldcn.chain import ChainSpec, ModuleSpec, build_chain
from ldcnd.sim.line import open_simulated_line
from ldcnd.testing.jumping_loop import JumpingLoop

SET_ADDRESS_1 = bytes.fromhex("aa 00 21 01 ff 21")
SET_ADDRESS_2 = bytes.fromhex("aa 00 21 02 ff 22")
NO_OPERATION_1 = bytes.fromhex("aa 01 0e 0f")


class Listener:
    def __init__(self):
        self.received = []
        self.losses = []

    def data_received(self, data):
        self.received.append((asyncio.get_running_loop().time(), data))

    def transport_lost(self, reason):
        self.losses.append(reason)


def chain_of(*names, **options):
    return build_chain(ChainSpec(tuple(ModuleSpec(name) for name in names), **options))


async def opened(chain):
    line = await open_simulated_line(chain)
    listener = Listener()
    line.attach(listener)
    return line, listener


async def test_reply_comes_at_the_instant_of_its_last_bit():
    chain, twin = chain_of("ls182ap"), chain_of("ls182ap")
    line, listener = await opened(chain)

    line.write(SET_ADDRESS_1)
    await asyncio.sleep(0.1)

    twin.write(0.0, SET_ADDRESS_1)
    ((at_s, data),) = twin.advance(0.1)
    assert listener.received == [(pytest.approx(at_s, abs=1e-8), data)]
    await line.close()


async def test_bytewise_delivery_gives_one_call_per_byte():
    line, listener = await opened(chain_of("ls182ap", delivery=Delivery.BYTEWISE))

    line.write(SET_ADDRESS_1)
    await asyncio.sleep(0.1)

    assert [len(data) for _, data in listener.received] == [1, 1]
    assert listener.received[1][0] - listener.received[0][0] == pytest.approx(10 / 19_531.25, rel=1e-4)
    await line.close()


async def test_answering_from_within_the_callback_goes_out_at_once():
    chain = chain_of("ls182ap")
    line, listener = await opened(chain)
    first_reply = listener.data_received

    def answer(data):
        first_reply(data)
        if len(listener.received) < 3:
            line.write(NO_OPERATION_1)

    listener.data_received = answer
    line.write(SET_ADDRESS_1)
    await asyncio.sleep(0.1)

    assert len(listener.received) == 3
    await line.close()


async def test_modules_live_on_while_the_line_is_closed():
    chain = chain_of("ls182ap", "picservo-v4")
    line, _ = await opened(chain)
    line.write(SET_ADDRESS_1)
    await asyncio.sleep(0.1)
    await line.close()

    line, listener = await opened(chain)
    line.write(NO_OPERATION_1)
    await asyncio.sleep(0.1)

    assert len(listener.received) == 1
    await line.close()


async def test_reply_to_a_closed_line_is_not_delivered_after_reopening():
    chain = chain_of("ls182ap")
    line, _ = await opened(chain)
    line.write(SET_ADDRESS_1)
    await line.close()
    await asyncio.sleep(0.1)

    line, listener = await opened(chain)
    await asyncio.sleep(0.1)

    assert listener.received == []
    await line.close()


async def test_discarding_drops_what_had_arrived_of_a_reply():
    twin, chain = chain_of("ls182ap"), chain_of("ls182ap")
    twin.write(0.0, SET_ADDRESS_1)
    ((ends_at_s, reply),) = twin.advance(0.1)
    line, listener = await opened(chain)

    line.write(SET_ADDRESS_1)
    await asyncio.sleep(ends_at_s - 0.5 * 10 / 19_531.25)
    line.discard_input()
    await asyncio.sleep(0.1)

    assert [data for _, data in listener.received] == [reply[1:]]
    await line.close()


async def test_unplugging_is_told_once_and_refuses_writing_and_opening():
    chain = chain_of("ls182ap")
    line, listener = await opened(chain)

    chain.unplug(asyncio.get_running_loop().time())
    with pytest.raises(TransportLost, match="unplugged"):
        line.write(NO_OPERATION_1)
    await asyncio.sleep(0.1)
    with pytest.raises(TransportLost, match="unplugged"):
        await open_simulated_line(chain)

    assert len(listener.losses) == 1


async def test_replugged_line_finds_the_modules_as_they_were():
    chain = chain_of("ls182ap")
    line, _ = await opened(chain)
    line.write(SET_ADDRESS_1)
    await asyncio.sleep(0.1)
    chain.unplug(asyncio.get_running_loop().time())
    await line.close()
    chain.replug()

    line, listener = await opened(chain)
    line.write(NO_OPERATION_1)
    await asyncio.sleep(0.1)

    assert len(listener.received) == 1
    await line.close()


async def test_unplug_fault_reports_the_loss_after_the_write_returned():
    chain = chain_of("ls182ap", faults=FaultPlan((LineFault(FaultKind.UNPLUGGED, longest_s=2.0),)))
    line, listener = await opened(chain)

    line.write(NO_OPERATION_1)
    losses_within_write = list(listener.losses)
    await asyncio.sleep(0.1)

    assert losses_within_write == []
    assert len(listener.losses) == 1
    await asyncio.sleep(2.0)
    assert chain.plugged(asyncio.get_running_loop().time())


async def test_closed_line_refuses_writing_and_may_be_closed_again():
    line, _ = await opened(chain_of("ls182ap"))
    await line.close()
    await line.close()

    with pytest.raises(TransportLost, match="closed"):
        line.write(NO_OPERATION_1)
    with pytest.raises(TransportLost, match="closed"):
        line.set_baud(115_200)


async def test_echo_comes_before_the_reply():
    line, listener = await opened(chain_of("ls182ap", faults=FaultPlan((LineFault(FaultKind.ECHO),))))

    line.write(SET_ADDRESS_1)
    await asyncio.sleep(0.1)

    assert listener.received[0][1] == SET_ADDRESS_1
    assert len(listener.received) == 2
    await line.close()


async def test_delayed_reply_survives_the_next_request():
    chain = chain_of("ls182ap", faults=FaultPlan((LineFault(FaultKind.REPLY_DELAYED, until_s=0.01, longest_s=0.5),)))
    line, listener = await opened(chain)

    line.write(SET_ADDRESS_1)
    await asyncio.sleep(0.01)
    line.write(NO_OPERATION_1)
    await asyncio.sleep(1.0)

    assert len(listener.received) == 2
    await line.close()


async def test_duplicated_reply_follows_the_first():
    line, listener = await opened(chain_of("ls182ap", faults=FaultPlan((LineFault(FaultKind.REPLY_DUPLICATED),))))

    line.write(SET_ADDRESS_1)
    await asyncio.sleep(0.1)

    (first_s, first), (second_s, second) = listener.received
    assert first == second
    assert second_s - first_s == pytest.approx(20 / 19_531.25, rel=1e-4)
    await line.close()


def test_same_seed_and_same_requests_give_the_same_bytes_at_the_same_instants():
    kinds = set(FaultKind) - {FaultKind.UNPLUGGED, FaultKind.ECHO}
    faults = tuple(LineFault(kind, 0.1, longest_s=0.01) for kind in sorted(kinds))

    async def session():
        line, listener = await opened(chain_of("ls182ap", "picservo-v4", faults=FaultPlan(faults, seed=6)))
        for request in (SET_ADDRESS_1, SET_ADDRESS_2, *[NO_OPERATION_1] * 40):
            line.write(request)
            await asyncio.sleep(0.02)
        await line.close()
        return listener.received

    with asyncio.Runner(loop_factory=JumpingLoop) as runner:
        first = runner.run(session())
    with asyncio.Runner(loop_factory=JumpingLoop) as runner:
        second = runner.run(session())

    assert first == second
    assert len(first) > 20
