"""Writing settings of one axis into a configuration, its comments and its order left as they are."""

import tomllib
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

import tomlkit
from tomlkit.exceptions import TOMLKitError
from tomlkit.items import InlineTable, Table

from ldcnd.config.edit import draft_of
from ldcnd.config.rig import load_config
from ldcnd.contract.errors import ConfigError
from ldcnd.contract.units import PER, converts
from ldcnd.drives.axis_config import QUANTITIES, units_of_table

AXIS = "bus.axis"
Literals = Mapping[str, str]
"""Settings of a table as TOML writes their values."""


def set_for_axis(config: Path, axis: str, tables: Mapping[str, Literals]) -> None:
    """Set values of an axis; those that are there already are replaced.

    Args:
        config: the file.
        axis: its name.
        tables: by their names below the axis, such as `home`; the empty name stands for the axis itself.

    Raises:
        ConfigError: the file is laid out so that the tables have to be put in by hand, or would be none any more.
    """
    with draft_of(config) as draft:
        draft.write_text(edited_for_axis(config, axis, tables), encoding="utf-8")
        draft.replace(config)


def edited_for_axis(config: Path, axis: str, tables: Mapping[str, Literals]) -> str:
    """Return a configuration as `set_for_axis` would make it, checked whole; the file stays as it is.

    Raises:
        ConfigError: as there.
    """
    document = tomlkit.parse(config.read_text(encoding="utf-8"))
    with suppress(KeyError, TOMLKitError):
        for each in [each for bus in document["bus"] for each in bus["axis"] if each["name"] == axis]:
            for name, values in tables.items():
                _set(each, name, {key: _with_unit(each, name, key, literal) for key, literal in values.items()})
    edited = tomlkit.dumps(document)
    with draft_of(config) as draft:
        draft.write_text(edited, encoding="utf-8")
        with suppress(ConfigError):
            if _holds(draft, axis, tables):
                return edited
    by_hand = "\n".join(_table(name, values) for name, values in tables.items())
    raise ConfigError(f"{config}: put this behind axis {axis} by hand:\n{by_hand}")


def _with_unit(axis: Any, table: str, key: str, literal: str) -> str:  # noqa: ANN401 - as below
    """Return a number in units of an axis with its unit, where it would be taken in another one without."""
    dimension, units = QUANTITIES.get(f"{table}.{key}".lstrip(".")), units_of_table(axis)
    if dimension is None or not converts(units, dimension):
        return literal
    return f'"{literal} {units.unit}{PER[dimension]}"'


def _table(name: str, values: Literals) -> str:
    header = f"[{AXIS}.{name}]" if name else f"[[{AXIS}]]"
    return "\n".join([header, *(f"{key} = {literal}" for key, literal in values.items())])


def _set(axis: Any, name: str, values: Literals) -> None:  # noqa: ANN401 - tables of tomlkit have no common type
    """Set the values of a table below an axis, which is made where it is missing."""
    table, parts = axis, name.split(".") if name else []
    for depth, part in enumerate(parts, 1):
        if part not in table and isinstance(table, InlineTable):
            table[part] = tomlkit.inline_table()
        elif part not in table:
            behind = _taken_end(axis)
            table[part] = tomlkit.table(is_super_table=depth < len(parts))
            _end(axis).extend(behind)
        table = table[part]
    for key, literal in values.items():
        behind = [] if isinstance(table, InlineTable) else _taken_end(table)
        table[key] = tomlkit.value(literal)
        if behind:
            _end(table).extend(behind)


def _end(table: Any) -> list[Any]:  # noqa: ANN401 - as above
    """Return the items of the last table in a table, which is itself where it has no other."""
    body: list[Any] = table.value.body
    last = next((item for key, item in reversed(body) if key is not None), None)
    return _end(last) if isinstance(last, Table) else body


def _taken_end(table: Any) -> list[Any]:  # noqa: ANN401 - as above
    """Remove the empty lines and remarks at the end of a table, which are about what follows, and return them."""
    body = _end(table)
    taken: list[Any] = []
    while body and body[-1][0] is None:
        taken.insert(0, body.pop())
    return taken


def _holds(draft: Path, axis: str, tables: Mapping[str, Literals]) -> bool:
    """Tell whether a configuration is one, and says these values of the axis."""
    rig = load_config(draft)
    (found,) = [each for bus in rig.bus for each in bus.axis if each.name == axis]
    for name, values in tables.items():
        table: object = found.model_dump(mode="json")
        for part in filter(None, name.split(".")):
            table = table.get(part) if isinstance(table, dict) else None
        wanted = tomllib.loads("\n".join(f"{key} = {literal}" for key, literal in values.items()))
        if not isinstance(table, dict) or any(table.get(key) != value for key, value in wanted.items()):
            return False
    return True
