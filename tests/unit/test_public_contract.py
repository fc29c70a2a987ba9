"""What is public changes by its rules: additions are free, anything else is announced."""

import json
import re
from pathlib import Path

import pytest

from tools.public_contract import breaking, changes_of, facts, unannounced

ROOT = Path(__file__).parents[2]
CHANGELOG = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
KEPT = {
    path.parent.name: tuple(path.read_text(encoding="utf-8").splitlines())
    for path in ROOT.glob("tests/kept/*/contract.txt")
}
BEFORE = (
    "+ network api: 1",
    "+ payload move_request.position: taken",
    "+ payload move_request.position: taken number",
    "- payload move_request needs: position",
    "+ payload move_request: taken object",
    "+ payload reply.latched: always sent",
    "+ python ldcnd.connect: takes rig",
)


def newest() -> str:
    return max(KEPT, key=lambda version: [int(part) for part in version.split(".")])


@pytest.mark.long
def test_working_tree_keeps_the_contract_of_the_latest_version_or_announces_the_change():
    version = newest()
    before, now = KEPT[version], facts()

    changes = breaking(before, now)

    silent = unannounced(changes, changes_of(CHANGELOG, version))
    assert not silent, (
        f"these break programs of {version}: name each in CHANGELOG.md in back quotes, above {version};"
        f" while {version} is not released, run `make fix`:\n" + "\n".join(silent)
    )
    if any(change[2:].startswith(("payload", "key")) for change in changes):
        assert not {"+ network api: 1"} & {*before} & {*now}, "keys or payloads break: let `API` grow"


@pytest.mark.parametrize(
    "change",
    [
        "+ payload move_request.position: taken",
        "+ payload reply.latched: always sent",
        "+ python ldcnd.connect: takes rig",
    ],
)
def test_a_promise_that_is_gone_breaks(change):
    assert breaking(BEFORE, tuple(line for line in BEFORE if line != change)) == (change,)


@pytest.mark.parametrize(
    ("line", "breaks"),
    [
        ("- payload move_request needs: velocity", True),
        ("- payload move_request.position: <= 10", True),
        ("+ payload move_request.velocity: taken", False),
        ("- payload move_request.velocity: > 0", False),
        ("- payload turn_request needs: angle", False),
        ("+ python ldcnd.connect: takes timeout", False),
    ],
)
def test_an_addition_breaks_where_it_demands_more_of_what_was_there(line, breaks):
    assert bool(breaking(BEFORE, (*BEFORE, line))) is breaks


@pytest.mark.parametrize(
    ("bound", "breaks"),
    [("items <= 256", False), ("items <= 32", True), ("items >= 1", False), ("items >= 3", True), ("items > 1", True)],
)
def test_a_bound_breaks_where_it_is_narrower_than_before(bound, breaks):
    subject = "payload move_request.axes: "
    before = (*BEFORE, f"+ {subject}taken", f"- {subject}items <= 64", f"- {subject}items >= 2")

    assert bool(breaking(before, (*BEFORE, f"+ {subject}taken", f"- {subject}{bound}"))) is breaks


def test_a_demand_that_is_gone_breaks_nothing():
    assert not breaking(BEFORE, tuple(line for line in BEFORE if not line.startswith("-")))


@pytest.mark.parametrize(
    ("words", "silent"),
    [
        ("`move_request.position` is called `target`.", False),
        ("`move_request` is gone.", False),
        ("The position is called target.", True),
        ("`move_request.pos` is gone.", True),
    ],
)
def test_a_change_is_announced_by_its_name_in_back_quotes(words, silent):
    change = ("+ payload move_request.position: taken",)

    assert bool(unannounced(change, words)) is silent


def test_only_what_stands_above_the_kept_version_announces():
    changelog = "# Changelog\n\n## 0.2.0 (not yet released)\n\nNew.\n\n## 0.1.0 (2026-11-26)\n\n`old`\n"

    assert "New." in changes_of(changelog, "0.1.0")
    assert "`old`" not in changes_of(changelog, "0.1.0")
    with pytest.raises(ValueError, match=re.escape("0.3.0")):
        changes_of(changelog, "0.3.0")


@pytest.mark.long
def test_every_schema_command_and_name_is_in_the_list():
    now = "\n".join(facts())

    assert all(f" payload {path.stem}: " in now for path in ROOT.glob("schemas/*.json"))
    needed = json.loads((ROOT / "schemas/move_absolute_request.json").read_text())["required"]
    assert needed
    assert all(f"- payload move_absolute_request needs: {name}" in now for name in needed)
    assert "+ command ldcnd stop" in now
    assert "+ exit 78" in now
    assert "+ python ldcnd.Axis.move_absolute: takes position" in now
    assert "+ metric ldcnd_daemon_up" in now
