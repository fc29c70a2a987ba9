"""What the page on safety promises has tests that are marked with it, and no test holds what is not promised."""

import ast
import re
from collections.abc import Iterator

import pytest

from tests.support.process import ROOT

PAGE = ROOT / "docs" / "explanation" / "safety.md"
PROMISE = re.compile(r"^\| .+ \| `([a-z0-9-]+)` \|$", re.MULTILINE)


def marked() -> Iterator[str]:
    """Yield the ids of all `@pytest.mark.promise(id)`."""
    for path in (ROOT / "tests").glob("*/test_*.py"):
        text = path.read_text(encoding="utf-8")
        for node in ast.walk(ast.parse(text)) if "mark.promise" in text else ():
            match node:
                case ast.Call(func=ast.Attribute(attr="promise"), args=[ast.Constant(value=str(promise))]):
                    yield promise


@pytest.mark.long
def test_every_promise_has_a_test_and_every_marked_test_a_promise():
    promised = PROMISE.findall(PAGE.read_text(encoding="utf-8"))

    assert len(promised) == len(set(promised)) > 0
    assert set(promised) == set(marked())
