"""Writing a figure to a file."""

from __future__ import annotations

import io
from pathlib import Path
from typing import TYPE_CHECKING, Any

from caper_jax.errors import CaperError
from caper_jax.files import write_atomically

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def save_figure(figure: Figure, path: str | Path, **options: Any) -> Path:
    """Writes a figure as PNG or whatever the path's ending names; makes the folder.

    Args:
      options: as ``Figure.savefig`` takes them.

    Raises:
      CaperError: the file cannot be written, or no such format is known.
    """
    path = Path(path)
    buffer = io.BytesIO()
    try:
        figure.savefig(buffer, format=path.suffix[1:] or "png", **options)
        path.parent.mkdir(parents=True, exist_ok=True)
    except ValueError as error:
        raise CaperError(f"cannot write {path}: {error}") from error
    except OSError as error:
        raise CaperError(f"cannot write {path}: {error.strerror or error}") from error
    write_atomically(path, buffer.getvalue())
    return path
