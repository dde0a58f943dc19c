"""What all readers of datasets share: frames by name, splits, objects, videos, broken files."""

from __future__ import annotations

import re
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any, ClassVar, TypeVar

import numpy as np
from pydantic import BaseModel, ConfigDict

from caper_jax import categories
from caper_jax.articulation.category import Category
from caper_jax.articulation.conversions import NotConvertible
from caper_jax.data.images import read_intrinsics
from caper_jax.data.types import Frame, NoFramesError
from caper_jax.errors import CaperError, unknown_name

ALL = "all"
T = TypeVar("T")
# A word of a list of frames: it has a number in it, or is the name of an annotation.
_FRAME = re.compile(r"\S*\d\S*|\S+\.json")


class Schema(BaseModel):
    """Values of a file: numbers are finite numbers, text is text, other fields are ignored."""

    model_config = ConfigDict(
        strict=True, allow_inf_nan=False, frozen=True, arbitrary_types_allowed=True
    )


class DatasetReader(ABC):
    """A dataset of one layout on disk: see ``data.types.Dataset``, which it is.

    A reader for another layout is a subclass with ``format``, ``mask_source``, ``categories_in``,
    ``list_frames`` and ``read_frame``; the other methods have defaults. Frames that show too little
    for a cloud have no points: to an evaluation, a failure. ``read_frame`` is called from several
    threads at once.

    Attributes:
      format: name of the layout on the command line.
      title: name of the dataset, in messages; the format's by default.
      mask_source: how the object was told from its surroundings.
      family: key of the layout's conversions in ``Category.datasets``; None where it needs none.
      has_official_split: whether ``test_objects`` gives the objects of an official test split.
      has_videos: whether frames are named ``<video>/<frame>`` and belong to videos.
      labeled: whether frames carry ground truth.
      checked: whether every array was checked on opening, so that a ``Loader`` need not.
      root, category, split: what was opened; ``split`` is "all" where none was named.
      names: the frames' names, in order.
    """

    format: str
    title: ClassVar[str] = ""
    mask_source: str
    family: ClassVar[str | None] = None
    has_official_split: ClassVar[bool] = False
    has_videos: ClassVar[bool] = False
    labeled: ClassVar[bool] = True
    checked: ClassVar[bool] = False

    def __init_subclass__(cls) -> None:
        cls.title = cls.title or getattr(cls, "format", "")

    def __init__(
        self,
        root: str | Path,
        category: str,
        split: str | None = None,
        num_points: int = 1024,
        official_split: bool = False,
        on_broken: Callable[[CaperError], None] | None = None,
    ):
        """Lists the frames; what else can wait is read when a frame is.

        Args:
          root: the dataset's root folder.
          category: name of the category to read.
          split: the split to read; None or "all" for all frames.
          num_points: points per frame.
          official_split: keep only frames of the objects that the official split puts in
            ``split``, as public loaders do; without a text file, these alone decide.
          on_broken: called with the error of every file that must be read beforehand and cannot
            be, whose frames then are left out; by default the error is raised.

        Raises:
          CaperError: no such data, a split or category that they do not have, or broken files.
        """
        self.root = Path(root)
        self.category: Category = categories.get(category)
        self.split = split or ALL
        self.num_points = num_points
        self.conversion: Any = self.conversion_of(self.category)
        self._on_broken = on_broken
        self._model = lru_cache(maxsize=None)(self.read_model)
        if official_split:
            self._check_official()
        self.open()
        self._files = self.list_frames()
        if self.split != ALL:
            self._keep_listed(required=not official_split)
        if official_split:
            tests = self.test_objects()
            self._files = {
                name: path
                for name, path in self._files.items()
                if (self.object_of(path) in tests) == (self.split == "test")
            }
        if not self._files:
            raise NoFramesError(
                f"{self.root}: split {self.split!r} holds no frame of {self.category.name!r}"
            )
        self.names: Sequence[str] = list(self._files)

    def __len__(self) -> int:
        return len(self.names)

    def __getitem__(self, index: int, /) -> Frame:
        name = self.names[index]
        return self.read_frame(name, self._files[name])

    def videos(self) -> dict[str, list[int]]:
        """Name of every video -> indices of its frames in the order of time; {} without videos."""
        return group_videos(self.names) if self.has_videos else {}

    # What a layout says about itself.

    @classmethod
    @abstractmethod
    def categories_in(cls, root: Path) -> list[str]:
        """Names of registered categories that a root holds and that can be read."""

    @classmethod
    def splits_in(cls, root: Path, category: Category) -> list[str]:
        """Splits that a root lists frames of, for one category."""
        folder = cls.split_folder(root, category)
        return [] if folder is None else list_splits(folder)

    @classmethod
    def split_folder(cls, root: Path, category: Category) -> Path | None:
        """The folder of text files <split>.txt, one frame a line; None where there are none."""
        return None

    def open(self) -> None:
        """Checks that the root has this layout, and reads what all frames share."""
        if not self.root.is_dir():
            raise CaperError(f"{self.root}: no such folder")

    @abstractmethod
    def list_frames(self) -> dict[str, Path]:
        """Name of every frame of the category -> the file that ``read_frame`` begins with."""

    @abstractmethod
    def read_frame(self, name: str, path: Path) -> Frame:
        """One frame; CaperError, which names the file and the field, for a broken one."""

    def frames_of_line(self, line: str) -> list[str] | None:
        """Names of the frames that a line of a split's file means; None if it means none at all.

        Of videos, a line may name a frame of one, or of every video that has one of this name.
        """
        name = line.removesuffix(".json")
        if name in self._files:
            return [name]
        return self._names_of_videos.get(name) if self.has_videos else None

    @cached_property
    def _names_of_videos(self) -> dict[str, list[str]]:
        """Bare names of frames -> the frames of that name, in any video."""
        names: dict[str, list[str]] = {}
        for name in self._files:
            names.setdefault(name.rpartition("/")[2], []).append(name)
        return names

    def object_of(self, path: Path) -> str:
        """Name of the object that a frame of ``list_frames`` shows, for official splits."""
        raise NotImplementedError

    def test_objects(self) -> set[str]:
        """Names of the category's objects in the official test split; none where there is none."""
        return {str(number) for number in getattr(self.conversion, "test_objects", ())}

    def read_model(self, object_id: str) -> Any:
        """An object by its name, for layouts that describe objects; each is read once."""
        raise NotImplementedError

    # What readers call.

    @classmethod
    def conversion_of(cls, category: Category) -> Any:
        """How the category's objects become ours; CaperError for one that the layout lacks."""
        if cls.family is None:
            return None
        conversion = category.datasets.get(cls.family)
        if isinstance(conversion, NotConvertible):
            fit = ", ".join(cls.known_categories())
            raise CaperError(f"{cls.title} has {conversion.reason}; categories that fit: {fit}")
        if conversion is None:
            raise unknown_name(f"{cls.title} category", category.name, cls.known_categories())
        return conversion

    @classmethod
    def known_categories(cls) -> list[str]:
        """Names of the registered categories that have a conversion for this layout."""
        known = (categories.registered(name) for name in categories.names())
        records = {category.name: category.datasets.get(cls.family or "") for category in known}
        return [
            name
            for name, record in records.items()
            if record is not None and not isinstance(record, NotConvertible)
        ]

    def need_folder(self, path: Path, hint: str = "") -> None:
        """CaperError for a folder of this layout that is not there."""
        if not path.is_dir():
            raise CaperError(
                f"{self.root}: no {self.title} folder of {self.category.name!r} (it lacks "
                f"{path.relative_to(self.root)}/){hint}"
            )

    def use_camera(self, path: Path) -> None:
        """Reads the camera of all frames."""
        read_intrinsics(path)
        self._read_intrinsics = lru_cache(maxsize=4)(read_intrinsics)
        self._camera = path

    def intrinsics_for(self, image: np.ndarray) -> np.ndarray:
        """[3, 3] of the camera of all frames, checked against the size of an image [H, W]."""
        return self._read_intrinsics(self._camera, (image.shape[0], image.shape[1]))

    def unless_broken(self, read: Callable[[Path], T], path: Path) -> T | None:
        """What ``read`` makes of a file; None if it is broken and broken files are left out."""
        try:
            return read(path)
        except CaperError as error:
            if self._on_broken is None:
                raise
            self._on_broken(error)
            return None

    def _check_official(self) -> None:
        if not self.has_official_split:
            raise CaperError(f"format {self.format!r} has no official split")
        if not self.test_objects() or self.split not in ("train", "test"):
            raise CaperError(
                f"the official split of {self.title} has train and test of "
                f"{', '.join(self.known_categories())}, not {self.split!r} of "
                f"{self.category.name!r}"
            )

    def _keep_listed(self, required: bool) -> None:
        """Keeps the frames that the split's text file lists, in its order."""
        folder = self.split_folder(self.root, self.category)
        if folder is None:
            return
        path = folder / f"{self.split}.txt"
        if not path.is_file():
            if not required:
                return
            raise CaperError(
                f"{folder}: no split {self.split!r} (no {path.name}); it has "
                f"{', '.join([ALL, *list_splits(folder)])}"
            )
        listed = {line: self.frames_of_line(line) for line in read_list(path)}
        missing = [line for line, names in listed.items() if names is None]
        if missing:
            more = f" ({len(missing)} such lines)" if len(missing) > 1 else ""
            raise CaperError(f"{path}: names {missing[0]!r}, which has no annotation{more}")
        names = [name for frames in listed.values() for name in frames or ()]
        self._files = {name: self._files[name] for name in names}


def natural_order(name: str) -> tuple[tuple[tuple[bool, int, str], ...], str]:
    """Sort key that counts runs of digits as numbers: frame2 comes before frame10."""
    words = re.findall(r"[0-9]+|[^0-9]+", name)
    numbers = ((False, int(w), "") if w.isdecimal() else (True, 0, w) for w in words)
    return tuple(numbers), name


def in_natural_order(files: dict[str, Path]) -> dict[str, Path]:
    """Files by name, 2 before 10."""
    return {name: files[name] for name in sorted(files, key=natural_order)}


def group_videos(names: Sequence[str]) -> dict[str, list[int]]:
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
        video: sorted(indices, key=lambda index: natural_order(names[index]))
        for video, indices in videos.items()
    }


def read_list(path: Path) -> list[str]:
    """The words of a text file, which names one frame a line.

    Raises:
      CaperError: the file is not UTF-8.
    """
    try:
        return path.read_text(encoding="utf-8-sig").split()
    except UnicodeDecodeError as error:
        raise CaperError(
            f"{path}: not a text file in UTF-8 ({error.reason}); save it as such"
        ) from error


def list_splits(folder: Path) -> list[str]:
    """Names, without their endings, of the text files that list frames; others may lie beside.

    What lists frames is told by its first line; an empty file lists none.
    """
    return sorted(path.stem for path in folder.glob("*.txt") if _lists_frames(path))


def _lists_frames(path: Path) -> bool:
    if not path.is_file():
        return False
    # A list in another encoding still is one, and read_list says what is wrong with it.
    with path.open(encoding="utf-8-sig", errors="replace") as file:
        line = next((line for line in file if line.strip()), "")
    return all(_FRAME.fullmatch(word) for word in line.split())
