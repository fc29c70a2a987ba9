"""Whatever is typed behind a command gets an exit code of the table and one message, never a traceback."""

import contextlib
import io
import sys
import traceback
from contextlib import asynccontextmanager

import click
import pytest

from ldcnd.cli import connection
from ldcnd.cli.connection import TargetOption
from ldcnd.cli.main import cli, main
from ldcnd.cli.names import COMMANDS
from ldcnd.cli.output import EXIT_CODES
from ldcnd.testing.memory_session import MemoryBroker

VALUES = ("nan", "inf", "0", "-1", "", "9" * 30, "\x1b[2J", "no/such")
DOCUMENTED = set(EXIT_CODES)
SERVES = {"run", "sim", "console", "metrics", "foxglove"}
"""These run until they are ended when all they are given can be used; what they refuse has tests of its own."""
HERE = {"pki"}
"""These write files where they are told to."""
NO_VALUES = {"top", "list"}
"""These have no option with a value but those for finding a daemon."""


@pytest.fixture(autouse=True)
def nobody_there(monkeypatch, tmp_path):
    """Let every command find a network on which there is no daemon; asyncio runs each call on a loop of its own."""

    @asynccontextmanager
    async def empty_network(_settings):
        async with MemoryBroker().session() as session:
            yield session

    monkeypatch.setattr(connection, "open_zenoh_session", empty_network)
    monkeypatch.setattr("ldcnd.cli.connection.open_zenoh_session", empty_network)
    monkeypatch.chdir(tmp_path)


def leaves(name):
    """Return a command, or all that are under it, with their words."""

    def walk(words, command):
        if isinstance(command, click.Group):
            for each in command.list_commands(click.Context(command)):
                yield from walk((*words, each), command.get_command(click.Context(command), each))
        else:
            yield words, command

    return walk((name,), cli.get_command(click.Context(cli), name))


def filled(command, odd, value):
    """Return an argument line with one parameter odd and the required others plausible."""
    line = []
    for param in command.params:
        if param is not odd and not param.required:
            continue
        plausible = param.type.choices[0] if isinstance(param.type, click.Choice) else "1"
        given = value if param is odd else plausible
        if isinstance(param, click.Option):
            if param.is_flag:
                continue
            line += [param.opts[-1], *([given] * param.nargs)]
        else:
            line.append(given)
    return line


def called(monkeypatch, words):
    """Return exit code and what was printed."""
    monkeypatch.setattr(sys, "argv", ["ldcnd", *words])
    monkeypatch.setattr(sys, "stdin", io.StringIO())
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed), contextlib.redirect_stderr(printed):
        try:
            main()
        except SystemExit as end:
            return end.code, printed.getvalue()
        except Exception:  # noqa: BLE001 - what comes here is what this test is about
            return "traceback", traceback.format_exc()


@pytest.mark.parametrize("name", sorted(COMMANDS.keys() - SERVES - HERE))
@pytest.mark.sweep(5)
def test_every_option_of_every_command_bears_every_value(name, monkeypatch):
    tried, wrong = 0, list[str]()
    for words, command in leaves(name):
        for param in command.params:
            flag = isinstance(param, click.Option) and param.is_flag
            if flag or (isinstance(param, TargetOption) and words != ("log",)):
                continue  # the options for finding a daemon are the same everywhere
            for value in VALUES:
                line = [*words, *filled(command, param, value)]
                code, printed = called(monkeypatch, line)
                tried += 1
                if code not in DOCUMENTED or "Traceback" in printed or "\x1b" in printed:
                    wrong.append(f"{line}: {code}: {printed[-300:]}")

    assert not wrong, "\n".join(wrong[:20])
    assert tried or name in NO_VALUES


@pytest.mark.parametrize(
    ("line", "said"),
    [
        ("move x nan", "VALUE"),
        ("move x inf", "VALUE"),
        ("move x 1 --velocity 0", "velocity"),
        ("move x 1 --acceleration -1", "acceleration"),
        ("jog x nan --for 1", "VELOCITY"),
        ("axis pwm x 2 1", "duty"),
        ("axis gains x --kp 99999", "kp"),
    ],
)
def test_a_value_that_is_none_is_refused_in_one_line_that_names_it(monkeypatch, line, said):
    code, printed = called(monkeypatch, line.split())

    assert code == 2
    assert said in printed.splitlines()[-1]
