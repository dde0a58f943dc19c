"""The part of ``caper track`` that follows a live stream."""

from __future__ import annotations

import socket
import sys
import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress

import jax
import numpy as np

from caper_jax.data.live import LiveFrame, Newest, read_frames
from caper_jax.errors import CaperError
from caper_jax.evaluation.records import frame_record, json_line
from caper_jax.tracker import Tracker

_CONNECT_S = 10.0


@contextmanager
def open_stream(source: str) -> Iterator[Iterable[LiveFrame]]:
    """Frames of standard input, every one, or of a TCP server, the newest.

    Args:
      source: "-", or HOST:PORT to connect to.

    Raises:
      CaperError: a terminal instead of a pipe, no address, or nobody who listens there.
    """
    if source == "-":
        if sys.stdin.isatty():
            raise CaperError(
                "--live - reads binary frames from standard input, and that is a terminal; pipe "
                "frames into it, or give HOST:PORT"
            )
        yield read_frames(sys.stdin.buffer)
        return
    host, _, port = source.rpartition(":")
    if not host or not port.isdecimal() or not 0 < int(port) < 1 << 16:
        raise CaperError(f"--live {source}: give HOST:PORT, e.g. localhost:5000, or -")
    try:
        connection = socket.create_connection((host.strip("[]"), int(port)), _CONNECT_S)
    except OSError as error:
        raise CaperError(
            f"--live {source}: cannot connect ({error.strerror or error}); start the sender first"
        ) from error
    with connection, connection.makefile("rb") as stream:
        connection.settimeout(None)  # a camera may pause
        try:
            yield Newest(read_frames(stream))
        finally:
            # Its thread may wait for a frame, and nobody can close what is being read.
            with suppress(OSError):
                connection.shutdown(socket.SHUT_RDWR)


def track_stream(tracker: Tracker, frames: Iterable[LiveFrame]) -> None:
    """Prints one JSON object per frame until the stream ends, then a summary to standard error.

    Args:
      tracker: is reset.
      frames: e.g. from ``open_stream``.

    Raises:
      CaperError: a broken stream, or points that cannot be meters.
    """
    tracker(np.zeros((0, 3), np.float32))  # compiles
    tracker.reset()
    skipped, lost, seconds = 0, 0, []
    try:
        for frame in frames:
            began = time.perf_counter()
            try:
                result = jax.block_until_ready(tracker(frame.points))
            except CaperError as error:
                raise CaperError(f"frame {frame.sequence}: {error}") from error
            seconds.append(time.perf_counter() - began)
            record = frame_record(frame.sequence, result, tracker.estimator.category, seconds[-1])
            print(json_line({**record, "skipped": frame.skipped}), flush=True)
            skipped += frame.skipped
            lost += record["lost"]
    finally:
        speed = f", {1000 * np.median(seconds):.1f} ms per frame (median)" if seconds else ""
        print(
            f"{len(seconds)} frames tracked, lost in {lost}; {skipped} skipped{speed}",
            file=sys.stderr,
        )
