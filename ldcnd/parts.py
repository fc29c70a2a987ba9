"""Parts that are not everywhere: the wings of ldcnd, packages of others that an extra brings, signals of POSIX."""

import asyncio
import importlib.metadata
import os
import signal
import sys
from collections.abc import Callable
from importlib.util import find_spec

from ldcnd.contract.errors import ConfigError

EXTRAS = {
    "caproto": ("caproto", "epics"),
    "cryptography": ("cryptography", "ops"),
    "frappy": ("frappy-core", "secop"),
    "foxglove": ("foxglove-sdk", "foxglove"),
    "gpiod": ("gpiod", "gpio"),
    "markdown_it": ("markdown-it-py", "console"),
    "matplotlib": ("matplotlib", "plot"),
    "mcap": ("mcap", "lab"),
    "numpy": ("numpy", "bench"),
    "p4p": ("p4p", "epics-pva"),
    "prometheus_client": ("prometheus-client", "lab"),
    "pyarrow": ("pyarrow", "parquet"),
    "pytest_asyncio": ("pytest-asyncio", "testing"),
    "segno": ("segno", "console"),
    "starlette": ("starlette", "console"),
    "textual": ("textual", "tui"),
    "uvicorn": ("uvicorn", "console"),
    "uvloop": ("uvloop", "fast"),
    "websockets": ("websockets", "console"),
}
"""By the name of its module: a package, and the extra of ldcnd that brings it."""
DEBIAN = {
    "ldcnd": ("console", "fast", "gpio", "journal", "lab", "ops", "tui"),
    "ldcnd-tuning": ("bench", "plot"),
    "ldcnd-bridges": ("bluesky", "epics", "epics-pva", "foxglove", "secop"),
}
"""Debian packages, each upon those before it, with the extras that it brings."""


def require(*modules: str) -> None:
    """Refuse to begin without packages that are optional.

    Args:
        modules: of `EXTRAS`.

    Raises:
        ConfigError: one is not installed; names the extra.
    """
    for module in modules:
        if find_spec(module) is None:
            raise missing(module)


def missing(module: str) -> ConfigError:
    """Return what to say when an optional package is not there: how to get it depends on how ldcnd came here.

    Args:
        module: of `EXTRAS`.
    """
    package, extra = EXTRAS[module]
    remedy = f"pip install 'ldcnd[{extra}]'"
    # who has installed it is recorded beside it (Python packaging user guide, "Recording installed projects")
    if (importlib.metadata.distribution("ldcnd").read_text("INSTALLER") or "").strip() == "debian":
        debian = next((name for name, extras in DEBIAN.items() if extra in extras), None)
        remedy = f"apt install {debian}, or dpkg -i its file" if debian else f"use an ldcnd of pip, with its {extra}"
    return ConfigError(f"{package} is not installed", remedy=remedy)


def missing_wing(error: ModuleNotFoundError) -> ConfigError | None:
    """Return what to say when a command cannot be loaded as a wing of ldcnd is not there; None for other modules."""
    root, _, wing = (error.name or "").partition(".")
    if root != "ldcnd" or not wing:
        return None
    return ConfigError(f"this needs {error.name}, a part of ldcnd that is not installed", remedy="install all of ldcnd")


ENDS = ("SIGTERM", "SIGINT", "SIGHUP")
"""Signals that end a program: of a person, of a service manager, of a terminal that was closed."""


def on_signals(call: Callable[[], None], *names: str) -> None:
    """Call something on the running loop at these signals, instead of being killed; Windows has not all of them."""
    loop = asyncio.get_running_loop()
    for number in (getattr(signal, name) for name in names if hasattr(signal, name)):
        try:
            loop.add_signal_handler(number, call)
        except NotImplementedError:
            signal.signal(number, lambda *_: loop.call_soon_threadsafe(call))


def on_end_of_input(call: Callable[[], None]) -> None:
    """Call something on the running loop when the standard input ends: it is a pipe from a program that has ended."""
    loop, descriptor = asyncio.get_running_loop(), sys.stdin.fileno()

    def read() -> None:
        if not os.read(descriptor, 4096):
            loop.remove_reader(descriptor)
            call()

    loop.add_reader(descriptor, read)
