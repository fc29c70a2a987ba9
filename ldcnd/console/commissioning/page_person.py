"""A person at a page: each question is shown, and what the page says answers it.

The dead-man is a button of the page. It counts as held as long as the page goes on saying so; when the page lets go,
falls silent or is gone, it is released, and a released one is not held again by what arrives later.
"""

import asyncio
from collections import deque
from collections.abc import AsyncIterator, Callable, Mapping, Sequence
from contextlib import asynccontextmanager

from typing_extensions import override

from ldcnd.bench.person import Left, MoveCurve, Person
from ldcnd.console.commissioning.messages import Choice, HoldButton, PersonAnswer, Question
from ldcnd.printable import printable

HELD_S = 1.0
"""The button is released after this time without a message that it is held; pages send one each tenth of a second."""
MOST_LINES = 300
YES_NO = {"yes": "Yes", "no": "No"}
WRITE = {"yes": "Write", "no": "Leave"}


class PagePerson(Person):
    """What is asked and answered on one page.

    Args:
        changed: is called when there is something else to show.

    Attributes:
        question: what is asked now.
        curves: test moves that were shown last.
        unit: of these.
    """

    def __init__(self, changed: Callable[[], None]) -> None:
        self.question: Question | None = None
        self.curves: tuple[MoveCurve, ...] = ()
        self.unit = ""
        self._changed = changed
        self._lines: deque[str] = deque(maxlen=MOST_LINES)
        self._count = 0
        self._answer: asyncio.Future[str] | None = None
        self._pressed = False
        self._released: asyncio.Event | None = None
        self._silence: asyncio.TimerHandle | None = None
        self._gone = False

    @property
    def lines(self) -> tuple[str, ...]:
        """What was said since `begin_anew`."""
        return tuple(self._lines)

    @property
    def holds(self) -> bool:
        """Whether the button is held."""
        return self._released is not None and not self._released.is_set()

    # -- what programs ask -------------------------------------------------------------------------------------------

    @override
    def tell(self, *lines: str) -> None:
        self._lines += [printable(line) for line in lines]
        self._changed()

    @override
    def show_moves(self, unit: str, curves: Sequence[MoveCurve]) -> None:
        self.unit = unit
        self.curves = tuple(curves)
        self._changed()

    @override
    async def ask(self, question: str) -> str:
        return await self.pick(question, ())

    async def pick(self, question: str, likely: Sequence[str]) -> str:
        """Return the answer to a question of which some answers are likely."""
        choices = tuple(Choice(word=each, label=each) for each in likely)
        return await self._asked(Question(number=0, kind="text", text=question, choices=choices))

    @override
    async def ask_number(self, question: str, default: float | None) -> str:
        shown = "" if default is None else f"{default:g}"
        return await self._asked(Question(number=0, kind="number", text=question, default=shown))

    @override
    async def choose(self, question: str, choices: Mapping[str, str]) -> str:
        shown = tuple(Choice(word=word, label=label) for word, label in choices.items())
        return await self._asked(Question(number=0, kind="choice", text=question, choices=shown))

    @override
    async def confirm(self, question: str) -> bool:
        return await self.choose(question, YES_NO) == "yes"

    @override
    async def approve(self, file: str, change: Sequence[str]) -> bool:
        shown = tuple(Choice(word=word, label=label) for word, label in WRITE.items())
        lines = tuple(printable(line) for line in change)
        text = f"write this into {file}"
        return await self._asked(Question(number=0, kind="change", text=text, choices=shown, lines=lines)) == "yes"

    @override
    @asynccontextmanager
    async def holding(self, what: str) -> AsyncIterator[asyncio.Event]:
        question = Question(number=0, kind="hold", text=what)
        await self._asked(question)
        while not self._pressed:  # let go before this was noticed
            await self._asked(question)
        self._released = released = asyncio.Event()
        self.question = question.model_copy(update={"number": self._count})  # the button stays until the end
        self._hear_hold()
        self._changed()
        try:
            yield released
        finally:
            self._release()
            self._released = self.question = None
            self._changed()

    # -- what the page says ------------------------------------------------------------------------------------------

    def begin_anew(self) -> None:
        """Forget the lines: something else begins."""
        self._lines.clear()

    def answer(self, answer: PersonAnswer) -> None:
        """Take an answer; one to another question, or none of the choices, is none."""
        question = self.question
        if question is None or question.number != answer.number or question.kind == "hold":
            return
        words = {each.word for each in question.choices}
        if question.kind in ("choice", "change") and answer.text not in words:
            return
        self._settle(answer.text)

    def hold(self, hold: HoldButton) -> None:
        """Take a message of the button."""
        question = self.question
        if question is None or question.kind != "hold" or question.number != hold.number:
            return
        self._pressed = hold.on
        if self._released is None:
            if hold.on:
                self._settle("")
        elif hold.on:
            self._hear_hold()
        else:
            self._release()

    def leave(self) -> None:
        """No answer will come any more, and nothing is held."""
        self._gone = True
        self._pressed = False
        self._release()
        if self._answer and not self._answer.done():
            self._answer.set_exception(Left("the page has gone"))

    # -- inner -------------------------------------------------------------------------------------------------------

    async def _asked(self, question: Question) -> str:
        if self._gone:
            raise Left("the page has gone")
        self._count += 1
        self._pressed = False
        self._answer = asyncio.get_running_loop().create_future()
        self.question = question.model_copy(update={"number": self._count, "text": printable(question.text)})
        self._changed()
        try:
            return (await self._answer).strip()
        finally:
            self.question = self._answer = None
            self._changed()

    def _settle(self, text: str) -> None:
        if self._answer and not self._answer.done():
            self._answer.set_result(text)

    def _hear_hold(self) -> None:
        if self._silence:
            self._silence.cancel()
        self._silence = asyncio.get_running_loop().call_later(HELD_S, self._release)

    def _release(self) -> None:
        if self._silence:
            self._silence.cancel()
            self._silence = None
        if self._released and not self._released.is_set():
            self._released.set()
            self._changed()
