"""The floor of the bench in Python: the least that an asyncio program does to publish what it polls.

It sends the packets of the C floor, waits for each reply in a reader of its loop, checks and decodes it to a tuple and
puts that tuple, packed, on one key. It knows no lost replies, commands, rates or faults: what the daemon costs beyond
it is what those cost.

usage: python -m tests.bench.minimal_master TERMINAL BAUD MODULES STATUS_ITEMS ENDPOINT
"""

import argparse
import asyncio
import json
import os
import struct
import termios
import tty
from itertools import cycle

import msgpack
import zenoh

REPLY = struct.Struct("<BiBhBx")
"""Status, position, A/D value, velocity and auxiliary bits of a PIC-SERVO, and the checksum."""
HEADER, READ_STATUS = 0xAA, 0x13
SILENCE_S = 0.02
"""A reply that is not whole after so long is lost, as one is when this program is stopped in the middle."""
RATES = {19_200: termios.B19200, 115_200: termios.B115200}


class MinimalMaster:
    """Polls the modules of one line in turn, as often as it carries.

    Args:
        line: the descriptor of its terminal, raw.
        requests: the packets to send, in turn.
        session: where the tuples go.
    """

    def __init__(self, line: int, requests: list[bytes], session: zenoh.Session) -> None:
        self._line = line
        self._requests = cycle(requests)
        self._put = session.declare_publisher("ldcn/bench/tele/minimal").put
        self._loop = asyncio.get_running_loop()
        self._have = b""
        self._asked_at_s = 0.0
        self._loop.add_reader(line, self._receive)
        self._ask()
        self._loop.call_later(SILENCE_S, self._look)

    def _ask(self) -> None:
        self._have = b""
        self._asked_at_s = self._loop.time()
        os.write(self._line, next(self._requests))

    def _receive(self) -> None:
        self._have += os.read(self._line, 64)
        if len(self._have) < REPLY.size:
            return
        reply = self._have
        self._ask()
        if sum(reply[:-1]) & 0xFF == reply[-1]:
            self._put(msgpack.packb(REPLY.unpack(reply)))

    def _look(self) -> None:
        """Ask anew when a reply did not come."""
        self._loop.call_later(SILENCE_S, self._look)
        if self._loop.time() > self._asked_at_s + SILENCE_S:
            termios.tcflush(self._line, termios.TCIFLUSH)
            self._ask()


async def main(terminal: str, baud: int, modules: int, items: int, endpoint: str) -> None:
    """Poll until terminated."""
    line = os.open(terminal, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
    tty.setraw(line)
    settings = termios.tcgetattr(line)
    settings[4] = settings[5] = RATES[baud]
    settings[6][termios.VMIN] = REPLY.size
    termios.tcsetattr(line, termios.TCSANOW, settings)
    bodies = [bytes((address, READ_STATUS, items)) for address in range(1, modules + 1)]
    requests = [bytes((HEADER, *body, sum(body) & 0xFF)) for body in bodies]
    config = {"mode": "peer", "listen": {"endpoints": [endpoint]}, "scouting": {"multicast": {"enabled": False}}}
    with zenoh.open(zenoh.Config.from_json5(json.dumps(config))) as session:
        master = MinimalMaster(line, requests, session)
        await asyncio.Event().wait()
        del master


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("terminal")
    for name in ("baud", "modules", "items"):
        parser.add_argument(name, type=int)
    parser.add_argument("endpoint")
    options = parser.parse_args()
    asyncio.run(main(options.terminal, options.baud, options.modules, options.items, options.endpoint))
