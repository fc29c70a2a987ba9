"""A wing is a folder that can be deleted: whatever remains works without it, and its commands say what is missing."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.support.process import ROOT, client, daemon, simulated_terminal

STANDING = {
    "bench": ("console.commissioning",),
    "console": (),
    "lab": ("bluesky",),
    "ops": (),
    "ports": (),
    "sim": ("bench.tuning", "ports", "testing"),
    "testing": (),
}
"""By wing: what stands on it and goes with it, beside what the folder has."""
COMMANDS = {
    "bench": "scan /dev/null",
    "console": "console",
    "lab": "top",
    "ops": "pki init site",
    "sim": "sim --chain ls-182ap",
    "testing": "twin rig.toml",
}
WHOLE = ("tests/unit/test_packaging.py", "tests/unit/test_deploy_container.py")
"""They pack the whole tree."""
IMPORT_ALL = """
import contextlib, importlib, io, pkgutil, sys
import ldcnd
from ldcnd.cli import main

for found in pkgutil.walk_packages(ldcnd.__path__, "ldcnd.", onerror=lambda _: None):
    if not found.name.endswith("__main__"):
        try:
            importlib.import_module(found.name)
        except ModuleNotFoundError as error:
            if error.name.startswith("ldcnd."):  # and no package that an extra brings
                print(found.name, error.name)
print(ldcnd.__file__)
for words in (["--help"], sys.argv[1:]):
    sys.argv = ["ldcnd", *words]
    said, printed = io.StringIO(), io.StringIO()
    with contextlib.redirect_stderr(said), contextlib.redirect_stdout(printed), contextlib.suppress(SystemExit):
        main.main()
    print("\\n".join(f"{words[0]}: {line}" for line in (printed.getvalue() + said.getvalue()).splitlines()))
"""


@pytest.fixture(params=sorted(STANDING))
def tree(request, tmp_path):
    """Link to everything of the package but one wing."""
    (tmp_path / "ldcnd").mkdir()
    for each in (ROOT / "ldcnd").iterdir():
        if each.name not in {request.param, "__pycache__"}:
            (tmp_path / "ldcnd" / each.name).symlink_to(each)
    return request.param, tmp_path


def run(folder: Path, *words: str, within_s: float = 60, **more: str) -> subprocess.CompletedProcess[str]:
    environment = os.environ | {"PYTHONPATH": str(folder)} | more
    return subprocess.run(  # noqa: S603 - our own program; how it ends is what is tested
        [sys.executable, *words],
        cwd=folder,
        env=environment,
        capture_output=True,
        text=True,
        timeout=within_s,
        check=False,
    )


@pytest.mark.sweep(7)
def test_the_rest_is_there_without_a_wing_and_its_command_says_what_is_missing(tree):
    wing, folder = tree
    command = COMMANDS.get(wing, "run --help").split()
    lines = run(folder, "-c", IMPORT_ALL, *command).stdout.splitlines()
    failed = [line.split() for line in lines if line.startswith("ldcnd.")]
    helped = [line for line in lines if line.startswith("--help: ")]
    said = [line for line in lines if line.startswith(f"{command[0]}: ")]

    assert str(folder / "ldcnd" / "__init__.py") in lines
    assert {missing.split(".")[1] for _, missing in failed} <= {wing}
    places = tuple(f"ldcnd.{place}" for place in STANDING[wing])
    assert [name for name, _ in failed if not name.startswith(places)] == []
    assert any("Own RS-485 servo lines" in line for line in helped)
    if wing in COMMANDS:
        assert len(said) == 2, said
        assert f"this needs ldcnd.{wing}" in said[0]


@pytest.mark.system
@pytest.mark.real_time
async def test_a_daemon_serves_a_real_line_without_a_wing(tree, tmp_path):
    _, folder = tree
    config = tmp_path / "bench.toml"
    config.write_text(
        f'rig = "bench"\n[[bus]]\nname = "a"\nport = "{tmp_path}/line"\nfamily = "ldcn"\nmargin_ms = 200\n'
        '[[bus.axis]]\nname = "x"\naddress = 1\nmodel = "ls-182ap"\nvelocity = 1000\nacceleration = 5000\n'
    )
    async with simulated_terminal(tmp_path / "line", "ls-182ap"), daemon(config, folder) as endpoint:
        async with client(endpoint) as rig:
            state = await rig.state("x")

    assert state is not None
    assert state.link == "up"


@pytest.mark.parametrize("tree", ["sim"], indirect=True)
@pytest.mark.long
def test_without_the_simulator_a_simulated_line_is_refused_with_one_error(tree):
    _, folder = tree
    done = run(folder, "-m", "ldcnd", "check-config", str(ROOT / "config" / "simulated.toml"))

    assert done.returncode == 78
    assert len(done.stderr.splitlines()) == 1
    assert "sim[0]: simulated lines need the simulator, ldcnd.sim, which is not installed" in done.stderr


@pytest.mark.system
@pytest.mark.timeout(1200)
@pytest.mark.parametrize("tree", ["bench", "console", "lab", "ops"], indirect=True)  # most tests need simulated lines
def test_the_other_unit_tests_pass_without_a_wing(tree):
    wing, folder = tree
    for each in ROOT.iterdir():
        if each.name not in {"ldcnd", "build"} and not each.name.startswith("."):
            (folder / each.name).symlink_to(each)
    options = ("-q", "--tb=no", "-n", "2", "-p", "tests.support.without_wing", *(f"--ignore={each}" for each in WHOLE))
    done = run(folder, "-m", "pytest", "tests/unit", *options, within_s=1100, LDCND_WITHOUT=wing)

    assert done.returncode == 0, "\n".join(line for line in done.stdout.splitlines() if "FAILED" in line)
