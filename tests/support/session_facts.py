"""What every session promises about samples, tokens and its end."""

import asyncio

import pytest

from ldcnd.contract.errors import SessionError
from ldcnd.net.session import UNDELIVERED_SAMPLES, Publication, Qos, SampleKind
from tests.support.session_pair import HALT, JSON, KEYS, POSITION, Pair, echo, served, subscribed


class SampleFacts:
    """Facts about samples; the module that inherits them has a fixture `pair`."""

    async def test_a_sample_arrives_with_its_key_encoding_and_instant(self, pair: Pair) -> None:
        samples = await subscribed(pair.server, pair.client)
        encoding, at_ns = "application/msgpack;position_sample", 1_700_000_000_123_456_789

        pair.server.publish(POSITION, b"\x81", encoding=encoding, qos=Qos.TELEMETRY, measured_at_ns=at_ns)

        async with asyncio.timeout(2):
            sample = await samples.get()
        assert sample[:5] == Publication(POSITION, b"\x81", encoding, SampleKind.PUT, at_ns)[:5]

    async def test_a_sample_names_the_session_that_an_answer_names(self, pair: Pair) -> None:
        """The only proof of origin: a program on the way puts its own name into a time stamp that is missing."""
        await pair.server.serve(HALT, echo, complete=True)
        await served(pair.client, HALT)
        samples = await subscribed(pair.server, pair.client)

        (answer,) = await pair.client.query(HALT)
        pair.server.publish(POSITION, b"1", encoding=JSON, qos=Qos.TELEMETRY)
        pair.server.publisher(POSITION, encoding=JSON, qos=Qos.TELEMETRY)(b"2", 1)
        pair.server.delete(POSITION)
        pair.client.publish(POSITION, b"3", encoding=JSON, qos=Qos.TELEMETRY)

        async with asyncio.timeout(2):
            found = {(sample := await samples.get()).payload: sample.source for _ in range(4)}
        other = found.pop(b"3")
        assert set(found.values()) == {answer.source}
        assert other not in ("", answer.source)

    async def test_samples_of_a_key_arrive_in_order_and_the_deletion_last(self, pair: Pair) -> None:
        samples = await subscribed(pair.server, pair.client)

        for number in range(30):
            pair.server.publish(POSITION, b"%d" % number, encoding=JSON, qos=Qos.TELEMETRY)
        pair.server.delete(POSITION)

        async with asyncio.timeout(2):
            arrived = [await samples.get() for _ in range(31)]
        assert [sample.payload for sample in arrived[:30]] == [b"%d" % number for number in range(30)]
        assert (arrived[30].kind, arrived[30].payload) == (SampleKind.DELETE, b"")

    async def test_a_flooded_subscription_ends_with_the_newest_samples(self, pair: Pair) -> None:
        samples = await subscribed(pair.server, pair.server)
        published = 10 * UNDELIVERED_SAMPLES

        # nothing is delivered in between: the loop is busy publishing to its own session
        for number in range(published):
            pair.server.publish(POSITION, b"%d" % number, encoding=JSON, qos=Qos.TELEMETRY)

        async with asyncio.timeout(2):
            arrived = [int((await samples.get()).payload) for _ in range(UNDELIVERED_SAMPLES)]
        assert arrived == list(range(published - UNDELIVERED_SAMPLES, published))
        assert samples.empty()

    async def test_samples_that_may_linger_arrive_in_order_and_none_after_the_end(self, pair: Pair) -> None:
        await subscribed(pair.server, pair.client)
        arrived: asyncio.Queue[Publication] = asyncio.Queue()
        declaration = await pair.client.subscribe("ldcn/bench1/tele/x/*", arrived.put_nowait, kept=1000, linger_s=0.02)
        while arrived.empty():
            pair.server.publish(POSITION, b"first", encoding=JSON, qos=Qos.TELEMETRY)
            await asyncio.sleep(0.01)

        for number in range(300):
            pair.server.publish(POSITION, b"%d" % number, encoding=JSON, qos=Qos.TELEMETRY)

        async with asyncio.timeout(5):
            samples = [await arrived.get()]
            while samples[-1].payload != b"299":
                samples.append(await arrived.get())
        await declaration.close()
        pair.server.publish(POSITION, b"late", encoding=JSON, qos=Qos.TELEMETRY)
        await asyncio.sleep(0.1)
        assert [sample.payload for sample in samples if sample.payload != b"first"] == [b"%d" % n for n in range(300)]
        assert arrived.empty()

    async def test_a_closed_subscription_takes_nothing_more(self, pair: Pair) -> None:
        kept = await subscribed(pair.server, pair.client)
        dropped: list[Publication] = []
        declaration = await pair.client.subscribe("ldcn/**", dropped.append)

        await declaration.close()
        await declaration.close()
        dropped.clear()
        pair.server.publish(POSITION, b"1", encoding=JSON, qos=Qos.EVENT)

        async with asyncio.timeout(2):
            await kept.get()
        assert dropped == []


class TokenFacts:
    """Facts about liveliness tokens and the end of a session."""

    async def test_a_token_appears_and_vanishes_with_its_declaration(self, pair: Pair) -> None:
        changes: asyncio.Queue[tuple[str, bool]] = asyncio.Queue()
        token = KEYS.alive("i1")
        await pair.client.watch_tokens(KEYS.all_alive, lambda key, alive: changes.put_nowait((key, alive)))

        async with asyncio.timeout(3):
            declaration = await pair.server.declare_token(token)
            appeared = await changes.get()
            await declaration.close()
            vanished = await changes.get()

        assert (appeared, vanished) == ((token, True), (token, False))

    async def test_a_watch_begins_with_the_tokens_that_are_there(self, pair: Pair) -> None:
        changes: asyncio.Queue[tuple[str, bool]] = asyncio.Queue()
        other, own = KEYS.alive("i1"), KEYS.alive("i2")
        await pair.server.declare_token(other)
        await pair.client.declare_token(own)

        async with asyncio.timeout(3):
            await pair.client.watch_tokens(KEYS.all_alive, lambda key, alive: changes.put_nowait((key, alive)))
            seen = {await changes.get(), await changes.get()}

        assert seen == {(other, True), (own, True)}

    async def test_tokens_vanish_with_their_session(self, pair: Pair) -> None:
        changes: asyncio.Queue[tuple[str, bool]] = asyncio.Queue()
        await pair.client.watch_tokens(KEYS.all_alive, lambda key, alive: changes.put_nowait((key, alive)))
        await pair.server.declare_token(KEYS.alive("i1"))

        async with asyncio.timeout(5):
            appeared = await changes.get()
            await pair.server.close()
            vanished = await changes.get()

        assert (appeared[1], vanished[1]) == (True, False)

    async def test_a_closed_session_says_so(self, pair: Pair) -> None:
        await pair.client.close()
        await pair.client.close()

        with pytest.raises(SessionError, match="closed"):
            pair.client.publish(POSITION, b"", encoding=JSON, qos=Qos.EVENT)
        with pytest.raises(SessionError, match="closed"):
            pair.client.delete(POSITION)
        with pytest.raises(SessionError, match="closed"):
            await pair.client.query(POSITION)
        with pytest.raises(SessionError, match="closed"):
            await pair.client.subscribe(POSITION, print)
