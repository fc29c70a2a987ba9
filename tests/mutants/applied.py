"""Lets a module be imported as a mutant: a plugin of pytest for changes of what runs at import.

The environment says which (`LDCND_MUTANT`: path, number of the node, kind of the change, as JSON).
"""

import json
import os
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.machinery import ModuleSpec, PathFinder, SourceFileLoader
from pathlib import Path
from types import CodeType, ModuleType
from typing import Protocol

from tests.mutants.changes import Mutant

MUTANT = "LDCND_MUTANT"


class Change(Protocol):
    """A module that is not as it stands in its file."""

    @property
    def path(self) -> str:
        """Of the module, below the root."""

    def module(self, root: Path) -> CodeType:
        """Return the changed module."""


class _ChangedLoader(SourceFileLoader):
    def __init__(self, name: str, mutant: Change, root: Path) -> None:
        super().__init__(name, str(root / mutant.path))
        self._mutant = mutant
        self._root = root

    def get_code(self, fullname: str) -> CodeType:
        return self._mutant.module(self._root)


class ChangedFinder(PathFinder):
    """Finds one module, changed."""

    def __init__(self, mutant: Change, root: Path) -> None:
        self._mutant = mutant
        self._root = root

    def find_spec(  # type: ignore[override]
        self, fullname: str, path: Sequence[str] | None = None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        if fullname.replace(".", "/") + ".py" != self._mutant.path:
            return None
        spec = PathFinder.find_spec(fullname, path, target)
        if spec:
            spec.loader = _ChangedLoader(fullname, self._mutant, self._root)
        return spec


def pytest_configure() -> None:
    """Put the mutant before the module; conftest has imported none of the modules that are changed."""
    path, node, kind = json.loads(os.environ[MUTANT])
    mutant = Mutant(path, "", "", (0, 0), node, kind, "")
    sys.meta_path.insert(0, ChangedFinder(mutant, Path(__file__).parents[2]))


@dataclass(frozen=True, slots=True)
class Revert:
    """One fix that is taken back.

    Attributes:
        path: of the module.
        fixed: what stands there, exactly once.
        broken: what stood there, or what comes to the same.
        noticed_by: tests every one of which fails without the fix.
    """

    path: str
    fixed: str
    broken: str
    noticed_by: tuple[str, ...]

    def module(self, root: Path) -> CodeType:
        """Return the module without the fix."""
        source = (root / self.path).read_text(encoding="utf-8").replace(self.fixed, self.broken)
        return compile(source, str(root / self.path), "exec")
