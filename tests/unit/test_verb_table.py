"""Every verb can be reached from the client and the command line, or the table says why not."""

from tests.support.verb_table import empty_cells, needless_explanations


def test_no_cell_is_empty():
    assert empty_cells() == []


def test_nothing_is_explained_that_is_there():
    assert needless_explanations() == []
