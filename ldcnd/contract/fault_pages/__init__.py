"""A page for each fault and each error: what it means, what the daemon has done, what to check, how to clear it.

The pages are files beside this one, `<code>.md`, in plain CommonMark. A console serves them at `/faults/<code>`, the
documentation has them under the same name, and every fault and every error reply names its page.
"""

from functools import cache
from pathlib import Path

FOLDER = Path(__file__).parent
UNLISTED_ALARM = "alarm_unlisted"
"""The page of all alarms that no manual lists."""


@cache
def codes() -> frozenset[str]:
    """Return the codes that have a page."""
    return frozenset(path.stem for path in FOLDER.glob("*.md"))


def page_of(code: str) -> str | None:
    """Return where the page of a code is, below a console or the documentation; None for a code without one."""
    if code in codes():
        return f"faults/{code}"
    return f"faults/{UNLISTED_ALARM}" if code.startswith("alarm_") else None


def page_text(code: str) -> str | None:
    """Return the page of a code as CommonMark; None for a code without one."""
    page = page_of(code)
    return page and (FOLDER / f"{page.removeprefix('faults/')}.md").read_text(encoding="utf-8")
