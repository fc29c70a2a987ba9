"""A plugin for pytest: tests that use a wing are skipped in a tree without it (`-p`, the wing in LDCND_WITHOUT)."""

import os
from collections.abc import Generator
from typing import Any

import pytest

WING = f"ldcnd.{os.environ.get('LDCND_WITHOUT', '?')}"


def _uses_it(error: BaseException | None) -> bool:
    """Tell whether something failed for the wing, whatever was raised from that."""
    while error is not None:
        if isinstance(error, BaseExceptionGroup):
            return any(_uses_it(each) for each in error.exceptions)
        if (isinstance(error, ModuleNotFoundError) and f"{error.name}.".startswith(f"{WING}.")) or (
            f"need {WING}" in f"{error}" or f"the simulator, {WING}" in f"{error}"
        ):
            return True
        error = error.__cause__ or error.__context__
    return False


@pytest.hookimpl(hookwrapper=True)
def pytest_make_collect_report() -> Generator[None, Any, None]:
    """Skip a module that cannot be loaded without the wing."""
    outcome = yield
    report = outcome.get_result()
    if report.failed and f"No module named '{WING}" in str(report.longrepr):
        report.outcome = "skipped"
        report.longrepr = ("", 0, f"uses {WING}")


@pytest.hookimpl(hookwrapper=True)
def pytest_runtest_makereport(call: pytest.CallInfo[None]) -> Generator[None, Any, None]:
    """Skip a test that uses the wing as it runs."""
    outcome = yield
    report = outcome.get_result()
    if report.failed and call.excinfo and _uses_it(call.excinfo.value):
        report.outcome = "skipped"
        report.longrepr = ("", 0, f"uses {WING}")
