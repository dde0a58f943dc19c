"""Frames: their schema and checks, readers of datasets, and the synthetic generator."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from caper_jax.errors import unknown_name

if TYPE_CHECKING:
    from caper_jax.data.schema import Dataset

__all__ = ["FORMATS", "open_dataset"]

# Layouts on disk, by the name they have on the command line.
FORMATS = ("caper", "reartmix")


def open_dataset(format: str, root: str | Path, category: str, split: str | None = None) -> Dataset:
    """Opens a labelled dataset; frames are read when asked for.

    Args:
      format: "caper" (one HDF5 file of this project) or "reartmix".
      root: the file or the root folder.
      category: the category to read.
      split: the split to read; None for all there is.

    Raises:
      CaperError: unknown format, or data that do not fit the format, category or split.
    """
    if format == "caper":
        from caper_jax.data.hdf5 import Hdf5Dataset

        return Hdf5Dataset(root, category, split)
    if format == "reartmix":
        from caper_jax.data.reartmix import ReArtMixDataset

        return ReArtMixDataset(root, category, split)
    raise unknown_name("format", format, FORMATS)
