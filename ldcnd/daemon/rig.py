"""The rig as a whole: every line, every axis and every I/O module by name, and the commands that concern them all."""

import asyncio
from collections.abc import Callable, Mapping
from typing import TypeVar

from ldcnd.axis.clock import Clock
from ldcnd.contract.errors import LdcndError, MalformedRequest, UnknownAxis, ValueOutOfRange
from ldcnd.contract.rig_commands import IoReply, IoTimer, SetIo, SetIoTimer
from ldcnd.contract.samples import IoReading, Quality, TelemetryItem
from ldcnd.daemon.line import BusService
from ldcnd.drives.driver import StopMode
from ldcnd.drives.network import IoDriver
from ldcnd.line.exchange import Timing
from ldcnd.line.proof import Condition, only_while, until_begun
from ldcnd.log import get_logger
from ldcnd.net.publisher import Publisher

FULL_SCALE_V = 5.0
FULL_SCALE_COUNTS = 255
MISSES_UNTIL_BAD = 3
log = get_logger("io")
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
    """

    def __init__(
        self,
        name: str,
        buses: tuple[BusService, ...],
        groups: Mapping[str, tuple[str, ...]],
        modules: tuple["ModuleService", ...] = (),
    ) -> None:
        self.name = name
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

    def members(self, names: tuple[str, ...]) -> tuple[str, ...]:
        """Return the axes that are meant by names of axes and of groups."""
        return tuple(dict.fromkeys(axis for name in names for axis in self.groups.get(name, (name,))))

    async def stop(self, names: tuple[str, ...], mode: StopMode = StopMode.SMOOTH) -> tuple[str, ...]:
        """Stop axes at once and latch; return those whose drives confirmed it.

        Every stop is queued on its line before any of them is waited for, on each line what stops several drives by
        one packet first.
        """
        chosen = [self.axes[name] for name in names]
        async with asyncio.TaskGroup() as group:
            for bus in self.buses:
                closed = frozenset(
                    axis.config.name for axis in bus.axes if axis in chosen and axis.tracker.status.enabled
                )
                if len(closed) > 1:
                    group.create_task(bus.stop_together(mode, closed), name=f"stop line {bus.bus.settings.name}")
            stops = {name: group.create_task(self.axes[name].stops.stop(mode), name=f"stop {name}") for name in names}
        return tuple(name for name, stop in stops.items() if stop.result())


class ModuleService:
    """One module under its name.

    Attributes:
        name: as configured.
        axes: on its line, whose leases cover it.
    """

    def __init__(self, driver: IoDriver, publisher: Publisher, clock: Clock, axes: tuple[str, ...]) -> None:
        self.name = driver.name
        self.axes = axes
        self._driver = driver
        self._clock = clock
        self._topic = publisher.item(driver.name, TelemetryItem.IO)
        self._misses = 0
        driver.observed, driver.lost = self._observed, self._lost

    async def set_io(self, command: SetIo, condition: Condition) -> IoReply:
        """Set outputs, if the sender still may when their packets are sent.

        Raises:
            MalformedRequest: a line is named twice.
            LdcndError: as `IoDriver.set_outputs`, or as the condition.
        """
        levels = dict.fromkeys(command.high, True) | dict.fromkeys(command.low, False)
        twice = sorted(set(command.high) & set(command.low))
        if twice:
            raise MalformedRequest(f"module {self.name}: line {twice[0]} cannot be high and low", value=twice[0])
        self._check(condition)
        with only_while(until_begun(condition)):
            reading = await self._driver.set_outputs(levels, frozenset(command.inputs), (command.pwm1, command.pwm2))
        log.info("outputs set", module=self.name, high=command.high, low=command.low, inputs=command.inputs)
        return IoReply(module=self.name, levels=reading.levels, outputs=reading.outputs)

    async def set_timer(self, command: SetIoTimer, condition: Condition) -> IoReply:
        """Choose what is counted, if the sender still may when the packet is sent.

        Raises:
            LdcndError: as `IoDriver.set_timer`, or as the condition.
        """
        self._check(condition)
        enabled, edges = command.mode is not IoTimer.OFF, command.mode is IoTimer.COUNTER
        with only_while(condition):
            await self._driver.set_timer(enabled=enabled, counts_edges=edges, prescale=command.prescale)
        reading = await self._driver.set_outputs({}, frozenset(), (None, None))
        return IoReply(module=self.name, levels=reading.levels, outputs=reading.outputs)

    def _check(self, condition: Condition) -> None:
        """Refuse before anything is noted of outputs: the line asks both again when the turn of a packet has come."""
        if not self._driver.proof.holds:
            raise self._driver.proof.refusal()
        condition()

    def _observed(self, reading: IoReading, timing: Timing) -> None:
        if not self._driver.proof.holds:
            self._lost()
            return
        self._misses = 0
        t, t_error_ns = self._clock.stamp(timing)
        self._topic.publish(
            {
                "t": t,
                "t_error_ns": t_error_ns,
                "seq": 0,
                "quality": Quality.GOOD,
                **dict(reading),
                "volts": tuple(value / FULL_SCALE_COUNTS * FULL_SCALE_V for value in reading.adc),
            }
        )

    def _lost(self) -> None:
        self._misses += 1
        self._topic.publish_again(Quality.BAD if self._misses >= MISSES_UNTIL_BAD else Quality.UNCERTAIN)
