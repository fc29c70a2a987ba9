"""Bring the stage where it may stay over night, without asyncio: focus first, as the sample may touch the lens."""

import ldcnd

SAFE_FOCUS = 2.5


def park() -> float:
    """Lift the focus, then bring x to its end; return where x is."""
    with ldcnd.connect_blocking() as rig, rig.control("x", "focus", client="park") as (x, focus):
        focus.power(on=True)
        focus.move_absolute(SAFE_FOCUS).done()
        x.power(on=True)
        x.home().done()
        x.move_absolute(-5).done()
        return x.position.value


if __name__ == "__main__":
    print(f"parked at {park():.3f} mm")
