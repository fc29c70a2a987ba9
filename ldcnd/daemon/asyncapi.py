"""The AsyncAPI 3 document of the interface, for generators and for readers without Zenoh.

AsyncAPI has no term for Zenoh's queries: they appear as request and reply on one channel, whose address is the key.
Source: AsyncAPI specification 3.0.0; payloads are the JSON Schemas of the models, dialect 2020-12.
"""

import json

from ldcnd.contract.catalogue import MODELS
from ldcnd.contract.codec import Encoding
from ldcnd.contract.commands import ErrorReply
from ldcnd.contract.frozen import Frozen, schema_name
from ldcnd.daemon.contract import Channel, Kind, channels
from ldcnd.version import version

ASYNCAPI = "3.0.0"
PUBLISHED = frozenset({Kind.TELEMETRY, Kind.NEWS, Kind.HEALTH})
PARAMETERS = {
    "rig": "The rig, as in its configuration.",
    "axis": "An axis of the rig.",
    "bus": "A line of the rig.",
    "monitor": "A monitor of the axis.",
    "index": "Number of the chunk, from 0.",
}


def asyncapi_document() -> dict[str, object]:
    """Return the document; it refers to nothing outside itself."""
    found = channels()
    models: dict[str, type[Frozen]] = {schema_name(ErrorReply): ErrorReply}
    for channel in found:
        for model in (channel.sent, channel.taken):
            if model:
                models[schema_name(model)] = MODELS.get(schema_name(model), model)
    schemas: dict[str, object] = {}
    for name, model in models.items():
        schemas[name] = _schema(model, schemas)
    return {
        "asyncapi": ASYNCAPI,
        "info": {
            "title": "ldcnd",
            "version": version(),
            "description": "Servo drives on RS-485 lines, over Zenoh. Seen from the daemon: it sends telemetry and"
            " receives queries. Payloads are MessagePack or JSON of the same structure.",
            "license": {"name": "Apache-2.0"},
        },
        "defaultContentType": Encoding.JSON.value,
        "channels": {channel.name: _channel(channel) for channel in found},
        "operations": {channel.name: _operation(channel) for channel in found},
        "components": {
            "messages": {name: {"name": name, "payload": {"$ref": f"#/components/schemas/{name}"}} for name in models},
            "schemas": schemas,
        },
    }


def asyncapi_text() -> str:
    """Return the document as JSON with a final newline."""
    return json.dumps(asyncapi_document(), indent=2) + "\n"


def _channel(channel: Channel) -> dict[str, object]:
    messages = [schema_name(channel.sent)]
    if channel.kind not in PUBLISHED:
        messages.append(schema_name(ErrorReply))
    if channel.taken:
        messages.append(schema_name(channel.taken))
    described: dict[str, object] = {
        "address": channel.key,
        "summary": channel.summary,
        "messages": {name: {"$ref": f"#/components/messages/{name}"} for name in messages},
    }
    if channel.parameters:
        described["parameters"] = {name: {"description": PARAMETERS[name]} for name in channel.parameters}
    return described


def _operation(channel: Channel) -> dict[str, object]:
    where = {"$ref": f"#/channels/{channel.name}"}
    sent = _message(channel, channel.sent)
    if channel.kind in PUBLISHED:
        return {"action": "send", "channel": where, "summary": channel.summary, "messages": [sent]}
    asked = [_message(channel, channel.taken)] if channel.taken else []
    return {
        "action": "receive",
        "channel": where,
        "summary": channel.summary,
        "messages": asked,
        "reply": {"channel": where, "messages": [sent, _message(channel, ErrorReply)]},
    }


def _message(channel: Channel, model: type[Frozen]) -> dict[str, str]:
    return {"$ref": f"#/channels/{channel.name}/messages/{schema_name(model)}"}


def _schema(model: type[Frozen], schemas: dict[str, object]) -> dict[str, object]:
    """Return a model's schema; the models inside it become schemas of their own."""
    schema = model.model_json_schema(mode="serialization", ref_template="#/components/schemas/{model}")
    schemas.update(schema.pop("$defs", {}))
    return schema
