import json

import pytest

from ldcnd.contract.errors import ConfigError, EepromBudgetSpent
from ldcnd.drives.smartstep.ledger import EepromLedger


async def test_counts_outlive_the_daemon(tmp_path):
    path = tmp_path / "deep" / "ledger.json"
    ledger = EepromLedger(path)

    await ledger.enter("feed", "Pn100", budget=10)
    await ledger.enter("feed", "Pn100", budget=10)
    await ledger.enter("feed", "Pn102", budget=10)

    again = EepromLedger(path)
    assert (again.writes("feed", "Pn100"), again.total("feed"), again.total("spool")) == (2, 3, 0)


async def test_a_write_that_was_not_carried_out_is_taken_back(tmp_path):
    ledger = EepromLedger(tmp_path / "ledger.json")
    await ledger.enter("feed", "Pn100", budget=10)

    await ledger.withdraw("feed", "Pn100")

    assert EepromLedger(tmp_path / "ledger.json").writes("feed", "Pn100") == 0


async def test_the_budget_refuses_before_anything_is_counted(tmp_path):
    ledger = EepromLedger(tmp_path / "ledger.json")
    await ledger.enter("feed", "Pn100", budget=1)

    with pytest.raises(EepromBudgetSpent):
        await ledger.enter("feed", "Pn100", budget=1)

    assert ledger.writes("feed", "Pn100") == 1


@pytest.mark.parametrize(
    "text",
    ["", "[]", '{"feed": 3}', '{"feed": {"Pn100": -1}}', '{"feed": {"Pn100": "2"}}', '{"feed": {"Pn100": true}}'],
)
async def test_what_a_damaged_ledger_has_counted_is_written_again_once_it_is_known(tmp_path, text):
    path = tmp_path / "ledger.json"
    path.write_text(text)

    for ledger in (EepromLedger(path), EepromLedger(path)):
        with pytest.raises(EepromBudgetSpent, match="not known"):
            await ledger.enter("feed", "Pn100", budget=10)
        assert path.read_text() == text
    await ledger.restart("feed", 7)
    again = EepromLedger(path)
    await again.enter("feed", "Pn100", budget=10)

    assert again.total("feed") == 8
    with pytest.raises(EepromBudgetSpent, match="not known"):
        await again.enter("spool", "Pn100", budget=10)
    assert (tmp_path / "ledger.json.damaged").read_text() == text


async def test_a_ledger_that_cannot_be_written_stops_the_write(tmp_path):
    (tmp_path / "taken").write_text("a file where a folder is needed")
    ledger = EepromLedger(tmp_path / "taken" / "ledger.json")

    with pytest.raises(ConfigError, match="cannot be written"):
        await ledger.enter("feed", "Pn100", budget=10)

    assert ledger.writes("feed", "Pn100") == 0


async def test_the_file_is_for_people_too(tmp_path):
    ledger = EepromLedger(tmp_path / "ledger.json")

    await ledger.enter("feed", "Pn100", budget=10)

    assert json.loads((tmp_path / "ledger.json").read_text()) == {"feed": {"Pn100": 1}}
    assert list(tmp_path.iterdir()) == [tmp_path / "ledger.json"]


@pytest.mark.parametrize("taken", [0, 40])
async def test_the_count_of_a_replaced_drive_begins_with_what_it_has_taken_already(tmp_path, taken):
    ledger = EepromLedger(tmp_path / "ledger.json")
    for parameter in ("Pn100", "Pn102"):
        await ledger.enter("feed", parameter, budget=10)
    await ledger.enter("spool", "Pn100", budget=10)

    previous = await ledger.restart("feed", taken)

    again = EepromLedger(tmp_path / "ledger.json")
    assert (previous, again.total("feed"), again.writes("feed", "Pn100"), again.total("spool")) == (2, taken, 0, 1)
