"""ROS 2 topics over DDS, without a ROS installation: names, types and quality of service of
rmw_cyclonedds_cpp."""

from __future__ import annotations

import os
from typing import Any

from fidsplat.logs.writers import DEPTH, DEPTHS
from fidsplat.util.errors import InputError, required_package

with required_package("cyclonedds", "live"):
    from cyclonedds import idl
    from cyclonedds.core import DDSException
    from cyclonedds.domain import Domain, DomainParticipant
    from cyclonedds.idl import types
    from cyclonedds.pub import DataWriter
    from cyclonedds.qos import Policy, Qos
    from cyclonedds.sub import DataReader
    from cyclonedds.topic import Topic
    from cyclonedds.util import duration

BLOCKING = duration(milliseconds=100)
"""longest wait for a subscriber; then a message is dropped"""
_LOCAL = """<CycloneDDS><Domain><General><Interfaces><NetworkInterface address="{host}"/></Interfaces>
<AllowMulticast>false</AllowMulticast></General><Discovery><ParticipantIndex>auto</ParticipantIndex>
<MaxAutoParticipantIndex>32</MaxAutoParticipantIndex><Peers><Peer address="{host}"/></Peers></Discovery>
</Domain></CycloneDDS>,"""
"""configuration for one machine, as with ROS_AUTOMATIC_DISCOVERY_RANGE=LOCALHOST; Cyclone DDS still receives
on every interface"""
_INTERFACE = """<CycloneDDS><Domain><General><Interfaces><NetworkInterface address="{host}"/></Interfaces>
</General></Domain></CycloneDDS>,"""
_PRIMITIVES = {"bool": bool, "string": str, "char": types.uint8}


class Ros2Topics:
    """A `LogFile` that publishes its messages as ROS 2 topics over DDS; also subscribes to topics.

    Args:
        store: message types.
        host: address of the network interface; a loopback address finds participants of this machine only,
            0.0.0.0 any network. CYCLONEDDS_URI has priority, ROS_DOMAIN_ID is the domain.

    Raises:
        InputError: an invalid domain, or no such interface.
    """

    def __init__(self, store: Any, host: str) -> None:
        self._store = store
        self._types: dict[str, Any] = {}
        self._writers: dict[str, Any] = {}
        self._readers: dict[str, Any] = {}
        domain = os.environ.get("ROS_DOMAIN_ID", "0")
        if not (domain.isdecimal() and int(domain) <= 232):
            raise InputError(f"ROS_DOMAIN_ID must be a number from 0 to 232, got {domain!r}")
        host = "127.0.0.1" if host == "localhost" else host
        config = _LOCAL if host.startswith("127.") else "" if host == "0.0.0.0" else _INTERFACE
        config = config.format(host=host) + os.environ.get("CYCLONEDDS_URI", "")
        try:
            self._domain = Domain(int(domain), config)
            enclave = Policy.Userdata(b"enclave=/;")
            self._participant = DomainParticipant(int(domain), Qos(enclave))
        except DDSException as error:
            raise InputError(
                f"cannot open ROS 2 domain {domain} on {host}: {error}; give another --host, ROS_DOMAIN_ID "
                "or CYCLONEDDS_URI"
            ) from None

    def write(self, topic: str, kind: str, time: int, data: bytes) -> None:
        if topic not in self._writers:
            self._writers[topic] = DataWriter(self._participant, *self._topic(topic, kind))
        sample = object.__new__(self._type(kind))
        sample.serialize = lambda use_version_2: data  # the data is serialised already
        try:
            self._writers[topic].write(sample, time)
        except DDSException as error:
            if error.code != DDSException.DDS_RETCODE_TIMEOUT:  # no error: a subscriber does not respond
                raise OSError(str(error)) from error

    def received(self, topic: str, kind: str) -> list[Any]:
        """Messages of a topic since the last call, oldest first; the first call subscribes to it."""
        if topic not in self._readers:
            self._readers[topic] = DataReader(self._participant, *self._topic(topic, kind))
        return [sample for sample in self._readers[topic].take(DEPTH) if isinstance(sample, self._type(kind))]

    def close(self, keep: bool) -> None:
        """End all topics, in this order, since parents must outlive their children."""
        for entities in (self._writers, self._readers):
            entities.clear()
        del self._participant, self._domain

    def _topic(self, topic: str, kind: str) -> tuple[Any, Any]:
        """A topic by its name in DDS, and the quality of service of its readers and writers."""
        quality = Qos(
            Policy.Reliability.Reliable(BLOCKING),
            Policy.Durability.Volatile,
            Policy.History.KeepLast(DEPTHS.get(topic, DEPTH)),
            Policy.DataRepresentation(use_cdrv0_representation=True),
            Policy.WriterDataLifecycle(autodispose=False),
            Policy.Userdata(f"typehash={self._store.hash_rihs01(kind)};".encode()),
        )
        return Topic(self._participant, f"rt{topic}", self._type(kind)), quality

    def _type(self, kind: str) -> Any:
        """The IDL type of a message type."""
        if kind not in self._types:
            package, _, name = kind.split("/")
            fields = {field: self._field(*form) for field, form in self._store.fielddefs[kind][1]}
            self._types[kind] = idl.make_idl_struct(name, f"{package}.msg.dds_.{name}_", fields)
        return self._types[kind]

    def _field(self, node: Any, form: Any) -> Any:
        if node.name == "BASE":
            return _PRIMITIVES.get(form[0]) or getattr(types, form[0])
        if node.name == "NAME":
            return self._type(form)
        element, size = self._field(*form[0]), form[1]
        return types.array[element, size] if node.name == "ARRAY" else types.sequence[element]
