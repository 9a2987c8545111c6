"""The topics on the wire: DDS as ROS 2 uses it, by CycloneDDS; no installation of ROS 2.

A topic `/a/b` is `rt/a/b` on the wire, a type `pkg/msg/Name` is `pkg::msg::dds_::Name_`, and the content is the CDR
that `codec` writes. So nodes of ROS 2 with a DDS middleware (rmw_cyclonedds, rmw_fastrtps) are heard and hear.
"""

import os
from collections.abc import Iterable, Mapping
from functools import cache
from typing import Any

from cyclonedds.core import InstanceState, ReadCondition, SampleState, ViewState, WaitSet
from cyclonedds.domain import Domain, DomainParticipant
from cyclonedds.idl import make_idl_struct
from cyclonedds.idl import types as idl
from cyclonedds.internal import InvalidSample
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

CONFIG = """<CycloneDDS><Domain><Compatibility><IgnoreTypeInformation>1.15,1.16</IgnoreTypeInformation></Compatibility>
</Domain></CycloneDDS>"""
"""Types of Fast DDS (vendor 1.15) and of CycloneDDS (1.16) are compared by name, as older releases of ROS 2 do: newer
ones announce structures that CycloneDDS cannot read or finds other than ours."""

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
        self._domain = _configured(domain)
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
        self._writers[topic].write(_wire_type(topic.type_name).deserialize(data))

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


@cache
def _configured(domain: int) -> Domain:
    """The DDS domain in this process, by the environment's CYCLONEDDS_URI and `CONFIG`."""
    return Domain(domain, ",".join(filter(None, (os.environ.get("CYCLONEDDS_URI"), CONFIG))))


def _taken(reader: DataReader, n: int) -> list[bytes]:
    return [sample.data for sample in reader.take(N=n) if not isinstance(sample, InvalidSample)]


@cache
def _wire_type(type_name: str) -> Any:
    """A class of samples of a type of ROS 2 that are their bytes, `data`.

    CycloneDDS itself checks bytes that arrive against the type.
    """
    made = _struct(type_name)

    def serialize(sample: Any, buffer: Any = None, endianness: Any = None, use_version_2: bool | None = None) -> bytes:
        return sample.data

    def deserialize(data: bytes, has_header: bool = True, use_version_2: bool | None = None) -> Any:
        sample = made.__new__(made)
        sample.data = bytes(data)
        return sample

    made.serialize, made.deserialize = serialize, staticmethod(deserialize)
    return made


@cache
def _struct(type_name: str) -> Any:
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
