"""MCAP: episodes, one sample each for people to look at in Foxglove, Lichtblick or Rerun, and the table `samples_mcap`.

Both are chunked, zstd-compressed, with CRCs and an index, as those tools want it; their bytes depend on samples alone.
"""

import hashlib
import io
import json
import math
import re
import time
import zlib
from collections import deque
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from google.protobuf.descriptor_pb2 import DescriptorProto, FieldDescriptorProto, FileDescriptorProto, FileDescriptorSet
from google.protobuf.timestamp_pb2 import Timestamp
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.records import Channel, Chunk, ChunkIndex, Footer, Metadata, MetadataIndex
from mcap.records import Message as McapMessage
from mcap.stream_reader import MAGIC_SIZE, StreamReader, breakup_chunk
from mcap.well_known import MessageEncoding, SchemaEncoding
from mcap.writer import CompressionType, Writer
from mcap_protobuf.schema import register_schema
from numpy.typing import NDArray

from factory.store.location import Location, Shard, naming, open_parquet, with_partition
from factory.store.schema import FIELDS, SAMPLES, SCHEMA, Column, TableSpec
from factory.store.table import KeyedTable
from tasks.sealed import sealed_json, unsealed_json
from tasks.world.arrays import Ints

FOLDER = "episodes"  # beside the table, of those that a run writes
LIBRARY = "driving-data-factory"
CHUNK_BYTES = 1 << 20
DATA_END = b"\x0f" + (4).to_bytes(8, "little")  # opcode and length; the checksum of everything before follows
DATA_END_BYTES = len(DATA_END) + 4


@dataclass(frozen=True)
class Message:
    """What stands under a topic at a time; a mapping is to be written as JSON."""

    topic: str
    time_ns: int
    content: Any  # a message of protobuf, or a mapping


def is_chosen(attempt_id: str, every: int) -> bool:
    """One sample in `every`, by its id alone; 1: all, 0: none."""
    return every > 0 and zlib.crc32(attempt_id.encode()) % every == 0


def episode_name(row: Mapping[str, Any]) -> str:
    """The file of a sample's row, by its attempt_id, settings_hash and stage_versions."""
    made_under = hashlib.sha256(f"{row['settings_hash']}\x1f{row['stage_versions']}".encode()).hexdigest()[:8]
    return f"{row['attempt_id']}-{made_under}.mcap"


def episode_bytes(messages: Sequence[Message], metadata: Mapping[str, str]) -> bytes:
    """An MCAP file of messages, in their order; metadata stands under the name `sample`."""
    stream = io.BytesIO()
    writer = Writer(stream, chunk_size=CHUNK_BYTES, compression=CompressionType.ZSTD, enable_data_crcs=True)
    writer.start(library=LIBRARY)
    writer.add_metadata("sample", dict(metadata))
    channels: dict[str, int] = {}
    for sequence, message in enumerate(messages):
        if message.topic not in channels:
            channels[message.topic] = _channel(writer, message)
        is_json = isinstance(message.content, Mapping)
        data = json.dumps(message.content, sort_keys=True).encode() if is_json else message.content.SerializeToString()
        writer.add_message(channels[message.topic], message.time_ns, data, message.time_ns, sequence)
    writer.finish()
    return stream.getvalue()


def check_episode(data: bytes) -> None:
    """Hold an MCAP file against its two checksums, of all but its last bytes (mcap.dev/spec, Data End and Footer).

    Raises ValueError, with the reason, where it is not whole.
    """
    try:
        last = deque(StreamReader(io.BytesIO(data)).records, maxlen=1)[0]
    except Exception as error:  # whatever damaged records, or a broken zstd frame, raise
        raise ValueError(str(error) or type(error).__name__) from error
    if not isinstance(last, Footer) or not DATA_END_BYTES < last.summary_start < len(data):
        raise ValueError("it ends before its footer")
    content, summary = data[: last.summary_start - DATA_END_BYTES], data[last.summary_start : -MAGIC_SIZE - 4]
    data_end = data[len(content) : last.summary_start]
    if not data_end.startswith(DATA_END):
        raise ValueError("its data do not end where they should")
    if zlib.crc32(content) != int.from_bytes(data_end[-4:], "little") or zlib.crc32(summary) != last.summary_crc:
        raise ValueError("its checksum is another")


def _channel(writer: Writer, message: Message) -> int:
    if isinstance(message.content, Mapping):
        name = message.topic.strip("/").capitalize()
        schema = writer.register_schema(name, SchemaEncoding.JSONSchema, json.dumps({"type": "object"}).encode())
        return writer.register_channel(message.topic, MessageEncoding.JSON, schema)
    schema = register_schema(writer, type(message.content))
    return writer.register_channel(message.topic, MessageEncoding.Protobuf, schema)


# Protobuf's wire format, as far as the topics need it (protobuf.dev/programming-guides/encoding).
#
# Written here so that a packed array goes from and to a buffer at once: protobuf's runtime hands out a Python object
# for every number, some 10,000 of a sample. Tests hold what is written against that runtime.

VARINT, FIXED64, LENGTH, FIXED32 = 0, 1, 2, 5
WIDTHS = {FIXED64: 8, FIXED32: 4}

Fields = dict[int, list[memoryview]]  # number -> what stands under it, in order


def varint(value: int) -> bytes:
    """Seven bits a byte, the lowest first."""
    out = bytearray()
    while value > 0x7F:
        out.append(value & 0x7F | 0x80)
        value >>= 7
    out.append(value)
    return bytes(out)


def fixed(number: int, data: bytes) -> bytes:
    """A field of 4 or 8 bytes."""
    return varint(number << 3 | (FIXED64 if len(data) == 8 else FIXED32)) + data


def delimited(number: int, data: bytes) -> bytes:
    """A text, bytes, an array without gaps or a message."""
    return varint(number << 3 | LENGTH) + varint(len(data)) + data


def repeated(number: int, items: Iterable[bytes]) -> bytes:
    """Several of them under one number."""
    return b"".join(delimited(number, item) for item in items)


def parse(message: bytes | memoryview) -> Fields:
    """The fields of a message, nothing copied. Raises ValueError where it is none."""
    data, at, found = memoryview(message), 0, Fields()
    while at < len(data):
        key, at = _varint(data, at)
        kind = key & 7
        if kind == LENGTH:
            length, at = _varint(data, at)
        elif kind in WIDTHS:
            length = WIDTHS[kind]
        else:
            raise ValueError(f"a field of wire type {kind}, which no topic has")
        if at + length > len(data):
            raise ValueError("a field ends behind its message")
        found.setdefault(key >> 3, []).append(data[at : at + length])
        at += length
    return found


def _varint(data: Sequence[int] | memoryview, at: int) -> tuple[int, int]:
    value = shift = 0
    while True:
        if at >= len(data) or shift > 63:
            raise ValueError("a number that does not end")
        byte = data[at]
        value |= (byte & 0x7F) << shift
        at += 1
        if byte < 0x80:
            return value, at
        shift += 7


# Which columns of a sample stand under which topic of an MCAP shard, and the protobuf types that say so.
#
# Both follow from the schema: a column is a field of its topic's message, under its own name, and its numbers are laid
# out row by row; where a shape has a second ragged size, `<column>_sizes` says it of each entry. A field that is
# missing is null, or an array without entries. The types are proto2, where every value can be missing.

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


# Columns of Arrow to the fields of messages and back, a row group at a time, every bit of every number kept.
#
# Arrays are plain lists, as Parquet's own types have them: `list<list<float>>` for (40, 3).

WIRE = {"bool": "u1", "int8": "<i4", "int32": "<i4", "float32": "<f4", "float64": "<f8"}  # as arrays lie in a message
SIZE = "<i4"


def fields_of(at: Numbered, array: pa.Array) -> list[bytes]:
    """Of each row the fields of a column; nothing where it is null or has no entries."""
    column = at.column
    if column.dtype == "struct":
        offsets = array.offsets.to_numpy()
        parts = [fields_of(member, array.values.field(member.column.name)) for member in inner(column)]
        entries = [b"".join(part) for part in zip(*parts)]
        return [repeated(at.number, entries[a:b]) for a, b in pairwise(offsets)]
    if column.dtype in ("string", "binary"):
        return [repeated(at.number, map(_bytes, _items(value, column))) for value in array.to_pylist()]
    if not column.shape:
        values = array.fill_null(0).to_numpy(zero_copy_only=False).astype(WIRE[column.dtype])
        return [fixed(at.number, value.tobytes()) if there else b"" for value, there in zip(values, array.is_valid())]
    return _arrays(at, array)


def array_of(
    at: Numbered,
    messages: Sequence[Fields | None],
    members: Collection[str] = (),
    beside: Mapping[str, pa.Array] | None = None,
) -> pa.Array:
    """The opposite: one value a message. None: it has none, and the value is null.

    members: of a struct's, those that are wanted; beside: members whose values of all entries stand elsewhere.
    Raises ValueError where the lengths of fields do not fit the column.
    """
    column = at.column
    found = [[] if message is None else message.get(at.number, []) for message in messages]
    there = (
        np.array([message is not None for message in messages])
        if column.dtype == "struct"
        else np.array([bool(items) for items in found])
    )
    nulls = ~there if column.nullable else np.zeros(len(found), bool)
    if column.dtype == "struct":
        entries = [parse(item) for items in found for item in items]
        numbers = {member.column.name: member for member in inner(column)}
        arrays = {name: array_of(member, entries) for name, member in numbers.items() if name in members}
        arrays |= beside or {}
        names = [member.name for member in column.members if member.name in arrays]
        values = pa.StructArray.from_arrays([arrays[name] for name in names], names)
        return _listed(values, [len(items) for items in found], nulls)
    if column.dtype in ("string", "binary"):
        plain = [[_value(item, column) for item in items] for items in found]
        if column.shape:
            kind = column.arrow_type.value_type
            return _listed(pa.array([v for row in plain for v in row], kind), [len(row) for row in plain], nulls)
        return pa.array([row[0] if row else None for row in plain], column.arrow_type)
    return _numbers(at, messages, found, nulls)


def _numbers(
    at: Numbered, messages: Sequence[Fields | None], found: Sequence[Sequence[memoryview]], nulls: NDArray[np.bool_]
) -> pa.Array:
    column = at.column
    wire = np.dtype(WIRE[column.dtype])
    flat = np.frombuffer(b"".join(item for items in found for item in items[:1]), wire).astype(column.dtype)
    if not column.shape:
        values = np.zeros(len(found), column.dtype)
        values[[bool(items) for items in found]] = flat
        return pa.array(values, mask=nulls)
    counts = [len(items[0]) // wire.itemsize if items else 0 for items in found]
    values = pa.array(flat)
    fixed_sizes = [int(size) for size in column.shape[2 if at.sizes else 1 :]]
    for size in reversed(fixed_sizes):
        values = _listed(values, np.full(len(values) // size, size), None)
    if not at.sizes:
        each = math.prod(fixed_sizes)
        if any(count % each for count in counts):
            raise ValueError(f"{column.name}: numbers that are no multiple of {each}")
        return _listed(values, [count // each for count in counts], nulls)
    sizes = [
        np.frombuffer(message[at.sizes][0], SIZE) if message is not None and at.sizes in message else np.zeros(0, SIZE)
        for message in messages
    ]
    values = _listed(values, np.concatenate([np.zeros(0, SIZE), *sizes]), None)
    return _listed(values, [len(size) for size in sizes], nulls)


def _listed(values: pa.Array, lengths: Sequence[int] | Ints, nulls: NDArray[np.bool_] | None) -> pa.Array:
    offsets = np.concatenate([[0], np.cumsum(lengths)]).astype(np.int32)
    if offsets[-1] != len(values):
        raise ValueError(f"{len(values)} entries where {offsets[-1]} are told")
    mask = None if nulls is None or not nulls.any() else pa.array(nulls)
    return pa.ListArray.from_arrays(pa.array(offsets), values, mask=mask)


def _arrays(at: Numbered, array: pa.Array) -> list[bytes]:
    """Fields of numbers in the order of their rows, and with them the sizes where a second one is ragged."""
    bounds, sizes, sized = np.arange(len(array) + 1), np.zeros(0, SIZE), np.zeros(len(array) + 1, np.int64)
    for depth in range(len(at.column.shape)):
        offsets = array.offsets.to_numpy()
        if depth == 1 and at.sizes:
            sizes, sized = np.diff(offsets).astype(SIZE), bounds
        bounds, array = offsets[bounds], array.values
    values = array.to_numpy(zero_copy_only=False).astype(WIRE[at.column.dtype])
    found = []
    for row in range(len(bounds) - 1):
        numbers = values[bounds[row] : bounds[row + 1]]
        lengths = sizes[sized[row] : sized[row + 1]]
        field = delimited(at.number, numbers.tobytes()) if len(numbers) else b""
        found.append(field + (delimited(at.sizes, lengths.tobytes()) if len(lengths) else b""))
    return found


def _items(value: object, column: Column) -> Sequence[str | bytes]:
    if value is None:
        return ()
    return value if column.shape else (value,)  # type: ignore[return-value]


def _bytes(value: str | bytes) -> bytes:
    return value.encode() if isinstance(value, str) else value


def _value(item: memoryview, column: Column) -> str | bytes:
    return str(item, "utf-8") if column.dtype == "string" else bytes(item)


# An MCAP shard: the samples of one Parquet shard, row group by row group, a chunk for each of their topics.
#
# A sample is one message of each topic (TOPICS) and one for each of its pictures under the camera's topic, with
# Foxglove's CompressedImage. All have the sample's place in the shard as `sequence`. So that one may be found by time,
# and a player shows one after the other, the sample at place i has its now at 10 i + 2 s of the file; the time of the
# log stands as publish_time. Chunks hold one topic of one row group: who wants few topics reads few.
#
# Metadata `row_groups` holds the rows of each group and the bytes that its columns take in the Parquet shard, by which
# the loader plans what it reads: its batches are the same from either.

ROW_GROUPS = "row_groups"  # name of the metadata
SLOT_NS, NOW_NS = 10_000_000_000, 2_000_000_000
NS = 1e9
FOOTER_BYTES = 9 + 20 + MAGIC_SIZE
RECORD_BYTES = 9  # opcode and length before a record's content
LARGE_BYTES = 2**40  # more than any chunk is to hold before it is closed
IMAGE_DATA = 2  # field of CompressedImage


def shard_bytes(file: pq.ParquetFile) -> bytes:
    """An MCAP file of all that a Parquet shard holds."""
    stream = io.BytesIO()
    writer = Writer(stream, chunk_size=LARGE_BYTES, compression=CompressionType.ZSTD, enable_data_crcs=True)
    writer.start(library=LIBRARY)
    writer.add_metadata(ROW_GROUPS, _layout(file))
    channels: dict[str, int] = {}
    for name, topic in TOPICS.items():
        schema = writer.register_schema(f"{PACKAGE}.{topic.message}", SchemaEncoding.Protobuf, descriptor_set(topic))
        channels[name] = writer.register_channel(name, MessageEncoding.Protobuf, schema, described(topic))
    image_schema = register_schema(writer, CompressedImage)
    first = 0
    for group in range(file.metadata.num_row_groups):
        rows = file.read_row_group(group)
        times = [int(NS * (a + b)) for a, b in zip(rows["clip_start_s"].to_pylist(), rows["now_s"].to_pylist())]
        for name, topic in TOPICS.items():
            arrays = [(at, rows[at.column.name].combine_chunks()) for at in topic.columns]
            parts = [fields_of(at, array) for at, array in arrays]
            alone = arrays[0][1].is_valid().to_pylist() if len(arrays) == 1 else [True] * rows.num_rows
            for i in (i for i in range(rows.num_rows) if alone[i]):
                at_ns = (first + i) * SLOT_NS + NOW_NS
                writer.add_message(channels[name], at_ns, b"".join(p[i] for p in parts), times[i], first + i)
            writer.flush()
        for camera, pictures in sorted(_pictures(rows).items()):
            name = camera_topic(camera)
            if name not in channels:
                channels[name] = writer.register_channel(name, MessageEncoding.Protobuf, image_schema)
            for i, time_s, jpeg in pictures:
                at_ns, shift_ns = (first + i) * SLOT_NS + NOW_NS, round(NS * time_s)
                image = CompressedImage(timestamp=_stamp(at_ns + shift_ns), frame_id=camera, data=jpeg, format="jpeg")
                data = image.SerializeToString(deterministic=True)
                writer.add_message(channels[name], at_ns + shift_ns, data, max(0, times[i] + shift_ns), first + i)
            writer.flush()
        first += rows.num_rows
    writer.finish()
    return stream.getvalue()


class ShardIndex:
    """What stands where in one shard."""

    def __init__(self, file: pa.NativeFile) -> None:
        """Raises ValueError for what is no MCAP shard or is damaged."""
        try:
            self._read(file)
        except Exception as error:  # whatever damaged records, or a broken zstd frame, raise
            raise ValueError(f"no MCAP shard: {type(error).__name__}: {error}") from error

    def _read(self, file: pa.NativeFile) -> None:
        size = file.size()
        footer = Footer.read(_content(_bytes_at(file, max(0, size - FOOTER_BYTES), FOOTER_BYTES)))
        summary = _bytes_at(file, footer.summary_start, max(0, size - footer.summary_start))
        if zlib.crc32(summary[: -MAGIC_SIZE - 4]) != footer.summary_crc:
            raise McapError("the checksum of its summary is another")
        records = list(StreamReader(io.BytesIO(summary), skip_magic=True).records)
        (place,) = [r for r in records if isinstance(r, MetadataIndex) and r.name == ROW_GROUPS]
        metadata = Metadata.read(_content(_bytes_at(file, place.offset, place.length))).metadata
        layout = unsealed_json(metadata["layout"].encode())
        self.serialized_size = len(summary) + place.length  # as of a footer of Parquet
        self.rows: Ints = np.array(layout["rows"], np.int64)  # (groups,)
        self.leaf_bytes: dict[str, list[int]] = layout["bytes"]  # leaf of the Parquet shard -> of each group
        starts = np.concatenate([[0], np.cumsum(self.rows)])
        self.first: list[int] = starts[:-1].tolist()  # place of each group's first sample
        topics = {record.id: record.topic for record in records if isinstance(record, Channel)}
        self.chunks: dict[tuple[int, str], ChunkIndex] = {}
        for chunk in (record for record in records if isinstance(record, ChunkIndex)):
            group = int(np.searchsorted(starts, chunk.message_end_time // SLOT_NS, side="right")) - 1
            for channel in chunk.message_index_offsets:
                self.chunks[group, topics[channel]] = chunk


class McapShard:
    """One shard, opened for reading; its chunks are held against their checksums."""

    def __init__(self, file: pa.NativeFile, index: ShardIndex | None = None) -> None:
        """file: seekable, such as of pyarrow's file systems; index: of this file, where it is known already.

        Raises ValueError for what is no MCAP shard or is damaged, here or when a row group is read.
        """
        self._file = file
        self.index = index if index is not None else ShardIndex(file)

    @property
    def rows(self) -> Ints:
        """(groups,) of each row group."""
        return self.index.rows

    @property
    def leaves(self) -> Mapping[str, Sequence[int]]:
        """Path of each of Parquet's leaves, and the bytes that it takes there in each row group."""
        return self.index.leaf_bytes

    def read_row_group(self, group: int, leaves: Collection[str]) -> pa.Table:
        """Leaves of Parquet's columns, in the order of the schema; of a struct the members among them."""
        try:
            return self._read(group, leaves)
        except Exception as error:  # whatever damaged records, or a broken zstd frame, raise
            raise ValueError(f"row group {group}: {type(error).__name__}: {error}") from error

    def read(self, leaves: Collection[str]) -> pa.Table:
        """Of all row groups."""
        return pa.concat_tables([self.read_row_group(group, leaves) for group in range(len(self.rows))])

    def _read(self, group: int, leaves: Collection[str]) -> pa.Table:
        wanted: dict[str, set[str]] = {}  # column -> members
        for leaf in leaves:
            column, _, below = leaf.partition(".")
            wanted.setdefault(column, set()).add(below.removeprefix("list.element.").split(".")[0])
        n, messages, found = int(self.rows[group]), dict[str, list[Fields | None]](), {}
        for topic in TOPICS.values():
            for at in (at for at in topic.columns if at.column.name in wanted):
                name = at.column.name
                if topic.name not in messages:
                    messages[topic.name] = self._messages(group, topic.name, n)
                beside = None
                if name == "images" and JPEG in wanted[name]:
                    beside = {JPEG: pa.array(self._jpegs(group, messages[topic.name]), pa.binary())}
                found[name] = array_of(at, messages[topic.name], wanted[name], beside)
        order = [name for name in dict.fromkeys(leaf.partition(".")[0] for leaf in self.leaves) if name in found]
        return pa.table([found[name] for name in order], names=order)

    def _messages(self, group: int, topic: str, n: int) -> list[Fields | None]:
        """Of each row its message."""
        found: list[Fields | None] = [None] * n
        for message in self._chunk(group, topic):
            found[message.sequence - self.index.first[group]] = parse(message.data)
        return found

    def _jpegs(self, group: int, messages: Sequence[Fields | None]) -> list[bytes]:
        """Of all entries of `images`, in their order."""
        (at,) = TOPICS[topic_of("images")].columns
        cameras = array_of(at, messages, {"camera"}).to_pylist()
        of_camera: dict[tuple[str, int], Iterator[bytes]] = {}
        for topic in {camera_topic(entry["camera"]) for row in cameras for entry in row or ()}:
            pictures: dict[int, list[bytes]] = {}
            for message in self._chunk(group, topic):
                pictures.setdefault(message.sequence - self.index.first[group], []).append(message.data)
            of_camera |= {(topic, row): iter(images) for row, images in pictures.items()}
        return [
            bytes(parse(next(of_camera[camera_topic(entry["camera"]), row]))[IMAGE_DATA][0])
            for row, entries in enumerate(cameras)
            for entry in entries or ()
        ]

    def _chunk(self, group: int, topic: str) -> list[McapMessage]:
        """The messages of a topic in a row group, in their order; none where there is no chunk."""
        place = self.index.chunks.get((group, topic))
        if place is None:
            return []
        chunk = Chunk.read(_content(_bytes_at(self._file, place.chunk_start_offset, place.chunk_length)))
        return [record for record in breakup_chunk(chunk, validate_crc=True) if isinstance(record, McapMessage)]


def _bytes_at(file: pa.NativeFile, offset: int, length: int) -> bytes:
    if not 0 <= offset <= file.size() - length:
        raise McapError(f"it ends within the {length} bytes at {offset}")
    return bytes(file.read_at(length, offset))


def _content(record: bytes) -> ReadDataStream:
    return ReadDataStream(io.BytesIO(record[RECORD_BYTES:]))


def _layout(file: pq.ParquetFile) -> dict[str, str]:
    groups = [file.metadata.row_group(group) for group in range(file.metadata.num_row_groups)]
    sizes: dict[str, list[int]] = {
        file.metadata.schema.column(i).path: [group.column(i).total_uncompressed_size for group in groups]
        for i in range(file.metadata.num_columns)
    }
    layout = {"rows": [group.num_rows for group in groups], "bytes": sizes}
    return {"layout": sealed_json(layout)}


def _pictures(rows: pa.Table) -> dict[str, list[tuple[int, float, bytes]]]:
    """Camera -> row, time relative to now [s] and JPEG of each of its pictures, row by row in their order."""
    found: dict[str, list[tuple[int, float, bytes]]] = {}
    for row, images in enumerate(rows["images"].to_pylist()):
        for image in images or ():
            found.setdefault(image["camera"], []).append((row, image["time_s"], image[JPEG]))
    return found


def _stamp(at_ns: int) -> Timestamp:
    return Timestamp(seconds=at_ns // 1_000_000_000, nanos=at_ns % 1_000_000_000)


# The table `samples_mcap`: for every shard of the table `samples` one MCAP shard with the same samples.
#
# It is a table of its own, with a log as the others have: what the log does not name never happened, and a run claims
# it. A shard is named `part-<digest of its Parquet shard>-<its own>.mcap`. So what is missing and what is out of date
# can be read from two logs, a shard that is made twice is the same file, and no sample stands in two shards that are
# named.

SAMPLES_MCAP = TableSpec("samples_mcap", SCHEMA, "attempt_id", SAMPLES.partition_by, SAMPLES.properties)
NAMED = re.compile(r"(.*part-[0-9a-f]{32})-([0-9a-f]{32})\.mcap")


class McapTable(KeyedTable):
    """The table `samples_mcap`; it reads MCAP where others read Parquet."""

    def __init__(self, out: Location) -> None:
        """out: the store."""
        super().__init__(out.child(SAMPLES_MCAP.name), SAMPLES_MCAP)

    def read_file(self, path: str, partition: Mapping[str, str], columns: Sequence[str] | None = None) -> pa.Table:
        schema = self.schema_of(columns)
        with naming(f"{self.location.uri}/{path}"):
            shard = open_shard(self.location, path)
            stored = shard.read([leaf for leaf in shard.leaves if leaf.partition(".")[0] in schema.names])
            return with_partition(stored, schema, partition)

    def behind(self, samples: KeyedTable) -> dict[str, Mapping[str, str]]:
        """Path and partition of the shards of `samples` that have none here."""
        have = {source_of(path) for path in self.live_files()}
        return {path: partition for path, partition in samples.live_files().items() if path not in have}

    def outdated(self, samples: KeyedTable) -> list[str]:
        """Shards of what is no shard of `samples` any more."""
        live = samples.live_files()
        return [path for path in self.live_files() if source_of(path) not in live]

    def keep_up(self, samples: KeyedTable, written: Sequence[Shard] = ()) -> None:
        """Take in what was written of shards that still are, and out what is outdated, in one transaction.

        Raises AnotherWriter.
        """
        behind, drop, now_ms = self.behind(samples), self.outdated(samples), int(time.time() * 1000)
        add = [(shard, now_ms) for shard in written if source_of(shard.path) in behind]
        if add or drop:
            self.replace_files(drop, add)


def source_of(path: str) -> str:
    """The Parquet shard of an MCAP shard, relative to its table. Raises ValueError for another name."""
    named = NAMED.fullmatch(path)
    if named is None:
        raise ValueError(f"{path}: not the name of an MCAP shard")
    return f"{named[1]}.parquet"


def open_shard(table: Location, path: str) -> McapShard:
    """Raises ValueError where it is no MCAP shard, or damaged."""
    filesystem, base = table.filesystem()
    return McapShard(filesystem.open_input_file(f"{base}/{path}"))


def write_mcap_shard(out: Location, path: str, partition: Mapping[str, str]) -> Shard:
    """The MCAP shard of a committed Parquet shard, to be committed. Idempotent. Raises OSError."""
    samples = out.child(SAMPLES.name)
    with naming(f"{samples.uri}/{path}"):
        parquet = open_parquet(samples, path)
        data = shard_bytes(parquet)
        keys = tuple(parquet.read(columns=[SAMPLES_MCAP.key])[SAMPLES_MCAP.key].to_pylist())
    name = f"{path.removesuffix('.parquet')}-{hashlib.sha256(data).hexdigest()[:32]}.mcap"
    out.child(SAMPLES_MCAP.name).write(name, data)
    return Shard(name, len(data), partition, keys)
