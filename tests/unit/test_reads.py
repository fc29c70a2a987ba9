"""Reads are answered in the time that nothing else needs, one step a turn of the loop, clients in turn."""

import asyncio
import contextlib
from collections.abc import Iterator

import pytest

from ldcnd.contract.errors import ErrorCode
from ldcnd.net.hand_over import Answer, Query
from ldcnd.net.reads import (
    BLOCKED_S,
    LEAVING_AT_ONCE,
    READS_OF_A_CLIENT,
    READS_OF_UNNAMED,
    READS_UNANSWERED,
    ReadIntake,
    Reads,
)
from ldcnd.testing.memory_session import MemoryBroker
from tests.support.session_pair import JSON, KEYS, echo, error_of

STEPS = 10


class Library:
    """Answers each read in so many steps, and notes whose step was made."""

    def __init__(self) -> None:
        self.steps: list[str] = []

    def on_read(self, query: Query) -> Iterator[None]:
        for _ in range(STEPS):
            self.steps.append(query.parameters["who"])
            yield
        query.finish()


class Desk:
    """A queryable that is only read, and clients that it has told apart."""

    def __init__(self, library: Library) -> None:
        self.intake = ReadIntake(Reads(asyncio.get_running_loop()), library.on_read)
        self.answered: list[str] = []
        self.held: list[object] = []

    def ask(self, who: str, *, take: bool = True) -> bool:
        """Ask once; a client that does not take its answer keeps it on its way."""
        admission = self.intake.admit(who)
        if admission is None:
            return False

        def send(_: tuple[Answer, ...]) -> None:
            self.answered.append(who)
            if take:
                admission.leave()
            else:
                self.held.append(admission)

        admission.offer(Query(KEYS.all_meta, {"who": who}, b"", "", send))
        return True


async def turns(count: int) -> None:
    for _ in range(count):
        await asyncio.sleep(0)


async def test_a_stop_behind_any_number_of_reads_waits_for_one_step() -> None:
    broker, library = MemoryBroker(), Library()
    steps_when_stopped: list[int] = []

    def stop(query: Query) -> None:
        steps_when_stopped.append(len(library.steps))
        echo(query)

    async with contextlib.AsyncExitStack() as sessions:
        server, stopping, *clients = [await sessions.enter_async_context(broker.session()) for _ in range(6)]
        await server.serve_reads(KEYS.all_meta, library.on_read, complete=True)
        await server.serve(KEYS.all_stops[0], stop, complete=True, urgent=True)
        async with asyncio.TaskGroup() as group:
            for number in range(len(clients) * READS_OF_A_CLIENT):
                client = clients[number % len(clients)]
                group.create_task(client.query(KEYS.all_meta, parameters={"who": "a"}), name="read")
            await turns(20)
            steps_when_asked = len(library.steps)
            await stopping.query(KEYS.stop("x"), urgent=True)
            steps_when_answered = len(library.steps)

    assert steps_when_stopped == [steps_when_asked + 1]
    assert steps_when_answered < len(library.steps) == len(clients) * READS_OF_A_CLIENT * STEPS


async def test_a_client_that_reads_once_waits_for_one_read_of_each_other() -> None:
    library = Library()
    desk = Desk(library)
    for _ in range(READS_OF_A_CLIENT):
        desk.ask("a")
        desk.ask("b")
    desk.ask("c")

    await turns(5 * STEPS)

    assert desk.answered[:3] == ["a", "b", "c"]


@pytest.mark.parametrize(("who", "bound"), [("a", READS_OF_A_CLIENT), ("", READS_OF_UNNAMED)])
async def test_a_client_has_so_many_unanswered_reads_and_others_have_theirs(who: str, bound: int) -> None:
    desk = Desk(Library())

    admitted = [desk.ask(who) for _ in range(bound + 10)]

    assert admitted == [True] * bound + [False] * 10
    assert desk.ask("b")
    assert desk.intake.refusal("key", who).limit == bound
    assert (desk.intake.load().waiting, desk.intake.load().lost) == (bound + 1, 10)


@pytest.mark.long
async def test_all_clients_together_have_so_many_unanswered_reads() -> None:
    desk = Desk(Library())

    admitted = [desk.ask(f"{client}") for client in range(100) for _ in range(READS_OF_A_CLIENT // 2)]

    assert sum(admitted) == READS_UNANSWERED


async def test_an_answered_read_makes_room_for_another() -> None:
    desk = Desk(Library())
    for _ in range(READS_OF_A_CLIENT):
        desk.ask("a")
    await turns(READS_OF_A_CLIENT * (STEPS + 5))

    assert (len(desk.answered), desk.intake.load().waiting) == (READS_OF_A_CLIENT, 0)
    assert desk.ask("a")


async def test_clients_that_take_no_answers_hold_up_others_for_a_bounded_time() -> None:
    loop = asyncio.get_running_loop()
    desk = Desk(Library())
    frozen = 4 * LEAVING_AT_ONCE
    for number in range(frozen):
        desk.ask(f"frozen {number}", take=False)
    desk.ask("reading")

    async with asyncio.timeout(60):
        while "reading" not in desk.answered:
            await asyncio.sleep(BLOCKED_S / 10)

    assert loop.time() <= BLOCKED_S * (frozen / LEAVING_AT_ONCE + 1)


async def test_reads_that_were_withdrawn_wait_no_longer() -> None:
    desk = Desk(Library())
    for who in ("a", "a", "b"):
        assert desk.ask(who)
    await turns(1)

    desk.intake.close()

    assert desk.answered == ["a", "a", "b"]  # refused
    assert desk.intake.reads.withdraw(desk.intake) == []


async def test_a_read_that_raises_is_answered_and_the_next_one_too() -> None:
    broker = MemoryBroker()
    raised: list[object] = []
    asyncio.get_running_loop().set_exception_handler(lambda _, context: raised.append(context["exception"]))

    def on_read(query: Query) -> Iterator[None]:
        yield
        if query.payload:
            raise ZeroDivisionError
        echo(query)

    async with broker.session() as server, broker.session() as client:
        await server.serve_reads(KEYS.all_meta, on_read, complete=True)

        broken = error_of(await client.query(KEYS.daemon, b"{}", encoding=JSON))
        whole = await client.query(KEYS.daemon)

    assert broken.code is ErrorCode.INTERNAL
    assert [answer.payload for answer in whole] == [b"none"]
    assert [type(error) for error in raised] == [ZeroDivisionError]


async def test_a_read_that_its_queryable_forgets_is_answered() -> None:
    broker = MemoryBroker()

    def on_read(_: Query) -> Iterator[None]:
        return iter(())

    async with broker.session() as server, broker.session() as client:
        await server.serve_reads(KEYS.all_meta, on_read, complete=True)

        forgotten = error_of(await client.query(KEYS.daemon))

    assert forgotten.code is ErrorCode.INTERNAL


async def test_reads_that_wait_when_serving_ends_are_refused() -> None:
    broker, library = MemoryBroker(), Library()
    async with broker.session() as server, broker.session() as client, asyncio.TaskGroup() as group:
        declaration = await server.serve_reads(KEYS.all_meta, library.on_read, complete=True)
        reads = [group.create_task(client.query(KEYS.all_meta, parameters={"who": "a"}), name="read") for _ in range(5)]
        await turns(4)
        await declaration.close()

    codes = [error_of(read.result()).code for read in reads]
    assert codes == [ErrorCode.SHUTTING_DOWN] * 5
    assert 0 < len(library.steps) < STEPS
