"""The documentation as a site."""

import shutil
import subprocess
import sys

import pytest

from tests.support.process import ROOT

GENERATED = shutil.ignore_patterns("faults", "install.md")


@pytest.mark.system
@pytest.mark.timeout(400)
def test_the_site_is_built_without_a_warning(tmp_path):
    """From a copy, because a build gathers pages from elsewhere among the sources."""
    for beside in ROOT.iterdir():
        if beside.name not in {"docs", ".git", ".venv", "build"}:
            (tmp_path / beside.name).symlink_to(beside)
    shutil.copytree(ROOT / "docs", tmp_path / "docs", ignore=GENERATED)

    built = subprocess.run(
        [sys.executable, "-m", "sphinx", "-W", "--keep-going", "-q", "-b", "html", "docs", "site"],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        timeout=350,
        check=False,
    )

    assert (built.returncode, built.stderr) == (0, "")
    assert "not an emergency stop" in (tmp_path / "site" / "index.html").read_text()
    assert (tmp_path / "site" / "faults" / "position_error.html").exists()
