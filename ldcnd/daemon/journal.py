"""What clients have asked for, among the packets of the flight recorders; never the lease that they asked with."""

import asyncio
import hashlib
import json

from ldcnd.contract.codec import to_json
from ldcnd.contract.commands import (
    Command,
)
from ldcnd.contract.frozen import Frozen
from ldcnd.contract.keys import RIG_ITSELF
from ldcnd.daemon.rig import OwnedRig
from ldcnd.line.flight_recorder import WireEvent

STOP = "@stop"
TOKENS = ("lease", "leases", "replaces")
"""Fields of requests that name leases."""
QUOTED_TOKENS = tuple(f'"{name}"'.encode() for name in TOKENS)


class Journal:
    """Writes the requests of clients into the flight recorders of the lines concerned, between the packets.

    A line of it is `axis/verb {payload}`, or `@stop/axis {}`, with the payload as JSON; requests that concern the whole
    rig are written to all lines. A lease is named by a fingerprint: a reader of a wire log must not be able to command
    with what it contains.
    """

    def __init__(self, rig: OwnedRig) -> None:
        logs = [(line.bus.wire_log, [axis.config.name for axis in line.axes]) for line in rig.buses]
        self._logs = {name: [log] for log, names in logs for name in names}
        self._logs[RIG_ITSELF] = [log for log, _ in logs]

    def asked(self, axis: str, command: Command[Frozen], lease: str | None = None) -> None:
        """Note a command of an axis or of the rig; `lease` is the token that was given in return."""
        payload = to_json(command, exclude_defaults=True)
        if lease or any(name in payload for name in QUOTED_TOKENS):
            fields = json.loads(payload) | ({"lease": lease} if lease else {})
            payload = json.dumps(without_tokens(fields), separators=(",", ":"), ensure_ascii=False).encode()
        self._note(axis, f"{axis}/{command.verb} ".encode() + payload)

    def stopped(self, axis: str | None) -> None:
        """Note a stop of an axis, or of the rig."""
        what = f"{STOP}/{axis}" if axis else STOP
        self._note(axis or RIG_ITSELF, f"{what} {{}}".encode())

    def _note(self, axis: str, line: bytes) -> None:
        now_s = asyncio.get_running_loop().time()
        for wire_log in self._logs[axis]:
            wire_log.add(now_s, WireEvent.COMMAND, line)


def without_tokens(given: object, *, secret: bool = False) -> object:
    """Return fields of a request with a fingerprint in the place of every lease, also in what is nested."""
    if isinstance(given, dict):
        return {name: without_tokens(value, secret=name in TOKENS) for name, value in given.items()}
    if isinstance(given, list):
        return [without_tokens(each, secret=secret) for each in given]
    return fingerprint(given) if secret and isinstance(given, str) else given


def fingerprint(token: str) -> str:
    """Return a name for a lease that does not give it away."""
    return hashlib.sha256(token.encode()).hexdigest()[:16]
