"""What the command line says when it is refused."""

import click
import pytest

from ldcnd.cli import main
from ldcnd.cli.output import WRONG_CONFIG, show_lines
from ldcnd.contract.errors import ConfigError, LeaseHeld


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
