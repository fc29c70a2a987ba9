"""Those who are told of every reading of a device, and its value as a signal of ophyd has it: suspenders need both."""

import logging
from collections.abc import AsyncIterator, Awaitable, Callable
from typing import TYPE_CHECKING, Generic, Protocol, TypeVar, cast

from ldcnd.client.loop_thread import LoopThread
from ldcnd.contract.errors import LdcndError
from ldcnd.lab.bluesky.status import Status

if TYPE_CHECKING:
    from bluesky.protocols import Callback, Reading

ValueT = TypeVar("ValueT")
log = logging.getLogger("ldcnd.bluesky")


class ValueCallback(Protocol):
    """What is called as the signals of ophyd call: suspenders take that."""

    def __call__(self, *, value: object, timestamp: float) -> object:
        """Take a value."""


class Followers(Generic[ValueT]):
    """Those who follow a device, each until it is removed.

    Args:
        name: of the device, and of the value in its readings.
        loop: the devices' own.
        readings: yields every reading from now on, the last one first when that is asked for.
        latest: returns the last reading.
    """

    def __init__(
        self,
        name: str,
        loop: LoopThread,
        readings: "Callable[[bool], AsyncIterator[dict[str, Reading[ValueT]]]]",
        latest: "Callable[[], Awaitable[dict[str, Reading[ValueT]]]]",
    ) -> None:
        self._name = name
        self._loop = loop
        self._readings = readings
        self._latest = latest
        self._told: Reading[ValueT] | None = None  # while there are followers
        self._following: dict[object, Status] = {}

    def add(self, function: "Callback[ValueT] | ValueCallback", run: bool | None) -> None:  # noqa: FBT001 - ophyd's
        """Call a function with every reading that comes, on the devices' own thread.

        What the function raises is logged, and it is called again. So is why there are no more readings.

        Args:
            function: what is called.
            run: unless it is None, call with `value` and `timestamp`; when true with the last value at once.
        """

        async def follow() -> None:
            try:
                async for read in self._readings(bool(run)):
                    self._told = read[self._name]
                    self._tell(function, read, by_value=run is not None)
            except LdcndError as error:
                log.error("%s: %r is not told of its values any more: %s", self._name, function, error)
                raise
            finally:
                self._told = None

        self.remove(function)
        self._following[function] = Status(f"subscription of {self._name}", self._loop.start(follow()))

    def remove(self, function: "Callback[ValueT] | ValueCallback") -> None:
        """Call a function no more."""
        status = self._following.pop(function, None)
        if status:
            status.cancel()

    def value(self) -> ValueT:
        """Return the value that followers were told last, or else ask for it, which no callback of a device can."""
        told = self._told
        return self._loop.run(self._asked()) if told is None else told["value"]

    async def _asked(self) -> ValueT:
        return (await self._latest())[self._name]["value"]

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
