"""Messages of ROS 2: made with default values, written to and read from CDR, by the published definitions.

Standard messages are those of ROS 2 Jazzy as rosbags has them; Autoware's are read from `definitions/`. A message is a
dataclass of rosbags with the fields of its definition; arrays of numbers are NumPy arrays.
"""

from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.interfaces import Nodetype
from rosbags.serde import SerdeError
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from negopipe.errors import UserError

Message = Any

NUMBERS = ("bool", "byte", "char", *(f"{kind}{bits}" for kind in ("int", "uint") for bits in (8, 16, 32, 64)))
"""Basic types whose default is 0."""

DEFINITIONS = Path(__file__).parent / "definitions"


@cache
def types() -> Typestore:
    """All definitions."""
    store = get_typestore(Stores.ROS2_JAZZY)
    found: dict[str, Any] = {}
    for path in sorted(DEFINITIONS.rglob("*.msg")):
        name = path.relative_to(DEFINITIONS).with_suffix("").as_posix()
        found |= get_types_from_msg(path.read_text(encoding="utf-8"), name)
    store.register(found)
    return store


def make(type_name: str, **fields: Any) -> Message:
    """A message; fields that are not given are 0, empty or messages of such."""
    given = {name: fields.pop(name) if name in fields else _default(what) for name, what in _fields(type_name)}
    if fields:
        raise TypeError(f"{type_name} has no field {', '.join(fields)}")
    return types().types[type_name](**given)


def encode(message: Message) -> bytes:
    """The message in CDR, with its header of encapsulation."""
    return bytes(types().serialize_cdr(message, message.__msgtype__))


def decode(data: bytes, type_name: str) -> Message:
    """The message of CDR. UserError where the bytes are none of its type."""
    try:
        return types().deserialize_cdr(data, type_name)
    except (SerdeError, AssertionError, IndexError) as error:
        raise UserError(f"{type_name} must be CDR of this type, got {len(data)} other bytes") from error


def definition(type_name: str) -> str:
    """Text of the definition and of all that it is made of, as MCAP files hold it."""
    return types().generate_msgdef(type_name, ros_version=2)[0]


def type_hash(type_name: str) -> str:
    """RIHS01 hash, by which ROS 2 compares types."""
    return types().hash_rihs01(type_name)


def _fields(type_name: str) -> list[tuple[str, Any]]:
    return types().fielddefs[type_name][1]


def _default(what: Any) -> Any:
    """Default value of a field by its parsed type."""
    kind, inner = what
    if kind == Nodetype.NAME:
        return make(inner)
    if kind == Nodetype.BASE:
        return "" if inner[0] == "string" else False if inner[0] == "bool" else 0 if inner[0] in NUMBERS else 0.0
    (inner_kind, name), length = inner
    length = length if kind == Nodetype.ARRAY else 0
    if inner_kind == Nodetype.NAME or name[0] == "string":
        return [_default(inner[0]) for _ in range(length)]
    return np.zeros(length, dtype={"byte": "uint8", "char": "uint8"}.get(name[0], name[0]))
