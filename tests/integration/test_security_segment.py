"""The set-up for a trusted segment: users and passwords."""

import json
from collections.abc import Iterator

import pytest
import zenoh

from ldcnd.contract.errors import SessionError
from ldcnd.net.zenoh_session import open_zenoh_session
from ldcnd.net.zenoh_settings import ZenohSettings
from tests.support.access_facts import AccessFacts
from tests.support.process import free_port
from tests.support.secured_rig import SecuredRig, copy_setup, serving

pytestmark = pytest.mark.real_time


@pytest.fixture(scope="module")
def rig(tmp_path_factory: pytest.TempPathFactory) -> Iterator[SecuredRig]:
    folder = copy_setup("segment", tmp_path_factory.mktemp("zenoh"))
    rig = SecuredRig(folder, f"tcp/127.0.0.1:{free_port()}")
    with serving(folder / "daemon.json5", [rig.endpoint], rig.config("viewer")):
        yield rig


class TestSegment(AccessFacts):
    """Viewers and operators, told apart by their user names."""


@pytest.mark.parametrize("login", [{"user": "operator", "password": "guessed"}, {"user": "eve", "password": "x"}, None])
@pytest.mark.sweep(3)
async def test_a_wrong_password_is_refused_and_says_so(
    rig: SecuredRig, tmp_path_factory: pytest.TempPathFactory, login: dict[str, str] | None
) -> None:
    file = tmp_path_factory.mktemp("login") / "login.json5"
    file.write_text(json.dumps({"transport": {"auth": {"usrpwd": login}}} if login else {}))

    with pytest.raises(SessionError, match="refuses this login: a wrong user or password"):
        async with open_zenoh_session(ZenohSettings(connect=(rig.endpoint,), mode="client", config_file=file)):
            pass


@pytest.mark.long
def test_a_viewer_with_the_operators_name_and_his_own_password_is_refused(rig: SecuredRig) -> None:
    config = rig.config("viewer")
    config.insert_json5("transport/auth/usrpwd/user", '"operator"')

    with pytest.raises(zenoh.ZError):
        zenoh.open(config)
