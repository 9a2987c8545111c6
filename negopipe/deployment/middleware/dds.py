"""The topics on the wire: DDS as ROS 2 uses it, by CycloneDDS; no installation of ROS 2.

A topic `/a/b` is `rt/a/b` on the wire, a type `pkg/msg/Name` is `pkg::msg::dds_::Name_`, and the content is the CDR
that `codec` writes. So nodes of ROS 2 with a DDS middleware (rmw_cyclonedds, rmw_fastrtps) are heard and hear.
"""

from collections.abc import Iterable, Mapping
from functools import cache
from typing import Any

from cyclonedds.core import InstanceState, ReadCondition, SampleState, ViewState, WaitSet
from cyclonedds.domain import DomainParticipant
from cyclonedds.idl import IdlStruct, make_idl_struct
from cyclonedds.idl import types as idl
from cyclonedds.pub import DataWriter
from cyclonedds.qos import Policy, Qos
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic as DdsTopic
from cyclonedds.util import duration
from rosbags.interfaces import Nodetype

from negopipe.deployment.middleware.codec import types
from negopipe.deployment.middleware.interface import Topic

ALIKE = {"bool": bool, "string": str, "byte": idl.uint8, "char": idl.uint8}
"""Basic types of ROS 2 whose name in IDL is another."""

BLOCKED_S = 1.0
"""Longest time that a write waits for slow readers."""


class Bus:
    """Readers and writers of one process.

    domain: number of the DDS domain, in ROS 2 the environment's ROS_DOMAIN_ID
    names: other names of topics
    """

    def __init__(
        self, domain: int, inputs: Iterable[Topic], outputs: Iterable[Topic], names: Mapping[str, str] | None = None
    ) -> None:
        self._names = names or {}
        self._participant = DomainParticipant(domain)
        self._readers = {topic: DataReader(self._participant, *self._of(topic)) for topic in inputs}
        self._writers = {topic: DataWriter(self._participant, *self._of(topic)) for topic in outputs}
        self._waiting = WaitSet(self._participant)
        unread = ViewState.Any | InstanceState.Any | SampleState.NotRead
        self._conditions = [ReadCondition(reader, unread) for reader in self._readers.values()]
        for condition in self._conditions:
            self._waiting.attach(condition)

    def wait(self, seconds: float) -> None:
        """Wait until there is a message, or for a time."""
        self._waiting.wait(duration(seconds=seconds))

    def take(self) -> list[tuple[Topic, bytes]]:
        """Messages since the last call, in the order of the inputs.

        The last input is read first: what came before its messages is there with them.
        """
        found = {topic: _taken(reader, topic.depth) for topic, reader in reversed(self._readers.items())}
        return [(topic, data) for topic in self._readers for data in found[topic]]

    def publish(self, topic: Topic, data: bytes) -> None:
        """data: CDR"""
        self._writers[topic].write(_wire_type(topic.type_name)(data))

    def is_matched(self, topic: Topic) -> bool:
        """Whether there is another side of a topic."""
        if topic in self._writers:
            return bool(self._writers[topic].get_matched_subscriptions())
        return bool(self._readers[topic].get_matched_publications())

    def wait_for_acks(self, topic: Topic, seconds: float) -> bool:
        """Wait until all readers have what was published, or for a time; whether they have."""
        return bool(self._writers[topic].wait_for_acks(duration(seconds=seconds)))

    def _of(self, topic: Topic) -> tuple[Any, Qos]:
        """The DDS topic and its quality of service."""
        durability = Policy.Durability.TransientLocal if topic.is_latched else Policy.Durability.Volatile
        qos = Qos(
            Policy.Reliability.Reliable(duration(seconds=BLOCKED_S)),
            Policy.History.KeepLast(topic.depth),
            durability,
        )
        name = f"rt{self._names.get(topic.name, topic.name)}"
        return DdsTopic(self._participant, name, _wire_type(topic.type_name), qos=qos), qos


def _taken(reader: DataReader, n: int) -> list[bytes]:
    samples = reader.take(N=n)
    return [sample.data for sample in samples if isinstance(sample, Wire)]


class Wire:
    """A sample that is its bytes; CycloneDDS itself checks them against the type when they arrive."""

    def __init__(self, data: bytes) -> None:
        self.data = data

    def serialize(self, buffer: Any = None, endianness: Any = None, use_version_2: bool | None = None) -> bytes:
        return self.data

    @classmethod
    def deserialize(cls, data: bytes, has_header: bool = True, use_version_2: bool | None = None) -> "Wire":
        return cls(bytes(data))


@cache
def _wire_type(type_name: str) -> Any:
    """A class of samples of a type of ROS 2."""
    return type("Sample", (Wire, _struct(type_name)), {})


@cache
def _struct(type_name: str) -> type[IdlStruct]:
    """The type for CycloneDDS, by its definition."""
    package, _, name = type_name.split("/")
    fields = {field: _idl(what) for field, what in types().fielddefs[type_name][1]}
    return make_idl_struct(name, f"{package}.msg.dds_.{name}_", fields)


def _idl(what: Any) -> Any:
    kind, inner = what
    if kind == Nodetype.BASE:
        return ALIKE[inner[0]] if inner[0] in ALIKE else getattr(idl, inner[0])
    if kind == Nodetype.NAME:
        return _struct(inner)
    each, length = inner
    return idl.array[_idl(each), length] if kind == Nodetype.ARRAY else idl.sequence[_idl(each)]  # type: ignore[misc]
