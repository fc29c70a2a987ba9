"""The rig as a whole: every axis by name, every line, and the commands that concern them all."""

import asyncio
from collections.abc import Mapping

from ldcnd.daemon.axis.axis import AxisService
from ldcnd.daemon.line.line import BusService
from ldcnd.daemon.line.modules import ModuleService
from ldcnd.drivers.driver import StopMode
from ldcnd.errors import UnknownAxis, ValueOutOfRange


class Rig:
    """All lines and axes of one daemon."""

    def __init__(
        self,
        name: str,
        buses: tuple[BusService, ...],
        groups: Mapping[str, tuple[str, ...]],
        modules: tuple[ModuleService, ...] = (),
    ) -> None:
        """Take what a rig consists of.

        Args:
            name: of the rig.
            buses: its lines.
            groups: configured groups, with the names of their axes.
            modules: its I/O modules.
        """
        self.modules = {module.name: module for module in modules}
        self.name = name
        self.buses = buses
        self.groups = groups
        self.axes: Mapping[str, AxisService] = {axis.config.name: axis for bus in buses for axis in bus.axes}

    def axis(self, name: str) -> AxisService:
        """Return the axis of that name.

        Raises:
            UnknownAxis: there is none; names those that exist.
        """
        try:
            return self.axes[name]
        except KeyError:
            raise UnknownAxis(
                f"rig {self.name} has no axis {name!r}; it has {', '.join(self.axes)}", axis=name, value=name
            ) from None

    def line(self, name: str) -> BusService:
        """Return the line of that name.

        Raises:
            ValueOutOfRange: there is none; names those that exist.
        """
        for line in self.buses:
            if line.bus.settings.name == name:
                return line
        names = ", ".join(line.bus.settings.name for line in self.buses)
        raise ValueOutOfRange(f"rig {self.name} has no bus {name!r}; it has {names}", value=name)

    def module(self, name: str) -> ModuleService:
        """Return the I/O module of that name.

        Raises:
            ValueOutOfRange: there is none; names those that exist.
        """
        try:
            return self.modules[name]
        except KeyError:
            names = ", ".join(self.modules) or "none"
            raise ValueOutOfRange(
                f"rig {self.name} has no module {name!r}; it has {names}", value=name, remedy="configure its name"
            ) from None

    def members(self, names: tuple[str, ...]) -> tuple[str, ...]:
        """Return the axes that are meant by names of axes and of groups."""
        return tuple(dict.fromkeys(axis for name in names for axis in self.groups.get(name, (name,))))

    async def stop(self, names: tuple[str, ...], mode: StopMode = StopMode.SMOOTH) -> tuple[str, ...]:
        """Stop axes at once and latch; return those whose drives confirmed it.

        Every stop is queued on its line before any of them is waited for, on each line what stops several drives by
        one packet first.
        """
        chosen = [self.axis(name) for name in names]
        async with asyncio.TaskGroup() as group:
            for bus in self.buses:
                closed = frozenset(axis.config.name for axis in bus.axes if axis in chosen and axis.tracker.enabled)
                if len(closed) > 1:
                    group.create_task(bus.stop_together(mode, closed), name=f"stop line {bus.bus.settings.name}")
            stops = {name: group.create_task(self.axis(name).stop(mode), name=f"stop {name}") for name in names}
        return tuple(name for name, stop in stops.items() if stop.result())
