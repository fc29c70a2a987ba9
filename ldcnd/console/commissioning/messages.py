"""What a commissioning page says on its web socket, and what it is shown: always everything, as it is now."""

from typing import Literal

from pydantic import Field

from ldcnd.bench.person import MoveCurve
from ldcnd.contract.commands import ErrorReply
from ldcnd.contract.frozen import Frozen

LONGEST_ANSWER = 400


class Choice(Frozen):
    """One of the answers to a question."""

    word: str
    """What is answered."""
    label: str
    """What it means; the word itself where that says it."""


class Question(Frozen):
    """What is asked of the person now."""

    number: int
    """Goes into the answer: one that comes too late answers nothing."""
    kind: Literal["text", "number", "choice", "change", "hold"]
    """How it is answered; `hold` by a button that stays pressed."""
    text: str
    """The question; of `hold`, what happens meanwhile."""
    default: str = ""
    """Stands in the field at first."""
    choices: tuple[Choice, ...] = ()
    """The answers there are; of `text`, some that are likely."""
    lines: tuple[str, ...] = ()
    """Of `change`: what would be changed, as `diff -u` shows it."""


class StepView(Frozen):
    """One step of the checklist."""

    name: str
    """In `begin`."""
    title: str
    """Its name for people."""
    about: str
    """What it does."""
    state: str
    """How far it is."""
    text: str
    """What it has led to, or why it is open again."""
    at: str
    """When, in UTC; empty before."""
    by: str
    """Whose answers they were."""
    obstacle: str
    """Why it cannot begin now; empty when it can."""


class View(Frozen):
    """Everything that a page shows of one axis, or of the search for drives."""

    running: str = ""
    """What is going on; empty when nothing is."""
    steps: tuple[StepView, ...] = ()
    """The checklist."""
    lines: tuple[str, ...] = ()
    """What was said since it began."""
    question: Question | None = None
    """What is asked now."""
    held: bool = False
    """The button is held: something moves, or may."""
    problem: ErrorReply | None = None
    """Why the last thing that was begun has failed."""
    unit: str = ""
    """Of the curves."""
    curves: tuple[MoveCurve, ...] = ()
    """Test moves of the last tuning."""


class ToCommissioningPage(Frozen):
    """One message to a page: either of both."""

    view: View | None = None
    """As it is now."""
    refused: ErrorReply | None = None
    """Why the page has no part in it; the web socket closes."""


class PersonAnswer(Frozen):
    """What the person answers."""

    number: int
    """Of the question."""
    text: str = Field(max_length=LONGEST_ANSWER)
    """The answer, or one of the words of a choice."""


class HoldButton(Frozen):
    """Whether the button is held."""

    number: int
    """Of the question."""
    on: bool
    """It is, for a while more; false: it was let go."""


class FromCommissioningPage(Frozen):
    """One message of a page; nothing in it but one of these has any effect."""

    begin: str | None = Field(default=None, max_length=64)
    """A step of the checklist, or `scan`, to begin."""
    by: str = Field(default="", max_length=64)
    """With `begin`: who the person is, for the record."""
    answer: PersonAnswer | None = None
    """To the question."""
    hold: HoldButton | None = None
    """Of the button."""
    leave: bool = False
    """End what is going on: what moves is halted."""
