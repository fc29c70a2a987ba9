"""Files that survive a loss of power: as they were before, or as they are afterwards, never in between.

What a program keeps for itself is read by `read`, whatever has become of the file: damage costs what the file held.
"""

import contextlib
import os
import stat
from collections import defaultdict
from collections.abc import Callable
from pathlib import Path
from threading import Lock
from typing import BinaryIO, TypeVar
from urllib.parse import quote

KeptT = TypeVar("KeptT")
BLOCK_BYTES = 4096
DISK_TIME_S = 2.0
"""A disk that takes longer than this counts as failed."""
_WRITING: defaultdict[Path, Lock] = defaultdict(Lock)
"""Held by the thread that writes a draft."""
if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_WRITING.clear)  # threads that hold one end with the fork


class DamagedFile(ValueError):
    """A kept file cannot be read, or holds something else; says which and why, in one line."""


def read(path: Path, parse: Callable[[str], KeptT]) -> KeptT | None:
    """Return what a kept file holds, or None when there is none.

    Args:
        path: the file.
        parse: of its text; raises ValueError, TypeError, AttributeError or KeyError for a text of something else.

    Raises:
        DamagedFile: it cannot be read, or makes no sense, as one that is cut short or that a newer version has written.
    """
    try:
        if not stat.S_ISREG(path.stat().st_mode):  # to open a pipe would wait for its other end
            raise DamagedFile(f"{path}: is no file")
        text = path.read_text(encoding="utf-8")
    except (FileNotFoundError, NotADirectoryError):
        if path.is_symlink():
            raise DamagedFile(f"{path}: is a link to what is not there") from None
        return None
    except OSError as error:
        raise DamagedFile(f"{path}: cannot be read: {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise DamagedFile(f"{path}: is no text (at byte {error.start})") from error
    if not text.strip("\0 \r\n\t"):
        raise DamagedFile(f"{path}: is {'full of zeros' if text else 'empty'}")
    try:
        return parse(text)
    except (ValueError, TypeError, AttributeError, KeyError, RecursionError) as error:
        details = getattr(error, "errors", None)  # of pydantic, whose text has several lines
        reason = details(include_url=False)[0]["msg"] if callable(details) else str(error)
        raise DamagedFile(f"{path}: {reason or 'is something else'}") from error


def state_file(kind: str, rig: str, axis: str) -> Path:
    """Return where a program keeps what it knows of an axis: below $XDG_STATE_HOME, or ~/.local/state."""
    state = os.environ.get("XDG_STATE_HOME")
    folder = (Path(state) if state else Path.home() / ".local" / "state") / "ldcnd" / kind
    return folder / f"{quote(rig, safe='')}@{quote(axis, safe='')}.json"  # names may have what files may not


def replace(path: Path, text: str) -> None:
    """Replace a file whole; it is on the disk when this returns.

    A link stays a link, and the file keeps its owner and mode.

    Raises:
        OSError: it cannot be written; the file is as it was.
    """
    path = Path(os.path.realpath(path))  # of a link to itself this is the link, which is replaced then
    path.parent.mkdir(parents=True, exist_ok=True)
    draft = _draft_of(path)
    with _WRITING[draft]:
        had_room = draft.exists()
        try:
            with _opened(draft) as file:
                _give_the_rights_of(path, file.fileno())
                file.write(text.encode())
                file.truncate()
                file.flush()
                os.fsync(file.fileno())
            draft.replace(path)
        except OSError:
            if not had_room:
                with contextlib.suppress(OSError):
                    draft.unlink(missing_ok=True)
            raise
    _sync(path.parent)


def keep_room(path: Path, size_bytes: int) -> None:
    """Have room on the disk for the next text of a file, or what there is of it: a full disk takes that text, too."""
    draft = _draft_of(Path(os.path.realpath(path)))
    with _WRITING[draft], contextlib.suppress(OSError):
        draft.parent.mkdir(parents=True, exist_ok=True)
        with _opened(draft) as file:
            file.seek(0, os.SEEK_END)
            while (missing := size_bytes - file.tell()) > 0:
                file.write(bytes(min(missing, BLOCK_BYTES)))
                file.flush()
            os.fsync(file.fileno())


def has_draft(path: Path) -> bool:
    """Tell whether there is a draft of a file that has not become the file: its writing failed, or was cut short."""
    return _draft_of(Path(os.path.realpath(path))).exists()


def _draft_of(path: Path) -> Path:
    return path.with_name(f"{path.name}.new")


def _opened(draft: Path) -> BinaryIO:
    """Open a draft to be written from its beginning, without giving back the room that it has."""
    return os.fdopen(os.open(draft, os.O_RDWR | os.O_CREAT | getattr(os, "O_BINARY", 0), 0o666), "r+b")


def remove(path: Path) -> None:
    """Remove a file and its draft, if they are there; they have gone from the disk when this returns.

    Raises:
        OSError: it cannot be removed.
    """
    draft = _draft_of(Path(os.path.realpath(path)))
    with _WRITING[draft], contextlib.suppress(FileNotFoundError, IsADirectoryError):
        draft.unlink()
    try:
        path.unlink()
    except (FileNotFoundError, IsADirectoryError):  # a directory holds nothing that anybody would read
        return
    _sync(path.parent)


def _give_the_rights_of(path: Path, opened: int) -> None:
    """Give an open file owner and mode of one that it will replace, if there is one."""
    with contextlib.suppress(FileNotFoundError, AttributeError):  # Windows has neither owners nor modes
        was = path.stat()
        with contextlib.suppress(PermissionError):  # of another user: only the mode can be kept
            os.fchown(opened, was.st_uid, was.st_gid)
        os.fchmod(opened, stat.S_IMODE(was.st_mode))


def _sync(directory: Path) -> None:
    """Have the names in a directory written to the disk; Windows opens no directories."""
    if not hasattr(os, "O_DIRECTORY"):
        return
    opened = os.open(directory, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(opened)
    finally:
        os.close(opened)
