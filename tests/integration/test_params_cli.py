"""`ldcnd params` in front of a daemon, on the jumping clock."""

from pathlib import Path

import pytest

from ldcnd.cli.parameter_file import load_parameters
from ldcnd.config.rig import load_config
from tests.support.command_line import virtual_rig
from tests.support.process import ROOT


def test_parameters_are_set_saved_compared_and_put_back(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    text = (ROOT / "config" / "mixed.toml").read_text()
    config = tmp_path / "mixed.toml"
    config.write_text(text.replace('state_dir = "state"', f'state_dir = "{tmp_path}"'))
    saved, some = tmp_path / "feed.toml", tmp_path / "some.toml"
    some.write_text("[parameters]\nPn102 = 56\n")

    with virtual_rig(monkeypatch, load_config(config)) as rig:
        written = rig.run("params set feed Pn102 55 --eeprom")
        dumped = rig.run(f"params dump feed {saved}")
        same = rig.run(f"params diff feed {saved}")
        refused = rig.run("params set feed Pn100 3000")
        without_type = rig.run(f"params restore feed {some} --yes")
        restored = rig.run(f"params restore feed {some} --yes --any-type")
        cloned = rig.run("params clone feed spool --dry-run")

    assert (written.code, dumped.code) == (0, 0)
    assert load_parameters(saved).values["Pn102"] == 55
    assert (same.code, same.printed, same.errors) == (0, "", "")
    assert (without_type.code, "type" in without_type.printed) == (1, True)
    assert (cloned.code, "Pn102 EEPROM 40 (0028H) -> 56 (0038H)" in cloned.printed) == (0, True)
    assert (refused.code, "[data_error]" in refused.errors) == (1, True)
    assert (restored.code, "read back: the drive holds the values" in restored.printed) == (0, True)
    assert '"Pn102": 2' in (tmp_path / "eeprom-writes.json").read_text()
