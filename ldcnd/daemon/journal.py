"""What clients ask for, written into the flight recorders of the lines concerned, between the packets.

A line of the journal is `axis/verb {payload}`, or `@stop/axis {}`, with the payload as JSON. A lease is named by a
fingerprint: whoever reads a wire log must not be able to command with what it finds there.
"""

import asyncio
import hashlib
import json

from ldcnd.bus.wire_log import WireEvent
from ldcnd.daemon.rig import Rig
from ldcnd.messaging.codec import to_json
from ldcnd.messaging.keys import RIG_ITSELF
from ldcnd.model.frozen import Frozen

STOP = "@stop"


class Journal:
    """Knows which line an axis is on; what concerns the rig as a whole is written to all lines."""

    def __init__(self, rig: Rig) -> None:
        logs = [(line.bus.wire_log, [axis.config.name for axis in line.axes]) for line in rig.buses]
        self._logs = {name: [log] for log, names in logs for name in names}
        self._logs[RIG_ITSELF] = [log for log, _ in logs]

    def asked(self, axis: str, verb: str, request: Frozen, lease: str | None = None) -> None:
        """Note a command of an axis or of the rig; `lease` is the token that was given in return."""
        token = lease or getattr(request, "lease", None)
        if token is None:
            payload = to_json(request, exclude_defaults=True)
        else:
            fields = request.model_dump(mode="json", exclude_defaults=True)
            payload = json.dumps({**fields, "lease": fingerprint(token)}, separators=(",", ":")).encode()
        self._note(axis, f"{axis}/{verb} ".encode() + payload)

    def stopped(self, axis: str | None) -> None:
        """Note a stop of an axis, or of the rig."""
        what = f"{STOP}/{axis}" if axis else STOP
        self._note(axis or RIG_ITSELF, f"{what} {{}}".encode())

    def _note(self, axis: str, line: bytes) -> None:
        now_s = asyncio.get_running_loop().time()
        for log in self._logs[axis]:
            log.add(now_s, WireEvent.COMMAND, line)


def fingerprint(token: str) -> str:
    """Return a name for a lease that does not give it away."""
    return hashlib.sha256(token.encode()).hexdigest()[:16]
