"""The checklist of one axis: which steps there are, which are open, and going through them with a person."""

import asyncio
import difflib
from collections.abc import Callable, Iterator, Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

from pydantic import JsonValue

from ldcnd.bench.commissioning import record as records
from ldcnd.bench.commissioning.distances import HomeRepeatability, Scale, Travel
from ldcnd.bench.commissioning.first_settings import FirstSettings, LoadStep
from ldcnd.bench.commissioning.gains import CLIENT, GainsStep
from ldcnd.bench.commissioning.holding import HoldingOutput
from ldcnd.bench.commissioning.limit_switches import LimitSwitches
from ldcnd.bench.commissioning.motor import MotorDirection
from ldcnd.bench.commissioning.record import CommissioningRecord, ConfigProposal, Result, StepRecord, StepState
from ldcnd.bench.commissioning.speed import HighestSpeed
from ldcnd.bench.commissioning.step import AxisContext, Step, StepContext
from ldcnd.bench.edit import edited_for_axis
from ldcnd.bench.kept_gains import PUT_BACK_S, KeptGains, kept_for, put_back, putting_back
from ldcnd.bench.person import Left, Person
from ldcnd.client.axis import seen
from ldcnd.client.calmed import ended_by_calm
from ldcnd.client.rig import Rig
from ldcnd.config.edit import write_over
from ldcnd.config.rig import RigConfig, load_config
from ldcnd.contract.errors import LdcndError, LeaseHeld, Remedy, UnknownAxis, WrongState
from ldcnd.contract.errors import step as remedy_step
from ldcnd.contract.meta import AxisInfo
from ldcnd.drives.axis_config import AxisConfig, MovedAxisConfig

STEPS: dict[str, Step] = {
    each.name: each
    for each in (
        LoadStep(),
        FirstSettings(),
        MotorDirection(),
        HoldingOutput(),
        Scale(),
        LimitSwitches(),
        HomeRepeatability(),
        GainsStep(),
        Travel(),
        HighestSpeed(),
    )
}
"""All of them, in the order in which they build on each other."""
LEASE_S = 2.0
"""So soon the daemon applies `loss.client` of the axis when this program disappears, seconds."""
WITHOUT_RUN = (StepState.NOT_POSSIBLE, StepState.NOT_NEEDED)
SETTLED = (StepState.DONE, StepState.SKIPPED, *WITHOUT_RUN)
SAME_IN_FILE = ("model", "address", "unit", "counts_per_unit", "direction", "modulo", "limits")
"""Settings in which the running daemon and the file must agree, or lengths and limits would mean something else."""
RELOADED = MovedAxisConfig.reloadable
RELOAD = remedy_step("reload", "ldcnd reload")


@dataclass(frozen=True, slots=True)
class Change:
    """What a step proposes, as a change of the file.

    Attributes:
        before: the file as it was.
        text: as it would be.
        lines: the difference, as `diff -u` shows it.
        restarts: keys for which the daemon must be restarted; for the others it reads the file again.
    """

    before: str
    text: str
    lines: tuple[str, ...]
    restarts: tuple[str, ...]


class Checklist:
    """The steps of one axis and what is known of them; made by `open_checklist`.

    Attributes:
        record: what is known, as it is on the disk.
        path: of the record.
    """

    def __init__(
        self, rig: Rig, config: Path, axis: str, person: Person, *, by: str, now: Callable[[], datetime] | None = None
    ) -> None:
        self.path = records.file_of(config, rig.name, axis)
        self.record = records.read(self.path, rig.name, axis)
        self._rig = rig
        self._config = config
        self._axis = axis
        self._person = person
        self._by = by
        self._now = now or (lambda: datetime.now(UTC))

    def next_open(self, after: str | None = None) -> str | None:
        """Return the first step that is neither done nor settled otherwise; None when there is none.

        Args:
            after: only those behind this one.
        """
        names = list(STEPS)
        behind = names[names.index(after) + 1 :] if after else names
        return next((name for name in behind if self.record.of(name).result.state not in SETTLED), None)

    async def refresh(self) -> list[str]:
        """Compare the record with the drive and the configuration as they are now.

        Returns:
            In words what has been reopened, and why.
        """
        site = await self._site()
        messages: list[str] = []
        record = self.record
        for name, step in STEPS.items():
            kept = record.of(name)
            begun = kept.result.state not in (StepState.OPEN, *WITHOUT_RUN)
            if begun and (differs := records.changes(kept, _basis(step, site))):
                why = f"{step.title} is open again: {'; '.join(differs)}"
                messages.append(why)
                opened = Result(state=StepState.OPEN, text="", proposals=())
                record = record.with_step(StepRecord(step=name, result=opened, reopened=why))
            elif not begun:
                by_itself = _without_run(step, site)
                if by_itself is None and kept.result.state is not StepState.OPEN:
                    record = record.with_step(StepRecord(step=name))
                elif by_itself is not None and by_itself != kept.result:
                    record = record.with_step(self._kept(step, site, by_itself))
        if record != self.record:
            self._keep(record)
        return messages

    @property
    def gains_to_put_back(self) -> KeptGains | None:
        """Gains that a step, or a tuning, that was cut short has not put back; None without such.

        Raises:
            ConfigError: the file that keeps them cannot be read.
        """
        return kept_for(self._rig.name, self._axis)

    async def put_back_gains(self) -> None:
        """Put back what `gains_to_put_back` says; nothing without such.

        Raises:
            LdcndError: as the daemon refused it; they are still to be put back.
            TimeoutError: it takes too long; likewise.
        """
        if kept := self.gains_to_put_back:
            async with asyncio.timeout(PUT_BACK_S):
                await put_back(self._rig, kept, CLIENT)

    async def _put_back_or_say(self) -> None:
        """Put back the gains that a step has left in the drive; where that fails, say why: they stay kept."""
        try:
            await self.put_back_gains()
        except (LdcndError, TimeoutError) as error:
            why = self._person.said(error) if isinstance(error, LdcndError) else f"it took longer than {PUT_BACK_S:g} s"
            by_hand = self._person.named(putting_back(self._axis), self._axis)
            self._person.tell(
                f"{self._axis}: its former gains could not be put back: {why}",
                f"the drive has gains of this step until they are: begin a step, or type: {by_hand}",
            )

    async def preview(self, name: str) -> tuple[str, ...]:
        """Return in words what a step would do now; nothing is sent to the drive.

        Raises:
            WrongState: the daemon runs with another configuration than the file.
            LdcndError: it would be refused.
        """
        site = await self._site()
        _require_same(site)
        step = STEPS[name]
        if obstacle := step.obstacle(site):
            return (obstacle,)
        return await step.preview(site)

    async def run(self, name: str) -> StepRecord:
        """Run a step that was confirmed, and keep its result; a failure is kept, too, before it is raised.

        Raises:
            LdcndError: it has failed.
            Left: the person has left in its middle; it stays as it was.
        """
        site = await self._site()
        _require_same(site)
        step = STEPS[name]
        if obstacle := step.obstacle(site):
            return self._settle(step, site, Result(state=StepState.NOT_POSSIBLE, text=obstacle))
        control = self._rig.control(self._axis, client=CLIENT, lease_s=LEASE_S)
        has_begun = False
        try:
            async with control if step.moves else self._rig.watch(self._axis) as axis:
                await seen(axis)
                has_begun = True
                ended = ended_by_calm(self._rig, axis, CLIENT, f"the step {name}")
                async with ended if step.moves else nullcontext():
                    result = await step.run(site, axis)
        except LdcndError as error:
            if has_begun:  # otherwise nothing was tried, and what is known of the step stays true
                self._settle(step, site, Result(state=StepState.FAILED, text=self._person.said(error)))
            raise
        finally:
            if has_begun:  # otherwise gains that are kept are those of a program which has control
                await self._put_back_or_say()
        return self._settle(step, site, result)

    async def settle(self, name: str, result: Result) -> StepRecord:
        """Keep the result of a step that was carried out elsewhere, or skipped for a reason."""
        return self._settle(STEPS[name], await self._site(), result)

    def change(self, name: str) -> Change | None:
        """Return how a step would change the configuration; None when it proposes nothing that is not there.

        Raises:
            ConfigError: it has to be put in by hand, or would make no configuration.
        """
        return change_of(self._config, self._axis, self.record.of(name).result.proposals)

    def write(self, change: Change) -> None:
        """Replace the configuration; it was checked whole when the change was made.

        Raises:
            ConfigError: it cannot be written, or was changed since; it is as it is.
        """
        write_over(self._config, change.before, change.text)

    async def reload(self) -> None:
        """Have the daemon read its configuration again.

        Raises:
            LdcndError: as the daemon refused it.
            LeaseHeld: another client controls the axis, which keeps its settings.
        """
        reply = await self._rig.reload()
        if kept := next((each for each in reply.changes if each.axis == self._axis), None):
            raise LeaseHeld(str(kept), axis=self._axis, remedy=Remedy("wait until it is released, then {}", RELOAD))

    # -- what it stands on -------------------------------------------------------------------------------------------

    async def _site(self) -> StepContext:
        config = axis_of(load_config(self._config), self._axis)
        infos = {info.axis: info for info in await self._rig.describe()}
        if self._axis not in infos:
            raise UnknownAxis(f"rig {self._rig.name} has no axis {self._axis!r}", axis=self._axis)
        self.record = records.read(self.path, self._rig.name, self._axis)  # another session may have added to it
        return StepContext(
            info=infos[self._axis], config=config, rig=self._rig, person=self._person, record=self.record
        )

    def _kept(self, step: Step, site: StepContext, result: Result) -> StepRecord:
        at = self._now().isoformat(timespec="seconds")
        return StepRecord(step=step.name, result=result, at=at, by=self._by, basis=_basis(step, site))

    def _settle(self, step: Step, site: StepContext, result: Result) -> StepRecord:
        kept = self._kept(step, site, result)
        self.record = records.read(self.path, self._rig.name, self._axis)
        self._keep(self.record.with_step(kept))
        return kept

    def _keep(self, record: CommissioningRecord) -> None:
        records.write(self.path, record)
        self.record = record


def change_of(config: Path, axis: str, proposals: Sequence[ConfigProposal]) -> Change | None:
    """Return how values for an axis would change a configuration; None where they are there.

    Raises:
        ConfigError: it has to be put in by hand, or would make no configuration.
    """
    tables: dict[str, dict[str, str]] = {}
    for each in proposals:
        tables.setdefault(each.table, {})[each.key] = each.literal
    before, after = config.read_text(encoding="utf-8"), edited_for_axis(config, axis, tables) if tables else ""
    if not tables or before == after:
        return None
    lines = difflib.unified_diff(before.splitlines(), after.splitlines(), str(config), str(config), lineterm="", n=2)
    restarts = tuple(each.name for each in proposals if not _is_reloaded(each.name))
    return Change(before, after, tuple(lines), restarts)


def axis_of(rig: RigConfig, name: str) -> AxisConfig:
    """Return the configuration of an axis.

    Raises:
        UnknownAxis: there is none of that name.
    """
    axes: dict[str, AxisConfig] = {axis.name: axis for bus in rig.bus for axis in bus.axis}
    if name not in axes:
        raise UnknownAxis(f"there is no axis {name!r}", axis=name, value=name, remedy=f"there are: {', '.join(axes)}")
    return axes[name]


def open_steps(record: records.CommissioningRecord, config: AxisConfig, info: AxisInfo | None) -> list[str]:
    """Return the steps of an axis that are neither done nor settled otherwise.

    Args:
        record: what is known of it.
        config: the axis, as the file has it.
        info: as the daemon describes it, which tells those that are not for it; None while none does.
    """
    still = [name for name in STEPS if record.of(name).result.state not in SETTLED]
    site = info and AxisContext(info=info, config=config)
    return [name for name in still if not site or _without_run(STEPS[name], site) is None]


def _without_run(step: Step, site: AxisContext) -> Result | None:
    """Return the result of a step that cannot be run, or need not be; None for any other."""
    if obstacle := step.obstacle(site):
        return Result(state=StepState.NOT_POSSIBLE, text=obstacle)
    if unneeded := step.unneeded(site):
        return Result(state=StepState.NOT_NEEDED, text=unneeded)
    return None


def _basis(step: Step, site: StepContext) -> dict[str, JsonValue]:
    """Return what a step depends on: who the drive is, and some of its configuration."""
    settings = site.config.model_dump(mode="json")
    basis: dict[str, JsonValue] = {"model": site.info.model, "address": site.info.address}
    if site.info.identity is not None:  # it answers
        basis["drive"] = site.info.identity
    for name in step.depends:
        value: JsonValue = settings
        for part in name.split("."):
            value = value.get(part) if isinstance(value, dict) else None
        basis[name] = value
    return basis


def _require_same(site: StepContext) -> None:
    """Refuse a daemon that runs with another configuration than the file.

    Raises:
        WrongState: names the settings.
    """
    differ = list(_differing(site.info, site.config))
    if differ:
        restarts = [name for name in differ if not _is_reloaded(name)]
        raise WrongState(
            f"axis {site.info.axis}: the daemon runs with other {' and '.join(differ)} than the file",
            axis=site.info.axis,
            remedy=f"restart the daemon with this file: it takes {' and '.join(restarts)} only then"
            if restarts
            else Remedy("{}", RELOAD),
        )


def _differing(info: AxisInfo, config: AxisConfig) -> Iterator[str]:
    for name in SAME_IN_FILE:
        if getattr(info, name) != getattr(config, name):
            yield name


def _is_reloaded(name: str) -> bool:
    return name.partition(".")[0] in RELOADED


RUN = {"yes": "Run it", "skip": "Skip it, for a reason", "no": "Not now"}


class ChecklistWalk:
    """What one person does with a checklist.

    Args:
        checklist: of the axis.
        person: the same that answers its steps.
        file: its configuration, as the person knows it.
        show: takes what a step has led to.
    """

    def __init__(self, checklist: Checklist, person: Person, file: str, show: Callable[[StepRecord], None]) -> None:
        self._checklist = checklist
        self._person = person
        self._file = file
        self._show = show

    async def put_back_gains(self) -> None:
        """Put gains back that an earlier program has left in the drive, once the person agrees.

        Raises:
            Left: the person does not: no step may run before.
        """
        if self._checklist.gains_to_put_back:
            self._person.tell("an earlier step, or a tuning, was cut short: the drive has gains of that")
            if not await self._person.confirm(
                "put the former gains back now? A loop that the daemon closes is opened for it"
            ):
                raise Left("the former gains are still to be put back")
            await self._checklist.put_back_gains()

    async def one(self, name: str) -> bool | None:
        """Explain a step, run it if the person agrees; None when the next one may follow, else whether all is well.

        Raises:
            LdcndError: it cannot begin, or has failed.
            Left: the person has left.
        """
        step = STEPS[name]
        self._person.tell("", f"{step.title} ({name})", f"  {step.about}")
        shown: tuple[str, ...] | None = None
        while (preview := await self._checklist.preview(name)) != shown:  # what was agreed to is what is run
            if shown is not None:
                self._person.tell("what it will do has changed meanwhile:")
            shown = preview
            self._person.tell(*(f"  * {line}" for line in shown))
            answer = await self._person.choose("run it", RUN)
            if answer == "no":
                return None
            if answer == "skip":
                while not (reason := await self._person.ask("for which reason")):
                    pass
                self._show(await self._checklist.settle(name, Result(state=StepState.SKIPPED, text=reason)))
                return None
        kept = await self._checklist.run(name)
        self._show(kept)
        if kept.result.state is StepState.FAILED:
            return False
        return await self.offer(name)

    async def offer(self, name: str) -> bool | None:
        """Show what a step proposes as a change of the configuration, and write it if the person agrees.

        Returns:
            True when it was written, and the daemon has to read it before the next step. None otherwise.
        """
        while change := self._checklist.change(name):
            if not await self._person.approve(self._file, change.lines):
                return None
            if change == self._checklist.change(name):  # what was shown is what is written
                break
            self._person.tell(f"{self._file} was changed meanwhile")
        if change is None:
            return None
        self._checklist.write(change)
        if change.restarts:
            keys = ", ".join(change.restarts)
            self._person.tell(f"{self._file} is changed: restart the daemon, which takes {keys} only then, and go on")
            return True
        try:
            await self._checklist.reload()
        except LdcndError as error:
            self._person.tell(f"{self._file} is changed, and the daemon has not read it: {self._person.said(error)}")
            return True
        self._person.tell(f"{self._file} is changed, and the daemon has read it")
        return None
