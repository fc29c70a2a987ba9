"""`ldcnd params` in front of a daemon, on the jumping clock."""

import asyncio
import json
import tomllib
from pathlib import Path

import pytest

from ldcnd.cli.params import load_parameters
from ldcnd.config.rig import load_config
from ldcnd.drives.smartstep.parameters import PARAMETERS, PN000, PN102
from ldcnd.sim.smartstep.cable import smartstep_chain
from ldcnd.sim.smartstep.unit import SimulatedUnit
from tests.support.command_line import virtual_rig
from tests.support.process import ROOT


@pytest.mark.long
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
        beyond = rig.run("params set feed Pn102 5000")
        listed = rig.run("params list feed")
        kept = saved.read_text()
        again = rig.run(f"params dump feed {saved}")
        kept_still = saved.read_text() == kept
        forced = rig.run(f"params dump feed {saved} --force")
        stored = rig.run("params set feed Pn102 55 --eeprom")

    assert "\\n" not in cloned.printed + listed.printed
    assert (again.code, "already" in again.errors, kept_still, forced.code) == (2, True, True, 0)
    assert (written.code, dumped.code) == (0, 0)
    assert ("Pn102 = 55 " in kept, load_parameters(saved).values["Pn102"]) == (True, 56)
    assert (same.code, same.printed, same.errors) == (0, "", "")
    assert (without_type.code, "type" in without_type.printed) == (1, True)
    assert (cloned.code, "Pn102 EEPROM 40 (0028H) -> 56 (0038H)" in cloned.printed) == (0, True)
    assert "at the next power-on" not in restored.errors + restored.printed
    assert (beyond.code, "it takes 1 to 2000" in beyond.errors) == (1, True)
    assert "RAM 56, EEPROM 55: at the next power-on 55 is used" in stored.errors
    assert (refused.code, "[data_error]" in refused.errors) == (1, True)
    assert (restored.code, "read back: the drive holds the values" in restored.printed) == (0, True)
    assert '"Pn102": 3' in (tmp_path / "eeprom-writes.json").read_text()


def test_a_plan_is_not_carried_out_on_a_drive_that_was_changed_while_it_was_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    feed, spool = (SimulatedUnit(None, {PN000: unit, PN102: value}) for unit, value in ((0x0101, 55), (0x0201, 40)))
    mixed = load_config(ROOT / "config" / "mixed.toml")
    config = mixed.model_copy(update={"state_dir": tmp_path, "bus": mixed.bus[1:]})

    with virtual_rig(monkeypatch, config, {"steps": smartstep_chain([feed, spool])}) as rig:

        def another_writes(_question: str, **_: object) -> bool:
            rig.run("params set spool Pn102 44 --eeprom")
            return True

        with monkeypatch.context() as patched:
            patched.setattr("click.confirm", another_writes)
            changed = rig.run("params clone feed spool")
        held = rig.run("params get spool Pn102")

    assert "Pn102 EEPROM 40 " in changed.printed
    assert "nothing was written; plan it again" in changed.printed
    assert (changed.code, "44 (002CH) stored" in held.printed) == (1, True)


CHANGED = {each: each.limits.value.lowest + 7 if each.limits else 0x0011 for each in PARAMETERS if each is not PN000}
"""Twenty-one parameters as no factory sets them."""


@pytest.mark.system
def test_a_factory_new_drive_is_made_the_one_that_it_replaces(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    old = SimulatedUnit(None, {**CHANGED, PN000: 0x0101})
    new = SimulatedUnit(None, {PN000: 0x0200})
    (tmp_path / "eeprom-writes.json").write_text(json.dumps({"spool": {"Pn100": 8990}}))
    mixed = load_config(ROOT / "config" / "mixed.toml")
    config = mixed.model_copy(update={"state_dir": tmp_path, "bus": mixed.bus[1:]})

    async def power_cycle() -> None:
        now_s = asyncio.get_running_loop().time()
        new.power_off(now_s)
        new.power_on(now_s)

    with virtual_rig(monkeypatch, config, {"steps": smartstep_chain([old, new])}) as rig:
        failed = rig.run("params clone feed spool", typed="y\n")
        refused = rig.run("params restart-count spool", typed="n\n")
        restarted = rig.run("params restart-count spool --yes")
        completed = rig.run("params clone feed spool --yes")
        rig.wait(power_cycle())
        again = rig.run("params clone feed spool --yes")
        for axis in ("feed", "spool"):
            assert rig.run(f"params dump {axis} {tmp_path / axis}.toml").code == 0

    not_tried = [line for line in failed.printed.splitlines() if line.startswith("not tried: ")]
    assert failed.code == 1
    assert failed.errors.count("[y/N]") == 1
    assert "1 of " in failed.errors  # progress, write by write
    assert "[eeprom_budget]" in failed.printed
    assert len(not_tried) > 10
    assert "still differ; the same command again completes it" in failed.printed
    assert refused.code == 130
    assert restarted.printed.endswith("spool: 0 EEPROM writes; the drive before it had 9000\n")  # behind the log
    assert (completed.code, "read back: the drive holds the values" in completed.printed) == (0, True)
    assert (again.code, again.printed) == (0, "spool holds these values already\n")
    first, second = (tomllib.loads((tmp_path / f"{name}.toml").read_text()) for name in ("feed", "spool"))
    for memory in ("parameters", "in_use"):
        assert len(first[memory]) == len(PARAMETERS)
        assert (first[memory].pop("Pn000"), second[memory].pop("Pn000")) == (0x0101, 0x0201)
    assert {key for key in first if first[key] != second[key]} - {"read_at"} == {"axis", "unit"}
    assert (first["unit"], second["unit"]) == (1, 2)
