import tomllib
from pathlib import Path
from typing import Any

import pytest

from ldcnd.config.plan import plan_rig
from ldcnd.config.rig import RigConfig, load_config
from ldcnd.contract.errors import ConfigError
from ldcnd.daemon.reload import Reloader, plan_reload
from tests.support.rig import running_rig

SIMULATED = Path(__file__).parents[2] / "config" / "simulated.toml"
RUNNING = load_config(SIMULATED)


def document() -> dict[str, Any]:
    return tomllib.loads(SIMULATED.read_text(encoding="utf-8"))


def axis(of: dict[str, Any], name: str) -> dict[str, Any]:
    found: dict[str, Any] = next(axis for axis in of["bus"][0]["axis"] if axis["name"] == name)
    return found


def validated(changed: dict[str, Any]) -> RigConfig:
    return RigConfig.model_validate(changed)


def test_same_configuration_changes_nothing():
    reload = plan_reload(RUNNING, validated(document()))

    assert reload.config == RUNNING
    assert reload.changed == reload.refused == ()


def test_limits_speeds_rates_and_priorities_apply():
    wanted = document()
    axis(wanted, "x")["limits"]["velocity"] = 40
    axis(wanted, "x")["velocity"] = 25
    axis(wanted, "y")["acceleration"] = 300
    axis(wanted, "y")["rates"]["adc"] = 1
    axis(wanted, "y")["priority"] = "high"

    reload = plan_reload(RUNNING, validated(wanted))

    assert reload.config == validated(wanted)
    assert set(reload.changed) == {
        "bus.line0.axis.x.limits.velocity",
        "bus.line0.axis.x.velocity",
        "bus.line0.axis.y.acceleration",
        "bus.line0.axis.y.rates.adc",
        "bus.line0.axis.y.priority",
    }
    assert reload.refused == ()


@pytest.mark.parametrize(
    ("path", "key", "value"),
    [
        ([], "rig", "other"),
        (["zenoh"], "listen", ["tcp/127.0.0.1:7448"]),
        (["bus", 0], "port", "/dev/ttyUSB0"),
        (["bus", 0], "baud", 57_600),
        (["bus", 0, "axis", 0], "address", 9),
        (["bus", 0, "axis", 0], "model", "pic-servo-v4"),
        (["bus", 0, "axis", 0], "reference", "required"),
        (["bus", 0, "axis", 0, "gains"], "kp", 351),
        (["bus", 0, "axis", 0, "home"], "velocity", 2),
    ],
)
def test_what_was_built_in_is_refused_by_name(path: list[str | int], key: str, value: object):
    wanted = document()
    part: Any = wanted
    for step in path:
        part = part[step]
    part[key] = value
    names = {"bus": "bus.line0", "axis": "axis.x"}
    shown = ".".join([names.get(step, step) for step in path if isinstance(step, str)] + [key])

    reload = plan_reload(RUNNING, validated(wanted))

    assert reload.refused == (shown,)
    assert reload.config == RUNNING


def test_other_scale_leaves_everything_of_that_axis_alone():
    wanted = document()
    axis(wanted, "x")["counts_per_unit"] = 500
    axis(wanted, "x")["limits"]["velocity"] = 40
    axis(wanted, "y")["velocity"] = 21

    reload = plan_reload(RUNNING, validated(wanted))

    assert reload.changed == ("bus.line0.axis.y.velocity",)
    assert set(reload.refused) == {"bus.line0.axis.x.counts_per_unit", "bus.line0.axis.x.limits.velocity"}


def test_added_and_removed_axes_are_refused_and_the_others_change():
    wanted = document()
    wanted["bus"][0]["axis"][3]["name"] = "d"
    axis(wanted, "x")["velocity"] = 21

    reload = plan_reload(RUNNING, validated(wanted))

    assert reload.changed == ("bus.line0.axis.x.velocity",)
    assert set(reload.refused) == {"bus.line0.axis.c", "bus.line0.axis.d"}


def test_axes_in_another_order_are_refused():
    wanted = document()
    wanted["bus"][0]["axis"].reverse()

    assert plan_reload(RUNNING, validated(wanted)).refused == ("bus.line0.axis",)


def test_parts_without_a_name_are_named_by_their_numbers():
    wanted = document()
    wanted["sim"][0]["module"][1]["travel_counts"] = [-1000, 1000]

    assert plan_reload(RUNNING, validated(wanted)).refused == ("sim.line0.module.2.travel_counts",)


def test_lists_of_different_lengths_are_refused_whole():
    wanted = document()
    wanted["sim"][0]["module"].append(wanted["sim"][0]["module"][0])

    assert plan_reload(RUNNING, validated(wanted)).refused == ("sim.line0.module",)


def test_change_that_contradicts_what_stays_is_an_error():
    running = document()
    axis(running, "x")["tracking"] = {"step": 1, "rate": 40}
    wanted = document()
    axis(wanted, "x")["limits"]["velocity"] = 30

    with pytest.raises(ConfigError, match=r"tracking\.step x rate 40 mm/s is above limits\.velocity 30 mm/s"):
        plan_reload(validated(running), validated(wanted))


def test_polls_that_become_slower_than_an_interlock_that_stays_needs_are_an_error():
    running, wanted = document(), document()
    for each, within_ms, hz in ((running, 150, 20), (wanted, 1400, 2)):
        axis(each, "y")["rates"] = dict.fromkeys(("position", "velocity", "adc", "state"), hz)
        requires = [{"axis": "y", "standstill": True}]
        each["interlock"] = [{"name": "apart", "of": "x", "requires": requires, "within_ms": within_ms}]

    with pytest.raises(ConfigError, match=r"interlock apart: within_ms 150 is less than two polls of y take"):
        plan_reload(validated(running), validated(wanted))


def test_rates_of_a_line_that_paces_itself_are_refused():
    running = load_config(SIMULATED.with_name("mixed.toml"))
    wanted = tomllib.loads(SIMULATED.with_name("mixed.toml").read_text(encoding="utf-8"))
    bus = next(bus for bus in wanted["bus"] if bus.get("family") == "smartstep")
    unit = bus["axis"][0]
    unit["rates"] = unit.get("rates", {}) | {"position": 0.7}

    reload = plan_reload(running, validated(wanted))

    assert reload.refused == (f"bus.{bus['name']}.axis.{unit['name']}.rates.position",)
    assert reload.config == running


def test_a_direction_that_is_turned_leaves_everything_of_that_axis_alone():
    wanted = document()
    axis(wanted, "x")["direction"] = "reverse"
    axis(wanted, "x")["limits"]["position_max"] = 50

    reload = plan_reload(RUNNING, validated(wanted))

    assert reload.config == RUNNING
    assert set(reload.refused) == {"bus.line0.axis.x.direction", "bus.line0.axis.x.limits.position_max"}


@pytest.mark.parametrize("change", [{"unit": "cm", "counts_per_unit": 10_000}, {"direction": "reverse"}])
def test_places_and_sequences_of_an_axis_whose_numbers_mean_something_else_stay(change: dict[str, Any]):
    """Each number of the file is in its units, and the axis that runs has others until the restart."""
    running, wanted = document(), document()
    for each, x, y in ((running, 10.0, 1.0), (wanted, 1.0, 2.0)):
        each["position"] = [{"name": "load", "axes": {"x": x, "y": y}}, {"name": "side", "axes": {"y": y}}]
        each["sequence"] = [{"name": "loads", "step": [{"go": "load", "standstill": ["y"]}]}]
    axis(wanted, "x").update(change)

    reload = plan_reload(validated(running), validated(wanted))

    assert [dict(each.axes) for each in reload.config.position] == [{"x": 10.0, "y": 1.0}, {"y": 2.0}]
    assert {key for key in reload.changed if key.startswith("position")} == {"position.side.axes.y"}
    assert "position.load.axes.x" in reload.refused


def test_a_sequence_of_a_line_that_comes_with_the_restart_keeps_nothing_else_from_being_taken(tmp_path: Path):
    text = CENTRIFUGE.read_text(encoding="utf-8")
    running, wanted = tmp_path / "running.toml", tmp_path / "wanted.toml"
    running.write_text(text.replace("balanced", "even"), encoding="utf-8")
    steps = '\n[[sequence]]\nname = "waits"\nstep = [{ until = { balanced = true }, timeout_s = 10 }]\n'
    limit = "velocity = 3300"
    assert text.count(limit) == 1
    wanted.write_text(text.replace(limit, "velocity = 3200") + steps, encoding="utf-8")

    reload = plan_reload(load_config(running), load_config(wanted))

    assert any(key.endswith("limits.velocity") for key in reload.changed)
    assert any(key.startswith("sequence") for key in reload.refused)


def test_limits_of_an_axis_that_becomes_rotary_stay_until_it_is():
    running, wanted = document(), document()
    axis(wanted, "x")["modulo"] = 360.0
    for edge in ("position_min", "position_max"):
        assert axis(wanted, "x")["limits"].pop(edge) is not None

    reload = plan_reload(validated(running), validated(wanted))

    assert (reload.config, reload.changed) == (validated(running), ())


def test_the_coasting_time_is_taken_with_the_velocity_limit_that_it_is_counted_from():
    running, wanted = document(), document()
    for each, velocity, coast_s in ((running, 30, 10), (wanted, 40, 55)):
        axis(each, "x")["limits"]["velocity"] = velocity
        axis(each, "x")["coast_s"] = coast_s

    assert plan_reload(validated(running), validated(wanted)).config == validated(wanted)


def test_what_clients_alone_use_applies():
    wanted = document() | {"position": [{"name": "park", "axes": {"x": 1.0}}]}

    reload = plan_reload(RUNNING, validated(wanted))

    assert (reload.refused, [each.name for each in reload.config.position]) == ((), ["park"])


CENTRIFUGE = SIMULATED.with_name("centrifuge.toml")


def changed_centrifuge(tmp_path: Path, *edits: tuple[str, str]) -> dict[str, str]:
    """Return what a reload says of an edited centrifuge: each key with its numbers."""
    text = CENTRIFUGE.read_text(encoding="utf-8")
    for before, after in edits:
        assert text.count(before) == 1
        text = text.replace(before, after)
    (path := tmp_path / "centrifuge.toml").write_text(text, encoding="utf-8")
    return {
        each.key: f"{each.before} -> {each.after}"
        for each in plan_reload(load_config(CENTRIFUGE), load_config(path)).changes
    }


def test_numbers_of_an_axis_are_named_in_the_units_that_people_read(tmp_path: Path):
    changes = changed_centrifuge(
        tmp_path,
        ("velocity = 3300, acceleration = 10 }", "velocity = 200, acceleration = 7.25 }"),
        ("above = 120", "above = 200"),
        ("axes = { rotor = 0.1 }", "axes = { rotor = 0.3 }"),
        ("window = 0.002", 'window = "0.9 deg"'),
    )

    assert changes == {
        "bus.line0.axis.rotor.limits.velocity": "3300 rpm (1218 g) -> 200 rpm (4.473 g)",
        "bus.line0.axis.rotor.limits.acceleration": "10 rev/s² -> 7.25 rev/s²",
        "bus.line0.axis.rotor.settle.window": "0.002 rev -> 0.0025 rev",
        "interlock.balance.above": "120 rpm (1.61 g) -> 200 rpm (4.473 g)",
        "position.bucket1.axes.rotor": "0.1 rev -> 0.3 rev",
    }


def test_a_number_within_a_list_is_named_in_the_units_that_people_read(tmp_path: Path):
    changes = changed_centrifuge(
        tmp_path,
        ('velocity = "100 g", acceleration = 10', 'velocity = "400 g", acceleration = 10'),
        ('requires = [{ axis = "rotor", below = 6 }]', 'requires = [{ axis = "rotor", below = 3.6 }]'),
    )

    assert changes == {
        "sequence.spin.step.4.arguments.velocity": "945.6528153 rpm (100 g) -> 1891.305631 rpm (400 g)",
        "interlock.lock_opens.requires.1.below": "6 rpm (0.004026 g) -> 3.6 rpm (0.001449 g)",
    }


def test_a_speed_above_its_limit_is_refused_in_the_units_of_the_file(tmp_path: Path):
    with pytest.raises(ConfigError, match=r"velocity 4000 rpm \(\d+ g\) is above limits\.velocity 3300 rpm"):
        changed_centrifuge(tmp_path, ("velocity = 30 #", "velocity = 4000 #"))


async def test_a_file_of_logins_that_was_changed_needs_a_restart(tmp_path):
    (tmp_path / "bench.json5").write_text("{}")
    zenoh = RUNNING.zenoh.model_copy(update={"config_file": tmp_path / "bench.json5"})
    config = RUNNING.model_copy(update={"zenoh": zenoh})
    async with running_rig(RUNNING) as rig:
        rig.daemon.reconfigure(config, plan_rig(config))
        reloader = Reloader(rig.daemon, lambda: config)
        before = (await reloader.reload()).refused
        (tmp_path / "bench.json5").write_text("{access_control: {}}")
        after = (await reloader.reload()).refused

    assert (before, after) == ((), ("zenoh.config_file",))
