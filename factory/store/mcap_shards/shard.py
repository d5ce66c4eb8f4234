"""An MCAP shard: the samples of one Parquet shard, row group by row group, a chunk for each of their topics.

A sample is one message of each topic (factory.store.mcap_shards.topics) and one for each of its pictures under the
camera's topic, with Foxglove's CompressedImage. All have the sample's place in the shard as `sequence`. So that one may
be found by time, and a player shows one after the other, the sample at place i has its now at 10 i + 2 s of the file;
the time of the log stands as publish_time. Chunks hold one topic of one row group: who wants few topics reads few.

Metadata `row_groups` holds the rows of each group and the bytes that its columns take in the Parquet shard, by which
the loader plans what it reads: its batches are the same from either.
"""

import io
import zlib
from collections.abc import Collection, Iterator, Mapping, Sequence

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from google.protobuf.timestamp_pb2 import Timestamp
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.records import Channel, Chunk, ChunkIndex, Footer, Message, Metadata, MetadataIndex
from mcap.stream_reader import MAGIC_SIZE, StreamReader, breakup_chunk
from mcap.well_known import MessageEncoding, SchemaEncoding
from mcap.writer import CompressionType, Writer
from mcap_protobuf.schema import register_schema

from factory.store.mcap_shards.rows import array_of, fields_of
from factory.store.mcap_shards.topics import JPEG, PACKAGE, TOPICS, camera_topic, described, descriptor_set, topic_of
from factory.store.mcap_shards.wire import Fields, parse
from tasks.sealed import sealed_json, unsealed_json
from tasks.world.arrays import Ints

LIBRARY = "driving-data-factory"
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

    def _chunk(self, group: int, topic: str) -> list[Message]:
        """The messages of a topic in a row group, in their order; none where there is no chunk."""
        place = self.index.chunks.get((group, topic))
        if place is None:
            return []
        chunk = Chunk.read(_content(_bytes_at(self._file, place.chunk_start_offset, place.chunk_length)))
        return [record for record in breakup_chunk(chunk, validate_crc=True) if isinstance(record, Message)]


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
