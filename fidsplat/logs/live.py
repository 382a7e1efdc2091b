"""LiveLog: the messages of a RobotLog over a network, by Foxglove's protocol and as ROS 2 topics."""

from __future__ import annotations

from typing import Any

from fidsplat.logs.robot_log import RobotLog
from fidsplat.logs.writers import LogFile
from fidsplat.util.arguments import text, whole_number
from fidsplat.util.errors import InputError, required_package

BACKLOG = 64
"""messages that wait for a slow client; the oldest are dropped"""


class LiveLog(RobotLog):
    """A RobotLog that sends its ROS 2 messages to clients of a WebSocket server, to ROS 2 nodes, or both; a
    context manager.

    Clients of the server are Foxglove (app.foxglove.dev, `ws://HOST:PORT`) and programs of the protocol
    `foxglove.sdk.v1`. ROS 2 nodes receive topics by rclpy where it is installed, else by Cyclone DDS.

    Args:
        host: address to listen on; 127.0.0.1 is this machine only.
        port: 0 for any free port, None for no server.
        ros2: whether the messages are ROS 2 topics, in the domain ROS_DOMAIN_ID.
        world, up: as in `RobotLog`.

    Raises:
        InputError: the server cannot listen there, or a package is missing (extra `live`).
    """

    def __init__(
        self,
        host: str = "127.0.0.1",
        port: int | None = 8765,
        *,
        ros2: bool = False,
        world: str = "map",
        up: Any = None,
    ) -> None:
        self._begin(world, up)
        if not text("host", host):
            raise InputError("host must be an address, got ''; 127.0.0.1 is this machine only")
        self._path, self.port, self._topics = host, None, None
        self._file = _LogFiles()
        if ros2:
            self._topics = _ros2_topics(self._store, host)
            self._file.append(self._topics)
        if port is not None:
            whole_number("port", port, 0, 65535)
            server = _Server(self._store, host, port)
            self.port = int(server.port)
            """port on which the server listens"""
            self._file.append(server)

    def received(self, topic: str, kind: str) -> list[Any]:
        """Messages of a ROS 2 topic since the last call, oldest first; the first call subscribes to it.

        kind: type, such as geometry_msgs/msg/Twist.
        """
        return [] if self._topics is None else self._topics.received(topic, kind)


def _ros2_topics(store: Any, host: str) -> Any:
    """ROS 2 topics by rclpy if it is installed, or else by Cyclone DDS."""
    try:
        from fidsplat.logs.rclpy_topics import RclpyTopics
    except ImportError:
        from fidsplat.logs.ros2 import Ros2Topics

        return Ros2Topics(store, host)
    return RclpyTopics(host)


class _LogFiles(list[LogFile]):
    """Log files that are written as one: each message goes to all, with the methods of `LogFile`."""

    def write(self, topic: str, kind: str, time: int, data: bytes) -> None:
        for file in self:
            file.write(topic, kind, time, data)

    def close(self, keep: bool) -> None:
        for file in self:
            file.close(keep)


class _Server:
    """A `LogFile` that sends its messages to clients of Foxglove's protocol."""

    def __init__(self, store: Any, host: str, port: int) -> None:
        with required_package("foxglove-sdk", "live"):
            import foxglove
        self._store, self._foxglove, self._context = store, foxglove, foxglove.Context()
        self._channels: dict[str, Any] = {}
        try:
            self._server = foxglove.start_server(
                name="fidsplat", host=host, port=port, context=self._context, message_backlog_size=BACKLOG
            )
        except Exception as error:  # Foxglove's class is not public
            raise InputError(
                f"cannot listen on {host}, port {port}: {error}; give another --host or --port"
            ) from None
        self.port = self._server.port

    def write(self, topic: str, kind: str, time: int, data: bytes) -> None:
        if topic not in self._channels:
            definition, _ = self._store.generate_msgdef(kind, ros_version=2)
            schema = self._foxglove.Schema(name=kind, encoding="ros2msg", data=definition.encode())
            self._channels[topic] = self._foxglove.Channel(
                topic, schema=schema, message_encoding="cdr", context=self._context
            )
        self._channels[topic].log(data, log_time=time)

    def close(self, keep: bool) -> None:
        for channel in self._channels.values():
            channel.close()
        self._server.stop()
