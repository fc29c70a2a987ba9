"""What several parts of the configuration share: names, identities, and the refusal of doubles."""

from typing import Annotated

from pydantic import Field

NAME_CHARACTERS = 63

Name = Annotated[str, Field(pattern=rf"^[a-z0-9][a-z0-9_]{{0,{NAME_CHARACTERS - 1}}}$")]
"""One chunk of a key: lower-case letters, digits, underscores."""

DeviceIdentity = tuple[Annotated[int, Field(ge=0, le=255)], Annotated[int, Field(ge=0, le=255)]]
"""Id and version, as an LDCN or NMC module reports them."""


def refuse_duplicates(what: str, names: list[str]) -> None:
    """Refuse a list in which something stands twice.

    Raises:
        ValueError: names what stands twice.
    """
    for name in names:
        if names.count(name) > 1:
            raise ValueError(f"{what} {name!r} is given more than once")
