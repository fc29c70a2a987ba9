"""Those who are told of every reading of a device, and its value as a signal of ophyd has it: suspenders need both."""

import asyncio
import logging
import math
import time
from collections.abc import AsyncIterator, Callable, Coroutine
from dataclasses import dataclass
from typing import TYPE_CHECKING, Generic, Protocol, TypeVar, cast

from ldcnd.client.loop_thread import LoopThread
from ldcnd.contract.errors import LdcndError
from ldcnd.lab.bluesky.status import Status

if TYPE_CHECKING:
    from bluesky.protocols import Callback, Reading

ValueT = TypeVar("ValueT")
ItemT = TypeVar("ItemT")
QUIET_S = 1.0
"""Silence after which the last value is checked, seconds."""
NO_NUMBER = (math.nan, -math.inf, math.inf, 0.0)
"""Stand-ins for a number that is not known; a follower gets the first, a suspender each in turn until it trips."""
NO_TEXT = ("unknown", "")
"""The same for texts."""
log = logging.getLogger("ldcnd.bluesky")


class ValueCallback(Protocol):
    """What is called as the signals of ophyd call: suspenders take that."""

    def __call__(self, *, value: object, timestamp: float) -> object:
        """Take a value."""


@dataclass(frozen=True, slots=True)
class News(Generic[ValueT]):
    """What comes of a device.

    Attributes:
        read: its reading; None where there is no new one.
        problem: why its value is not known, whatever was read; None while it is.
    """

    read: "dict[str, Reading[ValueT]] | None"
    problem: LdcndError | None = None

    @property
    def reading(self) -> "dict[str, Reading[ValueT]]":
        """The reading of news that has one."""
        assert self.read is not None  # noqa: S101 - that is what who asks for it knows
        return self.read


class Followers(Generic[ValueT]):
    """Those who follow a device, each until it is removed.

    Args:
        name: of the device, and of the value in its readings.
        loop: the devices' own.
        readings: yields what comes from now on, the last reading first when that is asked for; where nothing comes any
            more, that the value is not known.
        latest: returns the last reading.
        unknown: stands for a value that is not known, see `NO_NUMBER`.
    """

    def __init__(
        self,
        name: str,
        loop: LoopThread,
        readings: Callable[[bool], AsyncIterator[News[ValueT]]],
        latest: Callable[[], Coroutine[object, object, News[ValueT]]],
        unknown: tuple[object, ...] = NO_NUMBER,
    ) -> None:
        self._name = name
        self._loop = loop
        self._readings = readings
        self._latest = latest
        self._unknown = unknown
        self._told: News[ValueT] | None = None  # while there are followers
        self._telling: Reading[ValueT] | None = None  # while a function is told that the value is not known
        self._following: dict[object, Status] = {}
        self._told_now = 0  # how many are told

    def add(self, function: "Callback[ValueT] | ValueCallback", run: bool | None) -> None:  # noqa: FBT001 - ophyd's
        """Call a function with every reading that comes, on the devices' own thread.

        What the function raises is logged, and it is called again. So is why its value is not known, or why there are
        no more readings: who is told of values is told of none then, and a suspender trips.

        Args:
            function: what is called.
            run: unless it is None, call with `value` and `timestamp`; when true with the last value at once.
        """
        by_value = run is not None

        async def follow() -> None:
            known = True
            self._told_now += 1
            try:
                async for news in self._readings(bool(run)):
                    self._told = news
                    if news.problem and known:
                        log.warning("%s: %s", self._name, news.problem)
                        self._tell_unknown(function, by_value=by_value)
                    known = news.problem is None
                    if news.read and (known or not by_value):
                        self._tell(function, news.read, by_value=by_value)
            except LdcndError as error:
                log.error("%s: %r is not told of its values any more: %s", self._name, function, error)
                self._tell_unknown(function, by_value=by_value)
                raise
            finally:
                self._told_now -= 1
                if not self._told_now:
                    self._told = None

        self.remove(function)
        self._following[function] = Status(f"subscription of {self._name}", self._loop.start(follow()))

    def remove(self, function: "Callback[ValueT] | ValueCallback") -> None:
        """Call a function no more."""
        status = self._following.pop(function, None)
        if status:
            status.cancel()

    def value(self) -> ValueT:
        """Return the value that followers were told last, or else ask for it, which no callback of a device can.

        A follower that is being told of an unknown value gets the value that stands for it. While a suspender is
        tripped by one, so does its question for the reason. All other callers get the error. The daemon is not asked
        while there are followers: a suspender holds its lock while it asks, and waits for it while it is told.
        """
        telling = self._telling
        if telling is not None and self._loop.is_here():
            return telling["value"]
        told = self._told
        try:
            news = self._loop.run(self._latest()) if told is None else told
            if news.problem:
                raise news.problem
        except LdcndError:
            if any(getattr(function, "tripped", False) for function in tuple(self._following)):
                return cast("ValueT", self._unknown[0])  # a plan that is to begin says why it waits
            raise
        return news.reading[self._name]["value"]

    def _tell_unknown(self, function: "Callback[ValueT] | ValueCallback", *, by_value: bool) -> None:
        """Tell who is told of values that there is none; readings say themselves what they are worth."""
        for value in self._unknown if by_value else ():
            if getattr(function, "tripped", False):
                return
            self._telling = {"value": cast("ValueT", value), "timestamp": time.time()}
            try:
                self._tell(function, {self._name: self._telling}, by_value=True)
            finally:
                self._telling = None
            if not hasattr(function, "tripped"):
                return

    def _tell(
        self, function: "Callback[ValueT] | ValueCallback", read: "dict[str, Reading[ValueT]]", *, by_value: bool
    ) -> None:
        try:
            if by_value:
                its = read[self._name]
                cast("ValueCallback", function)(value=its["value"], timestamp=its["timestamp"])
            else:
                cast("Callback[ValueT]", function)(read)
        except Exception:
            log.exception("%s: %r, which is told of its values, has failed", self._name, function)


async def with_quiet(items: AsyncIterator[ItemT]) -> AsyncIterator[ItemT | None]:
    """Yield what comes, and None whenever nothing has come for `QUIET_S`.

    Args:
        items: come for ever, and survive that a wait for the next one is given up, as no generator does.
    """
    while True:
        item: ItemT | None = None
        try:
            async with asyncio.timeout(QUIET_S):
                item = await anext(items)
        except TimeoutError:
            pass
        yield item
