"""The bench's C programs, built on the spot."""

import shutil
import subprocess
from pathlib import Path

SOURCES = Path(__file__).parent


class NoCompiler(Exception):
    """There is no C compiler here."""


def build(name: str, folder: Path) -> Path:
    """Compile one program; return it."""
    compiler = shutil.which("cc") or shutil.which("gcc") or shutil.which("clang")
    if compiler is None:
        raise NoCompiler("the paced line and the floor are C programs; install a C compiler to measure them")
    program = folder / name
    source = SOURCES / f"{name}.c"
    subprocess.run([compiler, "-O2", "-Wall", "-Wextra", "-o", program, source, "-lutil"], check=True)  # noqa: S603
    return program
