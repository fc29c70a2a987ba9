"""Which ldcnd this is."""

import importlib.metadata
from functools import cache


@cache
def version() -> str:
    """Return the version of the installed package; it is read from a file, so only once."""
    return importlib.metadata.version("ldcnd")
