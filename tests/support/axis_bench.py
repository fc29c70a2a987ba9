"""One axis with all of its commands on a drive that does nothing by itself: no line, no polls, no packets.

A test shows the axis what the drive reads, sends commands, and looks at what the drive was told. What happens while a
call of the drive is under way - a stop, a lost reply - is put in `during`.
"""

import asyncio
from collections.abc import AsyncIterator, Awaitable, Callable, Sequence
from contextlib import asynccontextmanager
from dataclasses import replace
from typing import Any, cast

from typing_extensions import override

from ldcnd.axis.axis import AxisService
from ldcnd.axis.clock import Clock
from ldcnd.axis.permit import UNCONDITIONAL, Right
from ldcnd.axis.readings import Arrival
from ldcnd.axis.scale import AxisScale
from ldcnd.axis.status import AxisStatus, CommandEnd
from ldcnd.axis.tracker import AxisTracker
from ldcnd.contract.codec import Encoding
from ldcnd.contract.commands import AxisCommand, CommandReply, HomeMethod, PinMode, Power, Verb
from ldcnd.contract.errors import LdcndError
from ldcnd.contract.events import CommandStatus
from ldcnd.contract.keys import Keys
from ldcnd.contract.samples import Sample, TelemetryItem
from ldcnd.contract.units import AxisUnits
from ldcnd.drives.axis_config import AxisConfig
from ldcnd.drives.driver import (
    NO_CEILING,
    AnalogMotion,
    AxisReading,
    AxisSpec,
    Ceiling,
    CountsMotion,
    Gains,
    HomeCapture,
    Moves,
    PwmOutput,
    StopMode,
)
from ldcnd.line.bus import Bus
from ldcnd.line.exchange import Exchange, ReplyVerdict, Timing
from ldcnd.line.proof import Proofs
from ldcnd.net.publisher import Publisher
from ldcnd.net.session import Publication
from ldcnd.testing.memory_session import MemoryBroker

KEYS = Keys("bench")
COUNTS_PER_MM = 1000
GAINS = Gains(kp=350, kd=3000, ki=400, il=400, ol=250, cl=0, el=4000, sr=1, deadband=0)
AT_REST = AxisReading(
    position_counts=0,
    following_error_counts=None,
    velocity_counts_per_s=0.0,
    velocity_resolution_counts_per_s=1953.0,
    adc_counts=None,
    enabled=False,
    profile_done=True,
    homing=False,
    faults=(),
)
RUNNING: dict[str, Any] = {"profile_done": False, "velocity_counts_per_s": 10_000.0}
STANDING: dict[str, Any] = {"profile_done": True, "velocity_counts_per_s": 0.0}

Happening = Callable[[], Awaitable[None]]


class FakeDrive(Moves):
    """A drive that records what it is told.

    Attributes:
        shown: what a reading returns.
        told: the calls, in order: a name and what came with it.
        during: by name of a call, what happens while it is under way, once; it may raise.
        home_counts: what was captured.
    """

    def __init__(self) -> None:
        self.spec = AxisSpec("x", 1, "pic-servo-v4", GAINS)
        self.wanted_gains = GAINS
        self.identity = None
        self.capabilities = frozenset(Verb)
        self.adc_full_scale = 1023
        self.home_methods = frozenset(HomeMethod)
        self.shown = AT_REST
        self.told: list[tuple[str, Any]] = []
        self.during: dict[str, Happening] = {}
        self.home_counts = 0

    @property
    def calls(self) -> list[str]:
        """Return the names of the calls so far."""
        return [name for name, _ in self.told]

    async def _take(self, name: str, what: object = None) -> None:
        self.told.append((name, what))
        if happening := self.during.pop(name, None):
            await happening()

    @override
    def reading(self, items: frozenset[TelemetryItem]) -> Exchange[AxisReading]:
        return Exchange(1, b"", 0, lambda _data: ReplyVerdict.INTACT, lambda _data: self.shown, 0.0, repeatable=True)

    @override
    def quantise(self, motion: CountsMotion, most: Ceiling = NO_CEILING, *, in_motion: bool = False) -> CountsMotion:
        return motion

    @override
    def quantise_output(self, output: PwmOutput, most: Ceiling = NO_CEILING) -> PwmOutput:
        return output

    @override
    def exchanges(
        self, legs: Sequence[CountsMotion], here: AxisReading, gains: Gains | None
    ) -> tuple[Exchange[Any], ...]:
        return ()

    @override
    async def power(self, *, on: bool) -> None:
        await self._take("power", on)
        self.shown = replace(self.shown, enabled=on)

    @override
    async def load(
        self,
        motion: CountsMotion | AnalogMotion | PwmOutput,
        *,
        home: HomeCapture | None = None,
        stands_when_done: bool = True,
    ) -> None:
        await self._take("load", motion if home is None else (motion, home))

    @override
    async def start(self) -> None:
        await self._take("start")

    @override
    async def stop(self, mode: StopMode) -> StopMode:
        await self._take("stop", mode)
        return mode

    @override
    def stands_on(self, limit: HomeMethod, reading: AxisReading) -> bool:
        return False

    @override
    async def captured_home(self) -> int:
        await self._take("captured_home")
        return self.home_counts

    @override
    async def reset(self) -> None:
        await self._take("reset")

    @override
    async def clear_warnings(self) -> None:
        await self._take("clear_warnings")

    @override
    async def set_gains(self, gains: Gains, *, stands_when_done: bool = True) -> None:
        await self._take("set_gains", gains)
        self.wanted_gains = gains

    @override
    async def track(self, position_counts: int, *, stands_when_done: bool = True) -> None:
        await self._take("track", position_counts)

    @override
    async def set_outputs(self, limit1: PinMode | None, limit2: PinMode | None) -> None:
        await self._take("set_outputs", (limit1, limit2))


class IdleBus:
    """A line without a wire: what is asked of the drive is answered by it at once.

    Attributes:
        is_open: as of a `Bus`.
        distrusted: how often late replies were to be looked for.
        withdrawn: the nodes whose waiting exchanges were withdrawn, with the reasons.
        during: what happens while an exchange is under way, once.
        proofs: as of a `Bus`.
    """

    def __init__(self) -> None:
        self.is_open = True
        self.distrusted = 0
        self.withdrawn: list[tuple[int, LdcndError]] = []
        self.during: Happening | None = None
        self.proofs = Proofs()

    async def execute(self, exchange: Exchange[Any], *_args: object, **_kwargs: object) -> object:
        """Answer an exchange."""
        happening, self.during = self.during, None
        if happening:
            await happening()
        return exchange.decode(b"")

    def distrust(self) -> None:
        """Take note."""
        self.distrusted += 1

    def withdraw(self, node: int, error: LdcndError) -> None:
        """Take note."""
        self.withdrawn.append((node, error))


def tracked(name: str = "x", unit: str = "mm", **fields: Any) -> AxisTracker:
    """Return the tracker of an axis whose drive is known to be the one that is meant."""
    proof = Proofs().expect(1, f"axis {name}", name)
    proof.prove()
    return AxisTracker(AxisStatus(name, AxisScale(AxisUnits(unit, {})), **fields), proof)


def put(tracker: AxisTracker, **fields: Any) -> None:
    """Have a tracker know something else, as if it had been observed or commanded."""
    tracker.status = replace(tracker.status, **fields)


class AxisBench:
    """One axis at work, and what a test needs of it.

    Attributes:
        ended: the commands that are over: id, status, reason.
        notes: what happened outside any command.
        heard: the items that were published, in their order.
    """

    def __init__(self, config: AxisConfig, publisher: Publisher, heard: list[str]) -> None:
        self.drive = FakeDrive()
        self.bus = IdleBus()
        self.proof = self.bus.proofs.expect(self.drive.spec.address, f"axis {config.name}", config.name)
        self.proof.prove()
        self.ended: list[tuple[str, CommandStatus, str | None]] = []
        self.notes: list[tuple[str, CommandStatus, str]] = []
        self.heard = heard
        self._ids = iter(f"own-{number}" for number in range(1000))
        self._publisher = publisher
        self.axis = AxisService(
            config,
            cast("Bus", self.bus),  # only what is fake is called
            self.drive,
            publisher,
            Clock(lambda: round(asyncio.get_running_loop().time() * 1e9)),
            lambda: next(self._ids),
            self._ended,
            lambda _axis, verb, status, reason, _code: self.notes.append((verb, status, reason)),
        )
        self.tracker = self.axis.tracker
        self.axis.connected(placed=True)

    def _ended(self, end: CommandEnd, _arrival: Arrival | None) -> None:
        self.ended.append((end.command.command_id, end.status, end.reason))

    def published(self, item: TelemetryItem) -> Sample | None:
        """Return the last sample of an item; its fields are those of its model, in their order."""
        sample = self._publisher.last.get(KEYS.telemetry(self.axis.config.name, item))
        if sample is None:
            return None
        assert list(vars(sample)) == list(type(sample).model_fields)
        return type(sample).model_validate(vars(sample), strict=True)

    def show(self, **changes: Any) -> None:
        """Let the axis see what the drive reads from now on."""
        self.drive.shown = replace(self.drive.shown, **changes)
        now_s = asyncio.get_running_loop().time()
        self.axis.readings.accept(self.drive.shown, frozenset(), Timing(now_s, now_s, now_s, now_s))

    async def pass_s(self, seconds: float, **changes: Any) -> None:
        """Let time pass, then show the drive's reading, and let the axis act upon it."""
        await asyncio.sleep(seconds)
        self.show(**changes)
        await asyncio.sleep(0.001)

    async def settled(self, **changes: Any) -> None:
        """Show a reading for so long that rest is proven."""
        self.show(**(STANDING | changes))
        for _ in range(3):
            await self.pass_s(1.0)

    async def send(
        self, command: AxisCommand[CommandReply], command_id: str | None = None, right: Right = UNCONDITIONAL
    ) -> CommandReply:
        """Carry out a command under a permit of its own."""
        name = command_id or next(self._ids)
        return await self.axis.execute(command, self.axis.permit(name, command.verb, right))

    async def power_on(self) -> None:
        """Close the loop at rest, and forget how."""
        await self.settled()
        await self.send(Power(on=True))
        await self.settled(enabled=True)
        self.drive.told.clear()

    async def stop(self) -> None:
        """Stop, as a client does."""
        await self.axis.stops.stop(StopMode.SMOOTH)


def raising(error: BaseException) -> Happening:
    """Return what lets a call fail."""

    async def fail() -> None:
        raise error

    return fail


@asynccontextmanager
async def axis_bench(*, powered: bool = True, **axis: object) -> AsyncIterator[AxisBench]:
    """Run an axis until the context ends.

    Args:
        powered: its loop is closed and it stands.
        axis: overrides and additions to its configuration.
    """
    document = {
        "name": "x", "address": 1, "model": "pic-servo-v4", "unit": "mm", "counts_per_unit": COUNTS_PER_MM,
        "velocity": 20, "acceleration": 200,
        "gains": {"kp": 350, "kd": 3000, "ki": 400, "il": 400, "ol": 250, "el": 4000},
        "settle": {"window": 1e6, "time_s": 0},  # the end of a profile is the end, wherever the test shows the axis
    }  # fmt: skip
    config = AxisConfig.model_validate(document | axis)
    heard: list[str] = []

    def overhear(sample: Publication) -> None:
        heard.append(sample.key.rpartition("/")[2])

    async with MemoryBroker().session(overhear=overhear) as session, asyncio.TaskGroup() as group:
        bench = AxisBench(config, Publisher(session, KEYS, Encoding.JSON), heard)
        running = group.create_task(bench.axis.run(), name="axis")
        try:
            if powered:
                await bench.power_on()
            yield bench
        finally:
            running.cancel()
