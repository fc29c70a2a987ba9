import re
from pathlib import Path

from tools.config_reference import config_reference

PAGE = Path(__file__).parents[2] / "docs" / "reference" / "configuration.md"


def test_the_page_is_what_the_models_say():
    assert PAGE.read_text() == config_reference(), "run `make fix`"


def keys() -> list[tuple[str, str, str]]:
    """Return name, type and meaning of every key; the default stands behind the type and a semicolon."""
    return re.findall(r"(?m)^\* `(\w+)` \((.*?)\):(.*)$", config_reference())


def test_every_key_says_what_it_means():
    assert len(keys()) > 150
    assert [name for name, _, meaning in keys() if not meaning.strip()] == []


def test_types_are_words_of_toml():
    foreign = [value for _, value, _ in keys() if re.search(r"[\[\](){}]|[a-z]\.[a-z]", value.partition(";")[0])]

    assert foreign == []
    assert ("identity", "array of 2 integers 0 to 255") in [key[:2] for key in keys()]
