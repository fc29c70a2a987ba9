"""Numbers that people type: one table of cases for the command line's reader and for the console's."""

import json
from pathlib import Path

import pytest

from ldcnd.contract.number_text import NotANumber, read_number, read_whole, read_word
from tests.support.console_parts import ask_the_pages, part_of_pages

ROOT = Path(__file__).parents[2]
CASES = json.loads((ROOT / "tests" / "vectors" / "typed_numbers.json").read_text(encoding="utf-8"))
ASK_THE_PAGES = """
const [reader, cases] = JSON.parse(require("fs").readFileSync(0, "utf8"));
import(`data:text/javascript;base64,${Buffer.from(reader).toString("base64")}`).then(({ readNumber, Unread }) => {
  const out = cases.map(({ text, unit }) => readNumber(text, { unit }));
  const told = out.map((each) => (each instanceof Unread ? { refused: each.message } : { value: each }));
  console.log(JSON.stringify(told));
});
"""


def read_by_python(case):
    try:
        return {"value": read_number(case["text"], case.get("unit", ""))}
    except NotANumber as error:
        return {"refused": str(error)}


@pytest.mark.parametrize("case", CASES, ids=lambda case: repr(case["text"]))
def test_a_typed_number_is_taken_or_refused_in_words(case):
    read = read_by_python(case)

    if "refused" in case:
        assert case["refused"] in read["refused"]
    elif case["value"] is None:
        assert read == {"refused": "a number is missing"}
    else:
        assert read == {"value": case["value"]}


def test_pages_read_every_number_as_the_command_line_does():
    told = ask_the_pages(ASK_THE_PAGES, part_of_pages("number_text.js"), CASES)

    expected = [{"value": None} if case.get("value", 0) is None else read_by_python(case) for case in CASES]
    assert told == expected


@pytest.mark.parametrize(("text", "whole"), [("5", 5), ("-12", -12), ("1e3", 1000), ("5.0", 5)])
def test_whole_numbers(text, whole):
    assert read_whole(text) == whole


@pytest.mark.parametrize("text", ["1.5", "1_000", "1e17", "0x10", ""])
def test_what_is_no_whole_number(text):
    with pytest.raises(NotANumber):
        read_whole(text)


@pytest.mark.parametrize(
    ("text", "word"), [("0", 0), ("0007", 7), ("65535", 65535), ("0x0101", 257), ("0101H", 257), ("ffffh", 65535)]
)
def test_words(text, word):
    assert read_word(text) == word


@pytest.mark.parametrize(
    "text", ["", "65536", "-1", "0010", "012", "1_0", "0b1", "0o7", "10000H", "\uff11", "1.0", "0x"]
)
def test_what_is_no_word(text):
    with pytest.raises(NotANumber):
        read_word(text)
