"""Frames: their schema and checks, readers of datasets, and the synthetic generator."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from caper_jax import categories
from caper_jax.errors import CaperError, unknown_name

if TYPE_CHECKING:
    from caper_jax.data.types import Dataset

__all__ = ["FORMATS", "categories_in", "open_dataset", "splits_in"]

# Layouts on disk, by the name they have on the command line.
FORMATS = ("artimage", "caper", "captra", "pm-videos", "reart-videos", "reartmix")
OFFICIAL_SPLITS = ("artimage", "captra", "pm-videos", "reart-videos")


def open_dataset(
    format: str,
    root: str | Path,
    category: str,
    split: str | None = None,
    official_split: bool = False,
    num_points: int = 1024,
    on_broken: Callable[[CaperError], None] | None = None,
) -> Dataset:
    """Opens a labeled dataset; frames are read when asked for.

    Args:
      format: one of ``FORMATS``; "caper" is one HDF5 file of this project, the others are public
        layouts.
      root: the file or the root folder.
      category: the category to read; its name, or FILE.py:NAME (see ``categories.get``).
      split: the split to read; None for all there is.
      official_split: tell train from test by the objects of the official split too (artimage,
        captra, pm-videos and reart-videos).
      num_points: points per frame of the layouts with images; a file of "caper" has its own.
      on_broken: called with the error of every file that the layout must read beforehand but can
        leave out (annotations of reartmix); by default such an error is raised.

    Raises:
      CaperError: unknown format, one without an official split, or data that do not fit the
        format, category or split.
    """
    reader = _reader(format)
    if format == "caper":
        options: dict[str, Any] = {}
    elif format == "reartmix":
        options = {"num_points": num_points, "on_broken": on_broken}
    else:
        options = {"num_points": num_points, "official_split": official_split}
    if official_split and format not in OFFICIAL_SPLITS:
        raise CaperError(f"format {format!r} has no official split ({', '.join(OFFICIAL_SPLITS)})")
    dataset: Dataset = reader(root, categories.get(category).name, split, **options)
    return dataset


def categories_in(format: str, root: str | Path) -> list[str]:
    """The registered categories that a root holds, sorted; no frame is read.

    Args:
      format: one of ``FORMATS``.
      root: the file or the root folder.

    Raises:
      CaperError: unknown format, or a root that holds none of the categories in this layout.
    """
    reader, root = _reader(format), Path(root)
    if format != "caper" and not root.is_dir():
        raise CaperError(f"{root}: no such folder (format {format!r} is a folder)")
    found = sorted(set(reader.categories_in(root)) & set(categories.names()))
    if not found:
        raise CaperError(
            f"{root}: holds no {format} data of a known category ({', '.join(categories.names())})"
        )
    return found


def splits_in(format: str, root: str | Path, category: str) -> list[str]:
    """The splits that a root lists for one of its categories.

    Args:
      format: one of ``FORMATS``.
      root: the file or the root folder.
      category: one of ``categories_in``.
    """
    return list(_reader(format).splits_in(Path(root), category))


def _reader(format: str) -> Any:
    """The class of a layout, imported only when it is used."""
    if format == "artimage":
        from caper_jax.data.readers.artimage import ArtImageDataset

        return ArtImageDataset
    if format == "caper":
        from caper_jax.data.hdf5 import Hdf5Dataset

        return Hdf5Dataset
    if format == "captra":
        from caper_jax.data.readers.captra import CaptraDataset

        return CaptraDataset
    if format == "pm-videos":
        from caper_jax.data.readers.pm_videos import PmVideosDataset

        return PmVideosDataset
    if format == "reart-videos":
        from caper_jax.data.readers.reart_videos import ReArtVideosDataset

        return ReArtVideosDataset
    if format == "reartmix":
        from caper_jax.data.readers.reartmix import ReArtMixDataset

        return ReArtMixDataset
    raise unknown_name("format", format, FORMATS)
