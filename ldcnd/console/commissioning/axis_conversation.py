"""The checklist of one axis on a page."""

from pathlib import Path

from typing_extensions import override

from ldcnd.bench.commissioning import record as records
from ldcnd.bench.commissioning.checklist import STEPS, Checklist, ChecklistWalk
from ldcnd.bench.commissioning.record import CommissioningRecord, StepRecord, StepState
from ldcnd.client.rig import Rig
from ldcnd.config.rig import load_config
from ldcnd.console.commissioning.conversation import Conversation
from ldcnd.console.commissioning.messages import FromCommissioningPage, StepView, View
from ldcnd.console.rigs import Rigs
from ldcnd.contract.errors import UnknownVerb


class AxisConversation(Conversation):
    """One page and one axis.

    Args:
        rigs: of the console.
        config: the configuration of the rig.
        axis: its name.
        visitor: who has the page, where the person gives no name.
    """

    def __init__(self, rigs: Rigs, config: Path, axis: str, visitor: str) -> None:
        super().__init__()
        self._rigs = rigs
        self._config = config
        self._axis = axis
        self._visitor = visitor
        self._record = CommissioningRecord(rig="", axis=axis)
        self._seen: object = None

    @override
    def shown(self) -> View:
        return View(
            steps=tuple(self._step_view(self._record.of(name)) for name in STEPS),
            unit=self.person.unit,
            curves=self.person.curves,
        )

    @override
    async def refresh(self) -> None:
        self._seen = self._outside()
        config = load_config(self._config)
        self._record = records.read(records.file_of(self._config, config.rig, self._axis), config.rig, self._axis)
        if config.rig in self._rigs.names:
            await self._opened(self._visitor)

    @override
    def is_stale(self) -> bool:
        return self._outside() != self._seen

    @override
    async def carry_out(self, begun: FromCommissioningPage) -> None:
        if begun.begin not in STEPS:
            raise UnknownVerb(f"there is no step {begun.begin!r}", value=begun.begin)
        checklist = await self._opened(begun.by.strip() or self._visitor)
        walk = ChecklistWalk(checklist, self.person, str(self._config), lambda kept: self._keep(checklist, kept))
        await walk.put_back_gains()
        await walk.one(begun.begin)

    async def _opened(self, by: str) -> Checklist:
        """Return the checklist as it is now, compared with drive and file."""
        client = self._rigs.client(load_config(self._config).rig)
        rig = Rig(client, await client.daemon())
        checklist = Checklist(rig, self._config, self._axis, self.person, by=by)
        await checklist.refresh()
        self._record = checklist.record
        return checklist

    def _keep(self, checklist: Checklist, kept: StepRecord) -> None:
        self._record = checklist.record
        self.person.tell(kept.result.text)

    def _outside(self) -> object:
        """Return what tells when file or daemon have changed."""
        changed_ns = self._config.stat().st_mtime_ns if self._config.exists() else 0
        return changed_ns, {rig: self._rigs.instance(rig) for rig in self._rigs.names}

    def _step_view(self, kept: StepRecord) -> StepView:
        step, result = STEPS[kept.step], kept.result
        impossible = result.state is StepState.NOT_POSSIBLE
        return StepView(
            name=kept.step,
            title=step.title,
            about=step.about,
            state=result.state.value.replace("_", " "),
            text=kept.reopened or result.text,
            at=kept.at,
            by=kept.by,
            obstacle=result.text if impossible else "",
        )
