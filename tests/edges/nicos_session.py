"""NICOS, unmodified, as a program that is told what to do: `python -m tests.edges.nicos_session FOLDER SETUP`.

It loads a setup of `FOLDER/setups` and then carries out each line of its input as NICOS's own console does. Each is
answered by a line: the value, or `!` and the error. With the setup `cache` it is NICOS's cache server instead, until
its input ends.
"""

import os
import sys
from pathlib import Path

from nicos import config, session
from nicos.core.sessions.simple import ScriptSession

FOLDER, SETUP = Path(sys.argv[1]), sys.argv[2]
CACHE = "cache"


def serve() -> None:
    session.loadSetup(CACHE, allow_special=True, autoload_system=False)
    server = session.getDevice("Server")
    server.start()
    answer("ready")
    sys.stdin.read()
    server.quit()
    server.wait()


def obey() -> None:
    session.loadSetup([])
    session.setMode("master")  # before there are devices, as an EpicsDevice keeps the mode in which it was made
    session.loadSetup(SETUP)
    answer("ready")
    for line in sys.stdin:
        try:
            try:
                said = eval(compile(line.strip(), "console", "eval"), session.namespace)  # noqa: S307
            except SyntaxError:
                said = exec(compile(line.strip(), "console", "single"), session.namespace)  # noqa: S102
        except Exception as error:  # noqa: BLE001
            answer(f"!{type(error).__name__}: {error}")
        else:
            answer(repr(said))
    session.shutdown()


def answer(text: str) -> None:
    print(text.replace("\n", " "), file=ANSWERS, flush=True)


if __name__ == "__main__":
    ANSWERS = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)  # what NICOS logs
    config.apply()
    config.user = config.group = None
    config.nicos_root = str(FOLDER)
    config.pid_path, config.logging_path = str(FOLDER / "pid"), str(FOLDER / "log")
    session.__class__ = ScriptSession
    session.__init__("ldcnd")
    session.setSetupPath(str(FOLDER / "setups"))
    serve() if SETUP == CACHE else obey()
