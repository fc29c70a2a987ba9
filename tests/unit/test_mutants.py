"""The tool behind `make mutants`: what it changes, and which tests it runs for a change."""

import json
import tomllib
from collections.abc import Iterable, Mapping
from pathlib import Path

import pytest

from tests.mutants.__main__ import EQUIVALENTS, SUBJECTS, TESTS, report
from tests.mutants.campaign import Judgement, Verdict
from tests.mutants.changes import Mutant, mutants_of
from tests.mutants.covering import ROOT, Covering

MODULE = """
@dataclass(frozen=True)
def allowed(speed: int | str, limit, latched, hurry=False):
    if latched and speed > 0:
        raise ValueError(f"{speed + 1}")
    check(limit)
    log.info("asked")
    return not latched and speed <= limit
"""


@pytest.fixture
def mutants(tmp_path: Path) -> Mapping[str, Mutant]:
    (tmp_path / "module.py").write_text(MODULE)
    return {mutant.change: mutant for mutant in mutants_of("module.py", tmp_path)}


def test_conditions_guards_and_calls_are_changed_but_no_types_messages_and_logs(mutants: Mapping[str, Mutant]):
    assert set(mutants) == {
        "condition true: latched and speed > 0", "condition false: latched and speed > 0",
        "and to or: latched and speed > 0", "Gt to GtE: speed > 0", "raise removed: raise ValueError(f'{speed + 1}')",
        "call removed: check(limit)", "and to or: not latched and speed <= limit", "not removed: not latched",
        "LtE to Lt: speed <= limit", "the other truth value: False",
    }  # fmt: skip


def test_each_change_changes_the_code(mutants: Mapping[str, Mutant], tmp_path: Path):
    same = compile(MODULE, str(tmp_path / "module.py"), "exec")

    assert all(mutant.module(tmp_path) != same for mutant in mutants.values())


def test_a_change_is_made_where_it_says(mutants: Mapping[str, Mutant], tmp_path: Path):
    removed = mutants["call removed: check(limit)"]

    (function,) = [code for code in removed.module(tmp_path).co_consts if hasattr(code, "co_names")]
    assert (removed.lines, removed.place) == ((6, 6), "allowed")
    assert "check" not in function.co_names
    assert "log" in function.co_names


def test_the_order_of_mutants_is_the_same_whatever_else_there_is(mutants: Mapping[str, Mutant], tmp_path: Path):
    (tmp_path / "module.py").write_text("import other\n\n\n" + MODULE + "\n\nother.call(1 < 2)\n")
    moved = list(mutants_of("module.py", tmp_path))

    def names(those: Iterable[Mutant]) -> list[str]:
        return [each.change for each in sorted(those, key=lambda mutant: mutant.rank(7)) if each.change in mutants]

    assert names(moved) == names(mutants.values())


def test_a_default_is_changed_where_the_function_is_defined(mutants: Mapping[str, Mutant]):
    assert mutants["the other truth value: False"].function == ""
    assert mutants["call removed: check(limit)"].function == "allowed"


def test_quick_tests_come_first_and_lines_are_followed_by_their_text(tmp_path: Path):
    subject = "tests/mutants/__init__.py"
    text = (ROOT / subject).read_text()
    (tmp_path / "sources").mkdir()
    (tmp_path / "sources" / "before").write_text("import gone\n" + text)
    record = {
        "module": "tests/unit/test_mutants.py", "digest": "", "seconds": {"slow": 9.0, "quick": 0.1},
        "lines": {subject: {"2": [0, 1]}}, "sources": {subject: "before"},
    }  # fmt: skip
    (tmp_path / "a.json").write_text(json.dumps(record))

    covering = Covering([subject], tmp_path)

    assert covering.of(subject, [1]) == ["quick", "slow"]
    assert covering.of(subject, [2]) == []


def test_a_campaign_fails_on_a_survivor_and_on_too_few_killed(
    mutants: Mapping[str, Mutant], capsys: pytest.CaptureFixture[str]
):
    chosen = list(mutants.values())
    killed = [Judgement(number, Verdict.KILLED, "a test", 0.1) for number in range(len(chosen))]

    assert report(chosen, killed, 1.0) == 0
    assert report(chosen, [*killed[1:], Judgement(0, Verdict.SURVIVED, "", 0.1)], 1.0) == 1
    assert f"survived: {chosen[0]}" in capsys.readouterr().out


def test_every_subject_and_folder_of_tests_exists():
    assert [glob for glob in (*SUBJECTS, *TESTS) if not list(ROOT.glob(glob))] == []


def test_what_is_argued_to_be_equivalent_is_still_in_the_code():
    argued = tomllib.loads(EQUIVALENTS.read_text())["equivalent"]
    known = {
        (mutant.path, mutant.place, mutant.change)
        for path in {each["path"] for each in argued}
        for mutant in mutants_of(path, ROOT)
    }

    assert [each for each in argued if (each["path"], each["place"], each["change"]) not in known] == []
    assert all(each["reason"].strip() for each in argued)
