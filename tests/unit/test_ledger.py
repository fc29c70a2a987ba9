import pytest

from ldcnd.axis.status import ActiveCommand, CommandEnd, Completion
from ldcnd.contract.commands import REPLAYED_WITHIN_S, CommandReply, Halt, MoveAbsolute, Verb
from ldcnd.contract.errors import CommandIdReused, StopLatched, TooManyRequests, UnknownCommand
from ldcnd.contract.events import CommandStatus
from ldcnd.contract.samples import AxisState
from ldcnd.daemon.ledger import ANSWERS_PER_SENDER, SENDERS, Ledger, LedgerEntry

MOVE = MoveAbsolute(position=1.0)


def entry(command_id="c1", command=MOVE) -> LedgerEntry:
    return LedgerEntry(command_id, "x", command, "ann")


def reached(ledger: Ledger, command_id: str, status: CommandStatus, reason: str | None = None) -> None:
    """Say that a command has got so far, as its axis does."""
    state, completion = AxisState.DISCRETE_MOTION, Completion.PROFILE
    command = ActiveCommand(command_id, Verb.MOVE_ABSOLUTE, 0, state, completion)
    ledger.ended(CommandEnd(command, status, reason, None), None)


@pytest.fixture
def heard() -> list[tuple[str, str | None]]:
    return []


@pytest.fixture
def ledger(heard) -> Ledger:
    return Ledger(
        lambda entry, error: heard.append((entry.status.value, error.code.value if error else None)),
        lambda: 0.0,
    )


def test_a_command_passes_through_its_states_once(ledger, heard):
    ledger.open(entry())
    ledger.answered("c1", CommandReply(command_id="c1", axis="x", verb="move_absolute"), CommandStatus.EXECUTING)
    reached(ledger, "c1", CommandStatus.EXECUTING)
    reached(ledger, "c1", CommandStatus.DONE)
    reached(ledger, "c1", CommandStatus.ABORTED, "too late")

    assert heard == [("accepted", None), ("executing", None), ("done", None)]
    assert ledger.get("c1").status is CommandStatus.DONE


def test_a_repeated_id_is_known_whatever_proves_that_it_may(ledger):
    ledger.open(entry())

    again = MOVE.model_copy(update={"lease": "l", "sequence": 7, "not_after": 9, "after_stops": 3, "client": "ann"})
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


def done(ledger, command_id, client="ann", **fields):
    command = MoveAbsolute(position=1.0, command_id=command_id, client=client, **fields)
    ledger.open(LedgerEntry(command_id, "x", command, client))
    reached(ledger, command_id, CommandStatus.DONE)


def test_what_is_not_over_is_never_forgotten(ledger):
    ledger.open(entry("running"))
    for number in range(ANSWERS_PER_SENDER + 10):
        ledger.open(entry(f"done-{number}"))
        reached(ledger, f"done-{number}", CommandStatus.DONE)

    assert ledger.get("running").status is CommandStatus.ACCEPTED
    with pytest.raises(UnknownCommand):
        ledger.get("done-0")
    assert ledger.get(f"done-{ANSWERS_PER_SENDER + 9}")


@pytest.mark.promise("one-id-one-motion")
def test_a_replay_whose_answer_is_forgotten_is_refused(ledger):
    for number in range(ANSWERS_PER_SENDER + 1):
        done(ledger, f"c{number}")

    with pytest.raises(CommandIdReused, match="not kept"):
        ledger.repeated("c0", "x", MOVE)
    assert ledger.repeated("c1", "x", MoveAbsolute(position=1.0, command_id="c1")) == ledger.get("c1")


def test_nobody_elses_commands_push_an_answer_out(ledger):
    done(ledger, "mine")
    for number in range(10 * ANSWERS_PER_SENDER):
        done(ledger, f"b{number}", client="bob")
        halt = Halt(command_id=f"h{number}", client="ann")
        ledger.open(LedgerEntry(f"h{number}", "x", halt, "ann"))
        reached(ledger, f"h{number}", CommandStatus.DONE)

    assert ledger.get("mine").status is CommandStatus.DONE


def test_senders_without_number_take_bounded_memory_and_their_replays_stay_refused(ledger):
    for number in range(2 * SENDERS):
        done(ledger, f"c{number}", client=f"client{number}")

    assert len(ledger._entries) == SENDERS
    with pytest.raises(CommandIdReused):
        ledger.repeated("c0", "x", MOVE)


def test_an_id_is_remembered_for_the_time_that_the_contract_names():
    now_s = 0.0
    ledger = Ledger(lambda _entry, _error: None, lambda: now_s)
    for number in range(ANSWERS_PER_SENDER + 1):
        done(ledger, f"c{number}")

    now_s = REPLAYED_WITHIN_S - 1.0
    with pytest.raises(CommandIdReused):
        ledger.repeated("c0", "x", MOVE)
    now_s = REPLAYED_WITHIN_S + 1.0
    assert ledger.repeated("c0", "x", MOVE) is None


def test_ids_that_could_not_be_remembered_are_refused_before_anything_is_done(ledger, monkeypatch):
    monkeypatch.setattr("ldcnd.daemon.ledger.LARGEST_MEMORY", 3)
    for number in range(3):
        done(ledger, f"c{number}")

    with pytest.raises(TooManyRequests):
        done(ledger, "c3")
    with pytest.raises(UnknownCommand):
        ledger.get("c3")
    done(ledger, "c4", lease="l", sequence=1)
    ledger.open(entry("made by the daemon"))


def test_an_id_under_a_lease_with_a_sequence_takes_no_memory(ledger):
    done(ledger, "c1", lease="l", sequence=1)
    assert not ledger._until_s


def test_an_entry_keeps_whose_it_is_through_all_its_states(ledger):
    ledger.open(LedgerEntry("c1", "x", MOVE, "ann", "operator"))
    ledger.answered("c1", CommandReply(command_id="c1", axis="x", verb="move_absolute"), CommandStatus.EXECUTING)
    reached(ledger, "c1", CommandStatus.DONE)

    kept = ledger.get("c1")
    assert (kept.command_id, kept.axis, kept.command, kept.client, kept.login) == ("c1", "x", MOVE, "ann", "operator")


def test_a_sender_with_a_login_is_known_by_it():
    ledger = Ledger(lambda _entry, _error: None, lambda: 0.0)
    for number in range(2 * SENDERS):
        command = MoveAbsolute(position=1.0, command_id=f"c{number}")
        ledger.open(LedgerEntry(f"c{number}", "x", command, f"client{number}", "operator"))
        reached(ledger, f"c{number}", CommandStatus.DONE)

    assert ledger.get("c0").login == "operator"  # all are of one sender


def test_a_sender_with_a_command_under_way_is_not_forgotten(ledger):
    ledger.open(LedgerEntry("running", "x", MOVE, "ann"))
    for number in range(2 * SENDERS):
        done(ledger, f"c{number}", client=f"client{number}")

    assert ledger.get("running").status is CommandStatus.ACCEPTED
