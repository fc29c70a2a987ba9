import tomllib
from datetime import UTC, datetime

import pytest
from click.testing import CliRunner

from ldcnd.cli.params import as_toml, command, load_parameters
from ldcnd.contract.errors import ConfigError
from ldcnd.contract.parameters import DriveFacts, ParameterDump, ParameterValue

READ_AT = datetime(2026, 11, 22, 12, 0, tzinfo=UTC)
FACTS = DriveFacts(driver_type=0x000C, software_version=1, unit=1, gain_switch=4, switches=("PARAMETERS_RULE",))


def value(parameter: str, active: int, stored: int) -> ParameterValue:
    return ParameterValue(parameter=parameter, name="Speed loop gain", active=active, stored=stored, eeprom_writes=None)


def test_a_dump_says_from_which_drive_it_is_and_what_both_memories_held(tmp_path):
    values = (value("Pn000", 0x0100, 0x0101), value("Pn100", 99, 80))
    dump = ParameterDump(command_id="c", axis="feed", verb="read_all_parameters", values=values, facts=FACTS)
    path = tmp_path / "feed.toml"
    path.write_text(as_toml("feed", dump, READ_AT))

    document = tomllib.loads(path.read_text())
    loaded = load_parameters(path)

    assert document["parameters"] == {"Pn000": 0x0101, "Pn100": 80}
    assert document["in_use"] == {"Pn000": 0x0100, "Pn100": 99}
    assert (document["driver_type"], document["unit"], document["read_at"]) == (0x000C, 1, READ_AT)
    assert document["switches_on"] == ["parameters_rule"]
    assert "Pn000.0 = 1: rotation direction, clockwise is forward [X]" in path.read_text()
    assert (loaded.named(), loaded.driver_type) == ({"Pn000": 0x0101, "Pn100": 80}, 0x000C)


def test_a_file_of_an_earlier_version_is_read(tmp_path):
    path = tmp_path / "old.toml"
    path.write_text('axis = "feed"\n[parameters]\nPn100 = 80  # Speed loop gain\n')

    assert load_parameters(path).named() == {"Pn100": 80}
    assert load_parameters(path).driver_type is None


@pytest.mark.parametrize(
    "text",
    [
        "",
        "parameters = 3",
        "[parameters]\nPn100 = 70000",
        '[parameters]\nPn100 = "80"',
        "[parameters]\nPn100 = true",
        'driver_type = "R7D"\n[parameters]\nPn100 = 80',
    ],
)
def test_what_is_no_dump_is_refused(tmp_path, text):
    path = tmp_path / "feed.toml"
    path.write_text(text)

    with pytest.raises(ConfigError, match=r"feed\.toml"):
        load_parameters(path)


def test_a_file_is_checked_without_a_drive(tmp_path):
    path = tmp_path / "feed.toml"
    path.write_text("[parameters]\nPn100 = 3000\nPn200 = 0x0009\nPn7FF = 1\npn100 = 5\n")

    result = CliRunner().invoke(command, ["check", str(path)])

    assert result.exit_code == 1
    assert "Pn100 = 3000 is outside of 1 to 2000 [X]" in result.output
    assert "Pn200.0 = 9: command pulse form" in result.output
    assert "wrong: Pn7FF: the manual lists no such parameter" in result.output
    assert "wrong: pn100: names the same parameter as Pn100" in result.output
    assert "Pn000 is missing" in result.output


def test_two_files_are_compared_however_their_parameters_are_spelt(tmp_path):
    left, right = tmp_path / "left.toml", tmp_path / "right.toml"
    left.write_text("[parameters]\nPn100 = 80\nPn102 = 40\nPn304 = 500\n")
    right.write_text('[parameters]\npn100 = 80\n"Position loop gain" = 41\nPn505 = 7\n')

    result = CliRunner().invoke(command, ["diff", str(left), str(right)])

    assert result.exit_code == 1
    assert "Pn100" not in result.output
    assert "Pn102" in result.output
    assert f"{right}: not there" in next(line for line in result.output.splitlines() if line.startswith("Pn304"))
    assert f"{left}: not there" in next(line for line in result.output.splitlines() if line.startswith("Pn505"))
