"""The table of verbs and where each can be reached; `python -m tests.support.verb_table` writes the page anew."""

import re
from collections.abc import Iterable
from pathlib import Path

from ldcnd.cli.verb_methods import method_name
from ldcnd.client.axis import Axis
from ldcnd.client.rig import Rig
from ldcnd.model.catalogue import COMMANDS
from ldcnd.model.commands import About, Command
from ldcnd.model.frozen import Frozen
from tests.support.process import ROOT

PAGE = ROOT / "docs" / "reference" / "verbs.md"
PLACES = ("client", "command line", "console", "documentation")
HEADER = """# Verbs

Where can a verb be reached? This table is made from the command classes and from the sources of the client, the command
line, the console and the documentation. A cell with words says why a verb is not there as such.

"""
LEASE = "part of `Rig.control`"
EXPLAINED = {
    ("acquire", "client"): LEASE,
    ("renew", "client"): LEASE,
    ("release", "client"): LEASE,
    ("events", "client"): "`Rig.events` follows them without gaps",
    ("wire_log", "client"): "for people: `ldcnd bus wire-log`",
    ("rehearse", "client"): "for people: `ldcnd drill`",
    ("acquire", "console"): "a page takes control by `/api/rigs/RIG/control`",
    ("renew", "console"): "by itself while a page is open",
    ("outcome", "console"): "the events of the rig show it",
    ("rehearse", "console"): "a loss is rehearsed at the machine, with `ldcnd drill`",
    ("move_relative", "documentation"): "`ldcnd axis move --relative`, in the reference of the command line",
    ("read_monitors", "console"): "the page of the axis shows the monitors as they are published",
    ("snapshot", "console"): "answered by the console's server; no page sends it yet: `ldcnd bus snapshot`",
    ("set_io", "console"): "what an output switches, a page cannot show: `ldcnd bus set-io`",
    ("set_io_timer", "console"): "`ldcnd bus set-io-timer`",
    ("renew", "documentation"): "`Rig.control` does it by itself",
    ("release", "command line"): "a lease of the command line ends with its command",
    ("renew", "command line"): "a command that holds control renews it by itself",
    ("outcome", "command line"): "`ldcnd events` shows it",
}
"""Why a verb is not in a place; everything else is there."""
METHODS_OF_RIGS = {"holders", "outcome", "move_together", "snapshot", "set_io", "set_io_timer"}
BY_FUNCTIONS = {
    "events": ("follow_events", "latest_events"),
    "wire_log": ("fetch_wire_log",),
    "why": ("client.why",),
    "read_all_parameters": ("read_dump",),
    "plan_parameters": ("plan_transfer",),
}
"""What the command line calls in place of the class."""


def verb_table() -> str:
    """Return the page."""
    lines = [f"| verb | about | {' | '.join(PLACES)} |", "|---|---|" + "---|" * len(PLACES)]
    for command in COMMANDS:
        cells = [_cell(command, place) for place in PLACES]
        lines.append(f"| `{command.verb}` | {command.about} | {' | '.join(cells)} |")
    return HEADER + "\n".join(lines) + "\n"


def empty_cells() -> list[tuple[str, str]]:
    """Return what is neither there nor explained."""
    return [(command.verb, place) for command in COMMANDS for place in PLACES if not _cell(command, place)]


def needless_explanations() -> list[tuple[str, str]]:
    """Return what is explained although it is there."""
    by_verb = {command.verb: command for command in COMMANDS}
    return [(verb, place) for verb, place in EXPLAINED if _found(by_verb[verb], place)]


def _cell(command: type[Command[Frozen]], place: str) -> str:
    return _found(command, place) or EXPLAINED.get((command.verb, place), "")


def _found(command: type[Command[Frozen]], place: str) -> str:
    match place:
        case "client":
            kind = Axis if command.about is About.AXIS else Rig
            name = method_name(command) if command.about is About.AXIS else command.verb
            known = command.about is About.AXIS or name in METHODS_OF_RIGS
            return f"`{kind.__name__}.{name}`" if known and hasattr(kind, name) else ""
        case "command line":
            names = "|".join((command.__name__, *BY_FUNCTIONS.get(command.verb, ())))
            files = (file for file in ROOT.glob("ldcnd/cli/*.py") if file.stem not in {"verb_methods", "schema"})
            return _in_sources(rf"\b(?:{names})\b", files)
        case "console":
            sources = [*ROOT.glob("ldcnd/console/static/**/*.js"), *ROOT.glob("ldcnd/console/*.py")]
            return _in_sources(
                rf"""["'`/]{command.verb}["'`]""",
                (each for each in sources if "vendor" not in str(each) and each.name != "remedies.js"),
            )
        case _:
            pages = [*ROOT.glob("docs/*/*.md"), *ROOT.glob("ldcnd/fault_pages/*.md")]
            spelt = re.escape(command.verb).replace("_", "[_ -]")
            return _in_sources(rf"\b{spelt}\b", (page for page in pages if not _is_generated(page)))


def _in_sources(pattern: str, files: Iterable[Path]) -> str:
    found = sorted(file for file in files if re.search(pattern, file.read_text(encoding="utf-8")))
    return f"`{found[0].name}`" if found else ""


def _is_generated(page: Path) -> bool:
    return page.parent.name == "adr" or page.name in {"verbs.md", "python.md", "keys.md", "cli.md", "errors.md"}


if __name__ == "__main__":
    PAGE.write_text(verb_table(), encoding="utf-8")
