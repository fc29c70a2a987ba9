"""What the console refuses before it listens."""

from pathlib import Path

import pytest

from ldcnd.console.settings import ConsoleSettings, read_token
from ldcnd.contract.errors import ConfigError
from ldcnd.listen_address import ListenAddress, parse_listen_address

CERTIFICATE, KEY, TOKEN = Path("cert.pem"), Path("key.pem"), "t" * 40


@pytest.mark.parametrize("address", ["127.0.0.1:8470", "localhost:0", "[::1]:8470", "127.1.2.3:1"])
def test_this_machine_needs_neither_certificate_nor_token(address):
    settings = ConsoleSettings((), (), parse_listen_address(address))

    assert settings.scheme == "http"
    assert "localhost" in settings.known_hosts


@pytest.mark.parametrize("address", ["192.0.2.1:8470", "[2001:db8::1]:8470", "console.example:8470", "0.0.0.0:8470"])
@pytest.mark.parametrize(
    ("given", "missing"),
    [
        ({}, "--certificate and --key and --token-file"),
        ({"token": TOKEN}, "--certificate and --key"),
        ({"certificate": CERTIFICATE, "key": KEY}, "--token-file"),
    ],
)
def test_any_other_address_takes_certificate_and_token(address, given, missing):
    with pytest.raises(ConfigError) as caught:
        ConsoleSettings((), (), parse_listen_address(address), hosts=("console.example",), **given)

    assert caught.value.message.endswith(f"that takes {missing}")
    assert caught.value.remedy


def test_another_address_with_both_is_known_by_its_names_only():
    settings = ConsoleSettings(
        (),
        (),
        ListenAddress("192.0.2.1", 8470),
        hosts=("console.example",),
        certificate=CERTIFICATE,
        key=KEY,
        token=TOKEN,
    )

    assert settings.scheme == "https"
    assert set(settings.known_hosts) == {"192.0.2.1", "console.example"}
    assert settings.shown_host == "console.example"


@pytest.mark.parametrize("address", ["0.0.0.0:8470", "[::]:8470"])
def test_every_address_needs_a_name(address):
    with pytest.raises(ConfigError, match="--host"):
        ConsoleSettings((), (), parse_listen_address(address), certificate=CERTIFICATE, key=KEY, token=TOKEN)


@pytest.mark.parametrize("half", [{"certificate": CERTIFICATE}, {"key": KEY}])
def test_a_certificate_needs_its_key(half):
    with pytest.raises(ConfigError, match="belong together"):
        ConsoleSettings((), (), parse_listen_address("127.0.0.1:0"), **half)


def test_a_token_is_read(tmp_path):
    path = tmp_path / "token"
    path.write_text(f"{TOKEN}\n")
    path.chmod(0o600)

    assert read_token(path) == TOKEN


@pytest.mark.parametrize(
    ("text", "mode", "words"),
    [
        (TOKEN, 0o640, "others than its owner"),
        (TOKEN, 0o604, "others than its owner"),
        ("t" * 31, 0o600, "32 or more"),
        ("two words " * 5, 0o600, "letters and digits"),
        ("é" * 40, 0o600, "no token can be read"),
        (None, 0, "no token can be read"),
    ],
)
def test_a_token_that_others_can_read_or_guess_is_refused(tmp_path, text, mode, words):
    path = tmp_path / "token"
    if text is not None:
        path.write_text(text)
        path.chmod(mode)

    with pytest.raises(ConfigError, match=words):
        read_token(path)
