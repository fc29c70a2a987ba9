"""Lets a module be imported as a mutant: a plugin of pytest for changes of what runs at import.

The environment says which (`LDCND_MUTANT`: path, number of the node, kind of the change, as JSON).
"""

import json
import os
import sys
from collections.abc import Sequence
from importlib.machinery import ModuleSpec, PathFinder, SourceFileLoader
from pathlib import Path
from types import CodeType, ModuleType

from tests.mutants.changes import Mutant

MUTANT = "LDCND_MUTANT"


class _ChangedLoader(SourceFileLoader):
    def __init__(self, name: str, mutant: Mutant, root: Path) -> None:
        super().__init__(name, str(root / mutant.path))
        self._mutant = mutant
        self._root = root

    def get_code(self, fullname: str) -> CodeType:
        return self._mutant.module(self._root)


class ChangedFinder(PathFinder):
    """Finds one module, changed."""

    def __init__(self, mutant: Mutant, root: Path) -> None:
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
