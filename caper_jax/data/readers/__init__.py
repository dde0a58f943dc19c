"""Readers of labeled datasets, by the name that their layout has on the command line.

A reader of your own is a subclass of ``DatasetReader`` in a file anywhere and one call of
``register_reader``; inside this package, it is one file here and one line in ``_READERS``.
"""

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

from caper_jax import categories
from caper_jax.errors import CaperError, unknown_name

if TYPE_CHECKING:
    from caper_jax.data.readers.base import DatasetReader

__all__ = ["categories_in", "formats", "open_dataset", "reader_of", "register_reader", "splits_in"]

# Modules of this project's readers, each imported when it is first used.
_READERS: dict[str, str | type[DatasetReader]] = {
    "artimage": "caper_jax.data.readers.artimage:ArtImageDataset",
    "caper": "caper_jax.data.hdf5:Hdf5Dataset",
    "captra": "caper_jax.data.readers.captra:CaptraDataset",
    "folder": "caper_jax.data.readers.depth_folder:DepthFolder",
    "pm-videos": "caper_jax.data.readers.artimage:PmVideosDataset",
    "reart-videos": "caper_jax.data.readers.reart:ReArtVideosDataset",
    "reartmix": "caper_jax.data.readers.reart:ReArtMixDataset",
}


def register_reader(name: str, reader: type[DatasetReader]) -> None:
    """Makes a reader known under a name, for the rest of the process.

    Args:
      name: of the layout, as on the command line.
      reader: a subclass of ``DatasetReader``.

    Raises:
      CaperError: another reader already has that name.
    """
    if _READERS.get(name, reader) is not reader:
        raise CaperError(f"format {name!r} is already registered; choose another name")
    _READERS[name] = reader


def formats(*, labeled: bool = False, videos: bool = False) -> tuple[str, ...]:
    """Names of the known layouts, sorted.

    Args:
      labeled: only those with ground truth, on which models are trained and measured.
      videos: only those that may hold videos.
    """
    readers = {name: reader_of(name) for name in _READERS} if labeled or videos else {}
    return tuple(
        name
        for name in sorted(_READERS)
        if (not labeled or readers[name].labeled) and (not videos or readers[name].has_videos)
    )


def reader_of(format: str) -> type[DatasetReader]:
    """The reader of a layout.

    Raises:
      CaperError: unknown format; names the nearest.
    """
    if format not in _READERS:
        raise unknown_name("format", format, _READERS)
    reader = _READERS[format]
    if isinstance(reader, str):
        module, _, name = reader.partition(":")
        reader = getattr(import_module(module), name)
    return reader


def open_dataset(
    format: str,
    root: str | Path,
    category: str,
    split: str | None = None,
    official_split: bool = False,
    num_points: int = 1024,
    on_broken: Callable[[CaperError], None] | None = None,
    **options: Any,
) -> DatasetReader:
    """Opens a dataset; a frame is read when it is indexed.

    Args:
      format: one of ``formats()``; "caper" is one HDF5 file of this project, "folder" depth images
        of one's own, the others are public layouts.
      root: the file or the root folder.
      category: the category to read; its name, or FILE.py:NAME (see ``categories.get``).
      split: the split to read; None for all there is.
      official_split: tell train from test by the objects of the official split too, where the
        dataset has one.
      num_points: points per frame of the layouts with images; a file of "caper" has its own.
      on_broken: called with the error of every file that the layout must read beforehand but can
        leave out; by default such an error is raised.
      **options: of this format alone, see its reader (``depth_scale`` of "folder").

    Raises:
      CaperError: unknown format, one without an official split, or data that do not fit the
        format, category or split.
    """
    name = categories.get(category).name
    reader = reader_of(format)
    return reader(root, name, split, num_points, official_split, on_broken, **options)


def categories_in(format: str, root: str | Path) -> list[str]:
    """The registered categories that a root holds, sorted; no frame is read.

    Args:
      format: one of ``formats(labeled=True)``.
      root: the file or the root folder.

    Raises:
      CaperError: unknown format, or a root that holds none of the categories in this layout.
    """
    reader, root = reader_of(format), Path(root)
    if format != "caper" and not root.is_dir():
        raise CaperError(f"{root}: no such folder (format {format!r} is a folder)")
    held = sorted(set(reader.categories_in(root)) & set(categories.names()))
    if not held:
        raise CaperError(
            f"{root}: holds no {format} data of a known category ({', '.join(categories.names())})"
        )
    return held


def splits_in(format: str, root: str | Path, category: str) -> list[str]:
    """The splits that a root lists for one of its categories.

    Args:
      format: one of ``formats()``.
      root: the file or the root folder.
      category: one of ``categories_in``.
    """
    return reader_of(format).splits_in(Path(root), categories.get(category))
