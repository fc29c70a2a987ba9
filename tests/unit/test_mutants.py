"""The tool behind `make mutants`: what it changes, and which tests it runs for a change."""

import json
from collections.abc import Iterable, Mapping
from pathlib import Path

import pytest

from tests.mutants.__main__ import mutants_in, report
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


def test_a_campaign_fails_that_has_not_judged_every_mutant(
    mutants: Mapping[str, Mutant], capsys: pytest.CaptureFixture[str]
):
    chosen = list(mutants.values())
    killed = [Judgement(number, Verdict.KILLED, "a test", 0.1) for number in range(len(chosen) - 1)]

    assert report(chosen, killed, 1.0) == 1
    assert f"not judged: {chosen[-1]}" in capsys.readouterr().out


def test_a_change_is_addressed_by_its_function_and_kind_whatever_the_names_in_it(tmp_path: Path):
    def addresses(text: str) -> list[tuple[str, str, str, int]]:
        (tmp_path / "module.py").write_text(text)
        return [mutant.address for mutant in mutants_of("module.py", tmp_path)]

    renamed = MODULE.replace("speed", "rate").replace("check", "examine")

    assert addresses(MODULE) == addresses(renamed)
    assert len(set(addresses(MODULE))) == len(addresses(MODULE))


def test_subjects_are_modules_and_functions_and_one_that_names_nothing_ends_the_campaign():
    changes = "tests/mutants/changes.py"

    assert {mutant.place for mutant in mutants_in([f"{changes}::Mutant.__str__", f"{changes}::_places"])} == {
        "Mutant.__str__",
        "_places",
    }
    assert "_kinds" in {mutant.place for mutant in mutants_in([changes])}
    with pytest.raises(SystemExit, match="no_such"):
        mutants_in([f"{changes}::no_such"])
