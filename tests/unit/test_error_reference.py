"""Every error code is documented, and produced by at least one test."""

import re
from pathlib import Path

import pytest

from ldcnd import errors
from ldcnd.errors import ERRORS, ErrorCode, LdcndError, as_markdown

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs" / "reference" / "errors.md").read_text()
TESTS = "\n".join(path.read_text() for path in (ROOT / "tests").rglob("*.py") if path != Path(__file__))
CLASSES = {
    member.code: member.__name__
    for member in vars(errors).values()
    if isinstance(member, type) and issubclass(member, LdcndError) and "code" in vars(member)
}


@pytest.mark.parametrize("code", list(ErrorCode))
def test_every_code_has_a_row_with_its_meaning_and_the_way_out(code):
    row = re.search(rf"^\| `{code.value}` \| (.+) \| (.+) \| (yes|no) \|$", PAGE, re.MULTILINE)

    assert row, f"docs/reference/errors.md has no row for {code.value}"
    assert row[3] == ("yes" if _class(code).retryable else "no")


def test_the_page_is_made_of_the_classes():
    assert PAGE.endswith(as_markdown())


@pytest.mark.parametrize("code", list(ErrorCode))
def test_every_code_has_one_class_that_says_what_to_do(code):
    error = ERRORS[code]

    assert error.code is code
    assert "way_out" in vars(error), "a way out is not inherited: it would be that of another error"
    assert error("something happened").page == f"faults/{code}"


@pytest.mark.parametrize("code", list(ErrorCode))
def test_every_code_is_produced_by_a_test(code):
    assert re.search(rf"\b{_class(code).__name__}\b|['\"]{code.value}['\"]", TESTS), f"no test produces {code.value}"


def test_the_page_documents_nothing_that_does_not_exist():
    documented = set(re.findall(r"^\| `([a-z_]+)` \|", PAGE, re.MULTILINE))

    assert documented == {code.value for code in ErrorCode}


def _class(code: ErrorCode) -> type[LdcndError]:
    return getattr(errors, CLASSES[code])
