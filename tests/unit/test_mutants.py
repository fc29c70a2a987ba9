"""The tool behind `make mutants`: what it changes, and that it notices whether a test notices."""

from pathlib import Path

from tests.mutants.__main__ import ROOT, SUBJECTS
from tests.mutants.changes import mutants_of
from tests.mutants.covering import CoveringTests

MODULE = """
@dataclass(frozen=True)
def allowed(speed, limit, latched):
    if latched and speed > 0:
        raise ValueError(speed)
    check(limit)
    log.info("asked")
    return not latched and speed <= limit
"""


def test_each_change_compiles_and_differs(tmp_path: Path):
    (tmp_path / "module.py").write_text(MODULE)

    mutants = list(mutants_of("module.py", tmp_path))

    assert {mutant.change for mutant in mutants} == {
        "condition true", "condition false", "and to or", "Gt to GtE", "raise removed", "call removed", "not removed",
        "LtE to Lt",
    }  # fmt: skip
    assert len({mutant.source for mutant in mutants}) == len(mutants)
    for mutant in mutants:
        compile(mutant.source, "module.py", "exec")


def test_a_change_is_made_where_it_says(tmp_path: Path):
    (tmp_path / "module.py").write_text(MODULE)

    (removed,) = [mutant for mutant in mutants_of("module.py", tmp_path) if mutant.change == "call removed"]

    assert (removed.line, removed.before) == (6, "check(limit)")
    assert "check(limit)" not in removed.source
    assert "log.info" in removed.source


def test_the_quickest_covering_tests_are_taken_until_their_time_is_over():
    covering = CoveringTests({"a.py": {"3": [0, 1, 2]}}, ["slow", "quick", "middling"], [9.0, 0.1, 1.0])

    assert covering.of("a.py", 3, within_s=2.0) == ["quick", "middling"]
    assert covering.of("a.py", 3, within_s=0.01) == ["quick"]
    assert covering.of("a.py", 4, within_s=2.0) == []


def test_every_subject_exists_and_there_are_enough_changes():
    assert [glob for glob in SUBJECTS if not list(ROOT.glob(glob))] == []
