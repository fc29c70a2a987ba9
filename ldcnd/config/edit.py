"""Writing into a configuration, its comments and its order left as they are."""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

import tomlkit

from ldcnd import durable
from ldcnd.config.rig import load_config
from ldcnd.contract.errors import ConfigError


def teach(config: Path, name: str, places: Mapping[str, float]) -> None:
    """Write where axes stand into a configuration as a named position, new or in the place of the old one.

    Raises:
        ConfigError: the file would be no configuration any more; it is as it was.
    """
    before = config.read_text(encoding="utf-8")
    document = tomlkit.parse(before)
    known = document.setdefault("position", tomlkit.aot())
    table = next((each for each in known if each.get("name") == name), None)
    if table is None:
        table = tomlkit.table()
        table["name"] = name
        known.append(table)
    table["axes"] = tomlkit.inline_table()
    table["axes"].update(places)
    with draft_of(config) as draft:
        draft.write_text(tomlkit.dumps(document), encoding="utf-8")
        load_config(draft)
    write_over(config, before, tomlkit.dumps(document))


def write_over(config: Path, before: str, text: str) -> None:
    """Replace a configuration that is still as it was when the change was made; empty stands for none.

    Raises:
        ConfigError: it cannot be written, or was changed since; it is as it is.
    """
    try:
        if (config.read_text(encoding="utf-8") if config.exists() else "") != before:
            raise ConfigError(f"{config} has been changed meanwhile", remedy="look at the change again")
        durable.replace(config, text)
    except OSError as error:
        raise ConfigError(f"{config}: cannot be written: {error.strerror}") from error


@contextmanager
def draft_of(config: Path) -> Iterator[Path]:
    """Yield where a new version of a configuration is written and checked; it goes unless it has replaced the old one.

    It is beside the old one, because a configuration names other files as seen from its folder.
    """
    draft = config.with_name(f".{config.name}.draft")
    try:
        yield draft
    finally:
        draft.unlink(missing_ok=True)
