"""What the command line says when it is refused."""

import shlex

import click
import pytest

from ldcnd.cli import main
from ldcnd.cli.names import COMMANDS, EXAMPLES
from ldcnd.cli.output import WRONG_CONFIG, show_lines
from ldcnd.contract.errors import ConfigError, LeaseHeld
from tests.support.command_line import run_here
from tests.support.pages import require_command_line


def test_a_refused_configuration_comes_with_what_to_do(monkeypatch, capsys):
    def refuse(**_options):
        raise ConfigError("run.mcap exists already", remedy="choose another name")

    monkeypatch.setattr(main, "cli", click.Command("ldcnd", callback=refuse))
    monkeypatch.setattr("sys.argv", ["ldcnd"])

    with pytest.raises(SystemExit) as end:
        main.main()

    assert end.value.code == WRONG_CONFIG
    assert capsys.readouterr().err == "run.mcap exists already\n  choose another name\n"


def test_names_from_the_network_steer_no_terminal_and_forge_no_line(capsys):
    show_lines("x: by eve\x1b]52;c;aGk=\x07\nx: stopped \x9b2J\u202e", "y")

    assert capsys.readouterr().out == ("x: by eve\\x1b]52;c;aGk=\\x07\\nx: stopped \\x9b2J\\u202e\ny\n")


def test_errors_quote_what_a_stranger_sent_without_passing_it_on(monkeypatch, capsys):
    def refuse(**_options):
        raise LeaseHeld("axis x is controlled by eve\x1b[2J", remedy="wait\x9b")

    monkeypatch.setattr(main, "cli", click.Command("ldcnd", callback=refuse))
    monkeypatch.setattr("sys.argv", ["ldcnd"])

    with pytest.raises(SystemExit) as end:
        main.main()

    assert end.value.code == 1
    said = capsys.readouterr().err
    assert "eve\\x1b[2J" in said
    assert "\x1b" not in said
    assert "\x9b" not in said


@pytest.mark.parametrize("path", sorted(EXAMPLES))
@pytest.mark.sweep(2)
def test_the_example_of_each_command_can_be_typed_and_stands_in_its_help(path):
    words = path.split()

    require_command_line([*words, *shlex.split(EXAMPLES[path])])
    assert f"Example: ldcnd {path} {EXAMPLES[path]}".rstrip() in " ".join(run_here(*words, "--help").printed.split())


def test_every_command_has_an_example():
    def walk(command, context, path):
        yield path
        if isinstance(command, click.Group):
            for name in command.list_commands(context):
                inner = command.get_command(context, name)
                yield from walk(inner, click.Context(inner, parent=context, info_name=name), [*path, name])

    paths = {" ".join(path) for path in walk(main.cli, click.Context(main.cli), [])} - {""}
    other_names = {f"axis {name}" for name in COMMANDS}

    assert paths - other_names == set(EXAMPLES)


def test_the_help_has_five_groups_with_every_command():
    printed = run_here("--help").printed

    assert [line[:-1] for line in printed.splitlines() if line in {"Run:", "Operate:", "Look:", "Set up:", "Connect:"}]
    for name in ("list", "move", "home", "stop", "watch", "jog", "why", "scan", "run"):
        assert f"\n  {name} " in printed


@pytest.mark.parametrize(
    ("typed", "said"),
    [
        ("axis move x -1.5 --wait", "`ldcnd move x -1.5 --wait`"),
        ("axis list", "`ldcnd list`"),
        ("axis watch x", "`ldcnd watch x`"),
        ("axis jog x 1", "`ldcnd jog x 1`"),
        ("set-position x -1", "`ldcnd axis set-position x -1`"),
        ("probe x", "`ldcnd axis probe x`"),
        ("mvoe x 1", "'move'"),
        ("events --axis x", "`ldcnd log --axis x`"),
        ("trace plot x.csv -o x.png", "`ldcnd plot x.csv -o x.png`"),
        ("trace last x", "`ldcnd trace show x`"),
        ("position list rig.toml", "`ldcnd position go --list rig.toml`"),
        ("sequence list rig.toml", "`ldcnd sequence run --list rig.toml`"),
        ("group preview x=-1", "`ldcnd group move --dry-run --straight x=-1`"),
        ("bus convert one.capture", "`ldcnd bus wire-log one.capture`"),
        ("bus guests", "`ldcnd bus list --guests`"),
        ("doctor ldcn --bus line0", "`ldcnd doctor --bus line0`"),
    ],
)
def test_a_command_that_stands_elsewhere_is_refused_with_what_to_type(typed, said):
    ran = run_here(*typed.split())

    assert ran.code == 2
    assert said in ran.errors


@pytest.mark.parametrize("name", ["stop", "halt", "home", "reset"])
def test_commands_of_every_day_have_two_names(name):
    context = click.Context(main.cli)
    axis = main.cli.get_command(context, "axis")

    assert axis.get_command(click.Context(axis, parent=context), name) is main.cli.get_command(context, name)
