"""Clouds as a stream of bytes, for pipes and sockets.

A stream is a sequence of frames and nothing else; every frame is a header of 16 or 28 bytes and its
points. All numbers are little-endian::

    offset  type         content
    0       4 bytes      magic, the letters CAPR
    4       uint32       version of this format, 1, or 2 with gravity
    8       uint32       N, number of points; 0 for a frame that does not show the object
    12      uint32       sequence, a number that the sender gives the frame
    16      float32 * 3  version 2 only: the way things fall, camera frame; zeros where unknown
    16, 28  float32 * 3N x, y, z of every point: meters, camera frame (OpenCV)

The stream may end after any whole frame.

Example:
  stream.write(pack_frame(points, sequence))     # the sender
  for frame in read_frames(stream): ...          # the receiver
"""

from __future__ import annotations

import struct
import threading
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from typing import BinaryIO

import numpy as np

from caper_jax.errors import CaperError

MAGIC = b"CAPR"
VERSION, WITH_GRAVITY = 1, 2
MAX_POINTS = 1 << 22  # more than any depth camera has pixels: 50 MB
_HEADER = struct.Struct("<4sIII")


@dataclass(frozen=True)
class LiveFrame:
    """One frame of a stream.

    Attributes:
      sequence: the number that its sender gave it.
      points: [N, 3] float32 meters, camera frame; N may be 0.
      skipped: frames that came since the last one and were passed over.
      gravity: [3] float32, the way things fall in the camera's frame; None without.
    """

    sequence: int
    points: np.ndarray
    skipped: int = 0
    gravity: np.ndarray | None = None


def pack_frame(points: np.ndarray, sequence: int = 0, gravity: np.ndarray | None = None) -> bytes:
    """The bytes of one frame.

    Args:
      points: [N, 3] meters, camera frame; N may be 0.
      sequence: 0 or more; counts modulo 2^32.
      gravity: [3] the way things fall in the camera's frame, of any length; zeros where it is
        unknown. A stream has it in every frame or in none.

    Raises:
      CaperError: points or gravity of another shape, or too many points.
    """
    points = np.asarray(points)
    if points.ndim != 2 or points.shape[1] != 3:
        raise CaperError(f"points must be [N, 3], got {points.shape}")
    if len(points) > MAX_POINTS:
        raise CaperError(f"a frame takes {MAX_POINTS} points at most, got {len(points)}")
    version = VERSION if gravity is None else WITH_GRAVITY
    header = _HEADER.pack(MAGIC, version, len(points), sequence % (1 << 32))
    if gravity is not None:
        down = np.asarray(gravity, "<f4")
        if down.shape != (3,):
            raise CaperError(f"gravity must be [3], got {down.shape}")
        header += down.tobytes()
    return header + points.astype("<f4").tobytes()


def read_frames(stream: BinaryIO) -> Iterator[LiveFrame]:
    """The frames of a stream, one by one as they arrive, until it ends.

    Args:
      stream: binary; ``read(n)`` may give fewer bytes.

    Raises:
      CaperError: the stream breaks off inside a frame, or holds something else.
    """
    number = 0
    while header := _read(stream, _HEADER.size, f"frame {number}"):
        magic, version, count, sequence = _HEADER.unpack(header)
        if magic != MAGIC:
            raise CaperError(
                f"frame {number} of the stream begins with {magic!r}, not {MAGIC!r}: this is no "
                "stream of frames, or bytes were lost"
            )
        if version not in (VERSION, WITH_GRAVITY):
            raise CaperError(
                f"frame {number} of the stream has version {version}, this program reads {VERSION} "
                f"and {WITH_GRAVITY}"
            )
        if count > MAX_POINTS:
            raise CaperError(
                f"frame {number} of the stream claims {count} points, more than {MAX_POINTS}: "
                "the stream is damaged"
            )
        rows = count + (version == WITH_GRAVITY)
        content = _read(stream, 12 * rows, f"frame {number}")
        if len(content) < 12 * rows:
            raise CaperError(f"the stream ends inside frame {number}, before its points")
        numbers = np.frombuffer(content, "<f4").reshape(rows, 3).astype(np.float32)
        points, gravity = numbers[rows - count :], numbers[0] if rows > count else None
        yield LiveFrame(sequence, points, gravity=gravity)
        number += 1


def _read(stream: BinaryIO, size: int, where: str) -> bytes:
    """``size`` bytes, or none where the stream ends.

    Raises:
      CaperError: it ends, or breaks, in between.
    """
    content = bytearray()
    while len(content) < size:
        try:
            piece = stream.read(size - len(content))
        except OSError as error:
            raise CaperError(f"the stream broke at {where}: {error.strerror or error}") from error
        if not piece:
            if not content:
                return b""
            raise CaperError(f"the stream ends inside {where}, after {len(content)} of its bytes")
        content += piece
    return bytes(content)


class Newest:
    """Iterates over a source that is faster than its user: always the newest frame.

    A thread reads the source, so that nothing piles up in buffers. What the source raises is
    raised here, after the frames that came before.
    """

    def __init__(self, source: Iterable[LiveFrame]) -> None:
        """Begins to read at once."""
        self._changed = threading.Condition()
        self._frame: LiveFrame | None = None
        self._skipped = 0
        self._ended = False
        self._error: Exception | None = None
        threading.Thread(target=self._fill, args=(source,), daemon=True).start()

    def __iter__(self) -> Iterator[LiveFrame]:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._frame is not None or self._ended)
                frame, self._frame = self._frame, None
                skipped, self._skipped = self._skipped, 0
            if frame is None:
                if self._error is not None:
                    raise self._error
                return
            yield replace(frame, skipped=skipped)

    def _fill(self, source: Iterable[LiveFrame]) -> None:
        try:
            for frame in source:
                with self._changed:
                    self._skipped += self._frame is not None
                    self._frame = frame
                    self._changed.notify()
        except Exception as error:
            self._error = error
        with self._changed:
            self._ended = True
            self._changed.notify()
