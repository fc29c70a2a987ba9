"""The command line as pages: an overview in Markdown, and man pages; both are made of what `--help` says."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import click

from ldcnd.cli.connection import TargetOption
from ldcnd.cli.main import cli
from ldcnd.cli.names import COMMANDS
from ldcnd.cli.output import EXIT_CODES
from ldcnd.version import version

EXIT_STATUS = tuple((str(code), f"{meaning[:1].upper()}{meaning[1:]}.") for code, meaning in EXIT_CODES.items())
INTRODUCTION = """# Command line

Which command does what? `ldcnd COMMAND --help` has its options, and so have the man pages of the Debian package. The
shell completes commands, options, axes and fault codes with this line in `~/.bashrc` (or `zsh_source`, `fish_source`):
`eval "$(_LDCND_COMPLETE=bash_source ldcnd)"`.

| exit code | meaning |
|---|---|
"""


@dataclass(frozen=True, slots=True)
class Entry:
    """One command.

    Attributes:
        path: its words, such as `ldcnd move`.
        usage: what follows them.
        paragraphs: of its help.
        options: as they are written, with their meaning; without those for finding the daemon, and without help.
        asks_a_daemon: it takes the options for finding the daemon.
        is_group: it has commands of its own.
    """

    path: str
    usage: str
    paragraphs: tuple[str, ...]
    options: tuple[tuple[str, str], ...]
    asks_a_daemon: bool
    is_group: bool


def entries(name: str) -> list[Entry]:
    """Return a command of the top level and all below it, the command itself first."""
    command = cli.get_command(click.Context(cli), name)
    if command is None:
        raise KeyError(name)
    return list(_walk(command, ("ldcnd", name)))


def target_options() -> tuple[tuple[str, str], ...]:
    """Return the options for finding the daemon."""
    command = cli.get_command(click.Context(cli), "events")
    return _options(command, of_target=True) if command else ()


def as_markdown() -> str:
    """Return the overview: exit codes, the options for finding a daemon, a line for each command of the top level."""
    codes = "".join(f"| {code} | {meaning} |\n" for code, meaning in EXIT_STATUS)
    finding = f"Commands that use a daemon find it by these options:\n\n{_table(target_options())}"
    lines = "".join(_overview_line(name, summary) for name, (_, summary) in COMMANDS.items())
    return "\n".join((INTRODUCTION + codes, finding, f"The commands, each with those below it:\n\n{lines}"))


def _overview_line(name: str, summary: str) -> str:
    """Return a command of the top level with what it does, and the commands below it."""
    own, *below = entries(name)
    inner = ", ".join(f"`{entry.path.removeprefix(f'{own.path} ')}`" for entry in below)
    return f"* `{name}`: {summary}{f' {inner}.' if inner else ''}\n"


def man_pages() -> Mapping[str, str]:
    """Return the man pages by file name: one for the program, one for each command of the top level."""
    names = {name: f"ldcnd-{name}" for name in COMMANDS}
    overview = [
        _head("ldcnd", "own RS-485 servo lines and expose their drives over Zenoh"),
        f".SH SYNOPSIS\n.B ldcnd\n{_roff('[OPTIONS] COMMAND [ARGS]...')}\n",
        ".SH COMMANDS\n" + "".join(_item(f"{page}(1)", COMMANDS[name][1]) for name, page in names.items()),
        _tail(*names.values()),
    ]
    return {"ldcnd.1": "".join(overview)} | {f"{page}.1": _man_page(name, page) for name, page in names.items()}


def _man_page(name: str, page: str) -> str:
    own, *below = entries(name)
    parts = [
        _head(page, COMMANDS[name][1]),
        f".SH SYNOPSIS\n.B {_roff(own.path)}\n{_roff(own.usage)}\n",
        ".SH DESCRIPTION\n" + _paragraphs(own.paragraphs),
    ]
    if own.options:
        parts.append(".SH OPTIONS\n" + "".join(_item(*option) for option in own.options))
    if below:
        parts.append(".SH COMMANDS\n")
    for entry in below:
        parts.append(f'.SS "{_roff(f"{entry.path} {entry.usage}".strip())}"\n' + _paragraphs(entry.paragraphs))
        parts += [_item(*option) for option in entry.options]
    if any(entry.asks_a_daemon for entry in (own, *below)):
        parts.append(".SH FINDING THE DAEMON\n" + "".join(_item(*option) for option in target_options()))
    return "".join([*parts, _tail("ldcnd")])


def _walk(command: click.Command, path: tuple[str, ...]) -> Iterator[Entry]:
    context = click.Context(command, info_name=path[-1])
    yield Entry(
        " ".join(path),
        " ".join(command.collect_usage_pieces(context)),
        tuple(" ".join(part.split()) for part in (command.help or "").split("\n\n")),
        _options(command, of_target=False),
        any(isinstance(parameter, TargetOption) for parameter in command.params),
        isinstance(command, click.Group),
    )
    if isinstance(command, click.Group):
        for name in command.list_commands(context):
            if found := command.get_command(context, name):
                yield from _walk(found, (*path, name))


def _options(command: click.Command, *, of_target: bool) -> tuple[tuple[str, str], ...]:
    """Return the options as `--help` writes them: those for finding the daemon, or all others."""
    context = click.Context(command)
    records = (
        parameter.get_help_record(context)
        for parameter in command.params
        if isinstance(parameter, click.Option) and isinstance(parameter, TargetOption) is of_target
    )
    return tuple((written, " ".join(meaning.split())) for written, meaning in filter(None, records))


def _table(rows: tuple[tuple[str, str], ...]) -> str:
    lines = ["| option | meaning |", "|---|---|"]
    for written, meaning in rows:
        option, text = (cell.replace("|", "\\|") for cell in (written, meaning))
        lines.append(f"| `{option}` | {text} |")
    return "\n".join(lines) + "\n"


def _head(page: str, summary: str) -> str:
    title = f'.TH {page.upper()} 1 "" "ldcnd {version()}" "ldcnd"\n'
    return f"{title}.SH NAME\n{_roff(page)} \\- {_roff(summary.rstrip('.'))}\n"


def _tail(*others: str) -> str:
    status = "".join(_item(code, meaning) for code, meaning in EXIT_STATUS)
    return f".SH EXIT STATUS\n{status}.SH SEE ALSO\n{_roff(', '.join(f'{page}(1)' for page in others))}\n"


def _paragraphs(paragraphs: tuple[str, ...]) -> str:
    return "".join(f".PP\n{_roff(text)}\n" for text in paragraphs)


def _item(term: str, meaning: str) -> str:
    return f".TP\n.B {_roff(term)}\n{_roff(meaning)}\n"


def _roff(text: str) -> str:
    """Return text that troff takes for nothing else: no escapes, no requests, hyphens that can be copied."""
    plain = text.replace("\\", "\\e").replace("-", "\\-").replace('"', "\\(dq")
    return f"\\&{plain}" if plain[:1] in (".", "'") else plain
