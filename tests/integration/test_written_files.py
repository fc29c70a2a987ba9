"""A command keeps a file that a person named and that is there already: it may be the only copy of what it holds."""

from pathlib import Path

import click
import pytest

from ldcnd.cli.main import cli
from ldcnd.cli.typed import NewFile
from tests.support.command_line import run_here

SAMPLES = {
    "file": ".toml",
    "out": ".csv",
    "output": ".png",
    "record": ".jsonl",
    "report": ".html",
    "wire_log": ".capture",
}
"""Names of the arguments and options that are files to be written, with a suffix that each command takes."""
KEPT_OTHERWISE = {
    ("record", "out"),  # a recording refuses a name that is taken itself
    ("record recover", "whole"),
    ("accept", "out"),  # a folder
}


def commands(group: click.Command, path: tuple[str, ...] = ()):
    """Yield every command of the command line with its words."""
    if isinstance(group, click.Group):
        context = click.Context(group)
        for name in group.list_commands(context):
            if found := group.get_command(context, name):
                yield from commands(found, (*path, name))
    else:
        yield path, group


WRITING = [
    (words, parameter)
    for words, command in commands(cli)
    for parameter in command.params
    if isinstance(parameter.type, NewFile)
]


def test_the_commands_that_write_a_file_are_found():
    found = {" ".join(words) for words, _ in WRITING}
    assert found >= {
        "params dump",
        "trace take",
        "trace show",
        "plot",
        "bus wire-log",
        "commission",
        "sim",
    }


def test_a_file_that_is_named_to_be_written_is_one_that_is_kept():
    written = {"out", "output", "report", "wire_log"}
    named = {
        (" ".join(words), parameter.name)
        for words, command in commands(cli)
        for parameter in command.params
        if parameter.name in written
        and isinstance(parameter.type, click.Path)
        and not isinstance(parameter.type, NewFile)
    }
    assert named <= KEPT_OTHERWISE


@pytest.mark.parametrize(
    ("words", "parameter"), WRITING, ids=lambda each: " ".join(each) if isinstance(each, tuple) else ""
)
def test_a_file_that_is_there_is_kept_unless_force_says_otherwise(tmp_path: Path, words, parameter):
    path = tmp_path / f"kept{SAMPLES[parameter.name]}"
    path.write_text("the only copy")
    refused = run_here(*words, *filled(words, parameter, path, tmp_path))

    assert refused.code == 2
    assert f"{path} is there already" in refused.errors
    assert path.read_text() == "the only copy"
    forced = run_here(*words, "--force", *filled(words, parameter, path, tmp_path), "--no-such-option")
    assert "No such option" in forced.errors


def filled(words, parameter, path: Path, folder: Path) -> list[str]:
    """Return arguments with which the command would be complete."""
    (folder / "in.txt").write_text("")
    given = [parameter.opts[0], str(path)] if parameter.param_type_name == "option" else []
    command = next(command for each, command in commands(cli) if each == words)
    for other in command.params:
        if other.param_type_name == "argument":
            given.append(
                str(path if other is parameter else folder / "in.txt" if isinstance(other.type, click.Path) else "x")
            )
        elif other.required and other is not parameter:
            given += [other.opts[0], "x"]
    return given


def test_devices_and_pipes_are_written_to(tmp_path):
    kept = NewFile()
    assert kept.convert("/dev/null", None, None) == Path("/dev/null")
    assert kept.convert(str(tmp_path / "new.csv"), None, None) == tmp_path / "new.csv"
