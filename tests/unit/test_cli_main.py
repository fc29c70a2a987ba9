"""What the command line says when it is refused."""

import click
import pytest

from ldcnd.cli import main
from ldcnd.errors import ConfigError


def test_a_refused_configuration_comes_with_what_to_do(monkeypatch, capsys):
    def refuse(**_options):
        raise ConfigError("run.mcap exists already", remedy="choose another name")

    monkeypatch.setattr(main, "cli", click.Command("ldcnd", callback=refuse))
    monkeypatch.setattr("sys.argv", ["ldcnd"])

    with pytest.raises(SystemExit) as end:
        main.main()

    assert end.value.code == main.EXIT_CONFIG
    assert capsys.readouterr().err == "run.mcap exists already\n  choose another name\n"
