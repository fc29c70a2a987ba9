"""Every error code is documented, with a class that says what to do."""

from pathlib import Path

from ldcnd.contract.errors import ERRORS, ErrorCode
from tools.__main__ import errors_table

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs" / "reference" / "errors.md").read_text()


def test_the_page_is_made_of_the_classes():
    assert PAGE.endswith(errors_table())


def test_every_code_has_one_class_that_says_what_to_do():
    for code in ErrorCode:
        error = ERRORS[code]
        assert error.code is code
        assert "way_out" in vars(error), f"{code}: a way out is not inherited: it would be that of another error"
        assert error("something happened").page == f"faults/{code}"
