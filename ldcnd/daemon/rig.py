"""The rig as a whole: every line, every axis and every I/O module by name, and the commands that concern them all."""

from collections.abc import Callable, Coroutine, Mapping
from types import MappingProxyType
from typing import Any, TypeVar

from ldcnd.axis.stopping import OwnStop
from ldcnd.config.ports import GuestView
from ldcnd.contract.errors import LdcndError, UnknownAxis, ValueOutOfRange
from ldcnd.contract.health import CertificateHealth
from ldcnd.daemon.line import BusService
from ldcnd.daemon.modules import ModuleService
from ldcnd.drives.driver import StopMode
from ldcnd.line.tasks import each

PartT = TypeVar("PartT")


class Named(dict[str, PartT]):
    """Parts of the rig by name; a name that is not among them is refused with those that are."""

    def __init__(self, parts: Mapping[str, PartT], unknown: Callable[[str, str], LdcndError]) -> None:
        """Take the parts.

        Args:
            parts: by name.
            unknown: returns the refusal of a name; takes it and the names that there are.
        """
        super().__init__(parts)
        self._unknown = unknown

    def __missing__(self, name: str) -> PartT:
        """Refuse a name that is not there."""
        raise self._unknown(name, ", ".join(self) or "none")


class OwnedRig:
    """All lines and axes of one daemon.

    Attributes:
        name: of the rig.
        buses: its lines.
        groups: configured groups, with the names of their axes.
        axes: by name; raises `UnknownAxis` for another one.
        lines: by name; raises `ValueOutOfRange` for another one.
        modules: the I/O modules by name; likewise.
        not_kept: why files of the state directory cannot be written, by name.
        certificate: the one in use that ends first; None without one.
    """

    def __init__(
        self,
        name: str,
        buses: tuple[BusService, ...],
        groups: Mapping[str, tuple[str, ...]],
        modules: tuple[ModuleService, ...] = (),
        not_kept: Mapping[str, str] = MappingProxyType({}),
        certificate: CertificateHealth | None = None,
    ) -> None:
        self.name = name
        self.certificate = certificate
        self.not_kept = not_kept
        self.buses = buses
        self.groups = groups
        self.axes = Named(
            {axis.config.name: axis for bus in buses for axis in bus.axes},
            lambda axis, known: UnknownAxis(f"rig {name} has no axis {axis!r}; it has {known}", axis=axis, value=axis),
        )
        self.lines = Named(
            {bus.bus.settings.name: bus for bus in buses},
            lambda line, known: ValueOutOfRange(f"rig {name} has no bus {line!r}; it has {known}", value=line),
        )
        self.modules = Named(
            {module.name: module for module in modules},
            lambda module, known: ValueOutOfRange(
                f"rig {name} has no module {module!r}; it has {known}", value=module, remedy="configure its name"
            ),
        )

    @property
    def not_kept_in_words(self) -> tuple[str, ...]:
        """Files of the state directory that cannot be written, each with the reason."""
        return tuple(f"{name}: {why}" for name, why in self.not_kept.items())

    def guest(self, port: str) -> GuestView:
        """Return the guest of a port.

        Raises:
            ValueOutOfRange: no such port is served.
        """
        served = {name: guest for bus in self.buses for name, guest in bus.guests.items()}
        return Named(
            served,
            lambda name, known: ValueOutOfRange(
                f"rig {self.name} serves no port {name!r}; it serves {known}", value=name
            ),
        )[port]

    def members(self, names: tuple[str, ...]) -> tuple[str, ...]:
        """Return the axes that are meant by names of axes and of groups."""
        return tuple(dict.fromkeys(axis for name in names for axis in self.groups.get(name, (name,))))

    async def stop(self, names: tuple[str, ...], mode: StopMode = StopMode.SMOOTH) -> dict[str, OwnStop]:
        """Stop axes at once and latch; return what became of it, by axis.

        Every stop is queued on its line before any of them is waited for, on each line what stops several drives by
        one packet first.
        """
        chosen = [self.axes[name] for name in names]
        together = dict[str, Coroutine[Any, Any, OwnStop | None]]()
        for bus in self.buses:
            # closed loops only: a stop that holds would close the open ones of its group
            closed = frozenset(axis.config.name for axis in bus.axes if axis in chosen and axis.tracker.status.enabled)
            if len(closed) > 1:
                together[f"stop line {bus.bus.settings.name}"] = bus.stop_together(mode, closed)
        done = await each({**together, **{name: self.axes[name].stops.stop(mode) for name in names}})
        return {name: own for name in names if (own := done[name])}
