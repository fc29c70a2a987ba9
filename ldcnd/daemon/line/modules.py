"""The I/O modules of the lines: publishes their samples and carries out commands for them."""

from ldcnd.bus.transaction import Condition, only_while
from ldcnd.daemon.clock import Clock
from ldcnd.daemon.publish.publisher import Publisher
from ldcnd.drivers.network import IoDriver, IoReading
from ldcnd.errors import MalformedRequest
from ldcnd.exchange import Timing
from ldcnd.log import get_logger
from ldcnd.model.rig_commands import IoReply, IoTimer, SetIo, SetIoTimer
from ldcnd.model.samples import Quality, TelemetryItem

FULL_SCALE_V = 5.0
FULL_SCALE_COUNTS = 255
MISSES_UNTIL_BAD = 3
log = get_logger("io")


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
        condition()
        with only_while(condition):
            reading = await self._driver.set_outputs(levels, frozenset(command.inputs), (command.pwm1, command.pwm2))
        log.info("outputs set", module=self.name, high=command.high, low=command.low, inputs=command.inputs)
        return IoReply(module=self.name, levels=reading.levels, outputs=reading.outputs)

    async def set_timer(self, command: SetIoTimer) -> IoReply:
        """Choose what is counted.

        Raises:
            BusError: the line failed.
        """
        enabled, edges = command.mode is not IoTimer.OFF, command.mode is IoTimer.COUNTER
        await self._driver.set_timer(enabled=enabled, counts_edges=edges, prescale=command.prescale)
        reading = await self._driver.set_outputs({}, frozenset(), (None, None))
        return IoReply(module=self.name, levels=reading.levels, outputs=reading.outputs)

    def _observed(self, reading: IoReading, timing: Timing) -> None:
        self._misses = 0
        t, t_error_ns = self._clock.stamp(timing)
        self._topic.publish(
            {
                "t": t,
                "t_error_ns": t_error_ns,
                "seq": 0,
                "quality": Quality.GOOD,
                "levels": reading.levels,
                "outputs": reading.outputs,
                "adc": reading.adc,
                "volts": tuple(value / FULL_SCALE_COUNTS * FULL_SCALE_V for value in reading.adc),
                "counter": reading.counter,
                "pwm": reading.pwm,
            }
        )

    def _lost(self) -> None:
        self._misses += 1
        self._topic.publish_again(Quality.BAD if self._misses >= MISSES_UNTIL_BAD else Quality.UNCERTAIN)
