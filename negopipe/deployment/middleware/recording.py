"""All messages of a drive in one MCAP file, in the order in which the node took them in and said them.

Schemas are ROS 2's (`ros2msg`), messages are CDR: Foxglove and the tools of ROS 2 open it. The file holds the measures
of the vehicle, a hash of the export and the seed of drawn horizons, so that `negopipe.deployment.replay` can drive it
again.
"""

import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

from mcap.exceptions import McapError
from mcap.reader import McapReader, make_reader
from mcap.writer import Writer

from negopipe.deployment.middleware.codec import definition
from negopipe.deployment.middleware.interface import TOPICS, Topic
from negopipe.errors import UserError

PROFILE = "ros2"
ABOUT = "negopipe"
"""Name of the file's metadata."""

SEED = "seed"
"""Key of the text that holds the seed of drawn horizons."""

CHUNK_BYTES = 64 * 1024
"""What is lost at most of a file whose writer is killed."""


class Recording:
    """An MCAP file that is being written; `with` closes it.

    about: texts that are kept with it
    """

    def __init__(self, path: Path, about: Mapping[str, str]) -> None:
        try:
            self._file = path.open("wb")
        except OSError as error:
            raise UserError(f"record must be a file that can be written, got {path}: {error.strerror}") from error
        self._writer = Writer(self._file, chunk_size=CHUNK_BYTES)
        self._writer.start(profile=PROFILE, library="negopipe")
        self._writer.add_metadata(ABOUT, dict(about))
        self._channels: dict[Topic, int] = {}
        self._last_ns = 0

    def __enter__(self) -> "Recording":
        return self

    def __exit__(self, *_: object) -> None:
        self._writer.finish()
        self._file.close()

    def add(self, topic: Topic, data: bytes) -> None:
        """Write a message with the time of now, later than all before."""
        self._last_ns = max(time.time_ns(), self._last_ns + 1)
        self._writer.add_message(self._channel(topic), self._last_ns, data, self._last_ns)

    def _channel(self, topic: Topic) -> int:
        if topic not in self._channels:
            text = definition(topic.type_name).encode()
            schema = self._writer.register_schema(topic.type_name, "ros2msg", text)
            self._channels[topic] = self._writer.register_channel(topic.name, "cdr", schema)
        return self._channels[topic]


def about(path: Path) -> dict[str, str]:
    """The texts that are kept with a file. UserError where it is no recording of the node."""
    with _reader(path) as reader:
        found = [each.metadata for each in reader.iter_metadata() if each.name == ABOUT]
    if not found:
        raise UserError(f"{path} must be a recording of the node, got an MCAP file of others")
    return found[0]


def messages(path: Path) -> Iterator[tuple[Topic, bytes]]:
    """The messages of the node's topics in the order in which they were written."""
    with _reader(path) as reader:
        for _, channel, message in reader.iter_messages(topics=list(TOPICS)):
            yield TOPICS[channel.topic], message.data


@contextmanager
def _reader(path: Path) -> Iterator[McapReader]:
    try:
        with path.open("rb") as file:
            yield make_reader(file)
    except OSError as error:
        raise UserError(f"recording must be a file that can be read, got {path}: {error.strerror}") from error
    except McapError as error:
        raise UserError(f"{path} must be a whole MCAP file, got another ({error})") from error
