"""Frames: their schema and checks, readers of datasets, and the synthetic generator."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from caper_jax.errors import CaperError, unknown_name

if TYPE_CHECKING:
    from caper_jax.data.schema import Dataset

__all__ = ["FORMATS", "open_dataset"]

# Layouts on disk, by the name they have on the command line.
FORMATS = ("artimage", "caper", "pm-videos", "reart-videos", "reartmix")
OFFICIAL_SPLITS = ("artimage", "pm-videos", "reart-videos")


def open_dataset(
    format: str,
    root: str | Path,
    category: str,
    split: str | None = None,
    official_split: bool = False,
) -> Dataset:
    """Opens a labelled dataset; frames are read when asked for.

    Args:
      format: one of ``FORMATS``; "caper" is one HDF5 file of this project, the others are public
        layouts.
      root: the file or the root folder.
      category: the category to read.
      split: the split to read; None for all there is.
      official_split: tell train from test by the objects of the official split too (artimage,
        pm-videos and reart-videos).

    Raises:
      CaperError: unknown format, one without an official split, or data that do not fit the
        format, category or split.
    """
    if official_split and format in FORMATS and format not in OFFICIAL_SPLITS:
        raise CaperError(f"format {format!r} has no official split ({', '.join(OFFICIAL_SPLITS)})")
    if format == "artimage":
        from caper_jax.data.artimage import ArtImageDataset

        return ArtImageDataset(root, category, split, official_split=official_split)
    if format == "pm-videos":
        from caper_jax.data.pm_videos import PmVideosDataset

        return PmVideosDataset(root, category, split, official_split=official_split)
    if format == "reart-videos":
        from caper_jax.data.reart_videos import ReArtVideosDataset

        return ReArtVideosDataset(root, category, split, official_split=official_split)
    if format == "caper":
        from caper_jax.data.hdf5 import Hdf5Dataset

        return Hdf5Dataset(root, category, split)
    if format == "reartmix":
        from caper_jax.data.reartmix import ReArtMixDataset

        return ReArtMixDataset(root, category, split)
    raise unknown_name("format", format, FORMATS)
