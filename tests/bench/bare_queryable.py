"""A process that answers queries at once, over the kind of session that the daemon has: the price of a round trip."""

import argparse
import asyncio

from ldcnd.net.hand_over import Query
from ldcnd.net.zenoh_session import ZenohSettings, open_zenoh_session

KEY = "bare/answer"


async def main(endpoint: str) -> None:
    """Answer until terminated."""

    def answer(query: Query) -> None:
        query.reply(b"{}", "application/json")

    async with open_zenoh_session(ZenohSettings(mode="peer", listen=(endpoint,), connect=())) as session:
        await session.serve(KEY, answer, complete=True)
        print("serving", flush=True)
        await asyncio.Event().wait()


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("endpoint")
    asyncio.run(main(parser.parse_args().endpoint))
