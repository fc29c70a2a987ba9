"""What the shell completes: commands, verbs, axes of the daemon, fault codes."""

import pytest
from click.shell_completion import ShellComplete

from ldcnd.cli.main import cli
from tests.support.command_line import virtual_rig


def completed(*words: str, incomplete: str = "") -> list[str]:
    shell = ShellComplete(cli, {}, "ldcnd", "_LDCND_COMPLETE")
    return [item.value for item in shell.get_completions(list(words), incomplete)]


def test_axes_of_the_daemon_are_completed(monkeypatch: pytest.MonkeyPatch) -> None:
    with virtual_rig(monkeypatch):
        axes = completed("move")
        begun = completed("axis", "gains", incomplete="x")
        several = completed("reset", "x", incomplete="y")
        commissioned = completed("commission", "--config", "rig.toml", incomplete="z")

    assert sorted(axes) == ["c", "x", "y", "z"]
    assert (begun, several, commissioned) == (["x"], ["y"], ["z"])


def test_commands_verbs_and_codes_are_completed() -> None:
    assert "move" in completed()
    assert "probe" in completed("axis")
    assert completed("axis", incomplete="quick") == ["quick-stop"]
    assert completed("fault", incomplete="stop_l") == ["stop_latched"]


@pytest.mark.real_time
def test_no_daemon_is_no_completion(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("LDCND_CONNECT", "127.0.0.1:1")

    assert completed("move") == []
