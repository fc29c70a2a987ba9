"""Files that survive a loss of power: as they were before, or as they are afterwards, never in between."""

import contextlib
import os
from pathlib import Path
from urllib.parse import quote


def state_file(kind: str, rig: str, axis: str) -> Path:
    """Return where a program keeps what it knows of an axis: below $XDG_STATE_HOME, or ~/.local/state."""
    state = os.environ.get("XDG_STATE_HOME")
    folder = (Path(state) if state else Path.home() / ".local" / "state") / "ldcnd" / kind
    return folder / f"{quote(rig, safe='')}@{quote(axis, safe='')}.json"  # names may have what files may not


def replace(path: Path, text: str) -> None:
    """Replace a file whole; it is on the disk when this returns.

    Raises:
        OSError: it cannot be written; the file is as it was.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    draft = path.with_name(f"{path.name}.new")
    try:
        with draft.open("w", encoding="utf-8") as file:
            file.write(text)
            file.flush()
            os.fsync(file.fileno())
        draft.replace(path)
    except OSError:
        with contextlib.suppress(OSError):
            draft.unlink(missing_ok=True)
        raise
    _sync(path.parent)


def remove(path: Path) -> None:
    """Remove a file, if it is there; it has gone from the disk when this returns.

    Raises:
        OSError: it cannot be removed.
    """
    try:
        path.unlink()
    except FileNotFoundError:
        return
    _sync(path.parent)


def _sync(directory: Path) -> None:
    """Have the names in a directory written to the disk."""
    opened = os.open(directory, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(opened)
    finally:
        os.close(opened)
