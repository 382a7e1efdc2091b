"""ROS 2 topics by rclpy, where ROS is installed: its middleware, discovery and settings."""

from __future__ import annotations

import os
import warnings
from collections import defaultdict, deque
from importlib import import_module
from typing import Any

import rclpy  # type: ignore[import-not-found]
from rclpy.executors import SingleThreadedExecutor  # type: ignore[import-not-found]
from rclpy.qos import QoSProfile  # type: ignore[import-not-found]

from fidsplat.logs.writers import DEPTH, DEPTHS
from fidsplat.util.errors import InputError


class RclpyTopics:
    """A `LogFile` that publishes its messages by a ROS 2 node; also subscribes to topics.

    host: a loopback address sets ROS_AUTOMATIC_DISCOVERY_RANGE, unless it is set, to nodes of this machine.

    Raises:
        InputError: ROS cannot start.
    """

    def __init__(self, host: str) -> None:
        if host.startswith("127.") or host == "localhost":
            os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
        self._context = rclpy.Context()
        try:
            self._context.init()
            self._node = rclpy.create_node("fidsplat", context=self._context)
        except Exception as error:  # the middlewares raise various classes
            raise InputError(f"cannot start a ROS 2 node: {error}; check the settings of ROS") from None
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self._node)
        self._publishers: dict[str, Any] = {}
        self._received: defaultdict[str, deque[Any]] = defaultdict(lambda: deque(maxlen=DEPTH))

    def write(self, topic: str, kind: str, time: int, data: bytes) -> None:
        if topic not in self._publishers:
            quality, message = QoSProfile(depth=DEPTHS.get(topic, DEPTH)), _class(kind)
            self._publishers[topic] = message and self._node.create_publisher(message, topic, quality)
        if self._publishers[topic] is not None:
            self._publishers[topic].publish(data)

    def received(self, topic: str, kind: str) -> list[Any]:
        """Messages of a topic since the last call, oldest first; the first call subscribes to it."""
        if topic not in self._received:
            messages = self._received[topic]
            # rclpy inspects the signature, which a built-in method lacks
            self._node.create_subscription(
                _class(kind), topic, lambda message: messages.append(message), DEPTH
            )
        for _ in range(DEPTH):
            self._executor.spin_once(timeout_sec=0)
        new_messages = list(self._received[topic])
        self._received[topic].clear()
        return new_messages

    def close(self, keep: bool) -> None:
        """End the node."""
        self._executor.shutdown()
        self._node.destroy_node()
        self._context.shutdown()


def _class(kind: str) -> Any:
    """The Python class of a message type; None, with a warning, if the ROS package is missing."""
    package, folder, name = kind.split("/")
    try:
        return getattr(import_module(f"{package}.{folder}"), name)
    except ImportError:
        warnings.warn(f"ROS has no package {package}; messages {kind} are not published", stacklevel=2)
        return None
