"""The how-to on traces says what works: its commands parse, its payload and its settings are accepted."""

import re
import tomllib
from pathlib import Path

from ldcnd.contract.codec import decode
from ldcnd.contract.traces import TakeTrace
from ldcnd.drives.smartstep.profiles import SmartStepTraceConfig

TEXT = (Path(__file__).parents[2] / "docs" / "how-to" / "take-a-trace.md").read_text(encoding="utf-8")


def blocks(language):
    return re.findall(rf"```{language}\n(.*?)```", TEXT, re.DOTALL)


def test_the_payload_of_the_page_is_a_request():
    (payload,) = blocks("json")

    assert decode(TakeTrace, payload.encode(), "application/json").samples == 300


def test_the_settings_of_the_page_are_those_that_hold_anyway():
    (settings,) = blocks("toml")

    table = tomllib.loads(settings)["bus"]["axis"]["smartstep"]["trace"]

    assert SmartStepTraceConfig.model_validate(table) == SmartStepTraceConfig()
