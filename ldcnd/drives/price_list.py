"""The exchanges of one drive model, to compute the bus budget before there is a line."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from ldcnd.contract.samples import TelemetryItem
from ldcnd.line.exchange import Exchange


@dataclass(frozen=True, slots=True)
class PriceList:
    """The exchanges of one model at one rate.

    Attributes:
        node_baud: the rate at which the drive answers when it is set to use the nominal one.
        reading: the exchange that reads these telemetry items, and the drive's state with them.
        commands: every other exchange that is made while the line is in use, by name, in its longest form.
        probe: the exchange in the place of a stop, to measure how long one would wait.
        stop: what brings a motor to rest; None for drives that the line cannot move.
        flush: what clears the line after a loss, `settle_s` the pause behind it.
    """

    node_baud: float
    reading: Callable[[frozenset[TelemetryItem]], Exchange[Any]]
    commands: Mapping[str, Exchange[Any]]
    probe: Exchange[Any]
    stop: Exchange[Any] | None
    flush: bytes
    settle_s: float
