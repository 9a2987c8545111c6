"""The node on the wire: it waits for messages, decides when a decision is due, publishes and records."""

import logging
import time
from collections.abc import Callable

from negopipe.deployment.middleware.codec import Message, decode, encode
from negopipe.deployment.middleware.dds import Bus
from negopipe.deployment.middleware.incoming import NS
from negopipe.deployment.middleware.interface import DEBUG, ODOMETRY, Topic
from negopipe.deployment.middleware.outgoing import OK
from negopipe.deployment.middleware.planning_node import PlanningNode
from negopipe.deployment.middleware.recording import Recording
from negopipe.errors import UserError

log = logging.getLogger("negopipe")

WAIT_S = 0.05
"""Longest time for which the node waits without looking at the clock."""


class Silence:
    """The clock of the stamps where no odometry comes any more.

    after_s: time without odometry from which on decisions are made all the same, which are stops
    period_s: time between two of them
    """

    def __init__(self, after_s: float, period_s: float) -> None:
        self._after_s, self._period_s = after_s, period_s
        self._heard_s = self._decided_s = time.monotonic()

    def heard(self) -> None:
        """An odometry has come."""
        self._heard_s = time.monotonic()

    def due(self, newest_ns: int | None) -> int | None:
        """Stamp of the decision that is due, ns, None where there is none; newest_ns: stamp of the newest odometry."""
        now_s = time.monotonic()
        silent_s = now_s - self._heard_s
        if newest_ns is None or silent_s < self._after_s or now_s - self._decided_s < self._period_s:
            return None
        self._decided_s = now_s
        return newest_ns + round(silent_s * NS)


class Served:
    """A node with its topics and, where there is one, its recording."""

    def __init__(self, node: PlanningNode, bus: Bus, silence: Silence, recording: Recording | None) -> None:
        self._node, self._bus, self._silence, self._recording = node, bus, silence, recording
        self._text = ""

    def run(self, is_over: Callable[[], bool]) -> None:
        """Run until `is_over`."""
        while not is_over():
            self._bus.wait(WAIT_S)
            for topic, data in self._bus.take():
                self._take(topic, data)
            stamp = self._node.due()
            if stamp is None:
                stamp = self._silence.due(self._node.newest_ns)
            if stamp is not None:
                for topic, message in self._node.decide(stamp):
                    self._say(topic, message)

    def _take(self, topic: Topic, data: bytes) -> None:
        if self._recording is not None:
            self._recording.add(topic, data)
        if topic is ODOMETRY:
            self._silence.heard()
        try:
            self._node.take(topic, decode(data, topic.type_name))
        except UserError as error:
            log.warning("%s: %s", topic.name, error)

    def _say(self, topic: Topic, message: Message) -> None:
        data = encode(message)
        self._bus.publish(topic, data)
        if self._recording is not None:
            self._recording.add(topic, data)
        if topic is DEBUG and message.status[0].message != self._text:
            (status,) = message.status
            self._text = status.message
            log.log(logging.INFO if status.level == OK else logging.WARNING, "%s", self._text)
