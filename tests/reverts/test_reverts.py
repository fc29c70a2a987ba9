"""Each fix of the tables stands where it is taken back, and is missed by its tests when it is gone."""

import re
from itertools import chain
from operator import attrgetter
from pathlib import Path

import pytest

from tests.reverts import adapters, ldcn, safety, smartstep
from tests.reverts.revert import ROOT, Revert, copy_of_checkout, failed, outcomes, taken_back

REVERTS: tuple[Revert, ...] = (*safety.REVERTS, *ldcn.REVERTS, *smartstep.REVERTS, *adapters.REVERTS)


def function_of(test: str) -> str:
    return test.rpartition("::")[2].partition("[")[0]


@pytest.mark.parametrize("revert", REVERTS, ids=attrgetter("name"))
def test_a_fix_that_can_be_taken_back_stands_in_its_file(revert: Revert):
    for edit in revert.edits:
        assert (ROOT / edit.path).read_text(encoding="utf-8").count(edit.fixed) == 1
    for test in revert.noticed_by:
        assert f"def {function_of(test)}(" in (ROOT / test.partition("::")[0]).read_text(encoding="utf-8")


def test_the_reference_of_ldcn_names_exactly_the_tests_that_hold_what_was_found():
    page = (ROOT / "docs" / "reference" / "ldcn-nmc.md").read_text(encoding="utf-8")
    table = page.partition("## Findings against the manuals")[2].partition("\n###")[0]

    held = {function_of(test) for revert in ldcn.REVERTS for test in revert.noticed_by}
    assert set(re.findall(r"`(test_\w+)`", table)) == held


def test_the_reference_of_smartstep_names_exactly_the_test_that_holds_each_finding():
    page = (ROOT / "docs" / "reference" / "smartstep.md").read_text(encoding="utf-8")
    table = page.partition("## Departures that were mended")[2]

    held = {(revert.finding, function_of(test)) for revert in smartstep.REVERTS for test in revert.noticed_by}
    assert set(re.findall(r"^\| (\d+) .*`(test_\w+)` \|$", table, re.MULTILINE)) == held


@pytest.fixture(scope="module")
def checkout(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return copy_of_checkout(tmp_path_factory.mktemp("reverts"))


@pytest.mark.soak
@pytest.mark.timeout(3600)
def test_the_tests_pass_with_every_fix(checkout):
    tests = sorted(set(chain.from_iterable(revert.noticed_by for revert in REVERTS)))

    found = outcomes(checkout, "-m", "not soak", *tests)

    assert [test for test, outcome in found.items() if outcome != "passed"] == []


@pytest.mark.soak
@pytest.mark.timeout(3600)
@pytest.mark.parametrize("revert", REVERTS, ids=attrgetter("name"))
def test_a_fix_that_is_taken_back_is_missed_by_each_of_its_tests(revert: Revert, checkout):
    with taken_back(checkout, revert):
        found = outcomes(checkout, "-m", "not soak", "--timeout", "300", *revert.noticed_by)

    assert [test for test in revert.noticed_by if not failed(found, test)] == []
