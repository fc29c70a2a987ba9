"""The velocity and the acceleration of the moves of an axis, as devices that a plan moves."""

import math
import time
from collections.abc import Callable
from typing import TYPE_CHECKING

from ldcnd.contract.errors import ValueOutOfRange
from ldcnd.lab.bluesky.status import Status, finished
from ldcnd.lab.bluesky.values import reading

if TYPE_CHECKING:
    from bluesky.protocols import Hints, Location, Reading
    from event_model.documents import DataKey

    from ldcnd.lab.bluesky.axis import PlanAxis


class Setting:
    """The velocity or the acceleration of the moves of an axis, as a device that a plan moves.

    Attributes:
        name: of the device, and of its reading in documents.
        parent: None; what it is a setting of describes it in its own configuration.
        value: as it was set; None for the default of the axis.
    """

    parent = None

    def __init__(self, axis: "PlanAxis", of: str, limit: Callable[[], float | None]) -> None:
        self.name = f"{axis.name}_{of}"
        self.value: float | None = None
        self._axis = axis
        self._of = of
        self._limit = limit

    @property
    def hints(self) -> "Hints":
        """Plot the value."""
        return {"fields": [self.name]}

    def check(self, value: float | None) -> None:
        """Raise what makes a value impossible.

        Raises:
            ValueOutOfRange: it is not above 0, or above the limit of the axis.
        """
        limit = self._limit()
        if value is not None and not 0 < value <= (math.inf if limit is None else limit):
            raise ValueOutOfRange(
                f"{self.name}: {value:g} is not above 0, or above its limit", value=value, limit=limit
            )

    def set(self, value: float | None) -> Status:
        """Have it hold for the moves that follow.

        Raises:
            ValueOutOfRange: it cannot.
        """
        self.check(value)
        self.value = value
        return finished(f"{self.name} of {value}")

    async def read(self) -> "dict[str, Reading[float]]":
        """Return what the drive's registers would hold for a move."""
        value = (await self._axis.read_speeds())[self._of]
        return {self.name: reading(math.nan if value is None else value, time.time())}

    async def describe(self) -> "dict[str, DataKey]":
        """Return what the value is."""
        return {self.name: (await self._axis.describe_speeds())[self._of]}

    async def locate(self) -> "Location[float]":
        """Return what was set, or else the default, and what the drive's registers would hold."""
        value = (await self.read())[self.name]["value"]
        return {"setpoint": value if self.value is None else self.value, "readback": value}

    def __repr__(self) -> str:
        return f"<{self.name}: {'default' if self.value is None else format(self.value, 'g')}>"
