"""The stream of live clouds: its bytes, its faults, and the newest frame first."""

import io
import struct
import threading

import numpy as np
import pytest

from caper_jax.data.live import LiveFrame, Newest, pack_frame, read_frames
from caper_jax.errors import CaperError

POINTS = np.array([[0.25, -0.5, 1.0], [0.0, 2.0, 3.0]])


class Dribble(io.BytesIO):
    """A pipe that never gives more than 5 bytes at a time."""

    def read(self, size=-1):
        return super().read(min(size, 5))


def test_bytes_are_those_of_the_specification():
    expected = b"CAPR" + struct.pack("<III", 1, 2, 7) + struct.pack("<6f", *POINTS.ravel())
    assert pack_frame(POINTS, 7) == expected
    assert pack_frame(POINTS, 2**32 + 7) == expected
    assert pack_frame(np.zeros((0, 3))) == b"CAPR" + struct.pack("<III", 1, 0, 0)


def test_frames_come_back_from_pieces():
    content = pack_frame(POINTS, 3) + pack_frame(np.zeros((0, 3)), 4) + pack_frame(POINTS + 1, 9)
    frames = list(read_frames(Dribble(content)))
    assert [frame.sequence for frame in frames] == [3, 4, 9]
    np.testing.assert_array_equal(frames[0].points, POINTS)
    assert frames[1].points.shape == (0, 3)
    np.testing.assert_array_equal(frames[2].points, POINTS + 1)
    assert all(frame.points.dtype == np.float32 for frame in frames)
    assert list(read_frames(io.BytesIO())) == []


def test_gravity_is_version_2():
    header = struct.pack("<III", 2, 2, 7) + struct.pack("<3f", 0, 1, 0.5)
    expected = b"CAPR" + header + struct.pack("<6f", *POINTS.ravel())
    packed = pack_frame(POINTS, 7, gravity=[0, 1, 0.5])
    assert packed == expected
    empty = pack_frame(np.zeros((0, 3)), 8, gravity=np.zeros(3))
    with_gravity, none, without = read_frames(Dribble(packed + empty + pack_frame(POINTS, 9)))
    np.testing.assert_array_equal(with_gravity.points, POINTS)
    np.testing.assert_array_equal(with_gravity.gravity, [0, 1, 0.5])
    assert none.points.shape == (0, 3) and not none.gravity.any()
    assert without.gravity is None
    with pytest.raises(CaperError, match=r"gravity must be \[3\]"):
        pack_frame(POINTS, gravity=[0, 1])
    with pytest.raises(CaperError, match="ends inside frame 0"):
        list(read_frames(io.BytesIO(packed[:30])))


GOOD = pack_frame(POINTS)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"RPAC" + GOOD[4:], r"frame 1 of the stream begins with b'RPAC'"),
        (b"CAPR" + struct.pack("<III", 3, 0, 0), "frame 1 of the stream has version 3"),
        (b"CAPR" + struct.pack("<III", 1, 2**31, 0), "frame 1 of the stream claims 2147483648"),
        (GOOD[:7], "ends inside frame 1, after 7"),
        (GOOD[:16], "ends inside frame 1"),
        (GOOD[:30], "ends inside frame 1, after 14"),
    ],
)
def test_damage_names_its_frame_and_what_came_before_is_kept(content, message):
    frames = read_frames(io.BytesIO(GOOD + content))
    np.testing.assert_array_equal(next(frames).points, POINTS)
    with pytest.raises(CaperError, match=message):
        next(frames)


def test_a_connection_that_breaks_is_named():
    class Reset(io.BytesIO):
        def read(self, size=-1):
            if self.tell() == len(GOOD):
                raise ConnectionResetError(104, "Connection reset by peer")
            return super().read(size)

    frames = read_frames(Reset(GOOD))
    next(frames)
    with pytest.raises(CaperError, match="broke at frame 1: Connection reset by peer"):
        next(frames)


@pytest.mark.parametrize("points", [np.zeros(3), np.zeros((4, 2)), np.zeros((2**22 + 1, 3))])
def test_no_frame_is_made_of_other_arrays(points):
    with pytest.raises(CaperError):
        pack_frame(points)


def test_the_newest_frame_is_taken_and_the_others_are_counted():
    taken, fed = threading.Event(), threading.Event()

    def source():
        yield LiveFrame(0, POINTS)
        taken.wait(10)
        for number in range(1, 5):
            yield LiveFrame(number, POINTS)
        fed.set()
        raise CaperError("the stream broke")

    frames = iter(Newest(source()))
    assert next(frames).sequence == 0
    taken.set()
    assert fed.wait(10)
    last = next(frames)
    assert (last.sequence, last.skipped) == (4, 3)
    with pytest.raises(CaperError, match="the stream broke"):
        next(frames)


def test_a_slow_source_loses_nothing():
    asked = threading.Semaphore(0)

    def source():
        for number in range(3):
            asked.acquire(timeout=10)
            yield LiveFrame(number, POINTS)

    frames = iter(Newest(source()))
    for number in range(3):
        asked.release()
        frame = next(frames)
        assert (frame.sequence, frame.skipped) == (number, 0)
    assert next(frames, None) is None
