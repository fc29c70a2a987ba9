"""A site's logins: certificates, roster and access rules; and that the delivered set-ups say the same."""

import base64
import datetime as dt
import json
import stat
from pathlib import Path

import pytest
import zenoh
from click.testing import CliRunner
from cryptography import x509
from cryptography.x509.oid import ExtendedKeyUsageOID, ExtensionOID, NameOID

from ldcnd.cli.main import cli
from ldcnd.contract.commands import Role
from ldcnd.contract.errors import ConfigError
from ldcnd.ops.pki.access import PERMITTED, Subject, access_control
from ldcnd.ops.pki.site import Login, Site, new_login, read_roster, set_up

NOW = dt.datetime(2026, 3, 1, tzinfo=dt.UTC)
SETUPS = Path(__file__).parents[2] / "config" / "zenoh"
DAEMON = Login(name="bench", role=Role.DAEMON, hosts=("10.0.0.5", "bench.example", "fe80::1"))
ADA = Login(name="ada", role=Role.OPERATOR)
VIC = Login(name="vic", role=Role.VIEWER)


@pytest.fixture
def site(tmp_path: Path) -> Site:
    site = set_up(tmp_path / "site", "test site", NOW)
    for login in (DAEMON, ADA, VIC):
        site.add(login, NOW, 30)
    return site


def configuration(tmp_path: Path, name: str) -> dict[str, object]:
    file = tmp_path / "site" / f"{name}.json5"
    zenoh.Config.from_file(file)  # it has nothing that Zenoh does not know
    return json.loads(file.read_text())


def subjects(tmp_path: Path) -> dict[str, list[str]]:
    rules = configuration(tmp_path, "bench")["access_control"]
    return {subject["id"]: subject["cert_common_names"] for subject in rules["subjects"]}


def certificate(tmp_path: Path, name: str) -> x509.Certificate:
    return x509.load_pem_x509_certificate((tmp_path / "site" / f"{name}.pem").read_bytes())


def test_logins_are_in_the_policy_under_their_role(site: Site, tmp_path: Path) -> None:
    assert subjects(tmp_path) == {"viewers": ["vic"], "operators": ["ada"]}


def test_revoking_takes_a_login_out_of_the_policy_and_its_files_away(site: Site, tmp_path: Path) -> None:
    site.revoke("ada")

    assert subjects(tmp_path) == {"viewers": ["vic"]}
    assert list((tmp_path / "site").glob("ada.*")) == []
    assert read_roster(tmp_path / "site").names(Role.OPERATOR) == ()


def test_a_role_that_nobody_has_is_left_out_because_zenoh_refuses_an_empty_list(site: Site, tmp_path: Path) -> None:
    site.revoke("ada")
    site.revoke("vic")

    rules = configuration(tmp_path, "bench")["access_control"]
    assert (rules["subjects"], rules["policies"]) == ([], [])
    zenoh.Config().insert_json5("access_control", json.dumps(rules))
    assert (rules["enabled"], rules["default_permission"]) == (True, "deny")


def test_a_revoked_name_is_not_given_again(site: Site, tmp_path: Path) -> None:
    site.revoke("ada")

    with pytest.raises(ConfigError, match="revive the old one"):
        site.add(ADA, NOW, 30)
    with pytest.raises(ConfigError, match="no such login; there are: bench, vic"):
        Site(tmp_path / "site").revoke("ada")


@pytest.mark.parametrize(
    ("login", "words"),
    [
        (VIC, "exists"),
        (Login(name="bob", role=Role.DAEMON), "needs a host"),
        (Login(name="gate", role=Role.ROUTER), "a router needs a host"),
        (Login(name="ca", role=Role.VIEWER), "reserved"),
    ],
)
def test_a_login_that_cannot_be_is_refused(site: Site, login: Login, words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        site.add(login, NOW, 30)


@pytest.mark.parametrize("name", ["", "../x", "Ada", "a/b", ".hidden", "a" * 64, "a b"])
def test_a_name_that_is_no_file_name_is_refused(name: str) -> None:
    with pytest.raises(ConfigError, match="cannot be a login"):
        new_login(name, Role.VIEWER, ())


def test_a_router_tells_people_apart_and_carries_for_daemons_and_routers(site: Site, tmp_path: Path) -> None:
    site.add(Login(name="gate", role=Role.ROUTER, hosts=("10.0.0.1",)), NOW, 30)
    site.add(Login(name="bob", role=Role.OPERATOR), NOW, 30)

    router = configuration(tmp_path, "gate")
    policies = {tuple(policy["subjects"]): policy["rules"] for policy in router["access_control"]["policies"]}
    assert router["mode"] == "router"
    assert router["access_control"]["default_permission"] == "deny"
    assert policies[("viewers",)] == [rule.name for rule in PERMITTED[Role.VIEWER]]
    assert policies[("operators",)] == [rule.name for rule in PERMITTED[Role.OPERATOR]]
    assert policies[("daemons",)] == policies[("routers",)] == ["carry_in", "carry_out"]
    assert configuration(tmp_path, "bob")["connect"] == {"endpoints": ["tls/10.0.0.1:7447", "tls/10.0.0.5:7447"]}


def test_to_a_daemon_a_router_is_trusted_and_another_daemon_is_nobody(site: Site, tmp_path: Path) -> None:
    site.add(Login(name="gate", role=Role.ROUTER, hosts=("10.0.0.1",)), NOW, 30)
    site.add(Login(name="other", role=Role.DAEMON, hosts=("10.0.0.6",)), NOW, 30)

    assert subjects(tmp_path) == {"viewers": ["vic"], "operators": ["ada"], "routers": ["gate"]}


def test_a_daemon_is_not_revoked_because_clients_would_trust_it_all_the_same(site: Site) -> None:
    with pytest.raises(ConfigError, match="cannot be revoked"):
        site.revoke("bench")


@pytest.mark.parametrize("name", ["bench", "vic"])
def test_a_login_is_renewed_under_its_name_hosts_and_role(site: Site, tmp_path: Path, name: str) -> None:
    before, rules = certificate(tmp_path, name), subjects(tmp_path)

    file = site.renew(name, NOW + dt.timedelta(days=29), 30)

    after = certificate(tmp_path, name)
    tls = configuration(tmp_path, name)["transport"]["link"]["tls"]
    assert file == tmp_path / "site" / f"{name}.json5"
    assert base64.b64decode(tls["connect_certificate_base64"]) == (file.with_suffix(".pem")).read_bytes()
    assert after.not_valid_after_utc == NOW + dt.timedelta(days=59)
    assert (after.subject, after.extensions.get_extension_for_class(x509.ExtendedKeyUsage).value) == (
        before.subject,
        before.extensions.get_extension_for_class(x509.ExtendedKeyUsage).value,
    )
    assert [each.value for each in after.extensions if each.oid == ExtensionOID.SUBJECT_ALTERNATIVE_NAME] == [
        each.value for each in before.extensions if each.oid == ExtensionOID.SUBJECT_ALTERNATIVE_NAME
    ]
    assert after.serial_number != before.serial_number
    assert subjects(tmp_path) == rules


def test_a_revoked_login_is_not_renewed(site: Site, tmp_path: Path) -> None:
    site.revoke("ada")

    done = CliRunner().invoke(cli, ["pki", "renew", str(tmp_path / "site"), "ada"], standalone_mode=False)

    assert isinstance(done.exception, ConfigError)
    assert "there is no such login; there are: bench, vic" in done.exception.message


def test_only_a_daemons_certificate_is_good_for_listening(site: Site, tmp_path: Path) -> None:
    usages = {
        name: set(certificate(tmp_path, name).extensions.get_extension_for_class(x509.ExtendedKeyUsage).value)
        for name in ("bench", "ada", "vic")
    }

    assert usages["bench"] == {ExtendedKeyUsageOID.SERVER_AUTH, ExtendedKeyUsageOID.CLIENT_AUTH}
    assert usages["ada"] == usages["vic"] == {ExtendedKeyUsageOID.CLIENT_AUTH}


def test_a_daemons_certificate_names_its_hosts_and_addresses(site: Site, tmp_path: Path) -> None:
    names = certificate(tmp_path, "bench").extensions.get_extension_for_class(x509.SubjectAlternativeName).value

    assert names.get_values_for_type(x509.DNSName) == ["bench.example"]
    assert [str(address) for address in names.get_values_for_type(x509.IPAddress)] == ["10.0.0.5", "fe80::1"]


def test_certificates_bear_their_name_and_time_and_the_signature_of_the_authority(site: Site, tmp_path: Path) -> None:
    authority, own = certificate(tmp_path, "ca"), certificate(tmp_path, "ada")

    own.verify_directly_issued_by(authority)
    assert own.subject.get_attributes_for_oid(NameOID.COMMON_NAME)[0].value == "ada"
    assert own.not_valid_before_utc < NOW
    assert own.not_valid_after_utc == NOW + dt.timedelta(days=30)


def test_a_client_connects_to_the_daemons_by_tls_only(site: Site, tmp_path: Path) -> None:
    client = configuration(tmp_path, "ada")

    assert client["mode"] == "client"
    assert client["connect"] == {"endpoints": ["tls/10.0.0.5:7447"]}
    assert client["transport"]["link"]["protocols"] == ["tls"]
    assert "access_control" not in client


def test_nobody_but_the_owner_reads_what_is_written(site: Site, tmp_path: Path) -> None:
    modes = {file.name: stat.S_IMODE(file.stat().st_mode) for file in (tmp_path / "site").iterdir()}

    assert set(modes.values()) == {0o600}
    assert {"ca.key", "ca.pem", "roster.json", "bench.json5", "ada.json5"} <= set(modes)


def test_a_second_authority_in_the_same_folder_is_refused(site: Site, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="there is a site already"):
        set_up(tmp_path / "site", "again", NOW)


def test_a_folder_without_a_site_says_how_to_make_one(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="ldcnd pki init"):
        Site(tmp_path)


def test_the_command_line_makes_a_site_and_says_what_to_do_next(tmp_path: Path) -> None:
    folder = str(tmp_path / "site")
    printed = ""

    for words in (
        ["init", folder],
        ["add", folder, "bench", "--role", "daemon", "--ip", "127.0.0.1", "--host", "bench.example"],
        ["add", folder, "ada", "--role", "operator"],
        ["revoke", folder, "ada"],
    ):
        result = CliRunner().invoke(cli, ["pki", *words], catch_exceptions=False)
        assert result.exit_code == 0
        printed += result.output

    assert f'config_file = "{folder}/bench.json5"' in printed
    said = (
        f"put {folder}/bench.json5 in the place of the one before, and restart the daemon or router that runs with it"
    )
    assert printed.count(said) == 2
    assert "until then ada keeps its rights" in printed
    assert read_roster(tmp_path / "site").find("ada") == Login(name="ada", role=Role.OPERATOR, revoked=True)


@pytest.mark.parametrize(
    ("setup", "subject", "names"),
    [
        ("local", Subject.LINKS, {Role.VIEWER: ("tcp",), Role.OPERATOR: ("unixsock-stream",)}),
        ("lan", Subject.CERTIFICATES, {Role.VIEWER: ("viewer",), Role.OPERATOR: ("operator",)}),
        ("segment", Subject.USERS, {Role.VIEWER: ("viewer",), Role.OPERATOR: ("operator",)}),
    ],
)
def test_the_delivered_set_ups_have_the_same_rules(
    setup: str, subject: Subject, names: dict[Role, tuple[str, ...]]
) -> None:
    delivered = zenoh.Config.from_file(SETUPS / setup / "daemon.json5")

    expected = zenoh.Config()
    expected.insert_json5("access_control", json.dumps(access_control(subject, names)))
    assert json.loads(delivered.get_json("access_control")) == json.loads(expected.get_json("access_control"))


@pytest.mark.parametrize("file", sorted(SETUPS.rglob("*.json5")), ids=lambda file: f"{file.parent.name}-{file.stem}")
def test_nothing_is_scouted_for_in_a_delivered_set_up(file: Path) -> None:
    config = zenoh.Config.from_file(file)

    assert config.get_json("scouting/multicast/enabled") == "false"
    assert config.get_json("scouting/gossip/enabled") == "false"
