"""What a client makes of a newer daemon, and of silence."""

import asyncio
import json
from collections.abc import AsyncIterator, Callable, Coroutine
from dataclasses import dataclass
from typing import Any

import pytest

from ldcnd.client.overview import health_reports
from ldcnd.client.own_samples import KEPT_RIVALS, Origin
from ldcnd.client.rig_client import RigClient, find_rigs
from ldcnd.contract.commands import CommandReply, Power
from ldcnd.contract.errors import LdcndError, OutcomeUnknown, SessionError, UnknownCommand
from ldcnd.contract.events import CommandOutcome, CommandStatus
from ldcnd.contract.health import BusHealth, DaemonHealth
from ldcnd.contract.samples import PositionSample, StateSample
from ldcnd.net.hand_over import Answer, Query
from ldcnd.net.session import Declaration, Publication, Qos, SampleKind
from ldcnd.testing.memory_session import MemoryBroker, MemorySession
from tests.support.session_pair import JSON, KEYS, POSITION

POWER = Power(on=True)
DAEMON = {
    "rig": "bench1", "version": "9", "api": 1, "instance": "i1", "started": 1, "encoding": "json", "axes": ["x"],
    "buses": [], "moon_phase": "full",
}  # fmt: skip
SAMPLE = {
    "t": 1, "t_error_ns": 0, "seq": 0, "quality": "good", "value": 1.5, "unit": "mm", "counts": 1500,
    "following_error": None, "temperature": 21.5,
}  # fmt: skip
STATE = {
    "t": 1, "t_error_ns": 0, "seq": 0, "quality": "good", "state": "standstill", "enabled": True, "referenced": True,
    "moving": "no", "link": "up", "stop_latched": False, "command": None,
}  # fmt: skip
HEALTH = {"t": 1, "seq": 2, "loop_lag_s": 0.0, "published": 1, "missed_reports": 0}
UNDER_WAY = {"seq": 1, "moving": "yes", "command": {"command_id": "m1", "verb": "move_absolute", "since": 1}}
MOVE = CommandReply(command_id="m1", axis="x", verb="move_absolute")


async def end_of_reply(client: RigClient) -> StateSample:
    state, _ = await client.end_of(MOVE)
    return state


@dataclass(frozen=True, slots=True)
class Newer:
    """A daemon of tomorrow, and a client of today."""

    session: MemorySession
    client_session: MemorySession
    client: RigClient
    broker: MemoryBroker

    async def answers(self, key: str, answer: Callable[[Query], None]) -> Declaration:
        return await self.session.serve(key, answer, complete=True)


def text(document: object) -> bytes:
    return json.dumps(document).encode()


def present(query: Query) -> None:
    query.reply(text(DAEMON), JSON)


@pytest.fixture
async def newer() -> AsyncIterator[Newer]:
    broker = MemoryBroker()
    async with broker.session() as server, broker.session() as client:
        yield Newer(server, client, RigClient(client, "bench1"), broker)


async def test_a_description_with_fields_that_are_news_is_understood(newer: Newer) -> None:
    await newer.answers(KEYS.daemon, present)

    assert (await newer.client.daemon()).instance == "i1"
    assert [rig.rig for rig in await find_rigs(newer.client_session)] == ["bench1"]


@pytest.mark.parametrize("complete", [False, True])
@pytest.mark.parametrize("serves_item", [True, False])
async def test_a_storage_with_older_values_is_not_taken_for_the_daemon(
    newer: Newer, *, complete: bool, serves_item: bool
) -> None:
    restarted = {**DAEMON, "instance": "i2", "started": 2}

    def stored(query: Query) -> None:
        if "/meta/daemon" in query.key:
            query.reply(text(DAEMON), JSON, KEYS.daemon)
        else:
            query.reply(text(SAMPLE), JSON, POSITION)
        query.finish()

    def last(query: Query) -> None:
        if serves_item:
            query.reply(text({**SAMPLE, "t": 3, "value": 9.0}), JSON, POSITION)
        query.finish()

    async with newer.broker.session() as first, newer.broker.session() as other:
        await first.serve("ldcn/bench1/**", stored, complete=complete)
        await newer.answers(KEYS.daemon, lambda query: query.reply(text(restarted), JSON))
        await newer.session.serve(KEYS.all_telemetry, last, complete=False)
        await other.serve("ldcn/bench1/**", stored, complete=complete)
        position, positions = await newer.client.position("x"), await newer.client.positions()

    assert (position and position.value, "x" in positions) == (9.0 if serves_item else None, serves_item)


async def test_a_sample_with_fields_that_are_news_is_understood(newer: Newer) -> None:
    await newer.answers(KEYS.daemon, present)
    async with newer.client.samples() as samples:
        newer.session.publish(POSITION, text(SAMPLE), encoding=JSON, qos=Qos.TELEMETRY)
        axis, sample = await anext(samples)

    assert axis == "x"
    assert isinstance(sample, PositionSample)
    assert sample.value == 1.5


@pytest.mark.parametrize("key", [KEYS.health, KEYS.bus_health("line0")])
@pytest.mark.parametrize("payload", [b"", b"\xff", b"[]", b'{"t": 1, "seq": 1}'])
async def test_a_report_that_cannot_be_understood_is_left_out_without_a_traceback(
    newer: Newer, key: str, payload: bytes
) -> None:
    raised: list[dict[str, Any]] = []
    asyncio.get_running_loop().set_exception_handler(lambda _, context: raised.append(context))
    reports: asyncio.Queue[DaemonHealth | BusHealth] = asyncio.Queue()
    await newer.answers(KEYS.daemon, present)
    async with health_reports(newer.client, reports.put_nowait):
        newer.session.publish(key, payload, encoding=JSON, qos=Qos.TELEMETRY)
        newer.session.publish(KEYS.health, text(HEALTH), encoding=JSON, qos=Qos.TELEMETRY)
        report = await reports.get()

    assert report.seq == HEALTH["seq"]
    assert not raised


async def test_samples_that_the_network_dropped_are_counted_for_each_key(newer: Newer) -> None:
    def publish(key: str, seq: int) -> None:
        newer.session.publish(key, text(SAMPLE | {"seq": seq}), encoding=JSON, qos=Qos.TELEMETRY)

    await newer.answers(KEYS.daemon, present)
    async with newer.client.samples() as samples:
        for seq in (7, 8, 11, 12, 0, 1, 3):  # two are missing, the daemon was started anew, one is missing
            publish(POSITION, seq)
            publish(KEYS.telemetry("y", "position"), seq if seq < 11 else seq - 2)
        for _ in range(14):
            await anext(samples)

    assert (samples.missed, samples.dropped) == (4, 0)


async def test_an_error_that_is_news_is_raised_in_words(newer: Newer) -> None:
    refusal = text({"code": "moon_is_full", "message": "wait for the new moon", "retryable": True})
    await newer.answers(KEYS.daemon, present)
    await newer.answers(KEYS.all_commands, lambda query: query.reply_error(refusal, JSON))

    with pytest.raises(LdcndError, match=r"wait for the new moon \(moon_is_full"):
        await newer.client.command("x", POWER)


async def test_a_command_that_nobody_answers_although_the_daemon_is_there_is_not_permitted(newer: Newer) -> None:
    await newer.answers(KEYS.daemon, present)

    with pytest.raises(SessionError, match="not permitted to command"):
        await newer.client.command("x", POWER)


async def test_a_command_whose_answer_was_lost_has_an_unknown_outcome(newer: Newer) -> None:
    def lose_answers_of_motors(query: Query) -> None:
        if query.key == KEYS.command("_", "renew"):
            query.reply_error(text({"code": "lease_unknown", "message": "there is no such lease"}), JSON)
        else:
            query.finish()

    await newer.answers(KEYS.daemon, present)
    await newer.answers(KEYS.all_commands, lose_answers_of_motors)

    with pytest.raises(OutcomeUnknown, match="may be carried out all the same"):
        await newer.client.command("x", POWER)


async def test_a_command_whose_daemon_has_disappeared_has_an_unknown_outcome(newer: Newer) -> None:
    declared = await newer.answers(KEYS.daemon, present)
    with pytest.raises(SessionError):
        await newer.client.command("x", POWER)  # now it knows the daemon
    await declared.close()

    with pytest.raises(OutcomeUnknown, match="no daemon serves rig bench1"):
        await newer.client.command("x", POWER)


async def test_a_stop_that_nobody_heard_is_sent_again_until_a_daemon_answers(newer: Newer, monkeypatch) -> None:
    query, sent = newer.client_session.query, []

    async def unheard_once(key: str, *args: Any, **how: Any) -> list[Answer]:
        answers = await query(key, *args, **how)
        sent.append(key)
        if len(sent) == 1:  # as behind a link that is made anew
            await newer.answers(key, lambda query: query.reply(text({"axes": ["x"], "confirmed": ["x"]}), JSON))
        return answers

    monkeypatch.setattr(newer.client_session, "query", unheard_once)

    reply = await newer.client.stop()

    assert reply.confirmed == ("x",)
    assert sent == [KEYS.stop()] * 2


async def test_a_stop_that_nobody_answers_is_not_confirmed_and_to_be_sent_again(newer: Newer) -> None:
    with pytest.raises(SessionError, match="the stop is not confirmed") as error:
        await newer.client.stop(timeout_s=0.1)

    assert str(error.value.remedy).startswith("send it again")


@pytest.mark.parametrize("first", [CommandStatus.ACCEPTED, CommandStatus.EXECUTING])
@pytest.mark.parametrize("wait", [end_of_reply, lambda client: client.wait_for_end("x", "m1")])
async def test_a_command_that_no_state_names_yet_has_not_ended(
    newer: Newer, first: CommandStatus, wait: Callable[[RigClient], Coroutine[Any, Any, StateSample]]
) -> None:
    status, asked = first, asyncio.Event()

    def outcome(query: Query) -> None:
        ended = CommandOutcome(command_id="m1", axis="x", verb="move_absolute", status=status, reason=None)
        query.reply(ended.model_dump_json().encode(), JSON)
        asked.set()

    def publish(**state: object) -> None:
        newer.session.publish(KEYS.telemetry("x", "state"), text(STATE | state), encoding=JSON, qos=Qos.EVENT)

    await newer.answers(KEYS.daemon, present)
    await newer.answers(KEYS.telemetry("x", "state"), lambda query: query.reply(text(STATE), JSON))
    await newer.answers(KEYS.command("_", "outcome"), outcome)
    async with asyncio.TaskGroup() as group:
        waiting = group.create_task(wait(newer.client))
        await asked.wait()
        publish(**UNDER_WAY)
        status = CommandStatus.DONE
        publish(seq=2)

    assert waiting.result().seq == 2


async def test_a_command_that_its_daemon_does_not_know_any_more_has_no_known_end(newer: Newer) -> None:
    await newer.answers(KEYS.daemon, present)
    await newer.answers(KEYS.telemetry("x", "state"), lambda query: query.reply(text(STATE), JSON))
    await newer.answers(KEYS.command("_", "outcome"), lambda query: query.refuse(UnknownCommand("no such command")))

    assert (await newer.client.wait_for_end("x", "m1")).seq == 0
    with pytest.raises(OutcomeUnknown, match="the daemon was restarted; it has no outcome of move_absolute"):
        await newer.client.end_of(MOVE)


async def test_other_sessions_without_number_take_no_memory_without_end() -> None:
    told = []

    async def find() -> None:
        raise AssertionError("nothing waits for the daemon")

    origin = Origin(find)
    origin.on_rival = lambda: told.append(origin.dropped)
    for number in (*range(1000), 999, 999):
        origin.drop(Publication(POSITION, b"", JSON, SampleKind.PUT, None, f"session {number}"))

    assert len(told) == 1000
    assert origin.dropped == 1002
    assert len(origin.rivals) == KEPT_RIVALS
