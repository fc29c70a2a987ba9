"""Several commands of `ldcnd` in one process: starting an interpreter for each costs more than what they do."""

import asyncio
import json
import sys
from asyncio.subprocess import PIPE
from dataclasses import dataclass
from pathlib import Path

PROGRAM = """
import contextlib, io, json, shlex, sys
from ldcnd.cli.main import main

results = []
for line in json.loads(sys.argv[1]):
    line, _, file = line.partition(" > ")
    sys.argv = shlex.split(line)
    printed, errors = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(printed), contextlib.redirect_stderr(errors):
        try:
            main()
        except SystemExit as end:
            code = end.code
    if file:
        with open(file, "w", encoding="utf-8") as target:
            target.write(printed.getvalue())
    results.append([code, printed.getvalue(), errors.getvalue()])
print(json.dumps(results))
"""
PATIENCE_S = 50.0


@dataclass(frozen=True, slots=True)
class Ran:
    """How a command went."""

    code: int
    printed: str
    errors: str


async def run_all(folder: Path, *commands: str) -> list[Ran]:
    """Run command lines such as `ldcnd axis list`, perhaps with ` > FILE` behind them, in a folder."""
    running = await asyncio.create_subprocess_exec(
        sys.executable, "-c", PROGRAM, json.dumps(commands), cwd=folder, stdout=PIPE, stderr=PIPE
    )
    async with asyncio.timeout(PATIENCE_S):
        printed, errors = await running.communicate()
    assert running.returncode == 0, errors.decode()
    return [Ran(*result) for result in json.loads(printed)]
