"""Messages of any contract with fields of random values."""

import random
from collections.abc import Callable, Sequence
from typing import Any

from google.protobuf.descriptor import FieldDescriptor

FLOATS = (0.0, 1.0, -1.0, float("nan"), float("inf"), 3e38, 1e-40)
WHOLE = (0, 1, 17_000, 500_000, 2**31 - 1)


def scrambled_message(
    message: Any, rng: random.Random, strings: Sequence[str], blob: Callable[[], bytes] = bytes, depth: int = 0
) -> Any:
    """The message, most of its fields set."""

    def value(field: Any) -> Any:
        match field.cpp_type:
            case FieldDescriptor.CPPTYPE_FLOAT | FieldDescriptor.CPPTYPE_DOUBLE:
                return rng.choice(FLOATS)
            case FieldDescriptor.CPPTYPE_STRING if field.type == FieldDescriptor.TYPE_BYTES:
                return blob()
            case FieldDescriptor.CPPTYPE_STRING:
                return rng.choice(strings)
            case FieldDescriptor.CPPTYPE_BOOL:
                return rng.random() < 0.5
            case FieldDescriptor.CPPTYPE_ENUM:
                return rng.choice(field.enum_type.values).number
            case FieldDescriptor.CPPTYPE_UINT64:
                return rng.choice([*WHOLE, 2**63, 2**64 - 1])
            case _:
                return rng.choice(WHOLE)

    for field in message.DESCRIPTOR.fields:
        if rng.random() < 0.15 or depth > 6:
            continue
        repeated = field.is_repeated
        for _ in range(rng.choice([0, 1, 2, 30]) if repeated else 1):
            if field.cpp_type == FieldDescriptor.CPPTYPE_MESSAGE:
                inner = getattr(message, field.name)
                scrambled_message(inner.add() if repeated else inner, rng, strings, blob, depth + 1)
                if not repeated:
                    inner.SetInParent()
            elif repeated:
                getattr(message, field.name).append(value(field))
            else:
                setattr(message, field.name, value(field))
    return message
