import contextlib
import struct
import zlib
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from foxglove_schemas_protobuf.FrameTransform_pb2 import FrameTransform
from foxglove_schemas_protobuf.RawImage_pb2 import RawImage
from google.protobuf.message import Message
from google.protobuf.timestamp_pb2 import Timestamp
from helpers.mcap_bytes import BagWriter, frames, record, write_recording
from hypothesis import given
from hypothesis import strategies as st
from mcap.well_known import MessageEncoding
from mcap.writer import CompressionType, Writer
from mcap_protobuf.schema import register_schema

from vtslam.common.geometry.camera import Camera
from vtslam.services.sensor.sources.base import SourceError
from vtslam.services.sensor.sources.mcap_poses import TransformPoses
from vtslam.services.sensor.sources.registry import open_source
from vtslam.storage.errors import MalformedRecording
from vtslam.storage.recording.mcap_file import McapFile

MAGIC = b"\x89MCAP0\r\n"
HEADER = MAGIC + record(1, bytes(8))
_SCHEMA, _CHANNEL, _MESSAGE, _CHUNK, _INDEX, _END = 3, 4, 5, 6, 7, 15


def chunk(
    data: bytes, *, compression: bytes = b"", size: int | None = None, crc: int | None = None, length: int | None = None
) -> bytes:
    head = struct.pack("<QQQI", 0, 0, len(data) if size is None else size, zlib.crc32(data) if crc is None else crc)
    name = struct.pack("<I", len(compression)) + compression
    return record(_CHUNK, head + name + struct.pack("<Q", len(data) if length is None else length) + data)


def message(channel: int, data: bytes, time_ns: int = 0) -> bytes:
    return record(_MESSAGE, struct.pack("<HIQQ", channel, 0, time_ns, time_ns) + data)


ONE = message(1, b"x")


@pytest.mark.parametrize(
    ("data", "text"),
    [
        (b"", "expected an MCAP file, found one that begins with "),
        (b"#ROSBAG V2.0\n", "expected an MCAP file, found one that begins with 23 52 4f 53"),
        (MAGIC, "expected recorded messages, found no whole chunk"),
        (HEADER + record(_END, bytes(4)), "expected recorded messages, found none"),
        (HEADER + record(_CHUNK, bytes(10)), "expected a chunk of at least 32 bytes, found 10 bytes"),
        (HEADER + chunk(ONE, length=2**60), "not at all, found 1152921504606846976 bytes"),
        (HEADER + chunk(ONE, size=2**50), "expected a chunk of at most 536870912 bytes, found 32 bytes for 1125"),
        (HEADER + chunk(ONE, size=10), "expected a chunk of at most .* found 32 bytes for 10"),
        (HEADER + chunk(ONE, compression=b"xz"), "compressed with lz4, zstd or not at all, found 32 bytes, 'xz'"),
        (HEADER + chunk(ONE, compression=b"zstd"), "expected zstd data, found"),
        (HEADER + chunk(ONE, compression=b"lz4"), "expected lz4 data, found"),
        (HEADER + chunk(ONE, crc=5), "expected checksum 00000005, found"),
        (HEADER + chunk(ONE), "messages: expected a channel 1, which they name, found none"),
        (HEADER + ONE, "messages: expected a channel 1, which they name, found none"),
        (HEADER + chunk(ONE[:-1]), "expected whole records, found one of 23 bytes in 31"),
        (HEADER + chunk(ONE + b"\5"), "expected whole records, found 1 bytes at its end"),
        (HEADER + chunk(message(1, b"")[:9]), "expected whole records, found one of 22 bytes in 9"),
        (HEADER + chunk(record(_MESSAGE, bytes(5))), "expected a message, found 5 bytes"),
        (HEADER + chunk(message(1, b"", 2**63)), "expected a time of less than 2\\*\\*63 ns, found a log time of"),
        (HEADER + chunk(record(_CHANNEL, b"\1\0\0\0\xff\xff\xff\x7f")), "expected a channel record, found"),
        (HEADER + chunk(record(_SCHEMA, b"\1\0\2\0\0\0\xff\xfe")), "expected a schema record, found"),
        (HEADER + record(_INDEX, bytes(6)), "expected a message index after its chunk, found one before any chunk"),
        (
            HEADER + chunk(ONE) + record(_INDEX, struct.pack("<HIQQ", 1, 16, 0, 9999)) + record(_END, bytes(4)),
            "expected messages within their chunk, found one at 9999",
        ),
        (
            HEADER + chunk(ONE) + record(_INDEX, struct.pack("<HIQQ", 1, 16, 2**63, 0)) + record(_END, bytes(4)),
            "expected a time of less than 2\\*\\*63 ns, found a log time of 9223372036854775808 ns",
        ),
        (HEADER + chunk(ONE) + record(_INDEX, b"\1\0\xff\xff\0\0") + record(_END, b""), "message ?index record, found"),
    ],
)
def test_files_that_break_the_format_are_refused(data: bytes, text: str, tmp_path: Path) -> None:
    path = tmp_path / "x.mcap"
    path.write_bytes(data)
    with pytest.raises(SourceError, match=text):
        open_source(f"mcap:{path}")


def test_what_is_no_file_is_refused(tmp_path: Path) -> None:
    for path, text in ((tmp_path / "x", "found No such file"), (tmp_path, "found no regular file")):
        with pytest.raises(SourceError, match=text):
            open_source(f"mcap:{path}")


def test_a_bomb_is_not_unpacked(tmp_path: Path) -> None:
    import lz4.frame
    import zstandard

    for name, packed in (
        (b"zstd", zstandard.ZstdCompressor().compress(bytes(1 << 26))),
        (b"lz4", lz4.frame.compress(bytes(1 << 26))),
    ):
        path = tmp_path / f"{name.decode()}.mcap"
        path.write_bytes(HEADER + chunk(packed, compression=name, size=100))
        with pytest.raises(SourceError, match="expected 100 bytes, found 101 or more"):
            open_source(f"mcap:{path}")


def _bag(change: Callable[[BagWriter], None]) -> BagWriter:
    bag, frame = BagWriter(), frames(1)[0]
    bag.add_frame(frame)
    change(bag)
    return bag


def _odd(color: np.ndarray, encoding: str) -> Callable[[BagWriter], None]:
    return lambda bag: bag.add_image("/odd", color, encoding, frames(1)[0].capture_time_ns)


@pytest.mark.parametrize(
    ("change", "text"),
    [
        (_odd(np.zeros((36, 48, 3), np.uint8), "yuv422"), "expected a colour image .*, found encoding 'yuv422'"),
        (_odd(np.zeros((30, 40, 3), np.uint8), "rgb8"), "expected the size of the intrinsics 48x36, found 40x30"),
        (
            _odd(np.zeros((36, 48), np.uint8), "rgb8"),
            "expected 36 rows of at least 144 bytes, found 1728 bytes in rows",
        ),
        (
            lambda bag: bag.add_compressed("/odd", b"GIF89a", "gif", frames(1)[0].capture_time_ns),
            "expected a PNG or JPEG file, found a file that begins with 47 49",
        ),
    ],
)
def test_odd_images_are_refused_when_read(change: Callable[[BagWriter], None], text: str, tmp_path: Path) -> None:
    path = _bag(change).write(tmp_path / "bag.mcap")
    source = open_source(f"mcap:{path}?color=/odd")
    with pytest.raises(SourceError, match=text):
        source.frame(0)


@pytest.mark.parametrize("stamp", [(-1, 0), (5, 10**9)])
def test_stamps_that_are_no_times_are_refused(stamp: tuple[int, int], tmp_path: Path) -> None:
    bag, frame = BagWriter(use_chunking=False), frames(1)[0]  # without a checksum
    bag.add_frame(frame)
    path = bag.write(tmp_path / "bag.mcap")
    sound = struct.pack("<iI", frame.capture_time_ns // 10**9, frame.capture_time_ns % 10**9)
    path.write_bytes(path.read_bytes().replace(sound, struct.pack("<iI", *stamp)))
    with pytest.raises(SourceError, match=r"/camera/color/image_raw: expected a time stamp, found a time of "):
        open_source(f"mcap:{path}")


def _foxglove(path: Path, messages: dict[str, Message]) -> Path:
    with path.open("wb") as file:
        writer = Writer(file, compression=CompressionType.NONE)
        writer.start("", library="test")
        for topic, content in messages.items():
            channel = writer.register_channel(topic, MessageEncoding.Protobuf, register_schema(writer, type(content)))
            writer.add_message(channel, 1, content.SerializeToString(), 1)
        writer.finish()
    return path


def test_stamps_of_more_than_63_bits_are_refused(tmp_path: Path) -> None:
    late, text = Timestamp(seconds=2**40, nanos=0), "a time of 1099511627776 s and 0 ns"
    image, transform = RawImage(timestamp=late), FrameTransform(timestamp=late, child_frame_id="camera")
    transform.rotation.w = 1.0
    images = _foxglove(tmp_path / "images.mcap", {"/image": image, "/depth": image})
    with pytest.raises(SourceError, match=text):
        open_source(f"mcap:{images}")
    transforms = McapFile(_foxglove(tmp_path / "transforms.mcap", {"/tf": transform}))
    with pytest.raises(MalformedRecording, match=text):
        TransformPoses(transforms, "/tf", "camera", None)


@pytest.mark.parametrize(
    ("options", "text"),
    [
        ({"tolerance_ms": "-1"}, "option tolerance_ms: expected a positive number, found '-1'"),
        ({"stamp": "wall"}, "option stamp: expected one of header, log, found 'wall'"),
        ({"distortion": "maybe"}, "option distortion: expected one of refuse, ignore, found 'maybe'"),
        ({"camera": "/x"}, "option camera: expected a topic with intrinsics /camera/color/camera_info, found '/x'"),
        ({"gamma": "1"}, "expected options among .*; found 'gamma'"),
    ],
)
def test_odd_options_are_refused(options: dict[str, str], text: str, tmp_path: Path) -> None:
    path = _bag(lambda bag: None).write(tmp_path / "bag.mcap")
    with pytest.raises(SourceError, match=text):
        open_source(f"mcap:{path}", overrides=options)


@pytest.mark.parametrize("option", ["depth_scale=500", "tolerance_ms=3", "stamp=log"])
def test_options_that_this_program_records_are_refused_of_its_recordings(option: str, tmp_path: Path) -> None:
    path = write_recording(tmp_path / "x.mcap", frames(2))
    name = option.partition("=")[0]
    with pytest.raises(SourceError, match=f"x.mcap: option {name}: expected for recordings of others, found one of"):
        open_source(f"mcap:{path}?{option}")


def test_bags_without_intrinsics_or_with_odd_ones_are_refused(tmp_path: Path) -> None:
    frame = frames(1)[0]
    for fx, width, text in (
        (0.0, 48, "expected a topic of intrinsics"),
        (-1.0, 48, "expected intrinsics, found not a camera"),
        (40.0, 10**6, "expected images of 1 to 16384 pixels, found 1000000x36"),
    ):
        bag = BagWriter()
        if fx:
            odd = Camera(width=width, height=36, fx=abs(fx), fy=42.0, cx=24.25, cy=18.125)
            object.__setattr__(odd, "fx", fx)
            bag.add_calibration("/info", odd, 0)
        bag.add_image("/image", frame.rgb, "rgb8", frame.capture_time_ns)
        bag.add_image("/depth", frame.depth, "16UC1", frame.capture_time_ns)
        with pytest.raises(SourceError, match=text):
            open_source(f"mcap:{bag.write(tmp_path / 'bag.mcap')}")


@pytest.fixture(scope="module")
def sound(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, bytes]:
    path = write_recording(tmp_path_factory.mktemp("damaged") / "x.mcap", frames(2, priors=True))
    return path, path.read_bytes()


@given(st.data())
def test_damage_is_refused_or_harmless(sound: tuple[Path, bytes], data: st.DataObject) -> None:
    path, whole = sound
    at = data.draw(st.integers(0, len(whole) - 1))
    damaged = bytearray(whole)
    damaged[at] ^= data.draw(st.integers(1, 255))
    target = path.with_name("damaged.mcap")
    target.write_bytes(damaged)
    found = []
    with contextlib.suppress(SourceError):
        source = open_source(f"mcap:{target}")
        found = [source.frame(index) for index in range(len(source))]
    for frame, expected in zip(found, frames(2), strict=False):
        np.testing.assert_array_equal(frame.rgb, expected.rgb)
        np.testing.assert_array_equal(frame.depth, expected.depth)
