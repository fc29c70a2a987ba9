"""Numbers on the command line: taken as the console takes them, negative ones without `--`."""

import click
import pytest
from click.testing import CliRunner

from ldcnd.cli.main import CommandGroup, cli
from ldcnd.cli.typed import Finite, WholeNumber
from tests.support.command_line import run_here


@click.group(cls=CommandGroup, homes={})
def program() -> None:
    """Hold one command."""


@program.command(context_settings={"ignore_unknown_options": True})
@click.argument("value", type=Finite())
@click.option("-e", "--endpoint")
@click.option("--count", type=WholeNumber(0, 9))
@click.option("--limit", type=Finite(0))
def show(value: float, endpoint: str | None, count: int | None, limit: float | None) -> None:
    """Show what was understood."""
    print(value, endpoint, count, limit)


def told(*arguments):
    ended = CliRunner().invoke(program, ["show", *arguments])
    return ended.exit_code, ended.output.strip().splitlines()[-1]


@pytest.mark.parametrize(
    ("text", "value"),
    [("1,5", 1.5), ("-1.5", -1.5), ("-1,5", -1.5), ("-1e3", -1000.0), ("-1e-2", -0.01), ("-.5", -0.5), ("+2", 2.0)],
)
def test_a_number_is_taken_whole(text, value):
    assert told(text) == (0, f"{value} None None None")
    assert told("-e", "here", text, "--count", "3") == (0, f"{value} here 3 None")


@pytest.mark.parametrize("text", ["1_000", "1,234", "nan", "-inf", "1.5mm", "0x10", "", "1 2", "1e999"])
def test_what_is_no_number_is_refused(text):
    code, said = told(text)

    assert code == 2
    assert said.startswith("Error: Invalid value for 'VALUE':")


@pytest.mark.parametrize("more", [("--count", "1_0"), ("--count", "1.5"), ("--count", "-1"), ("--limit", "-1e1")])
def test_options_are_held_to_the_same(more):
    assert told("1", *more)[0] == 2


@pytest.mark.parametrize("moves", ["x=1_000", "x=1,234", "x=nan", "x=", "x=1mm"])
def test_places_of_a_group_are_held_to_the_same(moves):
    ended = CliRunner().invoke(cli, ["group", "move", moves])

    assert ended.exit_code == 2


@pytest.mark.parametrize(
    ("line", "said"),
    [
        ("speed 50%", "type 50,"),
        ("move x -1,234", "can mean -1.234 or -1234: type one of them"),
        ("group move x=1,234", "can mean 1.234 or 1234: type one of them"),
    ],
)
def test_a_number_that_is_not_taken_is_refused_with_what_to_type(line, said):
    ran = run_here(*line.split())

    assert (ran.code, ran.printed) == (2, "")
    assert said in ran.errors
