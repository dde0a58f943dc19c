"""Files that appear whole or not at all."""

from __future__ import annotations

import os
from pathlib import Path

from caper_jax.errors import CaperError


def write_atomically(path: Path, content: bytes) -> None:
    """Write a file so that a kill at any moment leaves the old one or the new one.

    Raises:
      CaperError: it cannot be written, e.g. as the disk is full.
    """
    temporary = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        try:
            with open(temporary, "wb") as file:
                file.write(content)
                file.flush()
                os.fsync(file.fileno())
            os.replace(temporary, path)
        finally:
            temporary.unlink(missing_ok=True)
    except OSError as error:
        raise CaperError(f"{path}: cannot be written ({error.strerror or error})") from error
