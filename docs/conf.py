"""The documentation site: `make docs` builds it, with warnings as errors."""

import importlib.metadata
import shutil
from pathlib import Path

from ldcnd.contract.fault_pages import FOLDER

HERE = Path(__file__).parent

project = "ldcnd"
author = "the authors of ldcnd"
release = importlib.metadata.version("ldcnd")

extensions = ["myst_parser"]
myst_heading_anchors = 3
exclude_patterns = ["_*"]
suppress_warnings = ["myst.strikethrough"]

html_theme = "furo"
html_title = f"ldcnd {release}"
html_copy_source = False
html_show_copyright = False
html_show_sphinx = False


def gather() -> None:
    """Copy here what lies elsewhere, because a package or a deployment needs it there."""
    faults = HERE / "faults"
    shutil.rmtree(faults, ignore_errors=True)
    shutil.copytree(FOLDER, faults, ignore=shutil.ignore_patterns("*.py", "__pycache__"))
    shutil.copy(HERE.parent / "deploy" / "INSTALL.md", HERE / "how-to" / "install.md")


gather()
