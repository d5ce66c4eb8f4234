"""Which columns of a sample stand under which topic of an MCAP shard, and the protobuf types that say so.

Both follow from the schema: a column is a field of its topic's message, under its own name, and its numbers are laid
out row by row; where a shape has a second ragged size, `<column>_sizes` says it of each entry. A field that is missing
is null, or an array without entries. The types are proto2, where every value can be missing.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from google.protobuf.descriptor_pb2 import DescriptorProto, FieldDescriptorProto, FileDescriptorProto, FileDescriptorSet

from factory.store.columns import Column
from factory.store.schema import FIELDS

PACKAGE = "driving_data"
SIZES = "_sizes"
JPEG = "jpeg"  # member of `images` that stands under topics of its own, one a camera, with Foxglove's schema

TYPES = {  # dtype -> of a field; whole numbers have a fixed width, so that an array of them is a buffer too
    "string": FieldDescriptorProto.TYPE_STRING,
    "binary": FieldDescriptorProto.TYPE_BYTES,
    "bool": FieldDescriptorProto.TYPE_BOOL,
    "int8": FieldDescriptorProto.TYPE_SFIXED32,
    "int32": FieldDescriptorProto.TYPE_SFIXED32,
    "float32": FieldDescriptorProto.TYPE_FLOAT,
    "float64": FieldDescriptorProto.TYPE_DOUBLE,
}


@dataclass(frozen=True)
class Numbered:
    """A column and where it stands in its message."""

    column: Column
    number: int
    sizes: int = 0  # number of the field with the second ragged sizes; 0: there are none


@dataclass(frozen=True)
class Topic:
    """One message of it a sample, none where all of its columns are null and it has one alone."""

    name: str
    message: str  # of PACKAGE
    columns: tuple[Numbered, ...]


def numbered(columns: Sequence[Column]) -> tuple[Numbered, ...]:
    """Columns with the numbers of their fields, in their order."""
    found, number = [], 0
    for column in columns:
        number += 1
        is_ragged = any(isinstance(size, str) for size in column.shape[1:])
        found.append(Numbered(column, number, number + 1 if is_ragged else 0))
        number += is_ragged
    return tuple(found)


def camera_topic(name: str) -> str:
    """Where the pictures of a camera stand."""
    return f"/camera/{name}/image"


def topic_of(column: str) -> str:
    """The topic of a column."""
    if column in ("cameras", "images"):
        return f"/{column}"
    if column.startswith("agent_"):
        return "/agents"
    if column.startswith(("lane_", "drivable_", "crossing_", "light_", "map_", "route_")):
        return "/map"
    if column.startswith(("stage1_", "stage2_")):
        return "/scores"
    if column in ("label_subscores", "label_progress"):
        return "/labels"
    if column.startswith(("ego_", "label_10hz", "label_2hz", "proposal_", "perturbed_", "parent_")):
        return "/ego"
    return "/sample"


def _topics() -> Mapping[str, Topic]:
    columns: dict[str, list[Column]] = {}
    for column in FIELDS:
        columns.setdefault(topic_of(column.name), []).append(column)
    return {
        name: Topic(name, name.strip("/").capitalize(), numbered(members)) for name, members in sorted(columns.items())
    }


def inner(column: Column) -> tuple[Numbered, ...]:
    """The members of a struct column as they stand in its message."""
    return numbered([member for member in column.members if member.name != JPEG])


def descriptor_set(topic: Topic) -> bytes:
    """The types of a topic's message, as an MCAP schema of encoding `protobuf` has them."""
    file = FileDescriptorProto(name=f"{topic.message.lower()}.proto", package=PACKAGE, syntax="proto2")
    _describe(file.message_type.add(name=topic.message), topic.columns)
    return FileDescriptorSet(file=[file]).SerializeToString(deterministic=True)


def described(topic: Topic) -> dict[str, str]:
    """Field -> dtype, shape, unit, frame and what it is, for who reads the file without this project."""
    found = {}
    for at in topic.columns:
        members = [(f"{at.column.name}.{member.name}", member) for member in at.column.members]
        for name, column in ((at.column.name, at.column), *members):
            shape = "x".join(map(str, column.shape))
            words = (f"{column.dtype} {shape}".strip(), column.unit, column.frame, column.about)
            found[name] = "; ".join(word for word in words if word)
    return found


def _describe(message: DescriptorProto, columns: Sequence[Numbered]) -> None:
    for at in columns:
        column = at.column
        is_array = bool(column.shape)
        field = message.field.add(
            name=column.name,
            number=at.number,
            label=FieldDescriptorProto.LABEL_REPEATED if is_array else FieldDescriptorProto.LABEL_OPTIONAL,
        )
        if column.dtype == "struct":
            nested = column.name.removesuffix("s").capitalize()
            field.type, field.type_name = FieldDescriptorProto.TYPE_MESSAGE, f".{PACKAGE}.{message.name}.{nested}"
            _describe(message.nested_type.add(name=nested), inner(column))
        else:
            field.type = TYPES[column.dtype]
            if is_array and column.dtype not in ("string", "binary"):
                field.options.packed = True
        if at.sizes:
            sizes = message.field.add(
                name=f"{column.name}{SIZES}",
                number=at.sizes,
                label=FieldDescriptorProto.LABEL_REPEATED,
                type=FieldDescriptorProto.TYPE_SFIXED32,
            )
            sizes.options.packed = True


TOPICS = _topics()
