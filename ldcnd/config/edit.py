"""Writing settings of one axis into a configuration, its comments and its order left as they are."""

import json
import re
import tomllib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path

from ldcnd import durable
from ldcnd.config.rig import load_config
from ldcnd.contract.errors import ConfigError

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
    lines = config.read_text(encoding="utf-8").splitlines()
    with draft_of(config) as draft:
        for place in _places(lines, axis):
            end = _end_of_axis(lines, place)
            section = lines[place:end]
            for name, values in tables.items():
                _set(section, name, values)
            edited = "\n".join([*lines[:place], *section, *lines[end:]]) + "\n"
            draft.write_text(edited, encoding="utf-8")
            with suppress(ConfigError):
                if _holds(draft, axis, tables):
                    return edited
    by_hand = "\n".join(_table(name, values) for name, values in tables.items())
    raise ConfigError(f"{config}: put this behind axis {axis} by hand:\n{by_hand}")


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


def _table(name: str, values: Literals) -> str:
    header = f"[{AXIS}.{name}]" if name else f"[[{AXIS}]]"
    return "\n".join([header, *(f"{key} = {literal}" for key, literal in values.items())])


def _places(lines: list[str], axis: str) -> list[int]:
    """Return where the tables begin that have this name."""
    named = [n for n, line in enumerate(lines) if re.match(rf"\s*name\s*=\s*[\"']{re.escape(axis)}[\"']", line)]
    headers = [n for n, line in enumerate(lines) if line.lstrip().startswith("[[")]
    return [begin for n in named if (begin := max((each for each in headers if each < n), default=-1)) >= 0]


def _end_of_axis(lines: list[str], place: int) -> int:
    """Return where the next table of an array begins; empty lines and remarks before it are its own."""
    end = next((n for n in range(place + 1, len(lines)) if lines[n].lstrip().startswith("[[")), len(lines))
    while end > place and (not lines[end - 1].strip() or lines[end - 1].lstrip().startswith("#")):
        end -= 1
    return end


def _set(section: list[str], name: str, values: Literals) -> None:
    """Set the values of a table among the lines of an axis: in its own lines, in one of its parent, or at the end."""
    if not name:
        _replace(section, 1, values)
        return
    header = f"[{AXIS}.{name}]"
    if header in [line.strip() for line in section]:
        _replace(section, [line.strip() for line in section].index(header) + 1, values)
        return
    parent, _, leaf = name.rpartition(".")
    inline = next((n for n, line in enumerate(section) if re.match(rf"\s*{re.escape(leaf)}\s*=\s*\{{", line)), None)
    if inline is not None and _table_at(section, inline) == (f"[{AXIS}.{parent}]" if parent else f"[[{AXIS}]]"):
        held = {key: _literal(value) for key, value in tomllib.loads(section[inline])[leaf].items()}
        section[inline] = f"{leaf} = {_inline({**held, **values})}{_remark(section[inline])}"
        return
    section += ["", *_table(name, values).splitlines()]


def _replace(section: list[str], start: int, values: Literals) -> None:
    for key, literal in values.items():
        end = next((n for n in range(start, len(section)) if section[n].lstrip().startswith("[")), len(section))
        known = [n for n in range(start, end) if re.match(rf"\s*{re.escape(key)}\s*=", section[n])]
        if known:
            section[known[0]] = f"{key} = {literal}{_remark(section[known[0]])}"
        else:
            section.insert(_behind_keys(section, start, end), f"{key} = {literal}")


def _behind_keys(section: list[str], start: int, end: int) -> int:
    """Return where another key of a table goes: behind its last line that is neither empty nor a remark."""
    while end > start and (not section[end - 1].strip() or section[end - 1].lstrip().startswith("#")):
        end -= 1
    return end


def _remark(line: str) -> str:
    found = re.search(r"\s+#[^\"']*$", line)
    return found.group() if found else ""


def _table_at(section: list[str], place: int) -> str:
    """Return the header of the table that a line is in."""
    return next(line.split("#")[0].strip() for line in reversed(section[:place]) if line.lstrip().startswith("["))


def _literal(value: object) -> str:
    match value:
        case bool():
            return str(value).lower()
        case dict():
            return _inline({key: _literal(each) for key, each in value.items()})
        case str():
            return json.dumps(value, ensure_ascii=False)
        case _:
            return str(value)


def _inline(values: Literals) -> str:
    return f"{{ {', '.join(f'{key} = {literal}' for key, literal in values.items())} }}"


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
