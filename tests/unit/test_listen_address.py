"""HOST:PORT, read once for everything that listens."""

import pytest
from click.testing import CliRunner

from ldcnd.console.cli import console
from ldcnd.contract.errors import ConfigError
from ldcnd.lab.cli.serve import foxglove, metrics
from ldcnd.listen_address import ListenAddress, parse_listen_address


@pytest.mark.parametrize(
    ("text", "address", "in_url"),
    [
        ("127.0.0.1:8470", ListenAddress("127.0.0.1", 8470), "127.0.0.1"),
        ("console.example:0", ListenAddress("console.example", 0), "console.example"),
        ("[2001:db8::1]:65535", ListenAddress("2001:db8::1", 65535), "[2001:db8::1]"),
    ],
)
def test_a_host_and_a_port_are_read(text, address, in_url):
    assert parse_listen_address(text) == address
    assert address.in_url == in_url


@pytest.mark.parametrize("host", ["localhost", "127.0.0.1", "127.1.2.3", "::1"])
def test_loopback_is_recognised(host):
    assert ListenAddress(host, 0).is_loopback


@pytest.mark.parametrize("host", ["console.example", "192.0.2.1", "2001:db8::1", "::"])
def test_any_other_host_can_be_reached(host):
    assert not ListenAddress(host, 0).is_loopback


@pytest.mark.parametrize("text", ["", "8470", ":8470", "localhost", "localhost:", "localhost:http", "localhost:65536"])
def test_what_is_no_address_is_refused(text):
    with pytest.raises(ConfigError, match="HOST:PORT"):
        parse_listen_address(text)


@pytest.mark.parametrize(
    ("command", "option"),
    [(console, "--listen"), (metrics, "--address"), (foxglove, "--address")],
)
def test_every_command_that_serves_calls_it_wrong_usage(command, option):
    answer = CliRunner().invoke(command, [option, "localhost"])

    assert answer.exit_code == 2
    assert "'localhost' is not HOST:PORT" in answer.output
