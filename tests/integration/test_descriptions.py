"""Descriptions are encoded once for each change of what they describe, and never told as they were before one."""

import asyncio

from ldcnd.contract.codec import Encoding, encode
from ldcnd.contract.commands import Effect, Home, Power, SetGains
from ldcnd.contract.keys import Keys
from ldcnd.daemon.meta import COUNTERS_HZ, axis_info, command_list
from tests.support.rig import RunningRig, running_rig

KEYS = Keys("sim")
READ_ONLY = (KEYS.axis("x"), KEYS.budget, KEYS.configuration, KEYS.commands, KEYS.daemon, KEYS.schema("axis_info"))


async def payload(rig: RunningRig, key: str) -> bytes:
    (answer,) = await rig.session.query(key)
    return answer.payload


async def test_what_has_not_changed_is_not_encoded_again():
    async with running_rig() as rig:
        first = [await payload(rig, key) for key in READ_ONLY]
        await asyncio.sleep(5)
        again = [await payload(rig, key) for key in READ_ONLY]

    assert [one is other for one, other in zip(first, again, strict=True)] == [True] * len(READ_ONLY)


async def test_a_last_value_is_encoded_once_and_a_newer_one_again():
    key = KEYS.telemetry("x", "position")
    async with running_rig() as rig:
        await rig.until("x", lambda _: True)
        first, again = await payload(rig, key), await payload(rig, key)
        await asyncio.sleep(1)
        later = await payload(rig, key)

    assert first is again
    assert later != first


async def test_the_counters_of_a_line_are_at_most_a_tenth_of_a_second_old():
    key = KEYS.bus("line0")
    async with running_rig() as rig:
        first, again = await payload(rig, key), await payload(rig, key)
        await asyncio.sleep(1.5 / COUNTERS_HZ)
        later = await payload(rig, key)

    assert first is again
    assert later != first


async def test_the_description_of_an_axis_is_as_new_as_the_axis():
    async with running_rig() as rig:
        await rig.until("x", lambda _: True)
        (bus,) = rig.daemon.rig.buses
        axis = rig.daemon.rig.axes["x"]
        stale = []
        for command in (
            Power(on=True),
            SetGains(kp=123),
            Home(),
        ):
            await rig.client.command("x", command)
            fresh, _ = encode(axis_info(bus, axis), Encoding.JSON)
            if await payload(rig, KEYS.axis("x")) != fresh:
                stale.append(command.verb)

    assert stale == []


async def test_a_description_in_msgpack_is_not_the_one_in_json():
    async with running_rig() as rig:
        await payload(rig, KEYS.commands)
        (answer,) = await rig.session.query(KEYS.commands, parameters={"enc": "msgpack"})

    assert (answer.payload, answer.encoding) == encode(command_list(), Encoding.MSGPACK)


def test_the_list_of_commands_says_what_each_does_and_whether_it_needs_a_lease():
    told = {each.verb: (each.effect, each.needs_lease) for each in command_list().commands}

    assert told["halt"] == (Effect.REST, False)
    assert told["move_absolute"] == (Effect.MOTION, True)
    assert told["read_parameter"] == (Effect.QUESTION, False)
    assert told["move_together"] == (Effect.MOTION, True)
