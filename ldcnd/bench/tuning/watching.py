"""Following axes of a running rig by what it publishes: no lease, no command; what was learnt stays on this host."""

import asyncio
from collections.abc import Callable, Sequence
from pathlib import Path

import pydantic

from ldcnd import durable
from ldcnd.bench.kept_gains import file_of, gains_in
from ldcnd.bench.tuning.effort import FEWEST_SAMPLES, SeenPosition
from ldcnd.bench.tuning.plant import Plant
from ldcnd.bench.tuning.report import TuningReport
from ldcnd.bench.tuning.shadow import LEARNT_MOTIONS, FigureAlarm, FigureName, LearnedFigures, Shadow
from ldcnd.client.rig_client import RigClient
from ldcnd.contract.errors import ConfigError, LdcndError, NotSupported, WrongState
from ldcnd.contract.meta import AxisInfo
from ldcnd.contract.questions import ReportShadow
from ldcnd.contract.samples import FigureRange, PositionSample, Quality, ShadowFigure, StateSample
from ldcnd.drives.driver import Gains
from ldcnd.drives.ldcn.profiles import PROFILES, Profile
from ldcnd.log import get_logger
from ldcnd.sim.plant import MotorPlant

log = get_logger("shadow")

LOOK_S = 10.0
"""The gains in force are read, and what was found is published, so often, seconds."""
KEEP_MOTIONS = 20
"""While an axis teaches, what it has taught is written down after so many motions."""
RATE_SAMPLES = 20
SLOWEST_S = 0.025
"""With positions farther apart than this, seconds, short motions are not judged, and this is said."""

Show = Callable[["ShadowAlarm"], None]
Tell = Callable[[str], None]


class ShadowAlarm(FigureAlarm):
    """What `ldcnd shadow` says when an axis takes more or less than it has learnt, and when that is over."""

    axis: str
    """The axis."""
    t: int
    """When the last motion had ended, UTC in ns since 1970."""
    meaning: str
    """What may be behind it."""


class KeptMemory(LearnedFigures):
    """What was learnt of an axis, as it is on the disk."""

    rig: str
    """The rig."""
    axis: str
    """The axis."""
    plant: Plant
    """The model that it was learnt with."""
    gains: dict[str, int]
    """The gains likewise; with others it means nothing."""


def memory_file(rig: str, axis: str) -> Path:
    """Return where it is kept what an axis has taught."""
    return durable.state_file("shadow", rig, axis)


def read_report(path: Path) -> TuningReport:
    """Return what `ldcnd tune --json` has printed.

    Raises:
        ConfigError: the file cannot be read, or is something else.
    """
    try:
        report = TuningReport.model_validate_json(path.read_bytes())
        _plant_of(report)
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read: {error.strerror}") from error
    except (pydantic.ValidationError, TypeError) as error:
        raise ConfigError(
            f"{path}: not a report of `ldcnd tune --json`", remedy="make one: ldcnd tune AXIS --json > AXIS.json"
        ) from error
    return report


def machine_of(report: TuningReport) -> MotorPlant:
    """Return the simulated machine that behaves as the one that was identified."""
    return _plant_of(report).motor()


def _plant_of(report: TuningReport) -> Plant:
    return Plant(**{name: each.value for name, each in report.plant.items()})


def meaning(figure: FigureName, *, more: bool, places: tuple[int, ...] = ()) -> str:
    """Return what may be behind more or less of a figure than is usual, or behind an axis that stood at some places."""
    if figure is FigureName.OUTPUT_AT_REST:
        where = f"it stood at {', '.join(map(str, places))} counts with that output"
        if len(places) > 1:
            return f"{where}: a motor without supply or without one phase, or a brake; hardly a jam"
        return (
            f"{where}: a jam, a hard stop, a brake, or a motor without supply or without one phase. Switch it off and"
            " turn it a little by hand: a motor without one phase moves on from some places, and stands at others"
        )
    match figure, more:
        case FigureName.FRICTION, True:
            return "bearings, guides, grease, a brake that drags; or a coupling that slips"
        case FigureName.FRICTION, False:
            return "less friction: new grease, or a part that does not move any more"
        case FigureName.INERTIA, True:
            return "a heavier load, or less torque from the same output: supply, motor"
        case FigureName.INERTIA, False:
            return "a lighter load, or one that does not follow: coupling, belt"
        case _:
            return "the load does not follow evenly: coupling, belt, backlash, a jam; or a load that changes"


class WatchedAxis:
    """One axis with its shadow.

    Args:
        rig: its rig.
        info: its description.
        report: of its tuning.
        show: takes alarms.
        tell: gets a line now and then.

    Raises:
        NotSupported: its drive does not report the position error.
        ConfigError: the file of what was learnt cannot be read.
    """

    def __init__(self, rig: str, info: AxisInfo, report: TuningReport, show: Show, tell: Tell) -> None:
        self.name = info.axis
        self._rig, self._show, self._tell = rig, show, tell
        self._profile = _profile_of(info)
        counts_per_unit = info.counts_per_unit or 1.0
        self._counts_per_unit = -counts_per_unit if info.direction == "reverse" else counts_per_unit
        self._plant = _plant_of(report)
        self._gains: dict[str, int] = {}
        self._shadow: Shadow | None = None
        self._memory: KeptMemory | None = None
        self._closed = False
        self._kept_at = 0
        self._taken, self._first_t, self._latest_t = 0, 0, 0
        self.described(info)
        if self._shadow is None:
            tell(f"{self.name}: waits until its loop has been closed once: its gains are not known")

    def described(self, info: AxisInfo) -> None:
        """Take the description of the axis; what was learnt with other gains is void.

        Not with those that a tuning or commissioning of this host has lent it for some moves: they teach nothing.
        """
        if file_of(self._rig, self.name).exists():
            if self._shadow is not None:
                self.keep()
                self._gains, self._shadow, self._memory = {}, None, None
                self._tell(f"{self.name}: waits until it has its own gains back")
            return
        try:
            gains = gains_in(info)
        except WrongState:
            return  # its loop is open until it has gains
        if gains == self._gains:
            return
        self._gains = gains
        self._shadow = self._begin()
        self._kept_at = 0
        what = f"learns from its first {LEARNT_MOTIONS} motions" if self._shadow.is_learning else "was learnt before"
        self._tell(f"{self.name}: {what} with these gains ({memory_file(self._rig, self.name)})")

    def _begin(self) -> Shadow:
        memory = self._kept()
        if memory is None or memory.gains != self._gains or memory.plant != self._plant:
            memory = KeptMemory(rig=self._rig, axis=self.name, plant=self._plant, gains=self._gains)
        self._memory = memory
        return Shadow(self._profile, self._plant, Gains(**{"cl": 0, **self._gains}), memory)

    def _kept(self) -> KeptMemory | None:
        path = memory_file(self._rig, self.name)
        try:
            return durable.read(path, KeptMemory.model_validate_json)
        except durable.DamagedFile as error:
            log.warning("what was learnt is lost", axis=self.name, reason=str(error))
            return None

    def keep(self) -> None:
        """Write down what was learnt.

        Raises:
            ConfigError: it cannot be written.
        """
        if self._memory is None:
            return
        path = memory_file(self._rig, self.name)
        try:
            durable.replace(path, self._memory.model_dump_json(indent=1))
        except OSError as error:
            raise ConfigError(f"{path}: cannot be written: {error.strerror}", remedy="set XDG_STATE_HOME") from error

    def state(self, sample: StateSample) -> None:
        """Take its state: with the loop open there is no law to follow."""
        if not sample.enabled and self._shadow is not None:
            self._shadow.restart()
        self._closed = sample.enabled

    def position(self, sample: PositionSample) -> None:
        """Take its position."""
        self._watch_rate(sample)
        shadow = self._shadow
        usable = self._closed and sample.quality is not Quality.BAD
        if shadow is None or not usable or sample.following_error is None:
            return
        was_learning = shadow.is_learning
        error_counts = sample.following_error * self._counts_per_unit
        self._latest_t = sample.t
        for alarm in shadow.take(SeenPosition(sample.t / 1e9, sample.counts, error_counts)):
            self._show(self._reported(alarm, sample.t))
        if was_learning and (not shadow.is_learning or shadow.motions >= self._kept_at + KEEP_MOTIONS):
            self._kept_at = shadow.motions
            self.keep()
            if not shadow.is_learning:
                self._tell(f"{self.name}: learnt; from now on its motions are compared")

    def _watch_rate(self, sample: PositionSample) -> None:
        """Say it once when positions come too seldom."""
        self._taken += 1
        if self._taken == 1:
            self._first_t = sample.t
        elif self._taken == RATE_SAMPLES:
            every_s = (sample.t - self._first_t) / 1e9 / (RATE_SAMPLES - 1)
            if every_s > SLOWEST_S:
                self._tell(
                    f"{self.name}: its position comes every {every_s * 1e3:.0f} ms: motions shorter than"
                    f" {every_s * FEWEST_SAMPLES:.1f} s are not judged; configure rates.position of 50 Hz or more"
                )

    def report(self) -> ReportShadow | None:
        """Return what is to be published of it; None before it was seen with its loop closed."""
        shadow = self._shadow
        if shadow is None or not self._latest_t:
            return None
        figures = []
        for name, mean in shadow.trend.items():
            standing = shadow.standing.get(name)
            more = mean.latest >= mean.usual
            figures.append(
                ShadowFigure(
                    figure=name.value,
                    **mean.model_dump(include=set(FigureRange.model_fields)),
                    motions=mean.motions,
                    alarm=standing is not None,
                    meaning=meaning(name, more=more, places=standing.places) if standing else None,
                )
            )
        return ReportShadow(
            t=self._latest_t, learning=shadow.is_learning, judged=shadow.motions, figures=tuple(figures)
        )

    def _reported(self, alarm: FigureAlarm, t: int) -> ShadowAlarm:
        more = alarm.latest >= alarm.usual
        return ShadowAlarm(
            axis=self.name, t=t, meaning=meaning(alarm.figure, more=more, places=alarm.places), **dict(alarm)
        )


def _profile_of(info: AxisInfo) -> Profile:
    profile = PROFILES.get(info.model)
    if profile is None or not profile.position_error_bytes:
        raise NotSupported(
            f"axis {info.axis}: a {info.model} does not report its position error with its position, so what its motor"
            " is given cannot be told",
            axis=info.axis,
        )
    return profile


async def watch(client: RigClient, reports: Sequence[TuningReport], show: Show, tell: Tell, end: asyncio.Event) -> None:
    """Follow axes until the end; sends nothing to any drive, and to the daemon only what it is to publish.

    Args:
        client: of the rig.
        reports: of the tuning of each axis.
        show: takes alarms.
        tell: gets a line now and then.
        end: ends it; what was learnt is written down then.

    Raises:
        NotSupported: the drive of one of them does not report its position error.
        ConfigError: what was learnt cannot be read or written; or an axis does not exist.
    """
    infos = {info.axis: info for info in await client.axes()}
    missing = [report.axis for report in reports if report.axis not in infos]
    if missing:
        raise ConfigError(
            f"rig {client.rig} has no axis {missing[0]!r}; it has {', '.join(infos) or 'none'}", value=missing[0]
        )
    axes = [WatchedAxis(client.rig, infos[report.axis], report, show, tell) for report in reports]
    try:
        async with asyncio.TaskGroup() as group:
            tasks = [group.create_task(_follow(client, axis), name=f"shadow of {axis.name}") for axis in axes]
            tasks.append(group.create_task(_look(client, axes), name="gains in force"))
            tasks.append(group.create_task(_publish(client, axes, tell), name="trend"))
            await end.wait()
            for task in tasks:
                task.cancel()
    finally:
        for axis in axes:
            axis.keep()


async def _follow(client: RigClient, axis: WatchedAxis) -> None:
    async with client.samples(axis.name) as samples:
        state = await client.state(axis.name)
        if state is not None:
            axis.state(state)
        async for _, sample in samples:
            if isinstance(sample, StateSample):
                axis.state(sample)
            elif isinstance(sample, PositionSample):
                axis.position(sample)


async def _publish(client: RigClient, axes: Sequence[WatchedAxis], tell: Tell) -> None:
    """Have the daemon publish what is found, now and then; a refusal is said once."""
    said = False
    while True:
        await asyncio.sleep(LOOK_S)
        for axis in axes:
            report = axis.report()
            if report is None:
                continue
            try:
                await client.ask(report, axis.name)
            except LdcndError as error:  # this login may not command, the daemon is older or away
                if not said:
                    tell(f"its trend is not published: {error.message}")
                said = True


async def _look(client: RigClient, axes: Sequence[WatchedAxis]) -> None:
    while True:
        await asyncio.sleep(LOOK_S)
        infos = {info.axis: info for info in await client.axes()}  # none while the daemon is away
        for axis in axes:
            if axis.name in infos:
                axis.described(infos[axis.name])
