"""The session in memory: everything a session promises, in virtual time, and what only virtual time can show."""

import asyncio
from collections.abc import AsyncIterator

import pytest

from ldcnd.contract.errors import OutcomeUnknown
from ldcnd.net.hand_over import Query
from ldcnd.net.session import Publication, Qos
from ldcnd.testing.memory_session import MemoryBroker
from tests.support.query_facts import QueryFacts
from tests.support.session_facts import SampleFacts, TokenFacts
from tests.support.session_pair import JSON, KEYS, Pair, echo


@pytest.fixture
async def pair() -> AsyncIterator[Pair]:
    broker = MemoryBroker()
    async with broker.session() as server, broker.session() as client:
        yield Pair(server, client)


class TestMemorySession(SampleFacts, QueryFacts, TokenFacts):
    """The shared facts, in memory."""


async def test_a_query_waits_exactly_as_long_as_it_is_told(pair: Pair) -> None:
    loop = asyncio.get_running_loop()
    held: list[Query] = []
    await pair.server.serve(KEYS.all_commands, held.append, complete=True)

    with pytest.raises(OutcomeUnknown):
        await pair.client.query(KEYS.command("x", "halt"), timeout_s=3600)

    assert loop.time() == pytest.approx(3600)
    held.pop().finish()


async def test_answers_that_came_before_the_time_out_are_kept(pair: Pair) -> None:
    held: list[Query] = []
    await pair.server.serve(KEYS.all_telemetry, held.append, complete=False)
    await pair.client.serve(
        KEYS.all_telemetry,
        lambda query: (query.reply(b"1", JSON, key=KEYS.telemetry("x", "state")), query.finish()),
        complete=False,
    )

    answers = await pair.client.query("ldcn/**", timeout_s=1)

    assert [answer.payload for answer in answers] == [b"1"]
    held.pop().finish()


async def test_of_two_complete_queryables_one_is_asked(pair: Pair) -> None:
    await pair.server.serve(KEYS.all_commands, echo, complete=True)
    await pair.client.serve(KEYS.all_commands, echo, complete=True)

    answers = await pair.client.query(KEYS.command("x", "halt"))

    assert len(answers) == 1


async def test_of_two_incomplete_queryables_both_are_asked(pair: Pair) -> None:
    await pair.server.serve(KEYS.all_telemetry, echo, complete=False)
    await pair.client.serve(KEYS.all_telemetry, echo, complete=False)

    answers = await pair.client.query(KEYS.telemetry("x", "state"))

    assert len(answers) == 2


async def test_a_token_shown_twice_vanishes_with_the_last(pair: Pair) -> None:
    changes: asyncio.Queue[tuple[str, bool]] = asyncio.Queue()
    await pair.client.watch_tokens(KEYS.all_alive, lambda key, alive: changes.put_nowait((key, alive)))
    first = await pair.server.declare_token(KEYS.alive("i1"))
    second = await pair.client.declare_token(KEYS.alive("i1"))

    appeared = await changes.get()
    await first.close()
    quiet = changes.empty()
    await second.close()
    vanished = await changes.get()

    assert (appeared[1], quiet, vanished[1]) == (True, True, False)


async def test_undelivered_queries_are_refused_when_serving_ends(pair: Pair) -> None:
    declaration = await pair.server.serve(KEYS.all_commands, echo, complete=True)

    async with asyncio.TaskGroup() as group:
        asking = group.create_task(pair.client.query(KEYS.command("x", "halt")), name="ask")
        closing = group.create_task(declaration.close(), name="close")

    (answer,) = asking.result()
    assert answer.is_error
    assert b'"shutting_down"' in answer.payload
    assert closing.done()


async def test_a_subscription_that_raises_still_gets_what_follows(pair: Pair) -> None:
    unhandled: list[object] = []
    asyncio.get_running_loop().set_exception_handler(lambda _, context: unhandled.append(context["exception"]))
    samples: asyncio.Queue[Publication] = asyncio.Queue()

    def take(sample: Publication) -> None:
        if sample.payload == b"bad":
            raise ZeroDivisionError
        samples.put_nowait(sample)

    await pair.client.subscribe("ldcn/**", take)
    for payload in (b"bad", b"good"):
        pair.server.publish(KEYS.telemetry("x", "state"), payload, encoding=JSON, qos=Qos.EVENT)

    assert (await samples.get()).payload == b"good"
    assert [type(error) for error in unhandled] == [ZeroDivisionError]
