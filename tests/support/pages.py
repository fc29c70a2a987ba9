"""Markdown pages as a reader meets them: prose and fenced blocks, in their order."""

import re
import shlex
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import click

from ldcnd.cli.main import cli

ROOT = Path(__file__).parents[2]
GENERATED = (ROOT / "docs" / "faults", ROOT / "docs" / "how-to" / "install.md")
"""Copies that a build of the site makes."""
FENCE = re.compile(r"(?ms)^```([\w{}]*)\n(.*?)^```$")
SEPARATORS = {"|", "||", "&&", ";", "&"}


@dataclass(frozen=True, slots=True)
class Block:
    """One fenced block.

    Attributes:
        page: relative to the checkout, as in `docs/tutorials/first-rig.md`.
        prose: between the block before and this one.
        language: after the fence.
    """

    page: str
    prose: str
    language: str
    text: str

    @property
    def first_line(self) -> str:
        """What names the block."""
        return self.text.partition("\n")[0]

    def __str__(self) -> str:
        return f"{self.page}: {self.first_line}"


def pages() -> list[Path]:
    """Return every page that people read, without generated copies."""
    found = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "deploy").glob("*.md"))]
    docs = sorted((ROOT / "docs").rglob("*.md"))
    return found + [page for page in docs if not any(page.is_relative_to(copy) for copy in GENERATED)]


def broken_links(found: Iterable[Path]) -> list[str]:
    """Return the links of pages that lead to no file beside them, each with its page."""
    broken = []
    for page in found:
        text = re.sub(r"(?ms)^```.*?^```$|`[^`]*`", "", page.read_text(encoding="utf-8"))
        for target in re.findall(r"\]\(([^)\s]+)\)", text):
            place, _, _ = target.partition("#")
            if place and "://" not in place and not (page.parent / place).exists():
                broken.append(f"{page}: {target}")
    return broken


def blocks_of(page: Path) -> list[Block]:
    """Return the blocks of a page; what comes after the last one is the prose of an empty block without a language."""
    parts = FENCE.split(page.read_text(encoding="utf-8"))
    name = str(page.relative_to(ROOT))
    blocks = [Block(name, *parts[at : at + 3]) for at in range(0, len(parts) - 1, 3)]
    return [*blocks, Block(name, parts[-1], "", "")]


def command_lines(text: str) -> list[list[str]]:
    """Return the words of every `ldcnd` in some shell text."""
    lines: list[list[str]] = []
    for line in text.replace("\\\n", " ").splitlines():
        lexer = shlex.shlex(line, posix=True, punctuation_chars=True)
        lexer.whitespace_split = True
        words: list[str] = []
        for word in [*lexer, ";"]:
            if word not in SEPARATORS:
                words.append(word)
                continue
            if words and words[0].rpartition("/")[2] == "ldcnd":
                lines.append(words[1:])
            words = []
    return lines


def require_command_line(words: list[str]) -> None:
    """Let the command line read these words; the files that they name need not be there.

    Raises:
        click.UsageError: they are no command of ldcnd.
    """
    command: click.Command = cli
    context = click.Context(cli)
    while isinstance(command, click.Group) and words and (found := command.get_command(context, words[0])):
        command, words = found, words[1:]
    if isinstance(command, click.Group) and words and not words[0].startswith("-"):
        raise click.UsageError(f"there is no command {words[0]!r}")
    try:
        command.make_context("ldcnd", list(words))
    except click.BadParameter as error:
        if "does not exist" not in error.message:
            raise
