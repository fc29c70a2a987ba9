"""A bus that polls the drives of a paced line as fast as it can and does nothing with what they say."""

import argparse
import asyncio
import logging
from dataclasses import replace

import structlog
from typing_extensions import override

from ldcnd.contract.errors import BusError
from ldcnd.drives.ldcn import commands
from ldcnd.drives.ldcn.commands import Node
from ldcnd.drives.ldcn.packet import StatusItem, StatusPacket
from ldcnd.drives.ldcn.profiles import PROFILES
from ldcnd.line.bus import Bus
from ldcnd.line.exchange import Exchange, Poller, Timing
from ldcnd.line.port_url import port_opener
from ldcnd.line.settings import BusSettings

BAUD = 115_200
ITEMS = StatusItem.POSITION | StatusItem.VELOCITY | StatusItem.AUX


class Asker(Poller[StatusPacket]):
    """Asks one drive for nine bytes, again and again."""

    def __init__(self, address: int) -> None:
        self.node = address
        self.due_at_s = 0.0
        # polls know no short replies, see `LdcnAxis.reading`
        self._exchange = replace(commands.read_status(Node(address, PROFILES["ls-182ap"]), ITEMS), total_bytes=None)

    @override
    def next_exchange(self, now_s: float) -> Exchange[StatusPacket]:
        self.due_at_s = self.deadline_at_s = now_s
        return self._exchange

    @override
    def deliver(self, reply: StatusPacket, timing: Timing) -> None:
        pass

    @override
    def missed(self, error: BusError) -> None:
        pass


async def main(terminal: str, modules: int) -> None:
    """Poll until terminated."""
    structlog.configure(wrapper_class=structlog.make_filtering_bound_logger(logging.CRITICAL))
    bus = Bus(BusSettings("bench", BAUD, margin_s=0.02), port_opener(terminal, BAUD))
    async with asyncio.TaskGroup() as group:
        group.create_task(bus.run(), name="bus")
        await bus.wait_opened()
        for address in range(1, modules + 1):
            bus.add_poller(Asker(address))
        print("polling", flush=True)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("terminal")
    parser.add_argument("modules", type=int)
    options = parser.parse_args()
    asyncio.run(main(options.terminal, options.modules))
