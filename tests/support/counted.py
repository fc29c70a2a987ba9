"""What code costs in counts that no machine changes: calls, bytecodes, memory kept, turns of the loop, system calls."""

import asyncio
import gc
import sys
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import BuiltinFunctionType, CodeType, FrameType

import ldcnd

PACKAGE = str(Path(ldcnd.__file__).parent)
SYSTEM_CALLS = frozenset({"posix.read", "posix.write", "posix.sched_yield", "fcntl.ioctl", "epoll.poll"})
"""Functions of the interpreter that are one system call each, by module or type."""
OF_DRIVES = ("PacketReader.", "encode_status", "received_command", "_decode", "_decode_network")
"""Codecs that only simulated drives use while a rig works."""


@dataclass(slots=True)
class Count:
    """What was counted.

    Attributes:
        calls: of functions of ours.
        bytecodes: executed in them; 0 unless they were asked for.
        turns: of the event loop: what wakes a process that has nothing else to do.
    """

    calls: int = 0
    bytecodes: int = 0
    turns: int = 0


def is_daemons(code: CodeType) -> bool:
    """Tell whether code is the daemon's own; what simulates the line is not."""
    file = code.co_filename
    simulates = "/sim/" in file or "simulat" in file or code.co_qualname.startswith(OF_DRIVES)
    return file.startswith(PACKAGE) and not simulates


@contextmanager
def counted_calls() -> Iterator[Count]:
    """Count the calls of functions of the daemon and its client while the context lasts."""
    count = Count()

    def see(frame: FrameType, event: str, _argument: object) -> None:
        count.calls += event == "call" and is_daemons(frame.f_code)

    with _turns(count):
        sys.setprofile(see)
        try:
            yield count
        finally:
            sys.setprofile(None)


@contextmanager
def counted_system_calls() -> Iterator[Counter[str]]:
    """Count the system calls by which this thread serves ports and waits, by name; see `SYSTEM_CALLS`."""
    counted: Counter[str] = Counter()

    def see(_frame: FrameType, event: str, function: object) -> None:
        if event == "c_call" and isinstance(function, BuiltinFunctionType):
            owner = function.__self__
            name = f"{getattr(owner, '__name__', type(owner).__name__)}.{function.__name__}"
            if name in SYSTEM_CALLS:
                counted[name] += 1

    sys.setprofile(see)
    try:
        yield counted
    finally:
        sys.setprofile(None)


@contextmanager
def counted_bytecodes() -> Iterator[Count]:
    """Count calls and bytecodes; a hundred times slower than without."""
    count = Count()

    def within(_frame: FrameType, event: str, _argument: object) -> object:
        count.bytecodes += event == "opcode"
        return within

    def enter(frame: FrameType, _event: str, _argument: object) -> object:
        if not is_daemons(frame.f_code):
            return None
        count.calls += 1
        frame.f_trace_opcodes, frame.f_trace_lines = True, False
        return within

    before = sys.gettrace()
    with _turns(count):
        sys.settrace(enter)  # type: ignore[arg-type] # typeshed knows no tracer that may leave a frame alone
        try:
            yield count
        finally:
            sys.settrace(before)


@contextmanager
def _turns(count: Count) -> Iterator[None]:
    """Count the turns of the running loop."""
    selector = asyncio.get_running_loop()._selector  # type: ignore[attr-defined]
    select = selector.select

    def counting(timeout: float | None = None) -> object:
        count.turns += 1
        return select(timeout)

    selector.select = counting
    try:
        yield
    finally:
        del selector.select


def blocks_in_use() -> int:
    """Return how many blocks of memory the interpreter has allocated and not freed."""
    gc.collect()
    return sys.getallocatedblocks()
