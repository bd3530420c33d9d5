"""Finds and reads the messages of an MCAP file, whole or cut; nothing is trusted before its size was checked.

The file is walked once from its start, from record to record, passing over what is in chunks that have a message index.
So a file that lost its end (a process killed, a disk that was full) reads like any other, up to its last whole chunk.
"""

import os
import stat
import struct
import weakref
import zlib
from array import array
from collections import OrderedDict
from collections.abc import Iterator
from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path
from typing import NamedTuple, TypeVar

import lz4.frame
import numpy as np
import numpy.typing as npt
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel, MessageIndex, Schema

from vtslam.storage.errors import BadMagic, ChecksumMismatch, MalformedRecording, UnreadableFile

MAGIC = b"\x89MCAP0\r\n"
MAX_RECORD_BYTES = 1 << 29  # of a chunk, compressed or not, and of any other record that is read
_CACHED_CHUNKS = 4
_RECORD_HEAD = struct.Struct("<BQ")
_CHUNK_HEAD = struct.Struct("<QQQII")  # start, end, uncompressed size, its CRC-32, length of the compression's name
_MESSAGE_HEAD = struct.Struct("<HIQQ")  # channel, sequence, log time, publish time
_TOP_LEVEL = -1  # in place of a chunk's number: the message lies in the file itself
_END_OF_DATA = (Opcode.DATA_END, Opcode.FOOTER)

R = TypeVar("R", Schema, Channel, MessageIndex)


class StoredMessage(NamedTuple):
    """A message as it lies in the file."""

    log_time_ns: int
    sequence: int
    data: bytes


@dataclass(frozen=True, slots=True)
class _ChunkPlace:
    offset: int  # of its compressed records in the file
    length: int
    size: int  # uncompressed
    crc: int
    compression: str


@dataclass(slots=True, eq=False)
class Topic:
    """The messages of one topic in the order of their log time.

    Attributes:
        name: The topic.
        channel: Its first channel: encoding and metadata.
        schema: The kind of its messages; None if the file does not say.
        places: int64 [M,3]: log time (ns), number of the chunk (-1 for none), offset there.
    """

    name: str
    channel: Channel
    schema: Schema | None
    places: npt.NDArray[np.int64]

    def __len__(self) -> int:
        """Number of messages."""
        return len(self.places)


@dataclass(slots=True)
class _Found:
    """What the walk through the file has found."""

    schemas: dict[int, Schema] = field(default_factory=dict)
    channels: dict[int, Channel] = field(default_factory=dict)
    chunks: list[_ChunkPlace] = field(default_factory=list)
    places: dict[int, "array[int]"] = field(default_factory=dict)  # by channel: time, chunk, offset, time, ...


class McapFile:
    """An MCAP file, open for reading as long as somebody has it.

    Args:
        path: The file.

    Attributes:
        topics: By name.
        is_cut: Whether its end is missing.

    Raises:
        UnreadableFile: There is no such file, or it cannot be read.
        BadMagic: It is of another kind.
        MalformedRecording: A record breaks the format. Missing bytes at the end are no error.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        try:
            self._fd = os.open(path, os.O_RDONLY | os.O_CLOEXEC | os.O_NONBLOCK)
        except OSError as error:
            raise UnreadableFile(f"{path}: expected a readable recording, found {error.strerror}") from error
        weakref.finalize(self, os.close, self._fd)
        status = os.fstat(self._fd)
        if not stat.S_ISREG(status.st_mode):
            raise UnreadableFile(f"{path}: expected a recording, found no regular file")
        self._size = status.st_size
        self._cache: OrderedDict[int, bytes] = OrderedDict()
        self._found = _Found()
        self.is_cut = True
        self._walk()
        self.topics = self._topics()

    def message(self, topic: Topic, index: int) -> StoredMessage:
        """Message ``index`` of a topic.

        Raises:
            ChecksumMismatch, MalformedRecording: The chunk it is in is damaged.
        """
        _, chunk, offset = (int(value) for value in topic.places[index])
        if chunk == _TOP_LEVEL:
            opcode, length = self._record_head(offset)
            return self._message_in(self._bytes(offset + _RECORD_HEAD.size, length), opcode, 0, length, f"at {offset}")
        data, where = self._chunk(chunk), f"in the chunk at {self._found.chunks[chunk].offset}"
        if offset + _RECORD_HEAD.size > len(data):
            raise self._malformed(where, f"a message within {len(data)} bytes", f"one at {offset}")
        opcode, length = _RECORD_HEAD.unpack_from(data, offset)
        return self._message_in(data, opcode, offset + _RECORD_HEAD.size, length, where)

    # --- the walk ---------------------------------------------------------------------------------------------------

    def _walk(self) -> None:
        magic = self._bytes(0, min(len(MAGIC), self._size))
        if magic != MAGIC:
            raise BadMagic(f"{self.path}: expected an MCAP file, found one that begins with {magic.hex(' ')}")
        at, unindexed = len(MAGIC), -1  # a chunk that no index was seen of yet
        while at + _RECORD_HEAD.size <= self._size:
            opcode, length = self._record_head(at)
            start, end = at + _RECORD_HEAD.size, at + _RECORD_HEAD.size + length
            if opcode == 0 or end > self._size:
                break  # cut; zeros are what a power cut leaves
            if unindexed >= 0 and opcode != Opcode.MESSAGE_INDEX:
                self._look_into(unindexed)
                unindexed = -1
            if opcode in _END_OF_DATA:
                self.is_cut = False
                return
            if opcode == Opcode.CHUNK:
                unindexed = self._add_chunk(start, length)
            elif opcode == Opcode.MESSAGE_INDEX:
                unindexed = self._add_index(start, length, unindexed)
            elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL, Opcode.MESSAGE):
                self._add_record(opcode, self._record(start, length), _TOP_LEVEL, at)
            at = end
        if self._found.chunks:
            self._look_into(len(self._found.chunks) - 1)  # of the last chunk's indexes some may be missing

    def _add_chunk(self, start: int, length: int) -> int:
        """Note a chunk; its number."""
        if length < _CHUNK_HEAD.size:
            raise self._malformed(f"at {start}", f"a chunk of at least {_CHUNK_HEAD.size} bytes", f"{length} bytes")
        _, _, size, crc, name_length = _CHUNK_HEAD.unpack(self._bytes(start, _CHUNK_HEAD.size))
        head = _CHUNK_HEAD.size + name_length + 8
        if name_length > 64 or length < head:
            raise self._malformed(f"at {start}", "the head of a chunk", f"{length} bytes, a name of {name_length}")
        name = self._bytes(start + _CHUNK_HEAD.size, name_length).decode("ascii", errors="replace")
        (data_length,) = struct.unpack("<Q", self._bytes(start + head - 8, 8))
        if data_length != length - head or name not in ("", "lz4", "zstd"):
            expected = f"{length - head} bytes, compressed with lz4, zstd or not at all"
            raise self._malformed(f"at {start}", expected, f"{data_length} bytes, {name!r}")
        if max(size, data_length) > MAX_RECORD_BYTES or (not name and size != data_length):
            expected = f"a chunk of at most {MAX_RECORD_BYTES} bytes"
            raise self._malformed(f"at {start}", expected, f"{data_length} bytes for {size}")
        self._found.chunks.append(_ChunkPlace(start + head, data_length, size, crc, name))
        return len(self._found.chunks) - 1

    def _add_index(self, start: int, length: int, unindexed: int) -> int:
        """Take an index of the last chunk; -1 if the chunk need not be looked into for it."""
        chunk = len(self._found.chunks) - 1
        if chunk < 0:
            raise self._malformed(f"at {start}", "a message index after its chunk", "one before any chunk")
        index = self._parsed(MessageIndex, self._record(start, length), f"at {start}")
        if index.channel_id not in self._found.channels:
            self._look_into(chunk, places=False)
        for log_time_ns, offset in index.records:
            if offset >= self._found.chunks[chunk].size:
                raise self._malformed(f"at {start}", "messages within their chunk", f"one at {offset}")
            self._note(index.channel_id, log_time_ns, chunk, offset, where=f"at {start}")
        return -1

    def _look_into(self, chunk: int, *, places: bool = True) -> None:
        """Read a chunk's schemas and channels, and unless the indexes have them, where its messages are."""
        data = self._chunk(chunk)
        if places:
            for channel_places in self._found.places.values():
                while len(channel_places) and channel_places[-2] == chunk:
                    del channel_places[-3:]
        where = f"in the chunk at {self._found.chunks[chunk].offset}"
        for opcode, start, end in self._records_in(data, where):
            if places or opcode != Opcode.MESSAGE:
                self._add_record(opcode, data[start:end], chunk, start - _RECORD_HEAD.size)

    def _add_record(self, opcode: int, content: bytes, chunk: int, offset: int) -> None:
        where = f"at {offset}" if chunk == _TOP_LEVEL else f"in the chunk at {self._found.chunks[chunk].offset}"
        if opcode == Opcode.SCHEMA:
            schema = self._parsed(Schema, content, where)
            self._found.schemas[schema.id] = schema
        elif opcode == Opcode.CHANNEL:
            channel = self._parsed(Channel, content, where)
            self._found.channels[channel.id] = channel
        elif opcode == Opcode.MESSAGE:
            if len(content) < _MESSAGE_HEAD.size:
                raise self._malformed(where, "a message", f"{len(content)} bytes")
            channel_id, _, log_time_ns, _ = _MESSAGE_HEAD.unpack_from(content)
            self._note(channel_id, log_time_ns, chunk, offset, where=where)

    def _note(self, channel_id: int, log_time_ns: int, chunk: int, offset: int, *, where: str) -> None:
        """Keep where a message is."""
        if log_time_ns >= 2**63:
            raise self._malformed(where, "a time of less than 2**63 ns", f"a log time of {log_time_ns} ns")
        self._found.places.setdefault(channel_id, array("q")).extend((log_time_ns, chunk, offset))

    def _topics(self) -> dict[str, Topic]:
        topics: dict[str, Topic] = {}
        for channel_id, flat in self._found.places.items():
            channel = self._found.channels.get(channel_id)
            if channel is None:
                raise self._malformed("messages", f"a channel {channel_id}, which they name", "none")
            places = np.array(flat, np.int64).reshape(-1, 3)
            if channel.topic in topics:
                places = np.concatenate([topics[channel.topic].places, places])
                channel = topics[channel.topic].channel
            order = np.lexsort((places[:, 2], places[:, 1], places[:, 0]))
            schema = self._found.schemas.get(channel.schema_id)
            topics[channel.topic] = Topic(channel.topic, channel, schema, places[order])
        return dict(sorted(topics.items()))

    # --- bytes ------------------------------------------------------------------------------------------------------

    def _chunk(self, number: int) -> bytes:
        """The records of a chunk, uncompressed, with the right checksum."""
        if number in self._cache:
            self._cache.move_to_end(number)
            return self._cache[number]
        place = self._found.chunks[number]
        data = self._uncompressed(place)
        if place.crc not in (0, zlib.crc32(data)):
            raise ChecksumMismatch(
                f"{self.path}: chunk at {place.offset}: expected checksum {place.crc:08x}, found {zlib.crc32(data):08x}"
            )
        self._cache[number] = data
        while len(self._cache) > _CACHED_CHUNKS:
            self._cache.popitem(last=False)
        return data

    def _uncompressed(self, place: _ChunkPlace) -> bytes:
        data = self._bytes(place.offset, place.length)
        if not place.compression:
            return data
        try:
            if place.compression == "zstd":
                data = zstandard.ZstdDecompressor().stream_reader(data).read(place.size + 1)
            else:
                data = lz4.frame.LZ4FrameDecompressor().decompress(data, max_length=place.size + 1)
        except (zstandard.ZstdError, RuntimeError, EOFError) as error:
            raise self._malformed(f"chunk at {place.offset}", f"{place.compression} data", str(error)) from error
        if len(data) != place.size:
            raise self._malformed(f"chunk at {place.offset}", f"{place.size} bytes", f"{len(data)} or more")
        return data

    def _records_in(self, data: bytes, where: str) -> Iterator[tuple[int, int, int]]:
        """The records of a chunk: opcode, start and end of the content."""
        at = 0
        while at < len(data):
            if at + _RECORD_HEAD.size > len(data):
                raise self._malformed(where, "whole records", f"{len(data) - at} bytes at its end")
            opcode, length = _RECORD_HEAD.unpack_from(data, at)
            start, at = at + _RECORD_HEAD.size, at + _RECORD_HEAD.size + length
            if at > len(data):
                raise self._malformed(where, "whole records", f"one of {length} bytes in {len(data)}")
            yield opcode, start, at

    def _message_in(self, data: bytes, opcode: int, start: int, length: int, where: str) -> StoredMessage:
        if opcode != Opcode.MESSAGE or length < _MESSAGE_HEAD.size or start + length > len(data):
            raise self._malformed(where, "a message", f"a record {opcode} of {length} bytes")
        _, sequence, log_time_ns, _ = _MESSAGE_HEAD.unpack_from(data, start)
        return StoredMessage(log_time_ns, sequence, data[start + _MESSAGE_HEAD.size : start + length])

    def _parsed(self, kind: type[R], content: bytes, where: str) -> R:
        try:
            record: R = kind.read(ReadDataStream(BytesIO(content)))
            return record
        except (struct.error, UnicodeDecodeError, McapError) as error:
            raise self._malformed(where, f"a {kind.__name__.lower()} record", str(error) or "its end") from error

    def _record(self, start: int, length: int) -> bytes:
        if length > MAX_RECORD_BYTES:
            raise self._malformed(f"at {start}", f"a record of at most {MAX_RECORD_BYTES} bytes", f"{length} bytes")
        return self._bytes(start, length)

    def _record_head(self, at: int) -> tuple[int, int]:
        opcode, length = _RECORD_HEAD.unpack(self._bytes(at, _RECORD_HEAD.size))
        return opcode, length

    def _bytes(self, at: int, length: int) -> bytes:
        try:
            data = os.pread(self._fd, length, at)
        except OSError as error:
            raise UnreadableFile(f"{self.path}: expected readable data, found {error.strerror}") from error
        if len(data) != length:
            raise self._malformed(f"at {at}", f"{length} bytes", f"{len(data)}: the file has become shorter")
        return data

    def _malformed(self, where: str, expected: str, found: str) -> MalformedRecording:
        return MalformedRecording(f"{self.path}: {where}: expected {expected}, found {found}")
