"""What is held of the words of the published contract: `python -m tests.words`, a part of `make check`.

Every description in `schemas/` is a whole sentence that begins with the thing described and ends with a full stop.
"""

import argparse
import json
import re
import sys
from collections.abc import Iterator
from pathlib import Path

SCHEMAS = Path(__file__).parents[1] / "schemas"
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


def main() -> int:
    """Print the descriptions that are no sentences; the exit status is 1 if there are any."""
    argparse.ArgumentParser(description=__doc__).parse_args()
    found = {
        f"{path}: {text!r} {fault}"
        for file in sorted(SCHEMAS.glob("*.json"))
        for path, text in descriptions(json.loads(file.read_text(encoding="utf-8")), file.stem)
        if (fault := fault_of(text))
    }
    print(*sorted(found), f"{len(found)} descriptions are no whole sentences", sep="\n")
    return bool(found)


if __name__ == "__main__":
    sys.exit(main())
