"""What every session promises about queries and their answers."""

import asyncio
from collections.abc import Callable

import pytest

from ldcnd.contract.codec import Encoding, rebuild_error
from ldcnd.contract.errors import ErrorCode, InternalError, OutcomeUnknown, PositionLimit
from ldcnd.net.hand_over import PENDING_QUERIES, Answer, OnQuery, Query
from tests.support.session_pair import HALT, JSON, KEYS, Pair, echo, error_of, served, until


def answering_probes(take: Callable[[Query], object]) -> OnQuery:
    """Return a callback that gives queries with a payload to `take`, and answers those without."""

    def on_query(query: Query) -> None:
        if query.payload:
            take(query)
        else:
            echo(query)

    return on_query


async def serve_commands(pair: Pair, on_query: OnQuery) -> None:
    """Serve all commands, and return when the client can reach them."""
    await pair.server.serve(KEYS.all_commands, on_query, complete=True)
    await served(pair.client, HALT)


class QueryFacts:
    """Facts about queries; the module that inherits them has a fixture `pair`."""

    async def test_a_query_carries_payload_encoding_and_parameters(self, pair: Pair) -> None:
        asked: list[Query] = []

        def remember(query: Query) -> None:
            asked.append(query)
            echo(query)

        await serve_commands(pair, remember)

        answers = await pair.client.query(HALT, b"{}", encoding=JSON, parameters={"enc": "msgpack", "a": ""})

        assert answers == [Answer(HALT, b"{}", JSON)]
        assert (asked[-1].key, asked[-1].payload, asked[-1].encoding) == (HALT, b"{}", JSON)
        assert asked[-1].parameters == {"enc": "msgpack", "a": ""}

    async def test_an_empty_payload_keeps_its_encoding(self, pair: Pair) -> None:
        await serve_commands(pair, lambda query: query.reply(b"-", query.encoding or "none"))

        (answer,) = await pair.client.query(HALT, b"", encoding=Encoding.MSGPACK.value)

        assert answer.encoding == Encoding.MSGPACK.value

    async def test_nobody_answers_where_nothing_is_served(self, pair: Pair) -> None:
        assert await pair.client.query(HALT) == []

    @pytest.mark.parametrize("wide", ["**", "ldcn/**", "ldcn/bench1/**", "ldcn/*/*/x/halt"])
    async def test_a_wildcard_query_never_reaches_a_command_or_a_stop(self, pair: Pair, wide: str) -> None:
        reached: list[str] = []

        def command(query: Query) -> None:
            reached.append(query.key)
            echo(query)

        for stop in KEYS.all_stops:
            await pair.server.serve(stop, command, complete=True, urgent=True)
        await serve_commands(pair, command)
        await served(pair.client, KEYS.stop("x"))
        reached.clear()

        answers = await pair.client.query(wide)

        assert (answers, reached) == ([], [])

    async def test_a_stop_of_the_rig_is_carried_out_once(self, pair: Pair) -> None:
        stops: list[str] = []

        def stop(query: Query) -> None:
            stops.append(query.key)
            echo(query)

        for key in KEYS.all_stops:
            await pair.server.serve(key, stop, complete=True, urgent=True)
        await served(pair.client, KEYS.stop("x"))
        stops.clear()

        answers = await pair.client.query(KEYS.stop(), urgent=True)

        assert len(answers) == 1
        assert stops == [KEYS.stop()]

    async def test_a_wildcard_query_gets_an_answer_for_each_key(self, pair: Pair) -> None:
        at_ns = 1_700_000_000_000_000_001

        def last_values(query: Query) -> None:
            for axis in ("x", "y"):
                query.reply(axis.encode(), JSON, key=KEYS.telemetry(axis, "position"), measured_at_ns=at_ns)
            query.finish()

        await pair.server.serve(KEYS.all_telemetry, last_values, complete=False)
        await served(pair.client, "ldcn/**")

        answers = await pair.client.query("ldcn/bench1/tele/*/position")

        assert answers == [Answer(KEYS.telemetry(axis, "position"), axis.encode(), JSON, at_ns) for axis in ("x", "y")]

    async def test_an_error_is_rebuilt_on_the_other_side(self, pair: Pair) -> None:
        refusal = PositionLimit("x: 412 mm is above 400 mm", axis="x", value=412.0, limit=400.0, nearest=400.0)
        await serve_commands(pair, lambda query: query.refuse(refusal))

        error = rebuild_error(error_of(await pair.client.query(HALT)))

        assert isinstance(error, PositionLimit)
        assert vars(error) == vars(refusal)

    async def test_a_handler_that_raises_still_answers(self, pair: Pair) -> None:
        unhandled: list[object] = []
        asyncio.get_running_loop().set_exception_handler(lambda _, context: unhandled.append(context["exception"]))

        def broken(_: Query) -> None:
            raise ZeroDivisionError

        await serve_commands(pair, answering_probes(broken))

        reply = error_of(await pair.client.query(HALT, b"{}"))

        assert reply.code is ErrorCode.INTERNAL
        assert [type(error) for error in unhandled] == [ZeroDivisionError]
        assert [answer.payload for answer in await pair.client.query(HALT)] == [b"none"]

    async def test_a_dropped_query_still_gets_its_answer(self, pair: Pair) -> None:
        await serve_commands(pair, answering_probes(lambda _: None))

        reply = error_of(await pair.client.query(HALT, b"{}"))

        assert reply.code is ErrorCode.INTERNAL

    async def test_a_query_is_answered_only_once(self, pair: Pair) -> None:
        refused: list[InternalError] = []

        def twice(query: Query) -> None:
            query.reply(b"first", JSON)
            again: Callable[[], None]
            for again in (lambda: echo(query), query.finish, lambda: query.reply_error(b"", JSON)):
                try:
                    again()
                except InternalError as error:
                    refused.append(error)

        await serve_commands(pair, answering_probes(twice))

        answers = await pair.client.query(HALT, b"{}")

        assert [answer.payload for answer in answers] == [b"first"]
        assert len(refused) == 3

    async def test_a_query_may_be_answered_later(self, pair: Pair) -> None:
        held: asyncio.Queue[Query] = asyncio.Queue()
        await serve_commands(pair, answering_probes(held.put_nowait))

        async with asyncio.TaskGroup() as group:
            asking = group.create_task(pair.client.query(HALT, b"{}"), name="ask")
            query = await held.get()
            query.reply(b"at last", JSON)

        assert [answer.payload for answer in asking.result()] == [b"at last"]

    async def test_an_unanswered_query_ends_with_an_unknown_outcome(self, pair: Pair) -> None:
        held: list[Query] = []
        await serve_commands(pair, answering_probes(held.append))

        with pytest.raises(OutcomeUnknown, match=r"within 0\.2 s"):
            await pair.client.query(HALT, b"{}", timeout_s=0.2)

        held.pop().finish()

    async def test_too_many_unanswered_queries_are_refused_at_once(self, pair: Pair) -> None:
        held: list[Query] = []
        await serve_commands(pair, answering_probes(held.append))

        async def all_held() -> bool:
            return len(held) == PENDING_QUERIES

        async with asyncio.TaskGroup() as group:
            asking = [group.create_task(pair.client.query(HALT, b"{}"), name="ask") for _ in range(PENDING_QUERIES)]
            await until(all_held)
            reply = error_of(await pair.client.query(HALT, b"{}"))
            for query in held:
                query.reply(b"ok", JSON)

        assert (reply.code, reply.retryable) == (ErrorCode.TOO_MANY_REQUESTS, True)
        assert [answer.payload for task in asking for answer in task.result()] == [b"ok"] * PENDING_QUERIES

        async def room_again() -> bool:
            return not (await pair.client.query(HALT))[0].is_error

        await until(room_again)

    async def test_a_cancelled_query_leaves_the_session_usable(self, pair: Pair) -> None:
        held: asyncio.Queue[Query] = asyncio.Queue()
        await serve_commands(pair, answering_probes(held.put_nowait))

        async with asyncio.TaskGroup() as group:
            asking = group.create_task(pair.client.query(HALT, b"{}"), name="ask")
            query = await held.get()
            asking.cancel()
        query.reply(b"nobody waits", JSON)

        assert asking.cancelled()
        assert [answer.payload for answer in await pair.client.query(HALT)] == [b"none"]

    async def test_what_was_begun_is_still_answered_when_serving_ends(self, pair: Pair) -> None:
        held: asyncio.Queue[Query] = asyncio.Queue()
        declaration = await pair.server.serve(KEYS.all_commands, answering_probes(held.put_nowait), complete=True)
        await served(pair.client, HALT)

        async with asyncio.TaskGroup() as group:
            asking = group.create_task(pair.client.query(HALT, b"{}"), name="ask")
            query = await held.get()
            await declaration.close()
            query.reply(b"still answered", JSON)

        assert [answer.payload for answer in asking.result()] == [b"still answered"]
