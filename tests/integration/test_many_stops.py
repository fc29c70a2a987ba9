"""Everybody may stop at once: each gets exactly one answer, and none is refused for being one of many."""

import asyncio
import contextlib
import json

import pytest
import zenoh

from ldcnd.client.rig_client import RigClient
from ldcnd.contract.codec import decode_error
from ldcnd.daemon.requests import Requests
from ldcnd.net.hand_over import PENDING_QUERIES, Answer, Query
from ldcnd.net.zenoh_session import open_zenoh_session
from ldcnd.net.zenoh_settings import ZenohSettings
from tests.support.rig import running_rig
from tests.support.session_pair import JSON, KEYS, free_endpoint

CLIENTS = 200


async def test_each_of_200_clients_that_stop_the_rig_at_once_has_one_confirmed_answer():
    async with running_rig() as rig, contextlib.AsyncExitStack() as sessions, asyncio.TaskGroup() as group:
        clients = [
            RigClient(await sessions.enter_async_context(rig.broker.session()), rig.client.rig) for _ in range(CLIENTS)
        ]

        stops = [group.create_task(client.stop(), name="stop") for client in clients]
        replies = [await stop for stop in stops]

        assert {reply.confirmed for reply in replies} == {("x", "y", "z", "c")}
        for axis in "xyzc":
            state = await rig.client.state(axis)
            assert state
            assert state.stop_latched


@pytest.mark.real_time
@pytest.mark.long
async def test_200_unanswered_stops_are_all_held_and_each_is_answered_once():
    endpoint = free_endpoint()
    held: list[Query] = []
    client = {"mode": "client", "connect": {"endpoints": [endpoint]}, "scouting": {"multicast": {"enabled": False}}}
    config = json.dumps(client)

    def open_clients() -> list[zenoh.Session]:
        return [zenoh.open(zenoh.Config.from_json5(config)) for _ in range(CLIENTS)]

    def close_clients(clients: list[zenoh.Session]) -> None:
        for client in clients:
            client.close()

    async with open_zenoh_session(ZenohSettings(listen=(endpoint,))) as server:
        for key in KEYS.all_stops:
            await server.serve(key, held.append, complete=True, urgent=True)
        clients = await asyncio.to_thread(open_clients)
        try:
            channels = [client.get(KEYS.stop(), zenoh.handlers.FifoChannel(8), timeout=20) for client in clients]
            async with asyncio.timeout(20):
                while len(held) < CLIENTS:
                    await asyncio.sleep(0.01)  # the clients do not tell when their question has left
            for query in held:
                query.reply(b"stopped", JSON)
            replies = await asyncio.to_thread(lambda: [list(channel) for channel in channels])
        finally:
            await asyncio.to_thread(close_clients, clients)

    assert CLIENTS > PENDING_QUERIES
    assert [[reply.ok and reply.ok.payload.to_bytes() for reply in each] for each in replies] == [
        [b"stopped"]
    ] * CLIENTS


@pytest.mark.parametrize("what", ["on_stop", "on_command"])
async def test_what_comes_when_the_lines_are_closed_is_refused_in_words(what):
    answers: list[Answer] = []
    async with running_rig() as rig:
        async with asyncio.TaskGroup() as group:
            requests = Requests(rig.daemon.rig, rig.client.keys, group, rig.daemon._dispatcher)
        requests.finish()
        key = rig.client.keys.stop("x") if what == "on_stop" else rig.client.keys.command("x", "halt")
        getattr(requests, what)(Query(key, {}, b"{}", "application/json", answers.extend))

    (answer,) = answers
    assert decode_error(answer.payload, answer.encoding).code == "shutting_down"
