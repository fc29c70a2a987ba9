"""Names and keys that strangers choose, with control characters: refused, and never in events or in the log as sent."""

import json

import pytest
from structlog.testing import capture_logs

from ldcnd.contract.errors import ErrorCode
from ldcnd.contract.events import ReadEvents
from ldcnd.printable import is_printable
from tests.support.rig import running_rig
from tests.support.session_pair import error_of

CLIPBOARD = "\x1b]52;c;cm0gLXJmIC8=\x07"


@pytest.mark.parametrize("field", ["client", "command_id", "lease", "instance"])
async def test_a_command_with_such_a_name_is_refused_and_leaves_no_event(field: str):
    async with running_rig() as rig:
        payload = json.dumps({"on": True, field: CLIPBOARD}).encode()
        answers = await rig.session.query("ldcn/sim/@cmd/x/power", payload, encoding="application/json")
        events = (await rig.client.ask(ReadEvents())).events

    refusal = error_of(answers)
    assert refusal.code is ErrorCode.MALFORMED_REQUEST
    assert is_printable(refusal.message)
    assert [event for event in events if event.verb == "power"] == []


async def test_a_stop_with_such_a_name_stops_and_its_event_names_no_one():
    async with running_rig() as rig:
        payload = json.dumps({"client": CLIPBOARD}).encode()
        (answer,) = await rig.session.query("ldcn/sim/@stop/x", payload, encoding="application/json")
        events = (await rig.client.ask(ReadEvents(axis="x"))).events

    assert not answer.is_error
    assert [event.client for event in events if event.verb == "stop"] == [None]


@pytest.mark.parametrize("sequence", [2**53, 2**70, -1])
async def test_a_sequence_number_beyond_what_json_keeps_exactly_is_refused(sequence: int):
    async with running_rig() as rig:
        payload = json.dumps({"on": True, "sequence": sequence}).encode()
        answers = await rig.session.query("ldcn/sim/@cmd/x/power", payload, encoding="application/json")

    assert error_of(answers).code is ErrorCode.MALFORMED_REQUEST


async def test_refusals_without_end_leave_a_bounded_number_of_records():
    async with running_rig() as rig:
        with capture_logs() as records:
            for _ in range(1000):
                await rig.session.query("ldcn/sim/@cmd/x/fly")

    assert 0 < len([record for record in records if record["event"] == "refused"]) <= 20
