"""Every module that can be started with `-m` starts: each says what it is for, and nothing on a page is broken."""

import runpy
import socket
import sys

import pytest

from tests.bench.sample_cost import Relay, payload_bytes, wire_bytes
from tests.support.process import ROOT

IN_THE_GUEST = "tests/guest/agent.py"
"""Runs in the virtual machine only, which has no `tests`."""
STARTED = "if __name__ ==" + ' "__main__":'


def started() -> list[str]:
    files = [file for folder in ("ldcnd", "tests") for file in (ROOT / folder).rglob("*.py")]
    names = {
        str(file.relative_to(ROOT))
        for file in files
        if file.name == "__main__.py" or STARTED in file.read_text(encoding="utf-8")
    }
    return sorted(names - {IN_THE_GUEST})


@pytest.mark.parametrize("file", started())
@pytest.mark.sweep(2)
def test_a_module_that_can_be_started_says_what_it_is_for(file, monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", [file, "--help"])

    try:
        with pytest.raises(SystemExit) as ended:
            runpy.run_path(str(ROOT / file), run_name="__main__")
    except ModuleNotFoundError as error:
        if str(error.name).partition(".")[0] in {"ldcnd", "tests"}:
            raise
        pytest.skip(f"needs {error.name}")

    assert not ended.value.code
    assert "usage:" in capsys.readouterr().out.lower()


def test_all_that_pages_tell_readers_to_start_can_be_started():
    pages = [*(ROOT / "docs").rglob("*.md"), ROOT / "CONTRIBUTING.md", ROOT / "README.md"]
    told = {
        word.rstrip("`.,;:)")
        for page in pages
        for part in page.read_text(encoding="utf-8").split("python -m tests")[1:]
        for word in [f"tests{part.split()[0]}"]
    }

    assert len(told) > 5
    known = {file.removesuffix(".py").removesuffix("/__main__").replace("/", ".") for file in started()}
    assert told <= known | {"tests.bench", "tests.mutants"}


@pytest.mark.real_time
@pytest.mark.system
async def test_the_cost_of_a_sample_is_measured():
    assert 0 < await payload_bytes() < await wire_bytes(20) < 1000


def test_what_is_still_relayed_ends_with_the_relay():
    with socket.create_server(("127.0.0.1", 0)) as router:
        relay = Relay(f"tcp/127.0.0.1:{router.getsockname()[1]}")
        with relay.running():
            client = socket.create_connection(("127.0.0.1", int(relay.endpoint.rpartition(":")[2])), 5)
            client.sendall(b"a")
            behind, _ = router.accept()
            assert behind.recv(9) == b"a"
        with client, behind:
            behind.settimeout(5)
            assert (client.recv(9), behind.recv(9)) == (b"", b"")
