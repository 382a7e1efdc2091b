"""LiveLog: the messages of a RobotLog over a network, by Foxglove's WebSocket protocol."""

from __future__ import annotations

from typing import Any

from fidsplat.logs.robot_log import RobotLog
from fidsplat.util.arguments import text, whole_number
from fidsplat.util.errors import InputError

try:
    import foxglove
except ImportError as error:
    raise InputError(f"live messages need more packages ({error}); pip install 'fidsplat[live]'") from None

BACKLOG = 64
"""messages that wait for a slow client; the oldest are dropped"""


class LiveLog(RobotLog):
    """A RobotLog whose messages go to clients of a WebSocket server, as ROS 2 messages in CDR; a context
    manager.

    Clients are Foxglove (app.foxglove.dev, `ws://HOST:PORT`) and programs of the protocol
    `foxglove.sdk.v1`.

    Args:
        host: address to listen on; 127.0.0.1 is this machine only.
        port: 0 for any free port.
        world, up: as in `RobotLog`.

    Raises:
        InputError: the server cannot listen there, or the package is missing (extra `live`).
    """

    def __init__(
        self, host: str = "127.0.0.1", port: int = 8765, *, world: str = "map", up: Any = None
    ) -> None:
        self._begin(world, up)
        if not text("host", host):
            raise InputError("host must be an address, got ''; 127.0.0.1 is this machine only")
        whole_number("port", port, 0, 65535)
        self._path = f"{host}:{port}"
        server = _Server(self._store, host, port)
        self._file, self.port = server, int(server.port)
        """port on which the server listens"""

    def __enter__(self) -> LiveLog:
        return self


class _Server:
    """A `LogFile` that sends its messages."""

    def __init__(self, store: Any, host: str, port: int) -> None:
        self._store, self._context = store, foxglove.Context()
        self._channels: dict[str, Any] = {}
        try:
            self._server = foxglove.start_server(
                name="fidsplat", host=host, port=port, context=self._context, message_backlog_size=BACKLOG
            )
        except Exception as error:  # its own class, which is not public
            raise InputError(
                f"cannot listen on {host}, port {port}: {error}; give another --host or --port"
            ) from None
        self.port = self._server.port

    def write(self, topic: str, kind: str, time: int, data: bytes) -> None:
        if topic not in self._channels:
            definition, _ = self._store.generate_msgdef(kind, ros_version=2)
            schema = foxglove.Schema(name=kind, encoding="ros2msg", data=definition.encode())
            self._channels[topic] = foxglove.Channel(
                topic, schema=schema, message_encoding="cdr", context=self._context
            )
        self._channels[topic].log(data, log_time=time)

    def close(self, keep: bool) -> None:
        for channel in self._channels.values():
            channel.close()
        self._server.stop()
