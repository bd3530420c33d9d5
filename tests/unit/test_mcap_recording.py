from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.mcap_bytes import frames, write_recording
from helpers.recordings import camera_path
from mcap.reader import make_reader
from mcap.records import Chunk, Message
from mcap.stream_reader import StreamReader, breakup_chunk
from mcap_protobuf.decoder import DecoderFactory

from vtslam.common.frame import Frame
from vtslam.services.sensor.sources.registry import open_source
from vtslam.storage.errors import WriteFailed
from vtslam.storage.recording import topics
from vtslam.storage.recording import writer as writer_module
from vtslam.storage.recording.mcap_file import McapFile
from vtslam.storage.recording.writer import ColorFormat


def assert_same(found: Frame, expected: Frame, *, lossless: bool = True) -> None:
    if lossless:
        np.testing.assert_array_equal(found.rgb, expected.rgb)
    np.testing.assert_array_equal(found.depth, expected.depth)
    assert (found.frame_id, found.capture_time_ns) == (expected.frame_id, expected.capture_time_ns)
    assert (found.camera, found.depth_scale_m) == (expected.camera, expected.depth_scale_m)
    assert (found.pose_prior is None) == (expected.pose_prior is None)
    if found.pose_prior is not None and expected.pose_prior is not None:
        np.testing.assert_array_equal(found.pose_prior.T_world_camera, expected.pose_prior.T_world_camera)
        np.testing.assert_array_equal(found.pose_prior.covariance, expected.pose_prior.covariance)


@pytest.mark.parametrize("priors", [False, True])
def test_what_was_recorded_plays_bit_by_bit(priors: bool, tmp_path: Path) -> None:
    recorded = frames(5, priors=priors)
    source = open_source(f"mcap:{write_recording(tmp_path / 'x.mcap', recorded)}")
    assert (len(source), source.family) == (5, "tum")
    assert not McapFile(tmp_path / "x.mcap").is_cut
    for index in (3, 0, 4, 1, 2):
        assert_same(source.frame(index), recorded[index])
    again = open_source(open_source(source.uri, frames=(2, 4)).uri)
    assert again.frame(0).capture_time_ns == recorded[2].capture_time_ns
    with pytest.raises(IndexError):
        source.frame(5)


def test_jpeg_keeps_depth_and_about_the_colour(tmp_path: Path) -> None:
    recorded = frames(2)
    path = write_recording(tmp_path / "x.mcap", recorded, color=ColorFormat(name="jpeg", jpeg_quality=90))
    frame = open_source(f"mcap:{path}").frame(1)
    assert_same(frame, recorded[1], lossless=False)
    assert np.abs(frame.rgb.astype(int) - recorded[1].rgb).mean() < 4.0


def test_a_stranger_reads_it(tmp_path: Path) -> None:
    recorded = frames(3)
    path = write_recording(tmp_path / "x.mcap", recorded)
    seen: dict[str, list[tuple[Message, Any]]] = {}
    with path.open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        summary = reader.get_summary()
        for schema, channel, message, decoded in reader.iter_decoded_messages():
            assert schema is not None
            assert schema.name.startswith("foxglove.")
            seen.setdefault(channel.topic, []).append((message, decoded))
    assert summary is not None
    assert summary.statistics is not None
    assert summary.statistics.message_count == sum(map(len, seen.values())) == 3 * 5 + 1
    assert {len(seen[topic]) for topic in (topics.COLOR, topics.DEPTH, topics.CALIBRATION, topics.TRANSFORMS)} == {3}
    message, image = seen[topics.COLOR][2]
    assert image.timestamp.ToNanoseconds() == message.log_time == recorded[2].capture_time_ns
    assert image.data.startswith(b"\x89PNG")
    _, transform = seen[topics.TRANSFORMS][2]
    t = transform.translation
    np.testing.assert_array_equal([t.x, t.y, t.z], camera_path(3)[2][:3, 3])
    _, event = seen[topics.EVENTS][0]
    assert (event.name, event.message) == ("mapper", "section 0")


def test_an_earlier_recording_is_kept(tmp_path: Path) -> None:
    path = write_recording(tmp_path / "x.mcap", frames(1))
    with pytest.raises(WriteFailed, match="expected no such file yet"):
        write_recording(path, frames(1))
    with pytest.raises(WriteFailed, match="cannot write: No such file"):
        write_recording(tmp_path / "nowhere" / "x.mcap", frames(1))
    assert len(open_source(f"mcap:{path}")) == 1


def test_a_cut_recording_plays_up_to_its_last_whole_chunk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(writer_module, "CHUNK_BYTES", 12_000)  # a few frames
    recorded = frames(20)
    path = write_recording(tmp_path / "x.mcap", recorded)
    data, whole = path.read_bytes(), open_source(f"mcap:{path}")
    ends = _ends_of_chunks(data)
    assert len(ends) > 4
    lengths = []
    for length in [*range(ends[0][0], len(data), 997), *(end for end, _ in ends)]:
        path.write_bytes(data[:length])
        source = open_source(f"mcap:{path}")
        expected = max(number for end, number in ends if end <= length)
        assert len(source) == expected
        assert_same(source.frame(len(source) - 1), recorded[len(source) - 1])
        lengths.append(len(source))
    assert max(lengths) == len(whole) == 20


def _ends_of_chunks(data: bytes) -> list[tuple[int, int]]:
    """Where chunks end in the file, and how many frames lie before."""
    stream, found, messages = BytesIO(data), [], 0
    for record in StreamReader(stream, emit_chunks=True).records:
        if isinstance(record, Chunk):
            messages += sum(isinstance(each, Message) and each.channel_id == 2 for each in breakup_chunk(record))
            found.append((stream.tell(), messages))
    return found
