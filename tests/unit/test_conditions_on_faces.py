"""Every condition of an axis on every face: whatever shows a position says in words when it is not known.

Each face gets the same samples by its own way in, and is read as its user reads it.
"""

import asyncio
import json
from dataclasses import dataclass, replace
from pathlib import Path

import msgpack
import pytest
from click.testing import CliRunner
from prometheus_client import CollectorRegistry, generate_latest

from ldcnd.cli.looking import Watched, axes_table, rig_table
from ldcnd.cli.looking import row as row_of
from ldcnd.cli.main import cli
from ldcnd.client import overview
from ldcnd.client.axis import Axis
from ldcnd.client.fleet import AxisReport, RigReport
from ldcnd.client.overview import AxisNow, LastOfAxis
from ldcnd.client.rig_client import RigClient
from ldcnd.console.conditions import Conditions
from ldcnd.contract.codec import Encoding, encode
from ldcnd.contract.condition import Place, assess
from ldcnd.contract.fault_pages import page_text
from ldcnd.contract.frozen import Frozen
from ldcnd.contract.health import AxisHealth, BusHealth, DaemonHealth, StopWaitHealth
from ldcnd.contract.keys import Keys
from ldcnd.contract.meta import AxisInfo, AxisLimits, DaemonInfo
from ldcnd.contract.samples import (
    UNKNOWN_HOLDER,
    AxisState,
    CurrentCommand,
    FaultEntry,
    FaultSample,
    LinkState,
    Moving,
    PositionSample,
    Quality,
    StateSample,
    TelemetryItem,
)
from ldcnd.lab.metrics import HealthCollector
from ldcnd.lab.ros2.bridge import ERROR, STALE, WARN, Bridge
from ldcnd.lab.top.columns import as_text
from ldcnd.lab.top.rig_view import Description, RigView
from ldcnd.net.session import Publication, SampleKind
from ldcnd.testing.memory_session import MemoryBroker

NOW_NS = 1_000_000_000_000
NUMBER = 60.0
KEYS = Keys("sim")
INFO = AxisInfo(
    axis="x", bus="line0", address=1, family="ldcn", model="ls-182ap", identity="LS-182AP", unit="mm",
    counts_per_unit=1000.0, direction="forward", limits=AxisLimits(
        position_min=None, position_max=None, velocity=None, acceleration=None), capabilities=(), items=(
        "position", "state", "fault"), adc_full_scale=None,
)  # fmt: skip


def fault(code: str, *, stops: bool = True) -> FaultEntry:
    return FaultEntry(code=code, text=f"meaning of {code}", since=0, source="daemon", stops=stops)


@dataclass(frozen=True)
class Case:
    """A condition: what is known, and what every face that knows it has to say.

    Attributes:
        name: as the reference has it.
        state: what differs from an axis that stands, enabled and homed.
        says: what stands on faces; `without` is said by those that know neither faults, nor the line, nor ages.
        place: whether the position is known.
        position_quality: quality of the position, where that is not the state's.
    """

    name: str
    state: dict[str, object]
    says: str
    place: Place
    faults: tuple[FaultEntry, ...] = ()
    age_s: float = 0.0
    line_up: bool = True
    without: str | None = None
    position_quality: Quality | None = None


MOVE = CurrentCommand(command_id="c-1", verb="move_absolute", since=0)
DOWN = {"link": LinkState.DOWN, "moving": Moving.UNKNOWN, "referenced": False, "quality": Quality.BAD}
LOST = {"quality": Quality.UNCERTAIN, "referenced": False, "reference_lost": True, "state": AxisState.ERROR_STOP}
CASES = (
    Case("well", {}, "", Place.KNOWN),
    Case("not homed", {"referenced": False}, "not homed", Place.NOT_HOMED),
    Case("reference lost", {"referenced": False, "reference_lost": True}, "reference lost", Place.NOT_HOMED),
    Case("homing", {"referenced": False, "state": AxisState.HOMING, "moving": Moving.YES, "command": MOVE}, "homing",
         Place.NOT_HOMED),
    Case("drive does not answer", DOWN, "no answer", Place.NOT_ANSWERING, (fault("link_lost"),)),
    Case("line down", DOWN, "line down", Place.NOT_ANSWERING, line_up=False, without="no answer"),
    Case("not identified", DOWN, "not identified", Place.NOT_ANSWERING, (fault("not_identified"),),
         without="no answer"),
    Case("old", {}, "old", Place.OLD, age_s=57.0, without=""),
    Case("uncertain", {}, "uncertain", Place.UNCERTAIN, without="", position_quality=Quality.UNCERTAIN),
    Case("readings contradict", {**LOST, "motion_hidden_by": "readings_contradict"}, "readings contradict",
         Place.CONTRADICTED, (fault("readings_contradict"),)),
    Case("drive was reset", LOST, "drive reset", Place.CONTRADICTED, (fault("drive_reset"),),
         without="position lost"),
    Case("encoder may not count",
         {"quality": Quality.UNCERTAIN, "moving": Moving.UNKNOWN, "motion_hidden_by": "position_error",
          "state": AxisState.ERROR_STOP}, "may move", Place.CONTRADICTED, (fault("position_error"),)),
    Case("coasts", {"state": AxisState.DISABLED, "enabled": False, "moving": Moving.YES}, "moves with motor off",
         Place.KNOWN),
    Case("moves without a command", {"state": AxisState.DISCRETE_MOTION, "moving": Moving.YES},
         "moves without a command", Place.KNOWN),
    Case("moved by pulses", {"state": AxisState.DISCRETE_MOTION, "moving": Moving.YES, "has_reference": False},
         "", Place.KNOWN),
    Case("stop latched", {"stop_latched": True}, "stop latched", Place.KNOWN),
    Case("stop pending", {"stop_latched": True, "stop_pending": True}, "stop NOT CONFIRMED by the drive", Place.KNOWN),
    Case("stop pending, no answer", {**DOWN, "stop_pending": True}, "stop NOT CONFIRMED by the drive",
         Place.NOT_ANSWERING),
    Case("speed override 0 %", {"speed_override": 0.0}, "speed override 0 %", Place.KNOWN),
    Case("speed override 30 %", {"speed_override": 30.0}, "speed override 30 %", Place.KNOWN),
    Case("ended by an interlock",
         {"last_error": "move_velocity: aborted by halt", "interlock": "door_shut: input door_closed is false"},
         "ended by interlock", Place.KNOWN),
    Case("error stop", {"state": AxisState.ERROR_STOP, "last_error": "a jam"}, "error stop", Place.KNOWN),
    Case("a fault", {"state": AxisState.ERROR_STOP}, "overheat", Place.KNOWN, (fault("overheat"),),
         without="error stop"),
    Case("missed polls", {"link": LinkState.DEGRADED, "quality": Quality.UNCERTAIN, "moving": Moving.UNKNOWN},
         "missed polls", Place.KNOWN),
    Case("moved by another", {"state": AxisState.DISCRETE_MOTION, "moving": Moving.YES, "holder": "ada",
         "command": MOVE}, "moved by ada", Place.KNOWN),
    Case("controlled by another", {"holder": "ada"}, "controlled by ada", Place.KNOWN),
    Case("not controlled", {"holder": None}, "not controlled", Place.KNOWN),
)  # fmt: skip


@dataclass(frozen=True)
class Known:
    """The samples of a case."""

    case: Case
    state: StateSample
    faults: FaultSample
    position: PositionSample
    line: BusHealth


def known(case: Case) -> Known:
    t, quality = NOW_NS - round(case.age_s * 1e9), case.state.get("quality", Quality.GOOD)
    stamp = {"t": NOW_NS, "t_error_ns": 0, "seq": 1}
    standing = StateSample(
        **{**stamp, "t": t}, quality=Quality.GOOD, state=AxisState.STANDSTILL, enabled=True, referenced=True,
        moving=Moving.NO, link=LinkState.UP, stop_latched=False, command=None, holder=UNKNOWN_HOLDER,
    )  # fmt: skip
    axis = AxisHealth(axis="x", link=LinkState.UP, sample_age_s=0.0, rate_wanted_hz=20, rate_hz=20, faults=0)
    line = BusHealth(
        t=NOW_NS, seq=1, bus="line0", up=case.line_up, utilisation=0.1, exchanges=1, timeouts=0, corrupt_replies=0,
        rejected_packets=0, resent=0, resynchronisations=0, stray_bytes=0, losses=0, lanes=(),
        stop_wait=StopWaitHealth(bound_s=None, probes=0, p99_s=0, longest_s=0), axes=(axis,),
    )  # fmt: skip
    return Known(
        case,
        standing.model_copy(update=case.state),
        FaultSample(**stamp, quality=quality, active=case.faults, first=case.faults[0] if case.faults else None),
        PositionSample(
            **{**stamp, "t": t},
            quality=case.position_quality or quality,
            value=NUMBER,
            unit="mm",
            counts=60_000,
            following_error=0.0,
        ),
        line,
    )


def put(key: str, model: Frozen) -> Publication:
    payload, encoding = encode(model, Encoding.MSGPACK)
    return Publication(key, payload, encoding, SampleKind.PUT, None)


def published(at: Known) -> list[Publication]:
    tele = KEYS.telemetry
    return [
        put(tele("x", TelemetryItem.STATE), at.state),
        put(tele("x", TelemetryItem.FAULT), at.faults),
        put(tele("x", TelemetryItem.POSITION), at.position),
        put(KEYS.bus_health("line0"), at.line),
    ]


def axis_now(at: Known) -> AxisNow:
    last = LastOfAxis(at.state, at.faults, at.position, None)
    return overview.axis_now(INFO, last, at.line, lambda t: (NOW_NS - t) / 1e9)


def axis_list(at: Known) -> str:
    return axes_table([axis_now(at)])[0]


def axis_list_json(at: Known) -> str:
    row = json.loads(row_of(axis_now(at)).model_dump_json())
    assert {"position", "quality", "age_s", "state", "referenced", "link", "moving"} <= row.keys()
    return " ".join((row["place"], row["state"] or "null", *row["condition"]))


def axis_watch(at: Known) -> str:
    watched = Watched()
    watched.begin(axis_now(at))
    watched.text("x", at.faults)
    return f"{watched.text('x', at.position)}\n{watched.text('x', at.state)}"


def top(at: Known) -> str:
    view = RigView("sim", 0.0)
    for sample in published(at):
        view.take(sample, 100.0 - (at.case.age_s if sample.key.endswith(("position", "state")) else 0.0))
    view.take(put(KEYS.health, DaemonHealth(t=NOW_NS, seq=0, loop_lag_s=0, published=0, missed_reports=0)), 100.0)
    view.describe(Description(DAEMON, (INFO,)))
    return "\n".join(as_text(view.glance(100.0))[2:4])


DAEMON = DaemonInfo.model_construct(rig="sim", version="1", instance="a", buses=("line0",))


def fleet_table(at: Known) -> str:
    report = AxisReport(info=INFO, state=at.state, fault=at.faults, health=at.line.axes[0], line_up=at.case.line_up)
    return "\n".join(rig_table(RigReport(rig="sim", instance="a", daemon=None, health=None, axes=(report,))))


def metrics(at: Known) -> str:
    collector = HealthCollector("sim", lambda: 100.0)
    collector.take(at.line)
    collector.take_state("x", at.state)
    collector.take_state("x", at.faults)
    registry = CollectorRegistry()
    registry.register(collector)
    return generate_latest(registry).decode()


def ros2(at: Known) -> str:
    bridge = Bridge("sim", {"x": INFO})
    bridge.take("x", at.state, 0.0)
    bridge.take("x", at.faults, 0.0)
    (status,) = bridge.diagnostics(NOW_NS, 0.0).statuses
    return f"{status.message} {status.values}"


def client_of(at: Known) -> Axis:
    broker, loop = MemoryBroker(), asyncio.new_event_loop()
    try:
        axis = Axis("x", RigClient(broker.session(), "sim"), loop)
    finally:
        loop.close()
    for take, model in ((axis._take_state, at.state), (axis._take_position, at.position)):
        take(put("x", model))
    return axis


def python_repr(at: Known) -> str:
    return f"{client_of(at)!r}"


def notebook(at: Known) -> str:
    return client_of(at)._repr_html_()


def bluesky(at: Known) -> str:
    values = pytest.importorskip("ldcnd.lab.bluesky.values")
    read = values.reading(at.position.value, 0.0, Quality.GOOD, assess(at.state))
    return str(read)


def epics(at: Known) -> str:
    motor = pytest.importorskip("ldcnd.lab.epics.record")

    async def shown() -> str:
        record = motor.MotorRecord(INFO, (1.0, 1.0))
        for sample in (at.faults, at.position, at.state):
            await record.take(sample)
        said = record.fields["x:condition"].value
        return f"{record['SEVR'].value} {record['RBV'].alarm.severity.name} {said}"

    return asyncio.run(shown())


def console(at: Known) -> str:
    sent: list[Publication] = []
    conditions = Conditions("sim", sent.append, lambda: 100.0)
    for sample in published(at):
        conditions.take(sample)
    conditions.show()
    told = msgpack.unpackb(sent[-1].payload)
    return " ".join((told["mark"], told["state"], *(each["short"] for each in told["troubles"]), told["control"]))


ALL_KNOWN = (axis_list, axis_list_json, top, console)
"""Faces that know faults, lines and ages."""
NO_AGE = (fleet_table, metrics)
"""Those that know faults and lines."""
FAULTS_ONLY = (axis_watch, ros2, epics)
"""Those that know faults."""
STATE_ONLY = (python_repr, notebook, bluesky)
"""Those that know the state alone."""
FACES = (*ALL_KNOWN, *NO_AGE, *FAULTS_ONLY, *STATE_ONLY)


def wanted(case: Case, face: object) -> str:
    """Return what a face has to say of a case."""
    if face is python_repr and "holder" in case.state:
        return ""  # one line of a position and a state
    if case.without is None or face in ALL_KNOWN:
        return case.says
    if case.position_quality and face in (axis_watch, python_repr, notebook):
        return case.says
    knows = case.without != "" and (face in NO_AGE or (face in FAULTS_ONLY and case.name != "line down"))
    return case.says if knows else case.without


@pytest.mark.parametrize("face", FACES, ids=lambda face: face.__name__)
@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
@pytest.mark.sweep(2)
def test_every_face_says_every_condition(case, face, record_property):
    record_property("cells", len(CASES) * len(FACES))
    told = face(known(case))

    assert wanted(case, face) in told
    if face is not bluesky and case.name == "well":
        for other in CASES:
            assert not other.says or f" {other.says}" not in told.replace("s old", "")


NUMBERS = {axis_list: "60.000", axis_watch: "60.0000", top: "60.000", python_repr: "60.0000", notebook: "60.0000"}


@pytest.mark.parametrize("face", NUMBERS, ids=lambda face: face.__name__)
@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
@pytest.mark.sweep(2)
def test_a_number_that_does_not_say_where_the_axis_is_stands_in_brackets_with_words(case, face):
    told, digits = face(known(case)), NUMBERS[face]
    is_known = case.place is Place.KNOWN or not wanted(case, face)

    assert (f"({digits})" in told) is not is_known
    assert digits in told


@pytest.mark.parametrize("face", NUMBERS, ids=lambda face: face.__name__)
@pytest.mark.parametrize("quality", [Quality.UNCERTAIN, Quality.BAD])
def test_a_number_that_was_not_measured_since_its_drive_answers_stands_in_brackets(quality, face):
    at = known(CASES[0])

    told = face(replace(at, position=at.position.model_copy(update={"quality": quality})))

    assert f"({NUMBERS[face]})" in told


@pytest.mark.parametrize("face", [axis_list, top], ids=lambda face: face.__name__)
def test_a_number_in_another_unit_than_the_description_is_not_shown(face):
    at = known(CASES[0])

    told = face(replace(at, position=at.position.model_copy(update={"unit": "um"})))

    assert NUMBERS[face] not in told
    assert "  ?  " in told


SILENT = [case for case in CASES if case.place in (Place.OLD, Place.NOT_ANSWERING)]


@pytest.mark.parametrize("case", SILENT, ids=lambda case: case.name)
def test_programs_get_no_state_of_an_axis_that_does_not_answer(case):
    row = row_of(axis_now(known(case)))

    assert row.state is None
    assert row.link is not LinkState.UP
    if case.name != "old":  # of which metrics learn by the daemon's report
        assert "ldcnd_axis_state{" not in metrics(known(case))
    assert 'ldcnd_axis_state{axis="x",rig="sim",state="standstill"} 1.0' in metrics(known(CASES[0]))


@pytest.mark.parametrize("quality", [Quality.UNCERTAIN, Quality.BAD])
def test_a_joint_state_leaves_out_a_number_that_was_not_measured_since_its_drive_answers(quality):
    at, bridge = known(CASES[0]), Bridge("sim", {"x": INFO})
    bridge.take("x", at.state, 0.0)

    assert bridge.take("x", at.position.model_copy(update={"quality": quality}), 0.0) is None


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
def test_a_joint_state_leaves_out_a_place_that_is_not_known(case):
    at, bridge = known(case), Bridge("sim", {"x": INFO})
    bridge.take("x", at.state, 0.0)
    bridge.take("x", at.faults, 0.0)

    joint = bridge.take("x", at.position, 0.0)

    assert (joint is not None) is (case.place in (Place.KNOWN, Place.OLD))


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
def test_the_words_of_a_list_lead_to_a_page(case):
    condition = axis_now(known(case)).condition
    said = {condition.mark, condition.place.value, *(trouble.short for trouble in condition.troubles)} - {"", "known"}

    for words in said:
        for typed in ([words], words.split(), [words.replace(" ", "_")]):
            assert CliRunner().invoke(cli, ["fault", *typed]).exit_code == 0, typed


@pytest.mark.parametrize(
    ("said", "page"),
    [
        ("not_homed", "not_referenced"),
        ("reference lost", "not_referenced"),
        ("stop latched", "stop_latched"),
        ("speed override 30 %", "wrong_state"),
        ("stop NOT CONFIRMED by the drive", "stop_unconfirmed"),
        ("outputs float", "link_lost"),
        ("daemon silent", "session_failed"),
        ("nothing received", "session_failed"),
        ("line is being opened", "bus_down"),
        ("slow", "bus_busy"),
        ("homing", "not_referenced"),
    ],
)
def test_a_word_of_a_list_leads_to_the_page_of_what_it_is(said, page):
    assert CliRunner().invoke(cli, ["fault", said]).output == page_text(page)


CALM = ("moved by another", "controlled by another", "not controlled", "moved by pulses")


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
@pytest.mark.sweep(2)
def test_alarm_systems_get_no_ok_of_an_axis_whose_place_is_not_known(case):
    at = known(case)
    condition = axis_now(at).condition
    bridge = Bridge("sim", {"x": INFO})
    bridge.take("x", at.state, 0.0)
    bridge.take("x", at.faults, 0.0)

    assert condition.place is case.place
    assert (condition.alarm == 0) is (case.name in ("well", "speed override 30 %") or case.name in CALM)
    if case.place is not Place.KNOWN and case.without != "":
        assert bridge.diagnostics(NOW_NS, 0.0).statuses[0].level in {WARN, ERROR}
        assert not epics(at).startswith("NO_ALARM")
        assert 'ldcnd_axis_place_known{axis="x",rig="sim"} 0.0' in metrics(at)


def test_a_daemon_that_is_silent_leaves_nothing_to_be_believed():
    at = known(CASES[0])
    condition = assess(at.state, at.faults, silence="the daemon is silent")
    bridge = Bridge("sim", {"x": INFO})
    bridge.take("x", at.state, 0.0)

    assert (condition.place, condition.live) == (Place.NOT_ANSWERING, False)
    assert condition.position("60.000", "mm", 7.0) == "(60.000) mm daemon silent, 7 s old"
    assert bridge.diagnostics(NOW_NS, 60.0).statuses[0].level == STALE
    of_a_host_an_hour_ahead = bridge.diagnostics(NOW_NS + 3600 * 10**9, 0.0)
    assert of_a_host_an_hour_ahead.statuses[0].level != STALE


def reference() -> str:
    """Return the table of the reference."""
    lines = ["| condition | place | beside the number | values believed | alarm | said |", "|---|---|---|---|---|---|"]
    for case in CASES:
        now = axis_now(known(case)).condition
        live = "yes" if now.live else "no"
        cells = (case.name, now.place.value, now.mark, live, now.alarm.name.lower(), ", ".join(now.notes))
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)


def test_the_reference_has_this_table():
    page = Path(__file__).parents[2] / "docs" / "reference" / "conditions.md"

    assert reference() in page.read_text(encoding="utf-8")
