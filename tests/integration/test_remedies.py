"""What a refusal tells people to type is typed in the state that refused, and then the command works."""

import ast
import asyncio
import contextlib
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TypeAlias

import pytest

import ldcnd
from ldcnd.cli.names import typed
from ldcnd.config.rig import RigConfig, load_config
from ldcnd.contract.commands import AxisCommand, Command, CommandReply, Jog, MoveVelocity
from ldcnd.contract.errors import LdcndError, Remedy, step
from ldcnd.contract.events import ReadOutcome
from ldcnd.contract.frozen import Frozen
from ldcnd.contract.leases import Acquire, Release
from ldcnd.contract.samples import LinkState
from ldcnd.contract.traces import TakeTrace
from ldcnd.drives.smartstep.ledger import EEPROM_LIFE
from tests.support.command_line import Ran, VirtualRig, virtual_rig
from tests.support.console_parts import ask_the_pages, part_of_pages
from tests.support.rig import SIMULATED

AnyCommand: TypeAlias = AxisCommand[CommandReply] | Command[Frozen]

FILLED = {
    "POSITION": "5",
    "KP": "100",
    "EL": "4000",
    "PERCENT": "100",
    "VALUE": "61",
    "FILE": "{file}",
}
"""What stands for each word that a remedy leaves open."""


@dataclass(frozen=True)
class Case:
    """A refusal, and what it tells people to type.

    Attributes:
        says: the remedy, as typed.
        before: commands that lead to its state.
        refused: the command that is refused in it.
        typed: what the remedy names.
        waits_s: time that the remedy says to wait.
        then: what works afterwards; the refused command when empty.
    """

    says: str
    before: tuple[str, ...]
    refused: str
    typed: str
    waits_s: float = 0.0
    then: str = ""


MOVING = ("power on x", "move x 1 --wait", "move x 60 --velocity 5")
HALT = "ldcnd halt AXIS and wait"
GAINS = "ldcnd axis gains AXIS --kp KP --el EL"
OUTPUTS = "ldcnd axis outputs AXIS --limit1 input --limit2 input"
RESTART = (
    "write RAM, raise eeprom_budget (the memory endures {life} writes), or, if the drive was replaced,"
    " ldcnd params restart-count AXIS"
)
CLOSE = "configure gains or ldcnd axis gains AXIS --kp KP --el EL"
AXES = ("x", "n", "z", "g", "feed")
HELD = "wait until it is released, or ldcnd lease hold --axis AXIS --force -- COMMAND"
TAKEN = (
    "wait until it is released or not renewed, ldcnd lease hold --axis AXIS --force -- COMMAND, or share it by its"
    " token in LDCND_LEASE"
)
LEASE = "ldcnd lease hold --axis AXIS -- COMMAND"
DAMAGED = (
    "restore the file from a backup and start the daemon again, or ldcnd params restart-count AXIS with the writes that"
    " you know of"
)
CASES = {
    "disabled": Case("ldcnd power on AXIS", ("power off x",), "move x 1 --relative --wait", "power on x"),
    "not homed": Case(
        "ldcnd home AXIS or ldcnd axis set-position AXIS POSITION",
        ("power on n",),
        "move n 1",
        "home n",
        waits_s=30.0,
    ),
    "not homed, place known": Case(
        "ldcnd home AXIS or ldcnd axis set-position AXIS POSITION",
        ("power on z",),
        "move z 6",
        "axis set-position z POSITION",
    ),
    "moving": Case(HALT, MOVING, "move x 1 --wait", "halt x", waits_s=2.0),
    "moving, unreferenced": Case(HALT, MOVING, "axis set-position x 1", "halt x", waits_s=2.0),
    "resetting in motion": Case(HALT, MOVING, "reset x", "halt x", waits_s=2.0),
    "latched": Case("ldcnd reset AXIS", ("stop x",), "power on x", "reset x"),
    "speed override": Case(
        # no stop reaches the SmartStep, which is not known to stand
        "ldcnd speed PERCENT above 0 %",
        ("power on x", "TRY speed 0"),
        "move x 1 --wait",
        "speed PERCENT",
    ),
    "faulted": Case(
        "look at it, for it may move unseen; remove the cause, then ldcnd reset AXIS",
        (
            "power on x",
            "axis gains x --el 1",
            "TRY move x 30 --relative --velocity 40",
            "WAIT 3",
            "axis gains x --el 4000",
        ),
        "power on x",
        "reset x",
    ),
    "velocity of nothing": Case("ldcnd halt AXIS", ("power on x",), "VELOCITY x 0", "halt x", then="halt x"),
    "few gains": Case(GAINS, (), "axis gains g --kd 5", "axis gains g --kp KP --el EL"),
    "pin is an output": Case(
        OUTPUTS,
        ("power on z", "axis outputs z --limit2 low"),
        "home z --method forward_limit --velocity 5",
        "axis outputs z --limit1 input --limit2 input",
    ),
    "traced": Case(
        "wait for its end, or ldcnd trace abort AXIS",
        ("TRACE x",),
        "trace take x --channel position --samples 5",
        "trace abort x",
    ),
    "unlisted parameter": Case(
        "ldcnd params list AXIS, or allow unlisted ones",
        (),
        "params get feed Pn999",
        "params list feed",
        then="params get feed Pn100",
    ),
    "budget spent": Case(
        RESTART.format(life=EEPROM_LIFE),
        (),
        "params set feed Pn102 57 --eeprom",
        "params restart-count feed",
        then="params set feed Pn102 57 --eeprom",
    ),
    "renewal of no jog": Case(
        "let go, then ldcnd jog AXIS VELOCITY again",
        ("power on x",),
        "RENEW x",
        "jog x 1 --for 0.2",
        then="halt x",
    ),
    "unknown command": Case("ldcnd log", (), "OUTCOME x", "log", then="log"),
}


def rig_config() -> RigConfig:
    """Two families; `n` and `z` are not homed, `g` has no gains, the EEPROM of `feed` was written too often."""
    rig, mixed = load_config(SIMULATED), load_config(SIMULATED.with_name("mixed.toml"))
    x, y, z, c = rig.bus[0].axis
    axes = (
        x,
        y.model_copy(update={"name": "n", "reference": "required"}),
        z.model_copy(update={"reference": "required"}),
        c.model_copy(update={"name": "g", "gains": None}),
    )
    line = rig.bus[0].model_copy(update={"axis": axes})
    return rig.model_copy(update={"bus": (line, mixed.bus[1]), "sim": (*rig.sim, mixed.sim[1])})


@pytest.fixture(scope="module")
def rig(tmp_path_factory):
    kept = tmp_path_factory.mktemp("state")
    (kept / "eeprom-writes.json").write_text('{"feed": {"Pn102": 9000}}')
    with pytest.MonkeyPatch.context() as patch:
        with virtual_rig(patch, rig_config().model_copy(update={"state_dir": kept})) as here:
            for axis in ("x", "n", "z", "g", "feed"):
                here.wait(here.rig.until(axis, lambda state: state.link is LinkState.UP))
            yield here


def type_line(here: VirtualRig, line: str) -> Ran:
    """Type a line, or do what cannot be typed: begin a trace, ask for the outcome of a command of long ago."""
    match line.split():
        case ["TRY", *words]:  # it may end before it is seen to begin, or say what it does not reach
            here.run(" ".join(words))
            return Ran(0, "", "")
        case ["WAIT", seconds]:
            here.wait(asyncio.sleep(float(seconds)))
            return Ran(0, "", "")
        case ["TRACE", axis]:
            return send(here, axis, TakeTrace(channels=("position",), samples=5000, interval_s=0.1))
        case ["VELOCITY", axis, value]:
            return send(here, axis, MoveVelocity(velocity=float(value)))
        case ["RENEW", axis]:
            return send(here, axis, Jog(velocity=1.0, renews="of-long-ago"))
        case ["OUTCOME", axis]:
            return send(here, axis, ReadOutcome(command_id="of-long-ago"))
    for word, filled in FILLED.items():
        line = line.replace(word, filled)
    return here.run(line, typed="y\n")


def send(here: VirtualRig, axis: str, command: AnyCommand) -> Ran:
    """Send what no command line sends; what is refused is put as the command line puts it."""
    try:
        client = here.rig.client
        here.wait(client.command(axis, command) if isinstance(command, AxisCommand) else client.ask(command))
    except LdcndError as error:
        return Ran(1, "", error.remedy.phrased(lambda each: typed(each, axis)))
    return Ran(0, "", "")


@pytest.mark.parametrize("case", CASES.values(), ids=CASES)
@pytest.mark.sweep(6)
def test_what_a_refusal_names_is_a_way_out_of_the_state_that_refused(rig, case):
    for line in case.before:
        led = type_line(rig, line)
        assert led.code == 0, led.errors
    rig.wait(asyncio.sleep(0.5))

    refused = type_line(rig, case.refused)
    axis = next(word for word in case.refused.split() if word in AXES)
    assert refused.code != 0
    assert case.says.replace("AXIS", axis) in refused.errors
    assert " ".join(case.typed.split()[:2]) in case.says.replace("AXIS", axis)
    way_out = type_line(rig, case.typed)
    assert way_out.code == 0, way_out.errors
    rig.wait(asyncio.sleep(case.waits_s))
    now = type_line(rig, case.then or case.refused)
    assert now.code == 0, now.errors


def test_gains_that_were_never_given_are_given_as_the_refusal_says(monkeypatch):
    with virtual_rig(monkeypatch, rig_config()) as here:
        here.wait(here.rig.until("g", lambda state: state.link is LinkState.UP))

        refused = here.run("power on g")
        assert CLOSE.replace("AXIS", "g") in refused.errors
        assert type_line(here, "axis gains g --kp KP --el EL").code == 0
        assert here.run("power on g").code == 0


def test_a_count_of_writes_that_was_lost_is_begun_again_as_the_refusal_says(monkeypatch, tmp_path):
    (tmp_path / "eeprom-writes.json").write_text("{")
    with virtual_rig(monkeypatch, rig_config().model_copy(update={"state_dir": tmp_path})) as here:
        here.wait(here.rig.until("feed", lambda state: state.link is LinkState.UP))

        refused = here.run("params set feed Pn102 57 --eeprom", typed="y\n")
        assert DAMAGED.replace("AXIS", "feed") in refused.errors
        assert here.run("params restart-count feed --writes 40", typed="y\n").code == 0
        assert here.run("params set feed Pn102 57 --eeprom", typed="y\n").code == 0


def test_control_that_a_refusal_tells_people_to_take_is_enough(rig, monkeypatch):
    here = rig
    client = here.rig.client
    here.run("power on x")
    here.wait(client.ask(Acquire(client="ann", axes=("x",), lease_s=60.0)))
    refused = here.run("move x 1 --relative")
    assert HELD.replace("AXIS", "x") in refused.errors
    held = here.wait(client.ask(Acquire(client="ldcnd", axes=("x",), lease_s=60.0, force=True)))
    monkeypatch.setenv("LDCND_LEASE", held.lease)

    assert here.run("move x 1 --relative --wait").code == 0
    assert here.run("jog x 1 --for 0.2").code == 0
    here.wait(client.ask(Release(lease=held.lease)))


def test_a_lease_that_is_missing_is_taken_as_the_refusal_says(monkeypatch):
    with virtual_rig(monkeypatch, rig_config().model_copy(update={"authority": "leased"})) as here:
        here.wait(here.rig.until("x", lambda state: state.link is LinkState.UP))
        take = here.rig.client.ask
        other = here.wait(take(Acquire(client="ann", axes=("z",), lease_s=60.0)))
        brief = here.wait(take(Acquire(client="ann", axes=("x",), lease_s=0.2)))
        here.wait(asyncio.sleep(1.0))
        for lease in ("", "no-such-lease", other.lease, brief.lease):
            monkeypatch.setenv("LDCND_LEASE", lease)
            refused = here.run("power on x")
            assert refused.code != 0
            assert LEASE.replace("AXIS", "x") in refused.errors.replace("AXIS", "x"), lease
        taken = here.wait(take(Acquire(client="ldcnd", axes=("x",), lease_s=60.0)))
        monkeypatch.setenv("LDCND_LEASE", taken.lease)
        assert here.run("power on x").code == 0


def test_a_lease_that_another_program_of_the_same_name_holds_is_taken_or_shared_as_the_refusal_says(monkeypatch):
    with virtual_rig(monkeypatch, rig_config()) as here:
        here.wait(here.rig.until("x", lambda state: state.link is LinkState.UP))
        held = here.wait(here.rig.client.ask(Acquire(client="ldcnd lease hold", axes=("x",), lease_s=60.0)))
        refused = here.run("lease hold --axis x -- true")
        assert refused.code != 0
        assert TAKEN.replace("AXIS", "x") in refused.errors

        monkeypatch.setenv("LDCND_LEASE", held.lease)
        assert here.run("power on x").code == 0
        monkeypatch.delenv("LDCND_LEASE")
        assert here.run("lease hold --axis x --force -- true").code == 0


BY_OTHER_TESTS = {CLOSE, DAMAGED, HELD, LEASE, TAKEN}
NOT_RUN = {
    "remove the cause, then ldcnd reset AXIS": "a fault of the drive behind which its encoder shows the shaft",
    "look whether it stands, then ldcnd reset AXIS": "a shaft that nobody has seen to stand",
    "ldcnd power off AXIS, look whether it stands, then ldcnd reset AXIS": "a shaft that nobody has seen to stand",
    "ldcnd power off AXIS; look at it, for it may move unseen; remove the cause, then ldcnd reset AXIS": (
        "a motion that does not settle, which the tests of settling make"
    ),
    "ldcnd halt AXIS, wait until it stands, then ldcnd reset AXIS": "a shaft that turns without its drive",
    "wait until it stands, then ldcnd power on AXIS": "a shaft that turns without its drive",
    "look why, then ldcnd reset AXIS": "a sequence of which an axis is stopped, which their tests run",
    "ldcnd home AXIS and wait until it is homed": "an interlock, with the centrifuge",
    "ldcnd power off AXIS and wait until it stands, or ldcnd home AXIS if nothing is in the way of that": (
        "a shaft that was taken over under power, with the centrifuge"
    ),
    "look whether it moves, check the power of the drive and its line; once it answers, ldcnd halt AXIS": (
        "a line that is cut while a motion is waited for"
    ),
    "ldcnd reset AXIS first": "an encoder that is unplugged and plugged in by hand",
    "ldcnd bus list": "a line that is not up",
    "ldcnd reload": "a configuration that was edited, which the tests of commissioning do",
    "wait until it is released, then ldcnd reload": "an axis that another program controls during a commissioning",
    "run the step home, or, where its position is known, ldcnd axis set-position AXIS POSITION": (
        "a commissioning, whose tests reference the axis"
    ),
    "ldcnd home AXIS, then power it off": "a tuning, which the tests of tuning run",
    "secure the load, then ldcnd reset AXIS": "a load that is secured by hand",
    "wait for the end of the trace, or ldcnd trace abort AXIS": "a drive that a dead program has left in its trace",
    "ldcnd trace abort AXIS": "a daemon that is lost during a trace",
    "ldcnd trace abort AXIS again": "a drive that does not leave its trace",
    "ldcnd axis clear-counter AXIS COUNTER again": "a drive that does not leave its counter mode",
    "ldcnd log; give every command an id of its own": "thousands of commands",
    "ldcnd halt AXIS first: at standstill the counter is set back": "hours of motion",
    "ldcnd move AXIS DISTANCE --relative, a small distance: it sets the counter back": "hours of motion",
    "ldcnd halt AXIS and wait, or ldcnd power off AXIS if its loop hunts: at standstill the gains are loaded again": (
        "a drive taken over in motion"
    ),
}
"""Remedies whose state takes hands, hours or a broken drive, with what that is."""


@pytest.mark.long
def test_every_remedy_that_names_a_command_is_run_or_takes_hands():
    run = {case.says for case in CASES.values()} | BY_OTHER_TESTS
    known = {each.phrased(lambda step: typed(step, None)) for each in remedies()}
    print(f"{len(known)} remedies name commands, {len(run & known)} were run from the state that says them")

    assert run <= known
    assert not run & set(NOT_RUN)
    assert known - run == set(NOT_RUN)


LEADS_IN = re.compile(r"\b(type|send|with)\W*(\0|ldcnd|press|hold|set|move|write|look|clear|home|make)", re.IGNORECASE)


def test_each_remedy_is_a_sentence_on_a_page_which_tells_to_switch_off_where_it_means_that():
    """What introduces a command belongs to its words, which are others on each face."""
    told = list(remedies())
    module = part_of_pages("remedies.js").replace("export ", "")
    script = f"""globalThis.location = {{ hash: "#/axis/rig/x" }};
        {module}
        console.log(JSON.stringify(JSON.parse(require("fs").readFileSync(0)).map(inPageTerms)))"""
    asked = [
        {
            "remedy": str(each),
            "axis": "x",
            "steps": [{"verb": one.verb, "said": one.said, "arguments": dict(one.arguments)} for one in each.steps],
        }
        for each in told
    ]

    for remedy, page in zip(told, ask_the_pages(script, *asked), strict=True):
        assert not LEADS_IN.search(remedy.phrased(lambda _: "\0")), remedy
        assert not LEADS_IN.search(page.replace("type ldcnd ", "")), page
        switched = [one.arguments["on"] for one in remedy.steps if one.verb == "power"]
        assert ("press Disable" in page, "press Enable" in page) == (False in switched, True in switched), page


def remedies() -> Iterator[Remedy]:
    """Yield each remedy of the package that names commands."""
    words = {"Remedy": Remedy, "step": step, "remedy_step": step, "EEPROM_LIFE": EEPROM_LIFE, "again": ""}
    words["remedy"] = step("set_outputs", limit1="input", limit2="input")
    for file in Path(ldcnd.__file__).parent.rglob("*.py"):
        for remedy in written_in(ast.parse(file.read_text(encoding="utf-8")), dict(words)):
            if remedy.steps:
                yield remedy


def written_in(node: ast.AST, words: dict[str, object]) -> Iterator[Remedy]:
    """Yield the remedies of a piece of code, in which texts and steps have names."""
    if isinstance(node, ast.FunctionDef):
        words = dict(words)
    for each in ast.iter_child_nodes(node):
        match each:
            case ast.Assign(
                targets=[ast.Name(name)],
                value=ast.Constant(str()) | ast.JoinedStr() | ast.Call(func=ast.Name("step" | "remedy_step")),
            ):
                with contextlib.suppress(NameError, AttributeError):  # about what is only known as it runs
                    words.setdefault(name, eval(ast.unparse(each.value), words))  # noqa: S307 - our own code
            case ast.Call(func=ast.Name("Remedy")):
                with contextlib.suppress(NameError):  # the same; those of interlocks are run with the centrifuge
                    yield eval(ast.unparse(each), words)  # noqa: S307 - our own code
        yield from written_in(each, words)
