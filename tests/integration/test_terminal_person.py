"""A person at a terminal: answers do not block the event loop, and a key is held for as long as it repeats."""

import asyncio
import os
import sys

import pytest

from ldcnd.bench.cli.terminal_person import TerminalPerson
from ldcnd.bench.person import Left
from ldcnd.contract.errors import ConfigError

pytestmark = pytest.mark.real_time
TICKS = 5
WITHIN_S = 30.0


class Terminal(TerminalPerson):
    """Tells a test when something was said."""

    def __init__(self):
        super().__init__(None)
        self.spoke = asyncio.Event()

    def tell(self, *lines):
        self.spoke.set()


@pytest.fixture
def keyboard(monkeypatch):
    master, slave = os.openpty()
    with os.fdopen(slave, encoding="utf-8") as terminal:
        monkeypatch.setattr(sys, "stdin", terminal)
        yield lambda text: os.write(master, text)
    os.close(master)


async def test_the_loop_goes_on_while_a_person_thinks(keyboard):
    ticks = 0

    async def tick():
        nonlocal ticks
        while True:
            await asyncio.sleep(0)
            ticks += 1
            if ticks == TICKS:
                keyboard(b" yes \nand")

    async with asyncio.timeout(WITHIN_S), asyncio.TaskGroup() as group:
        ticking = group.create_task(tick())
        answer = await Terminal().ask("really")
        ticking.cancel()

    assert answer == "yes"
    assert ticks >= TICKS


async def asked(person, question):
    """Ask, and return the task that waits for the answer once the question is there to be read."""
    asking = asyncio.create_task(person.ask(question))
    await asyncio.sleep(0)
    return asking


async def test_the_end_of_input_leaves(keyboard):
    asking = await asked(Terminal(), "really")
    keyboard(b"\x04")

    async with asyncio.timeout(WITHIN_S):
        with pytest.raises(Left):
            await asking


@pytest.mark.parametrize("ahead", [b"y\ny\n", b"y\ny"])
async def test_no_question_is_answered_by_what_was_typed_before_it(keyboard, capsys, ahead):
    person = Terminal()
    async with asyncio.timeout(WITHIN_S):
        asking = await asked(person, "move it")
        keyboard(ahead)
        first = await asking
        asking = await asked(person, "write the file")
        shown = capsys.readouterr().err
        keyboard(b"no\n")
        second = await asking

    assert shown.endswith("write the file: ")
    assert (first, second) == ("y", "no")


async def test_piped_answers_are_kept_for_their_questions(monkeypatch):
    reading, writing = os.pipe()
    os.write(writing, b"y\nno\n3\n")
    os.close(writing)
    person = Terminal()
    with os.fdopen(reading, encoding="utf-8") as piped:
        monkeypatch.setattr(sys, "stdin", piped)
        async with asyncio.timeout(WITHIN_S):
            answers = [await person.ask(question) for question in ("move it", "write the file", "how far")]

    assert answers == ["y", "no", "3"]


async def test_a_key_that_is_not_repeated_counts_as_released(keyboard):
    person = Terminal()

    async def press(key):
        await person.spoke.wait()
        keyboard(key)

    async with asyncio.timeout(WITHIN_S), asyncio.TaskGroup() as group:
        group.create_task(press(b" "))
        async with person.holding("it moves") as released:
            assert not released.is_set()
            await released.wait()


@pytest.mark.parametrize("keys", [b"q", b" q", b"q "])
async def test_another_key_moves_nothing(keyboard, keys):
    person = Terminal()

    async def press():
        await person.spoke.wait()
        keyboard(keys)

    async with asyncio.timeout(WITHIN_S), asyncio.TaskGroup() as group:
        group.create_task(press())
        with pytest.raises(Left):
            async with person.holding("it moves"):
                pytest.fail("it would have moved")


async def test_without_a_keyboard_a_time_is_needed(monkeypatch, tmp_path):
    nothing = tmp_path / "nothing"
    nothing.touch()
    with nothing.open() as file:
        monkeypatch.setattr(sys, "stdin", file)
        with pytest.raises(ConfigError, match="no keyboard"):
            async with Terminal().holding("it moves"):
                pytest.fail("it would have moved")
        with pytest.raises(Left):
            await Terminal().ask("really")
