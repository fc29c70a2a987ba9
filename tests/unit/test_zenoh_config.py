"""From the rig's file to Zenoh's configuration: endpoints, file names, modes."""

import json
from pathlib import Path

import pytest
from click.testing import CliRunner

from ldcnd.cli.main import cli
from ldcnd.config.rig import load_config
from ldcnd.net.zenoh_config import endpoints, root_certificate, zenoh_config
from ldcnd.net.zenoh_settings import ZenohSettings

ROOT = Path(__file__).parents[2]
SIMULATED = (ROOT / "config" / "simulated.toml").read_text()


def rig_with(tmp_path: Path, zenoh: str) -> Path:
    file = tmp_path / "rig.toml"
    file.write_text(SIMULATED.replace('listen = ["tcp/127.0.0.1:7447"]', zenoh))
    return file


def test_a_rig_without_a_word_about_zenoh_listens_on_this_machine_only(tmp_path: Path) -> None:
    assert load_config(rig_with(tmp_path, "")).zenoh.listen == ("tcp/127.0.0.1:7447",)


def test_the_configuration_file_counts_from_the_rigs_file_and_says_where_to_listen(tmp_path: Path) -> None:
    rig = load_config(rig_with(tmp_path, 'config_file = "zenoh/daemon.json5"'))

    assert rig.zenoh.config_file == tmp_path / "zenoh" / "daemon.json5"
    assert rig.zenoh.listen == ()


def test_a_rig_that_says_where_to_listen_overrules_its_configuration_file(tmp_path: Path) -> None:
    rig = load_config(rig_with(tmp_path, 'config_file = "/etc/daemon.json5"\nlisten = ["tls/[::]:1"]'))

    assert rig.zenoh.config_file == Path("/etc/daemon.json5")
    assert rig.zenoh.listen == ("tls/[::]:1",)


@pytest.mark.parametrize("name", ["local", "lan", "segment"])
def test_a_delivered_set_up_keeps_its_endpoints_and_its_rules(name: str) -> None:
    file = ROOT / "config" / "zenoh" / name / "daemon.json5"

    config = zenoh_config(ZenohSettings(config_file=file))

    assert endpoints(config, "listen")
    assert json.loads(config.get_json("access_control/enabled")) is True
    assert json.loads(config.get_json("timestamping/enabled")) is True
    assert json.loads(config.get_json("listen/exit_on_failure")) is True


def test_relative_file_names_count_from_the_folder_of_the_configuration() -> None:
    folder = ROOT / "config" / "zenoh"

    lan = zenoh_config(ZenohSettings(config_file=folder / "lan" / "daemon.json5"))
    segment = zenoh_config(ZenohSettings(config_file=folder / "segment" / "daemon.json5"))

    assert json.loads(lan.get_json("transport/link/tls/listen_private_key")) == str(folder / "lan" / "daemon.key")
    assert json.loads(segment.get_json("transport/auth/usrpwd/dictionary_file")) == str(
        folder / "segment" / "users.txt"
    )


def test_absolute_file_names_stay(tmp_path: Path) -> None:
    (tmp_path / "z.json5").write_text('{transport: {link: {tls: {root_ca_certificate: "/etc/ssl/ca.pem"}}}}')

    config = zenoh_config(ZenohSettings(config_file=tmp_path / "z.json5"))

    assert json.loads(config.get_json("transport/link/tls/root_ca_certificate")) == "/etc/ssl/ca.pem"
    assert root_certificate(config) is None


@pytest.mark.parametrize(("text", "code"), [("{}", 0), ("{modee: 1}", 78), (None, 78)])
def test_check_config_reads_the_zenoh_configuration_too(tmp_path: Path, text: str | None, code: int) -> None:
    if text is not None:
        (tmp_path / "z.json5").write_text(text)
    rig = rig_with(tmp_path, 'config_file = "z.json5"')

    result = CliRunner().invoke(cli, ["check-config", "--json", str(rig)])

    assert result.exit_code == code
    assert code == 0 or str(tmp_path / "z.json5") in result.output


def test_a_mode_is_left_to_the_file_when_nobody_says_one(tmp_path: Path) -> None:
    (tmp_path / "z.json5").write_text('{mode: "client"}')

    modes = [
        json.loads(zenoh_config(ZenohSettings(mode=mode, config_file=tmp_path / "z.json5")).get_json("mode"))
        for mode in (None, "peer")
    ]

    assert modes == ["client", "peer"]
