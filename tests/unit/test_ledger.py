import pytest

from ldcnd.daemon.command.ledger import REMEMBERED, Entry, Ledger
from ldcnd.errors import CommandIdReused, StopLatched, UnknownCommand
from ldcnd.model.commands import CommandReply, Halt, MoveAbsolute
from ldcnd.model.events import CommandStatus

MOVE = MoveAbsolute(position=1.0)


def entry(command_id="c1", command=MOVE) -> Entry:
    return Entry(command_id, "x", command, "ann")


@pytest.fixture
def heard() -> list[tuple[str, str | None]]:
    return []


@pytest.fixture
def ledger(heard) -> Ledger:
    return Ledger(lambda entry, error: heard.append((entry.status.value, error.code.value if error else None)))


def test_a_command_passes_through_its_states_once(ledger, heard):
    ledger.open(entry())
    ledger.answered("c1", CommandReply(command_id="c1", axis="x", verb="move_absolute"), CommandStatus.EXECUTING)
    ledger.reached("c1", CommandStatus.EXECUTING)
    ledger.reached("c1", CommandStatus.DONE)
    ledger.reached("c1", CommandStatus.ABORTED, "too late")

    assert heard == [("accepted", None), ("executing", None), ("done", None)]
    assert ledger.get("c1").status is CommandStatus.DONE


def test_a_repeated_id_is_known_whatever_proves_that_it_may(ledger):
    ledger.open(entry())

    again = MOVE.model_copy(update={"lease": "l", "sequence": 7, "not_after": 9, "client": "ann"})
    assert ledger.repeated("c1", "x", again) == ledger.get("c1")
    assert ledger.repeated("c2", "x", MOVE) is None


@pytest.mark.parametrize(
    ("axis", "command"),
    [
        ("y", MOVE),
        ("x", Halt()),
        ("x", MoveAbsolute(position=2.0)),
    ],
)
def test_an_id_belongs_to_one_command(ledger, axis, command):
    ledger.open(entry())

    with pytest.raises(CommandIdReused):
        ledger.repeated("c1", axis, command)


def test_a_refusal_is_kept_with_its_reason(ledger, heard):
    ledger.open(entry())

    ledger.answered("c1", StopLatched("axis x: a stop is latched", axis="x"), CommandStatus.REFUSED)

    kept = ledger.get("c1")
    assert (kept.status, kept.reason) == (CommandStatus.REFUSED, "axis x: a stop is latched")
    assert isinstance(kept.answer, StopLatched)
    assert heard[-1] == ("refused", "stop_latched")


def test_an_unknown_id_says_so(ledger):
    with pytest.raises(UnknownCommand):
        ledger.get("c9")


def test_what_is_not_over_is_never_forgotten(ledger):
    ledger.open(entry("running"))
    for number in range(REMEMBERED + 10):
        ledger.open(entry(f"done-{number}"))
        ledger.reached(f"done-{number}", CommandStatus.DONE)

    assert ledger.get("running").status is CommandStatus.ACCEPTED
    with pytest.raises(UnknownCommand):
        ledger.get("done-0")
    assert ledger.get(f"done-{REMEMBERED + 9}")
