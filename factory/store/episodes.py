"""Episodes: MCAP files of one sample each, for people to look at in Foxglove, Lichtblick or Rerun.

Chunked, zstd-compressed, with CRCs and an index, as those tools want it; their bytes depend on samples alone. MCAP and
Protobuf are loaded where an episode is written or checked: every run names episodes, most write none.
"""

import hashlib
import io
import zlib
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from google.protobuf.message import Message as Content

EPISODES_FOLDER = "episodes"  # beside the table, of those that a run writes
LIBRARY = "driving-data-factory"
CHUNK_BYTES = 1 << 20
DATA_END = b"\x0f" + (4).to_bytes(8, "little")  # opcode and length; the checksum of everything before follows
DATA_END_BYTES = len(DATA_END) + 4


@dataclass(frozen=True)
class Message:
    """What stands under a topic at a time."""

    topic: str
    time_ns: int
    content: "Content"


def wants_episode(attempt_id: str, every: int) -> bool:
    """One sample in `every`, by its id alone; 1: all, 0: none."""
    return every > 0 and zlib.crc32(attempt_id.encode()) % every == 0


def episode_name(row: Mapping[str, Any]) -> str:
    """The file of a sample's row, by its attempt_id, settings_hash and stage_versions."""
    made_under = hashlib.sha256(f"{row['settings_hash']}\x1f{row['stage_versions']}".encode()).hexdigest()[:8]
    return f"{row['attempt_id']}-{made_under}.mcap"


def episode_bytes(messages: Sequence[Message], metadata: Mapping[str, str]) -> bytes:
    """An MCAP file of messages, in their order; metadata stands under the name `sample`."""
    from mcap.well_known import MessageEncoding
    from mcap.writer import CompressionType, Writer
    from mcap_protobuf.schema import register_schema

    stream = io.BytesIO()
    writer = Writer(stream, chunk_size=CHUNK_BYTES, compression=CompressionType.ZSTD, enable_data_crcs=True)
    writer.start(library=LIBRARY)
    writer.add_metadata("sample", dict(metadata))
    channels: dict[str, int] = {}
    for sequence, message in enumerate(messages):
        if message.topic not in channels:
            schema = register_schema(writer, type(message.content))
            channels[message.topic] = writer.register_channel(message.topic, MessageEncoding.Protobuf, schema)
        data = message.content.SerializeToString()
        writer.add_message(channels[message.topic], message.time_ns, data, message.time_ns, sequence)
    writer.finish()
    return stream.getvalue()


def check_episode(data: bytes) -> None:
    """Hold an MCAP file against its two checksums, of all but its last bytes (mcap.dev/spec, Data End and Footer).

    Raises ValueError, with the reason, where it is not whole.
    """
    from mcap.records import Footer
    from mcap.stream_reader import MAGIC_SIZE, StreamReader

    try:
        last = deque(StreamReader(io.BytesIO(data), emit_chunks=True).records, maxlen=1)[0]  # none is unpacked
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
