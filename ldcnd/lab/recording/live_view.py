"""A rig's publications, live in the Foxglove app: the same messages as in a recording.

Source: Foxglove WebSocket protocol, sub-protocol `foxglove.sdk.v1`. Read-only: nothing that a client of it may publish,
call or set is offered, because one way to move a drive is enough.
"""

import socket
from types import TracebackType
from typing import Self

from foxglove import Channel, Context, Schema, start_server

from ldcnd.client.network import Publication, SampleKind
from ldcnd.contract.codec import to_json
from ldcnd.contract.errors import ConfigError, LdcndError
from ldcnd.contract.frozen import Frozen
from ldcnd.lab.recording.messages import decode_published, message_of, schema_of


class LiveView:
    """A server under way; leaving the context ends it.

    Args:
        name: what the app shows.
        host: where to listen.
        port: likewise; 0 for one that is free.

    Attributes:
        port: where it listens.
        not_understood: how many samples were not what their keys should carry.

    Raises:
        ConfigError: it cannot listen there.
    """

    def __init__(self, name: str, host: str, port: int) -> None:
        self.not_understood = 0
        self._context = Context()
        self._channels: dict[str, Channel] = {}
        try:
            self._server = start_server(name=name, host=host, port=port, capabilities=[], context=self._context)
        except (RuntimeError, OSError, socket.gaierror) as error:
            raise ConfigError(f"cannot serve on {host}:{port}: {error}", value=port) from error
        self.port = self._server.port

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self._server.stop()

    def take(self, sample: Publication) -> None:
        """Show one value to the subscribers of its topic."""
        if sample.kind is SampleKind.DELETE:
            return
        try:
            value = decode_published(sample)
        except LdcndError:
            self.not_understood += 1
            return
        if value is None:
            return
        message = message_of(value)
        channel = self._channels.get(sample.key)
        if channel is None:
            channel = self._channels[sample.key] = self._channel(sample.key, type(message))
        if channel.has_sinks():
            channel.log(to_json(message), log_time=value.t)

    def _channel(self, key: str, message: type[Frozen]) -> Channel:
        name, text = schema_of(message)
        schema = Schema(name=name, encoding="jsonschema", data=text.encode())
        return Channel(f"/{key}", schema=schema, message_encoding="json", context=self._context)
