"""What is held of the words of the published contract: `python -m tests.words`, a part of `make check`.

Every description in `schemas/` is a whole sentence that begins with the thing described and ends with a full stop. The
name of a class stands once in the package.
"""

import argparse
import ast
import json
import re
import sys
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).parents[1]
SCHEMAS = ROOT / "schemas"
NO_THING = frozenset({
    "After", "Also", "And", "As", "At", "Because", "Before", "Beside", "Besides", "But", "By", "Else", "For", "From",
    "If", "In", "Likewise", "None", "Not", "Of", "On", "Only", "Or", "Otherwise", "Over", "Per", "Same", "Since", "So",
    "Than", "Then", "To", "Under", "Unless", "Until", "When", "Where", "Which", "While", "With", "Within", "Without",
})  # fmt: skip
"""Words that describe a thing without naming it, at the beginning of a sentence."""


def descriptions(node: object, path: str) -> Iterator[tuple[str, str]]:
    """Yield the place and the text of every description of a schema."""
    if isinstance(node, dict):
        if isinstance(text := node.get("description"), str):
            yield path, text
        for name, inner in node.items():
            yield from descriptions(inner, f"{path}/{name}")
    elif isinstance(node, list):
        for place, inner in enumerate(node):
            yield from descriptions(inner, f"{path}/{place}")


def fault_of(text: str) -> str | None:
    """Tell why a description is no whole sentence; None if it is one."""
    first = re.match(r"\W*(\w+)", text)
    if first is None:
        return "has no words"
    if first[1] in NO_THING:
        return f"begins with {first[1]!r}, not with the thing described"
    if text[0].islower():
        return "begins with a small letter"
    return None if text.rstrip().endswith(".") else "does not end with a full stop"


def names_twice(package: Path) -> Iterator[str]:
    """Yield the names of classes that several modules define, with these."""
    modules: dict[str, list[str]] = defaultdict(list)
    for file in sorted(package.rglob("*.py")):
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
            if isinstance(node, ast.ClassDef):
                modules[node.name].append(str(file.relative_to(package)))
    for name, found in modules.items():
        if len(found) > 1:
            yield f"class {name} stands in {', '.join(found)}"


def main() -> int:
    """Print descriptions that are no sentences and names that stand twice; the exit status is 1 if there are any."""
    argparse.ArgumentParser(description=__doc__).parse_args()
    texts = {
        f"{path}: {text!r} {fault}"
        for file in sorted(SCHEMAS.glob("*.json"))
        for path, text in descriptions(json.loads(file.read_text(encoding="utf-8")), file.stem)
        if (fault := fault_of(text))
    }
    names = list(names_twice(ROOT / "ldcnd"))
    print(*sorted(texts), *names, sep="\n", end="\n" if texts or names else "")
    print(f"{len(texts)} descriptions are no whole sentences, {len(names)} names of classes stand twice")
    return bool(texts or names)


if __name__ == "__main__":
    sys.exit(main())
