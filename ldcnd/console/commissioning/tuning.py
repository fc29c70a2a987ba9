"""Tuning as a step of the checklist, as the family of an axis offers it."""

from collections.abc import Awaitable, Callable
from dataclasses import dataclass
from importlib import import_module

from ldcnd.bench.commissioning.record import Result
from ldcnd.bench.person import Person
from ldcnd.client.rig_client import RigClient
from ldcnd.config.rig import RigConfig
from ldcnd.console.commissioning.messages import CurveView
from ldcnd.drives.known import FAMILIES


@dataclass(frozen=True, slots=True)
class Tuning:
    """What a tuning has led to.

    Attributes:
        result: of the step; None where the gains are the old ones.
        curves: the test moves.
        unit: of the axis.
    """

    result: Result | None
    curves: tuple[CurveView, ...] = ()
    unit: str = ""


@dataclass(frozen=True, slots=True)
class OfferedTuning:
    """How the page tunes an axis.

    Attributes:
        about: what that does, in words.
        tune: does it with the person, for an axis by name; None when nothing was tried.
    """

    about: str
    tune: Callable[[RigClient, Person, str], Awaitable[Tuning | None]]


def offered(config: RigConfig, axis: str) -> OfferedTuning | None:
    """Return how an axis of a configuration is tuned; None where nothing is known of that."""
    for bus in config.bus:
        modules = FAMILIES[bus.family].tuning
        if modules and axis in [each.name for each in bus.axis]:
            module = import_module(modules.page)
            return OfferedTuning(module.ABOUT, module.tune)
    return None
