"""A state directory for a copy of a daemon: what it holds counts as left there by the daemon itself."""

import json
import shutil
import time
from pathlib import Path


def copy_state(state: Path, to: Path) -> None:
    """Copy it, if there is one."""
    if not state.exists():
        return
    shutil.copytree(state, to)
    for file in to.glob("references/*.json"):
        file.write_text(json.dumps(json.loads(file.read_text()) | {"on_disk": time.time_ns()}))
