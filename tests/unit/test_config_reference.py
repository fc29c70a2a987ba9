import re
from pathlib import Path

from tools.config_reference import config_reference

PAGE = Path(__file__).parents[2] / "docs" / "reference" / "configuration.md"


def test_the_page_is_what_the_models_say():
    assert PAGE.read_text() == config_reference(), "run `make fix`"


def test_every_key_says_what_it_means():
    page = config_reference()

    silent = [line for line in page.splitlines() if line.startswith("| `") and line.endswith("|  |")]
    assert silent == []


def test_types_are_words_of_toml():
    page = config_reference()
    rows = [line.split(" | ") for line in page.splitlines() if line.startswith("| `")]

    foreign = [row for row in rows if re.search(r"[\[\](){}]|[a-z]\.[a-z]", row[1])]
    assert foreign == []
    assert ["| `stored`", "table of integers 0 to 65535, by parameter number"] in [row[:2] for row in rows]
