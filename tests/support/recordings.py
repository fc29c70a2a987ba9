"""Recordings of a rig on the jumping clock, and what is in them."""

import asyncio
import json
from collections import Counter
from collections.abc import AsyncIterator, Mapping
from contextlib import asynccontextmanager
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any

import jsonschema_rs
from mcap.reader import make_reader

from ldcnd.config.rig import RigConfig, load_config
from ldcnd.lab.recording.recorder import KEPT_SAMPLES, Recorder
from ldcnd.net.session import Publication
from ldcnd.sim.chain import Chain
from tests.support.rig import EPOCH_NS, SIMULATED, RunningRig, running_rig

LARGE = 1 << 40


@dataclass(frozen=True, slots=True)
class RecordedRig:
    """A rig that is being recorded.

    Attributes:
        rig: the rig.
        recorder: takes what it publishes.
        published: how many values were published on each key since the recording began.
    """

    rig: RunningRig
    recorder: Recorder
    published: Counter[str]


@asynccontextmanager
async def recorded_rig(
    path: Path,
    config: RigConfig | None = None,
    *,
    rotate_bytes: int = LARGE,
    kept: int = KEPT_SAMPLES,
    chains: Mapping[str, Chain] = MappingProxyType({}),
) -> AsyncIterator[RecordedRig]:
    """Record a rig until the context ends."""
    async with running_rig(config, chains) as rig:
        loop = asyncio.get_running_loop()
        counts: Counter[str] = Counter()
        descriptions = await rig.client.descriptions()
        with Recorder(
            path, descriptions, lambda: EPOCH_NS + round(loop.time() * 1e9), rotate_bytes, rig.client.descriptions
        ) as recorder:

            def take(sample: Publication) -> None:
                counts[sample.key] += 1
                recorder.take(sample)

            async with rig.client.published(take, kept) as gave_way, asyncio.TaskGroup() as group:
                group.create_task(recorder.run(gave_way), name="recorder")
                yield RecordedRig(rig, recorder, counts)
                recorder.end()


def thirty_one_axes(position_hz: float) -> RigConfig:
    """Return the simulated rig with as many axes as a line can have."""
    document = load_config(SIMULATED).model_dump()
    (bus,), (line,) = document["bus"], document["sim"]
    x, drive = bus["axis"][0], line["module"][0]
    x["rates"] |= {"position": position_hz, "velocity": position_hz}
    bus["axis"] = [{**x, "name": f"a{address}", "address": address} for address in range(1, 32)]
    line["module"] = [drive] * 31
    return RigConfig.model_validate(document)


def checked_topics(path: Path) -> Counter[str]:
    """Return how many messages of each topic a file has, having held each to the schema in the file."""
    counts: Counter[str] = Counter()
    validators: dict[int, Any] = {}  # the package's types are many
    with path.open("rb") as stream:
        for schema, channel, message in make_reader(stream, validate_crcs=True).iter_messages(log_time_order=False):
            assert schema is not None
            if schema.id not in validators:
                validators[schema.id] = jsonschema_rs.validator_for(json.loads(schema.data))
            validators[schema.id].validate(json.loads(message.data))
            counts[channel.topic.removeprefix("/")] += 1
    return counts
