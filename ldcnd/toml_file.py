"""TOML files: read, validated whole, refused with every complaint at once."""

import tomllib
from pathlib import Path
from typing import TypeVar

from pydantic import ValidationError

from ldcnd.errors import ConfigError
from ldcnd.model.frozen import Frozen

DocumentT = TypeVar("DocumentT", bound=Frozen)


def read_toml(path: Path, document_type: type[DocumentT]) -> DocumentT:
    """Read and validate a file.

    Raises:
        ConfigError: the file cannot be read, is not TOML, or cannot work; names file, keys, what is wrong, what is
            allowed.
    """
    try:
        text = path.read_text(encoding="utf-8")
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read: {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise ConfigError(f"{path}: not valid TOML: not UTF-8 at byte {error.start}") from error
    try:
        document = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise ConfigError(f"{path}: not valid TOML: {error}") from error
    try:
        return document_type.model_validate(document)
    except ValidationError as error:
        raise ConfigError("\n".join(f"{path}: {line}" for line in complaints(error))) from error


def complaints(error: ValidationError) -> list[str]:
    """Say for each refused key what is wrong with it."""
    said = []
    details = error.errors()
    for detail in details:
        if detail["type"] == "too_short" and any(
            len(other["loc"]) > len(detail["loc"]) and other["loc"][: len(detail["loc"])] == detail["loc"]
            for other in details
        ):
            continue  # a list is only short because its items were refused
        key = "".join(f"[{part}]" if isinstance(part, int) else f".{part}" for part in detail["loc"]).lstrip(".")
        shown = detail["input"] if isinstance(detail["input"], str | int | float | bool) else None
        given = f" (given: {shown!r})" if shown is not None else ""
        said.append(f"{key or 'whole file'}: {detail['msg'].removeprefix('Value error, ')}{given}")
    return said
