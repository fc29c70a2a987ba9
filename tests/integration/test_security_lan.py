"""The set-up for a network: mutual TLS with certificates that `ldcnd pki` makes, roles by common name."""

import base64
import datetime as dt
import json
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
import zenoh

from ldcnd.client.events import latest_events
from ldcnd.client.rig_client import RigClient
from ldcnd.contract.commands import Halt, Power, Role, Verb
from ldcnd.contract.errors import SessionError
from ldcnd.net.zenoh_session import open_zenoh_session
from ldcnd.net.zenoh_settings import ZenohSettings
from ldcnd.ops.pki.site import Site, new_login, set_up
from tests.support.access_facts import AccessFacts, alive
from tests.support.process import free_port
from tests.support.secured_rig import SecuredRig, answers, copy_setup, serving

pytestmark = pytest.mark.real_time

NOW = dt.datetime.now(dt.UTC)
TLS = "transport/link/tls"


def people(folder: Path) -> Site:
    """Set up a site with a daemon, and a login for each role that is called as the role."""
    site = set_up(folder, "test site", NOW)
    site.add(new_login("daemon", Role.DAEMON, ("127.0.0.1", "localhost")), NOW, 10)
    for role in (Role.VIEWER, Role.OPERATOR):
        site.add(new_login(role.value, role, ()), NOW, 10)
    return site


@pytest.fixture(scope="module")
def rig(tmp_path_factory: pytest.TempPathFactory) -> Iterator[SecuredRig]:
    folder = tmp_path_factory.mktemp("site")
    site = people(folder)
    # certificates that the authority has signed, of somebody whom the policy does not know
    site.add(new_login("stranger", Role.VIEWER, ()), NOW, 10)
    stranger = (folder / "stranger.json5").read_text()
    site.revoke("stranger")
    (folder / "stranger.json5").write_text(stranger)
    rig = SecuredRig(folder, f"tls/127.0.0.1:{free_port()}")
    with serving(folder / "daemon.json5", [rig.endpoint], rig.config("viewer")):
        yield rig


class TestLan(AccessFacts):
    """Viewers and operators, told apart by their certificates."""


def test_a_revoked_login_sees_nothing_and_moves_nothing(rig: SecuredRig) -> None:
    with rig.login("stranger") as stranger, rig.login("operator") as operator:
        received = stranger.declare_subscriber("**", zenoh.handlers.FifoChannel(200))
        told = [answers(stranger, key) for key in ("**", "ldcn/sim/@cmd/y/power", "ldcn/sim/@stop")]
        tokens = alive(stranger)
        watched = operator.declare_subscriber("ldcn/sim/tele/x/position", zenoh.handlers.FifoChannel(200))
        for _ in range(5):
            watched.recv()  # telemetry is on its way meanwhile

        assert told == [{}, {}, {}]
        assert tokens == set()
        assert received.try_recv() is None
        watched.undeclare()
        received.undeclare()


@pytest.mark.parametrize(
    "fact",
    [
        AccessFacts.test_spoofed_put_reaches_nobody,
        AccessFacts.test_hijacking_queryable_is_asked_nothing,
        AccessFacts.test_forged_daemon_token_is_seen_by_nobody,
    ],
)
def test_a_login_without_a_role_forges_nothing(
    rig: SecuredRig, fact: Callable[[AccessFacts, SecuredRig, str], None]
) -> None:
    fact(AccessFacts(), rig, "stranger")


def test_the_token_of_an_operator_reaches_the_daemon_and_that_of_a_viewer_does_not(rig: SecuredRig) -> None:
    # a session under the daemon's configuration stands in for it, because the daemon does not show what it sees
    config = zenoh.Config.from_file(rig.folder / "daemon.json5")
    own = SecuredRig(rig.folder, f"tls/127.0.0.1:{free_port()}")
    config.insert_json5("listen/endpoints", json.dumps([own.endpoint]))

    with zenoh.open(config) as daemon:
        watched = daemon.liveliness().declare_subscriber("ldcn/*/client/**", zenoh.handlers.FifoChannel(10))
        with own.login("viewer") as viewer, own.login("operator") as operator:
            dropped = viewer.liveliness().declare_token("ldcn/sim/client/viewer")
            alive(viewer)
            shown = operator.liveliness().declare_token("ldcn/sim/client/operator")
            first = watched.recv()
            shown.undeclare()
            dropped.undeclare()
        watched.undeclare()

    assert str(first.key_expr) == "ldcn/sim/client/operator"


async def refused(rig: SecuredRig, file: Path, endpoint: str | None = None) -> SessionError:
    """Return what a user is told whose login is refused."""
    settings = ZenohSettings(connect=(endpoint or rig.endpoint,), mode="client", config_file=file)
    with pytest.raises(SessionError) as caught:
        async with open_zenoh_session(settings):
            pass
    return caught.value


def changed(rig: SecuredRig, folder: Path, login: str, **settings: str | None) -> Path:
    """Write a login's configuration with other TLS settings; None leaves one out."""
    configuration = json.loads((rig.folder / f"{login}.json5").read_text())
    tls = configuration["transport"]["link"]["tls"]
    tls |= settings
    configuration["transport"]["link"]["tls"] = {name: value for name, value in tls.items() if value is not None}
    file = folder / "changed.json5"
    file.write_text(json.dumps(configuration))
    return file


def tls_of(file: Path) -> dict[str, str]:
    settings: dict[str, str] = json.loads(file.read_text())["transport"]["link"]["tls"]
    return settings


async def test_no_certificate_is_refused_and_says_so(rig: SecuredRig, tmp_path: Path) -> None:
    file = changed(rig, tmp_path, "operator", connect_certificate_base64=None, connect_private_key_base64=None)

    assert "refuses this login: no certificate" in (await refused(rig, file)).message


async def test_an_operator_of_another_authority_is_refused_and_says_so(rig: SecuredRig, tmp_path: Path) -> None:
    people(tmp_path / "rogue")
    rogue = tls_of(tmp_path / "rogue" / "operator.json5")
    wanted = ("connect_certificate_base64", "connect_private_key_base64")
    file = changed(rig, tmp_path, "operator", **{name: rogue[name] for name in wanted})

    assert "one of another authority" in (await refused(rig, file)).message


async def test_a_certificate_that_has_ended_is_refused_and_says_so(rig: SecuredRig, tmp_path: Path) -> None:
    Site(rig.folder).add(new_login("late", Role.OPERATOR, ()), NOW - dt.timedelta(days=9), 1)

    told = await refused(rig, rig.folder / "late.json5")

    assert "the certificate of late has ended on" in told.message
    assert told.remedy == "`ldcnd pki renew SITE late`, put its file in place, and restart what uses it"


async def test_plain_tcp_is_refused_and_says_so(rig: SecuredRig, tmp_path: Path) -> None:
    file = tmp_path / "plain.json5"
    file.write_text("{}")

    assert "it wants TLS" in (await refused(rig, file, rig.endpoint.replace("tls/", "tcp/"))).message


async def test_a_client_refuses_a_daemon_of_another_authority_and_says_so(rig: SecuredRig, tmp_path: Path) -> None:
    people(tmp_path / "rogue")

    assert "is not who it should be" in (await refused(rig, tmp_path / "rogue" / "operator.json5")).message


def posing(authority: str, certificate: bytes | str, key: bytes | str) -> tuple[str, zenoh.Config]:
    """Return an endpoint and the Zenoh configuration that listens there; arguments are in base64."""
    tls = {
        "enable_mtls": False,
        "root_ca_certificate_base64": authority,
        "listen_certificate_base64": certificate,
        "listen_private_key_base64": key,
    }
    config = {
        "mode": "peer",
        "listen": {"endpoints": [endpoint := f"tls/127.0.0.1:{free_port()}"]},
        "scouting": {"multicast": {"enabled": False}},
        "transport": {"link": {"tls": tls}},
    }
    return endpoint, zenoh.Config.from_json5(json.dumps(config))


async def test_an_operator_cannot_pose_as_the_daemon(rig: SecuredRig) -> None:
    own = tls_of(rig.folder / "operator.json5")
    endpoint, config = posing(
        own["root_ca_certificate_base64"], own["connect_certificate_base64"], own["connect_private_key_base64"]
    )

    with zenoh.open(config):
        told = await refused(rig, rig.folder / "viewer.json5", endpoint)

    assert "is not who it should be" in told.message


async def test_of_a_daemon_whose_certificate_has_ended_people_are_told_to_renew_it(tmp_path: Path) -> None:
    site = set_up(tmp_path / "site", "test site", NOW)
    site.add(new_login("viewer", Role.VIEWER, ()), NOW, 10)
    site.add(new_login("daemon", Role.DAEMON, ("127.0.0.1",)), NOW - dt.timedelta(days=20), 10)
    made = [base64.b64encode((tmp_path / "site" / f"daemon.{each}").read_bytes()).decode() for each in ("pem", "key")]
    authority = base64.b64encode((tmp_path / "site" / "ca.pem").read_bytes()).decode()
    endpoint, config = posing(authority, *made)

    with zenoh.open(config):
        told = await refused(SecuredRig(tmp_path / "site", endpoint), tmp_path / "site" / "viewer.json5", endpoint)

    assert "expired" in told.message
    assert "pki renew" in str(told.remedy)


async def test_a_viewer_who_commands_is_told_that_he_may_not(rig: SecuredRig) -> None:
    settings = ZenohSettings(connect=(rig.endpoint,), mode="client", config_file=rig.folder / "viewer.json5")

    async with open_zenoh_session(settings) as session:
        with pytest.raises(SessionError, match="not permitted to command"):
            await RigClient(session, "sim").command("x", Power(on=True))


@pytest.mark.long
async def test_events_tell_whose_certificate_a_command_came_with(rig: SecuredRig) -> None:
    settings = ZenohSettings(connect=(rig.endpoint,), mode="client", config_file=rig.folder / "operator.json5")

    async with open_zenoh_session(settings) as session:
        client = RigClient(session, "sim")
        await client.command("z", Halt(client="ann", command_id="by-ann"))
        with rig.login("operator") as stranger:  # an operator with a program that does not say who it is
            answers(stranger, "ldcn/sim/@cmd/z/halt", {"command_id": "by-somebody"})
        await client.stop("z", client="ann")
        events = await latest_events(client, 100, "z")

    logins = {event.command_id: (event.client, event.login) for event in events}
    assert logins["by-ann"] == ("ann", "operator")
    assert logins["by-somebody"] == (None, None)
    assert (events[-1].verb, events[-1].client, events[-1].login) == (Verb.STOP, "ann", "operator")


@pytest.mark.long
def test_the_example_of_the_set_up_works_with_certificates_in_files(rig: SecuredRig, tmp_path: Path) -> None:
    folder = copy_setup("lan", tmp_path)
    for name in ("ca.pem", "operator.pem", "operator.key", "viewer.pem", "viewer.key", "daemon.pem", "daemon.key"):
        (folder / name).write_bytes((rig.folder / name).read_bytes())
    example = SecuredRig(folder, f"tls/127.0.0.1:{free_port()}")
    # as delivered, with names that count from the file's folder
    (folder / "daemon.json5").write_text((folder / "daemon.json5").read_text().replace(f"{folder}/", ""))

    with serving(folder / "daemon.json5", [example.endpoint], example.config("viewer")):
        with example.login("operator") as operator, example.login("viewer") as viewer:
            command = "ldcn/sim/@cmd/x/power"
            assert answers(viewer, command, {"on": True}) == {}
            assert len(answers(operator, command, {"on": True})) == 1
