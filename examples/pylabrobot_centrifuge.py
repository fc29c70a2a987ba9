"""The centrifuge of `config/centrifuge.toml` as a backend of PyLabRobot, which `pip install pylabrobot` gets.

`pylabrobot_centrifuge.py [ENDPOINT]` runs a cycle. The interlocks of the rig hold whatever this program does.
"""

import asyncio
import sys
from collections.abc import Mapping
from contextlib import AsyncExitStack
from typing import Any

from pylabrobot.centrifuge import Centrifuge
from pylabrobot.centrifuge.backend import CentrifugeBackend

import ldcnd
from ldcnd.contract.samples import IoSample, Moving, StateSample

FULL_PERCENT = 100.0
_SHUT = {"door_closed": True, "door_ajar": False, "door_open": False}
_OPEN = {"door_closed": False, "door_ajar": True, "door_open": True}
_LOCKED = {"locked": True, "unlocked": False}
_UNLOCKED = {"locked": False, "unlocked": True}
_PIN_IN = {"pin_in": True, "pin_out": False}
_PIN_OUT = {"pin_in": False, "pin_out": True}


class LdcndCentrifuge(CentrifugeBackend):  # type: ignore[misc]  # it has no types
    """A rotor, a door, its lock and the pin that holds the rotor at a bucket."""

    def __init__(self, endpoint: str | None = None, *, bucket1: float = 0.1, bucket2: float = 0.6) -> None:
        """Describe it.

        Args:
            endpoint: of the daemon; the local one when missing.
            bucket1: where the first bucket is at the door, in revolutions from the index.
            bucket2: likewise.
        """
        super().__init__()
        self.endpoint, self.bucket1, self.bucket2 = endpoint, bucket1, bucket2
        self._open = AsyncExitStack()

    async def setup(self) -> None:
        """Take control, shut the door, find the index. A rotor that spins is brought to rest first."""
        try:
            self._rig = await self._open.enter_async_context(ldcnd.connect(self.endpoint))
            control = self._rig.control("rotor", client="PyLabRobot", lease_s=2.0)
            self._rotor = await self._open.enter_async_context(control)
            await self._rest()
            await self._shut()
            await self._rotor.power(on=True)
            await (await self._rotor.home()).done()
        except BaseException:
            await self._open.aclose()
            raise

    async def stop(self) -> None:
        """Bring the rotor to rest, open its loop, let go of it."""
        try:
            await self._rest()
            await self._rotor.power(on=False)
            await self._until({}, at_rest=True)
        finally:
            await self._open.aclose()

    async def open_door(self) -> None:
        """Unlock and open it."""
        await self.unlock_door()
        await self._set(high="door", until=_OPEN)

    async def close_door(self) -> None:
        """Close it; it stays unlocked."""
        if not _are(_SHUT, await self._named()):
            await self._set(high="unlock", until=_UNLOCKED)
        await self._set(low="door", until=_SHUT)

    async def lock_door(self) -> None:
        """Lock it; it has to be closed."""
        await self._until(_SHUT, within_s=1.0)
        await self._set(low="unlock", until=_LOCKED)

    async def unlock_door(self) -> None:
        """Unlock it; refused while the rotor turns."""
        await self._set(high="unlock", until=_UNLOCKED)

    async def lock_bucket(self) -> None:
        """Hold the rotor by its pin."""
        await self._set(high="pin", until=_PIN_IN)

    async def unlock_bucket(self) -> None:
        """Let go of the rotor."""
        await self._set(low="pin", until=_PIN_OUT)

    async def go_to_bucket1(self) -> None:
        """Bring the first bucket to the door, and open it."""
        await self._go(self.bucket1)

    async def go_to_bucket2(self) -> None:
        """Bring the second bucket to the door, and open it."""
        await self._go(self.bucket2)

    async def spin(self, g: float = 500, duration: float = 60, acceleration: float = 0.8) -> None:
        """Spin behind a locked door for a time at speed; the drive itself ends it with a ramp.

        Args:
            g: at the radius that the configuration has.
            duration: seconds at speed.
            acceleration: 0 to 1 of the limit of the axis.

        Raises:
            LdcndError: refused, or ended by an interlock: the door, the pin, the imbalance switch.
        """
        (info,) = [each for each in await self._rig.describe() if each.axis == "rotor"]
        await self._shut()
        if self._rotor.state.sample.speed_override < FULL_PERCENT:
            raise RuntimeError(
                f"a speed override of {self._rotor.state.sample.speed_override:g} % would spin it more slowly"
            )
        motion = await self._rotor.move_velocity(
            f"{g} g",
            acceleration=acceleration * (info.limits.acceleration or 1.0),
            duration_s=duration,
        )
        try:
            await motion.done()
        finally:
            await self._rest()

    def serialize(self) -> dict[str, Any]:
        """Return what makes the same backend again."""
        names = ("endpoint", "bucket1", "bucket2")
        return {"type": type(self).__name__} | {name: getattr(self, name) for name in names}

    # -- how it is done ----------------------------------------------------------------------------------------------

    async def _shut(self) -> None:
        await self.unlock_bucket()
        await self.close_door()
        await self.lock_door()

    async def _go(self, place: float) -> None:
        await self._shut()
        await (await self._rotor.move_absolute(place)).done()
        await self.open_door()

    async def _set(self, *, high: str | None = None, low: str | None = None, until: Mapping[str, bool]) -> None:
        await self._rig.set_io("cabinet", high=[high] if high else [], low=[low] if low else [])
        await self._until(until)

    async def _named(self) -> Mapping[str, bool | None]:
        sample = await self._rig.latest("cabinet", "io")
        return sample.named if isinstance(sample, IoSample) and sample.quality == "good" else {}

    async def _rest(self) -> None:
        await (await self._rotor.halt()).done()
        state = await self._rig.latest("rotor", "state")
        if isinstance(state, StateSample) and state.enabled and state.moving is Moving.UNKNOWN:
            await self._rotor.power(on=False)  # others have spun it: it is known to stand a while behind that
        await self._until({}, at_rest=True, within_s=120.0)

    async def _until(self, named: Mapping[str, bool], *, at_rest: bool = False, within_s: float = 10.0) -> None:
        """Wait until inputs have these values, and the rotor stands if it has to."""
        seen: Mapping[str, bool | None] = {}
        try:
            async with asyncio.timeout(within_s), self._rig.samples() as samples:
                while True:
                    seen, state = await self._named(), await self._rig.latest("rotor", "state")
                    stands = isinstance(state, StateSample) and state.moving is Moving.NO
                    if (stands or not at_rest) and _are(named, seen):
                        return
                    await anext(samples)
        except TimeoutError:
            wanted = dict(named) or "standstill"
            raise RuntimeError(f"{wanted} did not come within {within_s:g} s: {dict(seen)}") from None


def _are(wanted: Mapping[str, bool], seen: Mapping[str, bool | None]) -> bool:
    return all(seen.get(name) is value for name, value in wanted.items())


async def main(endpoint: str | None = None) -> None:
    """Load, spin at 100 g for ten seconds, unload."""
    centrifuge = Centrifuge(backend=LdcndCentrifuge(endpoint), name="centrifuge", size_x=300, size_y=300, size_z=300)
    await centrifuge.setup()
    try:
        await centrifuge.go_to_bucket1()
        await centrifuge.close_door()
        await centrifuge.spin(g=100, duration=10)
        await centrifuge.go_to_bucket2()
        await centrifuge.close_door()
        print("done")
    finally:
        await centrifuge.stop()


if __name__ == "__main__":
    asyncio.run(main(*sys.argv[1:]))
