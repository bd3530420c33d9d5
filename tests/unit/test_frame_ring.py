from pathlib import Path

import numpy as np
import pytest
from helpers.shm_sections import frame_bytes, frame_of, frame_with_prior_of

from vtslam.common.shm._atomics import Words
from vtslam.common.shm.blocks import ControlPage, Kind, open_file
from vtslam.common.shm.errors import (
    DamagedBlock,
    FrameGone,
    NoFreePin,
    RingFull,
    SharedMemoryError,
    StaleWriter,
    WriterAlive,
)
from vtslam.common.shm.frame_ring import FrameRingReader, FrameRingWriter
from vtslam.common.shm.process_identity import PID_BITS, own_identity
from vtslam.common.shm.ring_layout import FrameDescriptor, RingSpec

_SPEC = RingSpec(width=16, height=12, slots=4, pins=2)


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "ring"


@pytest.fixture
def writer(path: Path) -> FrameRingWriter:
    return FrameRingWriter.create(path, _SPEC)


def _control(path: Path) -> ControlPage:
    return ControlPage.open(path, open_file(path, writable=True), Kind.RING)


def test_what_dead_writers_reserved_and_never_finished_is_given_back(
    path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("vtslam.common.shm.frame_ring.is_alive", lambda identity: identity == 0x7A)
    stay = {".new-7a-ring", ".new-owner", ".new-7b-another", "other"}
    for name in (*stay, ".new-7b-ring"):
        (path.parent / name).write_bytes(b"reserved")
    FrameRingWriter.create(path, _SPEC)
    assert {each.name for each in path.parent.iterdir()} == stay | {"ring"}


def test_a_frame_comes_out_as_it_went_in_and_cannot_be_changed(path: Path, writer: FrameRingWriter) -> None:
    reader = FrameRingReader(path)
    assert reader.newest() is None
    descriptor = writer.publish_newest(frame_of(7))
    assert reader.newest() == descriptor
    assert frame_bytes(reader.copied(descriptor)) == frame_bytes(frame_of(7))
    with reader.using(descriptor) as frame:
        assert frame_bytes(frame) == frame_bytes(frame_of(7))
        for image in (frame.rgb, frame.depth):
            with pytest.raises(ValueError, match="read-only"):
                image[0, 0] = 1
            with pytest.raises(ValueError, match="cannot set WRITEABLE"):
                image.flags.writeable = True


def test_a_prior_comes_out_as_it_went_in_and_does_not_stay_for_the_next_frame(
    path: Path, writer: FrameRingWriter
) -> None:
    reader = FrameRingReader(path)
    for number in range(1, 8):  # more than there are slots
        frame = frame_with_prior_of(number)
        descriptor = writer.publish_newest(frame)
        assert (reader.copied(descriptor).pose_prior is None) == (frame.pose_prior is None) == (number % 3 == 0)
        assert frame_bytes(reader.copied(descriptor)) == frame_bytes(frame)


def test_waiting_stops_at_the_credit_and_goes_on_after_an_acknowledgement(writer: FrameRingWriter) -> None:
    assert writer.try_publish(frame_of(1), credit=2) is not None
    assert writer.try_publish(frame_of(2), credit=2) is not None
    assert writer.try_publish(frame_of(3), credit=2) is None
    with pytest.raises(RingFull, match="frames 1 to 2 were not acknowledged"):
        writer.publish_waiting(frame_of(3), credit=2, timeout_s=0.0)
    assert [d.sequence for d in writer.unacknowledged()] == [1, 2]
    writer.acknowledge(1)
    assert writer.publish_waiting(frame_of(3), credit=2, timeout_s=0.0).sequence == 3
    writer.acknowledge(3)
    writer.acknowledge(2)
    assert (writer.acknowledged, writer.lost) == (3, 0)
    with pytest.raises(ValueError, match="frame 4 was never published"):
        writer.acknowledge(4)
    with pytest.raises(ValueError, match="expected a credit of 1 to 2, got 3"):
        writer.try_publish(frame_of(4), credit=3)


def test_newest_overwrites_the_oldest_and_counts(path: Path, writer: FrameRingWriter) -> None:
    reader = FrameRingReader(path)
    descriptors = [writer.publish_newest(frame_of(n)) for n in range(1, 5)]
    writer.acknowledge(1)
    assert writer.publish_newest(frame_of(5)).slot == descriptors[0].slot
    assert writer.lost == 0
    assert writer.publish_newest(frame_of(6)).slot == descriptors[1].slot
    assert writer.lost == 1
    for gone in descriptors[:2]:
        with pytest.raises(FrameGone):
            reader.copied(gone)
        with pytest.raises(FrameGone):
            reader.pinned(gone)
    assert frame_bytes(reader.copied(descriptors[2])) == frame_bytes(frame_of(3))


def test_pinned_frames_stay_whatever_is_published(path: Path, writer: FrameRingWriter) -> None:
    reader = FrameRingReader(path)
    held = [reader.pinned(writer.publish_newest(frame_of(n))) for n in (1, 2)]
    with pytest.raises(NoFreePin, match="all 2 pins are held"):
        reader.pinned(writer.publish_newest(frame_of(3)))
    for n in range(4, 20):
        writer.publish_newest(frame_of(n))
    assert [frame_bytes(h.frame) for h in held] == [frame_bytes(frame_of(n)) for n in (1, 2)]
    for h in held:
        h.release()
        h.release()
    newest = reader.newest()
    assert newest is not None
    reader.pinned(newest).release()


def test_a_descriptor_that_names_nothing_is_gone(path: Path, writer: FrameRingWriter) -> None:
    reader = FrameRingReader(path)
    writer.publish_newest(frame_of(1))
    for slot, sequence in ((4, 1), (-1, 1), (0, 0), (0, 2), (0, 2**40)):
        with pytest.raises(FrameGone):
            reader.copied(FrameDescriptor(slot=slot, sequence=sequence))
        with pytest.raises(FrameGone):
            reader.pinned(FrameDescriptor(slot=slot, sequence=sequence))


def test_pins_of_a_reused_pid_are_reaped(path: Path, writer: FrameRingWriter) -> None:
    reader, pins = FrameRingReader(path), _control(path).pins
    descriptor = writer.publish_newest(frame_of(1))
    held = [reader.pinned(descriptor), reader.pinned(descriptor)]
    # As if an earlier process of the same pid had taken the first.
    words = Words(np.memmap(path, np.uint64, "r+", 0, (512,)))
    assert words.compare_exchange(held[0].pin.entry, own_identity(), own_identity() + (1 << PID_BITS))
    assert len(pins.holder_pids()) == 2
    reader.pinned(descriptor).release()
    assert len(pins.holder_pids()) == 1


def test_a_former_writer_is_refused(path: Path, writer: FrameRingWriter) -> None:
    writer.publish_newest(frame_of(1))
    taker = FrameRingWriter.adopt(path)
    with pytest.raises(StaleWriter, match="epoch 2"):
        writer.publish_newest(frame_of(2))
    assert taker.publish_newest(frame_of(2)).sequence == 2


def test_a_living_writer_is_not_taken_over(path: Path, writer: FrameRingWriter) -> None:
    words = Words(np.memmap(path, np.uint64, "r+", 0, (512,)))
    first = int(Path("/proc/1/stat").read_text().rpartition(")")[2].split()[19])
    words.store(4, 1 | first << PID_BITS)
    with pytest.raises(WriterAlive, match="still written by process 1"):
        FrameRingWriter.adopt(path)


@pytest.mark.parametrize("offset", [0, 8, 16, 24, 1024])
def test_a_damaged_control_page_is_refused(path: Path, writer: FrameRingWriter, offset: int) -> None:
    with open(path, "r+b") as file:
        file.seek(offset)
        file.write(b"\x77")
    with pytest.raises(DamagedBlock):
        FrameRingReader(path)


def test_no_ring_and_a_cut_one_are_refused(path: Path) -> None:
    with pytest.raises(SharedMemoryError, match="expected a frame ring, found nothing"):
        FrameRingReader(path)
    path.write_bytes(b"VTSLSHM1")
    with pytest.raises(DamagedBlock, match="expected at least"):
        FrameRingReader(path)


@pytest.mark.parametrize("sizes", [{"slots": 2, "pins": 2}, {"slots": 300}, {"pins": 25, "slots": 40}, {"pins": 0}])
def test_impossible_rings_are_refused(sizes: dict[str, int]) -> None:
    with pytest.raises(ValueError, match="more slots than pins"):
        RingSpec(width=4, height=4, **sizes)


def test_atomic_words() -> None:
    array = np.zeros(4, np.uint64)
    words = Words(array)
    words.store(2, 2**64 - 1)
    assert words.fetch_add(2, 2) == 2**64 - 1
    assert words.load(2) == 1 == array[2]
    assert not words.compare_exchange(2, 5, 6)
    assert words.compare_exchange(2, 1, 6)
    assert len(words) == 4
    with pytest.raises(IndexError):
        words.load(4)
    with pytest.raises(ValueError, match="aligned"):
        Words(np.zeros(33, np.uint8)[1:].view(np.uint64))


def test_a_ring_may_begin_after_frames_that_are_done_with(path: Path) -> None:
    FrameRingWriter.create(path, _SPEC, acknowledged=7)
    reader = FrameRingReader(path)
    assert (reader.published, reader.acknowledged, reader.unacknowledged()) == (7, 7, [])
    reader.acknowledge(7)
    writer = FrameRingWriter.adopt(path)
    assert [writer.try_publish(frame_of(i), credit=2) is None for i in range(3)] == [False, False, True]
    assert [each.sequence for each in reader.unacknowledged()] == [8, 9]
    assert frame_bytes(reader.copied(reader.unacknowledged()[0])) == frame_bytes(frame_of(0))
    assert reader.lost == 0
