"""Each fix of the table is noticed when it is missing."""

import os
import re
import subprocess
import sys

import pytest

from tests.mutants.ldcn_reverts import LDCN_REVERTS
from tests.mutants.reverts import REVERT, REVERTS, ROOT, Revert


def name(revert: Revert) -> str:
    return revert.noticed_by[0].rpartition("::")[2]


@pytest.mark.parametrize("revert", REVERTS, ids=name)
def test_a_fix_that_can_be_taken_back_stands_in_its_module(revert: Revert):
    assert (ROOT / revert.path).read_text(encoding="utf-8").count(revert.fixed) == 1
    for test in revert.noticed_by:
        file, _, function = test.partition("::")
        assert f"def {function.partition('[')[0]}(" in (ROOT / file).read_text(encoding="utf-8")


def test_the_reference_names_exactly_the_tests_that_hold_what_was_found():
    page = (ROOT / "docs" / "reference" / "ldcn-nmc.md").read_text(encoding="utf-8")
    table = page.partition("## Findings against the manuals")[2].partition("\n###")[0]

    held = {test.rpartition("::")[2].partition("[")[0] for revert in LDCN_REVERTS for test in revert.noticed_by}
    assert set(re.findall(r"`(test_\w+)`", table)) == held


@pytest.mark.soak
@pytest.mark.timeout(3600)
@pytest.mark.parametrize("number", range(len(REVERTS)), ids=map(name, REVERTS))
def test_a_fix_that_is_taken_back_is_missed_by_each_of_its_tests(number: int):
    revert = REVERTS[number]
    which = ("-m", "not soak and not guest and not edges")
    command = ("-q", "--no-header", "--tb=no", "-rA", "-p", "tests.mutants.reverts", "--timeout", "300", *which)
    run = subprocess.run(  # noqa: S603
        (sys.executable, "-m", "pytest", *command, *revert.noticed_by),
        cwd=ROOT,
        env=os.environ | {REVERT: str(number)},
        capture_output=True,
        text=True,
        check=False,
    )

    failed = [line for line in run.stdout.splitlines() if line.startswith("FAILED")]
    for test in revert.noticed_by:
        assert any(test in line for line in failed), f"{test} does not notice:\n{run.stdout[-2000:]}"
