"""Gains of a drive that tunes itself, on the page: what the drive says, values that are tried in its RAM, and kept."""

from collections.abc import Mapping

from ldcnd.bench.commissioning.record import Figure, Result, StepState
from ldcnd.bench.person import Person
from ldcnd.bench.tuning.smartstep import guided, session
from ldcnd.client.rig_client import RigClient
from ldcnd.console.commissioning.tuning import Tuning

ABOUT = (
    "The drive tunes itself: its auto-tuning and its gains are shown. Gains that you type are tried in its RAM, between"
    " two records of a move that your machine makes; nothing here moves the motor. They are kept when you agree."
)


async def tune(client: RigClient, person: Person, name: str) -> Tuning | None:
    """Show what a drive says of its tuning, and try gains; None when nothing was tried, and they are not called right.

    Raises:
        Left: the person has left; the old gains are back.
        LdcndError: as the daemon refused it, or a value would not be in use; likewise.
    """
    found = await session.read_tuning(client, name)
    person.tell(*guided.shown(found))
    wanted = await _wanted(person)
    if not wanted:
        right = await person.confirm(f"are the gains of {name} right as they are")
        gains = {each: value.active for each, value in found.gains.items()}
        return Tuning(_result("right as they are, as the person says", gains)) if right else None
    session.check_wanted(found, wanted)
    person.tell(guided.plan(wanted))
    tried = await guided.tune(client, person, found, wanted, await _record_s(person))
    if tried is None:
        return None
    person.tell(*([] if tried.kept else [guided.ending(tried)]))
    return Tuning(_result(guided.ending(tried), tried.tried) if tried.kept else None)


async def _wanted(person: Person) -> dict[str, int]:
    wanted: dict[str, int] = {}
    while text := await person.ask(f"a gain to try, as {guided.EXAMPLE}; nothing for no more"):
        value = guided.typed(text)
        if value:
            wanted.update([value])
        else:
            person.tell(f"{text!r} is not {guided.EXAMPLE}")
    return wanted


async def _record_s(person: Person) -> float:
    shortest, longest = guided.RECORDED_S
    while True:
        record_s = await person.number("for how long the drive records each move, in s", guided.RECORD_S)
        if shortest <= record_s <= longest:
            return record_s
        person.tell(f"{shortest:g} to {longest:g} s")


def _result(text: str, gains: Mapping[str, int]) -> Result:
    figures = tuple(Figure(what=name, value=value) for name, value in gains.items())
    return Result(state=StepState.DONE, text=text, figures=figures)
