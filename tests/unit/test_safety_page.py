"""The page on safety promises nothing that no test holds."""

import ast
import re

import pytest

from tests.support.pages import ROOT

PAGE = ROOT / "docs" / "explanation" / "safety.md"
TABLE = PAGE.read_text(encoding="utf-8").partition("## What the daemon promises")[2].partition("\n## ")[0]
PROMISES = [line for line in TABLE.splitlines() if line.startswith("| ") and not line.startswith("| promise")]


@pytest.mark.parametrize("promise", PROMISES, ids=lambda line: line[2:40])
def test_every_promise_names_tests_that_exist(promise):
    cells = promise.strip("| ").split(" | ")
    named = re.findall(r"`(tests/[a-z_/]+\.py)::(test_[a-z0-9_]+)`", cells[-1])

    assert len(cells) == 4
    assert named
    for path, name in named:
        tree = ast.parse((ROOT / path).read_text(encoding="utf-8"))
        assert name in {node.name for node in tree.body if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)}


def test_there_are_promises():
    assert len(PROMISES) > 10
