"""Going through the checklist with a person: each step is explained, asked for, run, and its proposal offered."""

from collections.abc import Callable

from ldcnd.bench.commissioning.checklist import STEPS, Checklist
from ldcnd.bench.commissioning.record import Result, StepRecord, StepState
from ldcnd.bench.person import Left, Person, said
from ldcnd.contract.errors import LdcndError

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
            self._person.tell(f"{self._file} is changed, and the daemon has not read it: {said(error)}")
            return True
        self._person.tell(f"{self._file} is changed, and the daemon has read it")
        return None
