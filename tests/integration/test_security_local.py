"""The local set-up: the socket commands, TCP watches and stops; no certificates."""

import stat
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.support.access_facts import AccessFacts
from tests.support.process import free_port
from tests.support.secured_rig import SecuredRig, copy_setup, serving

pytestmark = pytest.mark.real_time


@pytest.fixture(scope="module")
def socket(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("run") / "operator.sock"


@pytest.fixture(scope="module")
def rig(tmp_path_factory: pytest.TempPathFactory, socket: Path) -> Iterator[SecuredRig]:
    folder = copy_setup("local", tmp_path_factory.mktemp("zenoh"))
    tcp = f"tcp/127.0.0.1:{free_port()}"
    rig = SecuredRig(folder, tcp, {"operator": f"unixsock-stream/{socket}"})
    with serving(folder / "daemon.json5", [tcp, rig.endpoint_of("operator")], rig.config("viewer")):
        yield rig


class TestLocal(AccessFacts):
    """Viewers and operators, told apart by the way they come."""


@pytest.mark.long
def test_the_socket_is_for_the_daemons_user_and_group(rig: SecuredRig, socket: Path) -> None:
    assert stat.S_IMODE(socket.stat().st_mode) == 0o660
