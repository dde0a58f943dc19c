"""Clouds as a stream of bytes, for pipes and sockets.

A stream is a sequence of frames and nothing else; every frame is a header of 16 bytes and its
points. All numbers are little-endian::

    offset  type         content
    0       4 bytes      magic, the letters CAPR
    4       uint32       version of this format, 1
    8       uint32       N, number of points; 0 for a frame that does not show the object
    12      uint32       sequence, a number that the sender gives the frame
    16      float32 * 3N x, y, z of every point: meters, camera frame (OpenCV)

The stream may end after any whole frame.

Example:
  stream.write(pack_frame(points, sequence))     # the sender
  for frame in read_frames(stream): ...          # the receiver
"""

from __future__ import annotations

import struct
import threading
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import BinaryIO

import numpy as np

from caper_jax.errors import CaperError

MAGIC = b"CAPR"
VERSION = 1
MAX_POINTS = 1 << 22  # more than any depth camera has pixels: 50 MB
_HEADER = struct.Struct("<4sIII")


@dataclass(frozen=True)
class LiveFrame:
    """One frame of a stream.

    Attributes:
      sequence: the number that its sender gave it.
      points: [N, 3] float32 meters, camera frame; N may be 0.
      skipped: frames that came since the last one and were passed over.
    """

    sequence: int
    points: np.ndarray
    skipped: int = 0


def pack_frame(points: np.ndarray, sequence: int = 0) -> bytes:
    """The bytes of one frame.

    Args:
      points: [N, 3] meters, camera frame; N may be 0.
      sequence: 0 or more; counts modulo 2^32.

    Raises:
      CaperError: points of another shape, or too many.
    """
    points = np.asarray(points)
    if points.ndim != 2 or points.shape[1] != 3:
        raise CaperError(f"points must be [N, 3], got {points.shape}")
    if len(points) > MAX_POINTS:
        raise CaperError(f"a frame takes {MAX_POINTS} points at most, got {len(points)}")
    header = _HEADER.pack(MAGIC, VERSION, len(points), sequence % (1 << 32))
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
        if version != VERSION:
            raise CaperError(
                f"frame {number} of the stream has version {version}, this program reads {VERSION}"
            )
        if count > MAX_POINTS:
            raise CaperError(
                f"frame {number} of the stream claims {count} points, more than {MAX_POINTS}: "
                "the stream is damaged"
            )
        size = 12 * count
        content = _read(stream, size, f"frame {number}")
        if len(content) < size:
            raise CaperError(f"the stream ends inside frame {number}, before its points")
        points = np.frombuffer(content, "<f4").reshape(count, 3).astype(np.float32)
        yield LiveFrame(sequence, points)
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
            yield LiveFrame(frame.sequence, frame.points, skipped)

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
