"""The person whom a program asks: answers, confirmation, and a key that is held while something moves.

Commissioning and tuning know neither terminal nor browser: `ldcnd commission` and a page of the console are two such
persons.
"""

import asyncio
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from contextlib import AbstractAsyncContextManager

from ldcnd.contract.errors import LdcndError, RemedyCommand
from ldcnd.contract.frozen import Frozen
from ldcnd.contract.number_text import NotANumber, read_number
from ldcnd.contract.units import Described, Dimension, read_quantity

YES = ("y", "yes")
NO = ("n", "no")
LEAST, MOST = 1e-12, 1e12
"""Range of a number that a person types, either way, beside 0: what is worked out with it stays finite."""


class Left(Exception):
    """The person has left: no answer will come."""


class MoveCurve(Frozen):
    """One way of a test move, drawn forward."""

    label: str
    """What it shows."""
    times_s: tuple[float, ...]
    """From the begin of the move, seconds."""
    positions: tuple[float, ...]
    """Positions, in axis units."""
    following_errors: tuple[float, ...]
    """What they are behind the command, in axis units."""


class Person(ABC):
    """Answers questions; none of these may block the event loop, because control over the axis is renewed on it."""

    @abstractmethod
    def tell(self, *lines: str) -> None:
        """Show lines of text."""

    @abstractmethod
    async def ask(self, question: str) -> str:
        """Return the answer to a question, without spaces around it.

        Raises:
            Left: none will come.
        """

    @abstractmethod
    def holding(self, what: str) -> AbstractAsyncContextManager[asyncio.Event]:
        """Begin when the person holds the key that allows a motion; yields what is set when it is released.

        Args:
            what: what happens while it is held.

        Raises:
            Left: the key will not be held.
        """

    def named(self, command: RemedyCommand, axis: str | None) -> str:  # noqa: ARG002 - a terminal needs the axis
        """Return how a command is named to this person; by default as its remedy does."""
        return command.said

    def said(self, error: LdcndError) -> str:
        """Return an error and its remedy in one line."""
        if not error.remedy:
            return error.message
        return f"{error.message}; {error.remedy.phrased(lambda command: self.named(command, error.axis))}"

    def show_moves(self, unit: str, curves: Sequence[MoveCurve]) -> None:  # noqa: B027 - a terminal draws nothing
        """Draw test moves, where there is a place for that."""

    async def choose(self, question: str, choices: Mapping[str, str]) -> str:
        """Ask until the answer is one of some words, or begins one of them only; return that word.

        Args:
            question: without the words.
            choices: what each word means, where a word alone does not say it.
        """
        while True:
            answer = (await self.ask(f"{question}: {', '.join(choices)}")).lower()
            found = [word for word in choices if answer == word] or [
                word for word in choices if word.startswith(answer)
            ]
            if answer and len(found) == 1:
                return found[0]
            self.tell(f"{answer!r} is none of {', '.join(choices)}")

    async def approve(self, file: str, change: Sequence[str]) -> bool:
        """Show the change of a file, as `diff -u` does, and ask whether to write it."""
        self.tell(*change)
        return await self.confirm(f"write this into {file}")

    async def confirm(self, question: str) -> bool:
        """Ask until the answer is yes or no."""
        while True:
            answer = (await self.ask(f"{question} [y/n]")).lower()
            if answer in YES + NO:
                return answer in YES

    async def ask_number(self, question: str, default: float | None) -> str:
        """Return what is answered to the question for a number, as text."""
        return await self.ask(question if default is None else f"{question} [{default:g}]")

    async def number(self, question: str, default: float | None = None, of: Described | None = None) -> float:
        """Ask until the answer is 0 or a number from `LEAST` to `MOST`, either way; an empty one is the default.

        It may be a distance `of` an axis, in any of its units.
        """
        while True:
            answer = await self.ask_number(question, default)
            if not answer and default is not None:
                return default
            if (number := typed_number(answer, of)) is not None:
                return number
            self.tell(f"{answer!r} is no number: 0, or {LEAST:g} to {MOST:g} either way")


def typed_number(text: str, of: Described | None = None, dimension: Dimension = Dimension.POSITION) -> float | None:
    """Return a number that was typed; None for any other text, and for one that is too large or too small."""
    try:
        number = read_number(text) if of is None else read_quantity(text, of, dimension)
    except NotANumber:
        return None
    return number if not number or LEAST <= abs(number) <= MOST else None
