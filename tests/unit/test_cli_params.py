import tomllib

import pytest

from ldcnd.cli.params import as_toml, load_values
from ldcnd.errors import ConfigError
from ldcnd.model.parameters import ParameterDump, ParameterValue


def value(parameter: str, active: int, stored: int) -> ParameterValue:
    return ParameterValue(parameter=parameter, name="Speed loop gain", active=active, stored=stored, eeprom_writes=None)


def test_a_dump_is_toml_of_what_is_stored(tmp_path):
    dump = ParameterDump(
        command_id="c", axis="feed", verb="read_all_parameters", values=(value("Pn100", 99, 80), value("Pn102", 40, 40))
    )
    path = tmp_path / "feed.toml"
    path.write_text(as_toml("feed", dump))

    assert tomllib.loads(path.read_text()) == {"axis": "feed", "parameters": {"Pn100": 80, "Pn102": 40}}
    assert load_values(path) == {"Pn100": 80, "Pn102": 40}
    assert "in use 99" in path.read_text()


@pytest.mark.parametrize(
    "text",
    ["", "parameters = 3", "[parameters]\nPn100 = 70000", '[parameters]\nPn100 = "80"', "[parameters]\nPn100 = true"],
)
def test_what_is_no_dump_is_refused(tmp_path, text):
    path = tmp_path / "feed.toml"
    path.write_text(text)

    with pytest.raises(ConfigError, match=r"feed\.toml"):
        load_values(path)
