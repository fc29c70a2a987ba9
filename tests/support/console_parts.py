"""Modules of the console's pages, and what they answer in a node."""

import json
import shutil
import subprocess
from importlib.resources import files
from pathlib import Path
from typing import Any

import pytest


def part_of_pages(name: str, folder: str = "parts") -> str:
    """Return the source of one module of the pages; without the wing as ModuleNotFoundError."""
    return (files("ldcnd.console") / "static" / folder / name).read_text(encoding="utf-8")


def ask_the_pages(script: str, *asked: Any) -> Any:
    """Return what a script prints in JSON that reads what is asked from its input; skips the test without a node."""
    node = shutil.which("node") or _node_of_playwright()
    if node is None:
        pytest.skip("no node: neither on the PATH nor in playwright")
    told = subprocess.run(  # noqa: S603 - node, with a script of ours
        [node, "-e", script], input=json.dumps(asked), capture_output=True, text=True, check=True, timeout=60
    )
    return json.loads(told.stdout)


def _node_of_playwright() -> str | None:
    playwright = pytest.importorskip("playwright", reason="no node: neither on the PATH nor in playwright")
    node = Path(playwright.__file__).parent / "driver" / "node"
    return str(node) if node.exists() else None
