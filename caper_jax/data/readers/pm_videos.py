"""PM-Videos (dataset1 of KPA-Tracker): videos of PartNet objects, layout and models as ArtImage.

Layout of a root folder, read unchanged (see artimage.py for what is the same)::

    <category>/train/<video>/annotations/NNNNNN.json, depth/*.png, category_mask/*.png, color/*.jpg
    <category>/train.txt, test.txt           lines NNNNNN.json (any video), or <video>/NNNNNN.json

Annotations also carry ``sort_part``, the link that moves in the video.
"""

from __future__ import annotations

from functools import cached_property
from pathlib import Path

from caper_jax.data.readers.artimage import ArtImageDataset, read_annotation
from caper_jax.data.readers.listing import in_natural_order, natural_order
from caper_jax.errors import CaperError

FORMAT = "pm-videos"


def group_videos(names: list[str]) -> dict[str, list[int]]:
    """Indices of the frames of every video, in the natural order of their names.

    Args:
      names: ``<video>/<frame>``.

    Returns:
      Videos in the order of their first frame.
    """
    videos: dict[str, list[int]] = {}
    for index, name in enumerate(names):
        videos.setdefault(name.rpartition("/")[0], []).append(index)
    return {
        video: sorted(found, key=lambda index: natural_order(names[index]))
        for video, found in videos.items()
    }


class PmVideosDataset(ArtImageDataset):
    """The frames of all videos of one category; names are ``<video>/<frame>``, e.g. 00001/000034.

    Attributes:
      category, format, split, mask_source, names: see ``Dataset``.
    """

    format = FORMAT
    _annotations = "train/*/annotations/*.json"

    def videos(self) -> dict[str, list[int]]:
        """Name of every video -> indices of its frames, in the order of time."""
        return group_videos(list(self.names))

    def moving_part(self, index: int) -> int | None:
        """The part that moves in the video of frame ``index`` (``sort_part``); None if not stated.

        Raises:
          CaperError: a link that is none of the category's, or a broken annotation.
        """
        path = self._files[self.names[index]]
        annotation = read_annotation(path)
        link = annotation.get("sort_part")
        if link is None:
            return None
        if not isinstance(link, int) or not 0 <= link < self.category.num_parts:
            raise CaperError(
                f"{path}: sort_part must be a link from 0 to {self.category.num_parts - 1}, "
                f"got {link!r}"
            )
        return self._model(str(annotation["instances"][0]["urdf_id"])).links.index(link)

    def _list_frames(self) -> dict[str, Path]:
        paths = self._home.glob(self._annotations)
        return in_natural_order({f"{path.parent.parent.name}/{path.stem}": path for path in paths})

    @cached_property
    def _names_of_file(self) -> dict[str, list[str]]:
        """Bare names of annotations -> the frames of that name, in any video."""
        names: dict[str, list[str]] = {}
        for name in self._files:
            names.setdefault(name.rpartition("/")[2], []).append(name)
        return names

    def _frames_of(self, line: str) -> list[str]:
        name = line.removesuffix(".json")
        return [name] if name in self._files else self._names_of_file.get(name, [])
