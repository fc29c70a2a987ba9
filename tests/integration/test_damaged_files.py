"""What is kept in the state directory is damaged: it costs what was kept, and nothing else."""

import os
from collections.abc import Callable
from pathlib import Path

import pytest

from ldcnd.bench.commissioning import record
from ldcnd.bench.kept_gains import KeptGains, file_of, kept_for
from ldcnd.config.rig import load_config
from ldcnd.contract.errors import ConfigError
from ldcnd.contract.samples import LinkState
from tests.support.command_line import virtual_rig
from tests.support.rig import SIMULATED


def directory(path: Path) -> None:
    path.unlink()
    path.mkdir()


def pipe(path: Path) -> None:
    path.unlink()
    os.mkfifo(path)  # to open it would wait for whoever writes


def dangling(path: Path) -> None:
    path.unlink()
    path.symlink_to(path.with_name("nothing"))


def looping(path: Path) -> None:
    path.unlink()
    path.symlink_to(path)


DAMAGES: dict[str, Callable[[Path], object]] = {
    "empty": lambda path: path.write_bytes(b""),
    "cut short": lambda path: path.write_bytes(path.read_bytes()[:-7]),
    "zeros": lambda path: path.write_bytes(bytes(len(path.read_bytes()))),
    "no text": lambda path: path.write_bytes(b"\xff\xfe\x00\x80"),
    "something else": lambda path: path.write_text('["foreign"]'),
    "deeply nested": lambda path: path.write_text("[" * 100_000),
    "of a newer version": lambda path: path.write_text('{"format": 99, "content": {"x": 1}}'),
    "a directory": directory,
    "a link to itself": looping,
    "a link to nothing": dangling,
    "a pipe": pipe,
}
EVERY = pytest.mark.parametrize("damage", DAMAGES.values(), ids=DAMAGES)
READABLE = {name: damage for name, damage in DAMAGES.items() if name != "a pipe"}  # a shell's <(...) is one
OF_A_CONFIGURATION = pytest.mark.parametrize("damage", READABLE.values(), ids=READABLE)


@pytest.fixture(scope="module")
def kept(tmp_path_factory):
    """The state directory of a rig that has kept something of each kind."""
    folder = tmp_path_factory.mktemp("state")
    with pytest.MonkeyPatch.context() as patch, virtual_rig(patch, config(folder)) as here:
        here.wait(here.rig.until("feed", lambda state: state.link is LinkState.UP))
        here.wait(here.rig.until("x", lambda state: state.link is LinkState.UP))
        assert here.run("params set feed Pn102 55 --eeprom").code == 0
    for name, content in {
        "faults": '{"faults": []}',
        "references": '{"format": 1, "written": 5, "address": 1}',
    }.items():
        (folder / name).mkdir(exist_ok=True)
        (folder / name / "x.json").write_text(content)
    found = {path.relative_to(folder): path.read_bytes() for path in folder.rglob("*.json")}
    del found[Path("latches.json")]  # a damaged one latches every axis, see test_kept_latches.py
    return found


def config(folder: Path):
    mixed = load_config(SIMULATED.with_name("mixed.toml"))
    x = mixed.bus[0].axis[0].model_copy(update={"reference": "required"})
    fields = mixed.bus[0].model_dump(exclude_unset=True)
    line = type(mixed.bus[0]).model_validate({**fields, "axis": (x,), "start": "adopt", "adopt_fallback": "reset"})
    return mixed.model_copy(update={"state_dir": folder, "bus": (line, mixed.bus[1])})


@EVERY
@pytest.mark.sweep(5)
def test_a_rig_whose_kept_files_are_damaged_starts_and_lacks_what_they_held(
    monkeypatch, tmp_path, kept, damage, capsys
):
    assert {str(name) for name in kept} == {"eeprom-writes.json", "faults/x.json", "references/x.json"}
    for name, content in kept.items():
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_bytes(content)
        damage(tmp_path / name)

    with virtual_rig(monkeypatch, config(tmp_path)) as here:
        for axis in ("x", "feed", "spool"):
            here.wait(here.rig.until(axis, lambda state: state.link is LinkState.UP))
        eeprom = here.run("params set feed Pn102 61 --eeprom")
        ram = here.run("params set feed Pn102 62")
        counted = here.run("params restart-count feed --writes 3 --yes")
        written = here.run("params set feed Pn102 63 --eeprom")
        other = here.run("params set spool Pn102 63 --eeprom")
        moved = [here.run(line) for line in ("power on x", "axis set-position x 1", "move x 2 --wait")]

    assert "it is not known how often its EEPROM was written" in eeprom.errors
    assert [ran.code for ran in (ram, counted, written, other)] == [0, 0, 0, 1]
    assert [ran.errors for ran in moved if ran.code] == []
    said = capsys.readouterr().out
    assert said.count("EEPROM writes are not known") == 1
    assert said.count("kept faults not read") == 1
    assert said.count("kept reference refused") == 1, said


@EVERY
def test_what_programs_keep_is_one_clear_error_when_it_is_damaged(monkeypatch, tmp_path, damage):
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    gains, steps = file_of("sim", "x"), tmp_path / "commissioning-sim-x.json"
    gains.parent.mkdir(parents=True)
    gains.write_text(KeptGains(rig="sim", axis="x", gains={"kp": 1}).model_dump_json())
    steps.write_text(record.CommissioningRecord(rig="sim", axis="x").model_dump_json())
    for path, read in ((gains, lambda: kept_for("sim", "x")), (steps, lambda: record.read(steps, "sim", "x"))):
        damage(path)
        with pytest.raises(ConfigError, match=path.name) as refused:
            read()
        assert "\n" not in refused.value.message


@OF_A_CONFIGURATION
def test_a_damaged_configuration_is_one_clear_error(tmp_path, damage):
    path = tmp_path / "rig.toml"
    path.write_bytes(SIMULATED.read_bytes() + b'name = "cut')
    damage(path)
    with pytest.raises(ConfigError, match=r"rig\.toml"):
        load_config(path)
