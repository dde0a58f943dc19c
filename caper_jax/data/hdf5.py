"""The project's own format: one HDF5 file per category and split, stacked contiguous arrays.

Points are stored as int16 around the mean of their frame, ``p = mean + scale * q``: half the bytes
of float32 at a largest error of 0.01 mm for objects below 0.6 m, where float16 would cost 0.2 mm.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Literal

import h5py
import numpy as np

from caper_jax import categories
from caper_jax.arrays import array_problem
from caper_jax.articulation.category import Category
from caper_jax.articulation.pose import ArticulatedPose
from caper_jax.data.images import check_values
from caper_jax.data.readers.base import DatasetReader, Schema
from caper_jax.data.types import Frame, pose_problems, pose_shapes
from caper_jax.errors import CaperError

FORMAT = "caper"
FORMAT_VERSION = 1
_LEVELS = 32767
# Fields that a file may lack, and their types.
_OPTIONAL = {"visibility": "f4", "video": "i4", "frame": "i4", "instance": "i4"}


def write(
    path: str | Path,
    *,
    category: Category,
    split: str,
    points: np.ndarray,
    labels: np.ndarray,
    pose: ArticulatedPose,
    visible: np.ndarray,
    visibility: np.ndarray | None = None,
    video: np.ndarray | None = None,
    frame: np.ndarray | None = None,
    instance: np.ndarray | None = None,
    names: Sequence[str] | None = None,
    mask_source: str = "simulated",
    attributes: Mapping[str, Any] | None = None,
    overwrite: bool = False,
) -> None:
    """Writes F frames as one file; the file appears whole or not at all.

    Args:
      path: the file, usually ``<category>_<split>.h5``.
      category: what all frames show.
      split: e.g. "train" or "test".
      points: [F, N, 3] meters, camera frame.
      labels: [F, N] part of every point, -1 unknown.
      pose: arrays [F, K, ...].
      visible: [F, K] points or pixels that show each part.
      visibility: [F, K] fraction of each part that nothing hides, 0 to 1, where known.
      video, frame: [F] number of the video and of the frame in it, where the frames are of videos.
      instance: [F] number of the object shown, where known.
      names: F unique names; numbers by default.
      mask_source: how the object was told from its surroundings.
      attributes: further facts to keep (noise, seed, generator version, ...): text or numbers.
      overwrite: replace an existing file.

    Raises:
      CaperError: the file exists, the folder does not, or the arrays break the conventions.
    """
    path = Path(path)
    check_writable(path, overwrite)
    points = np.asarray(points, np.float32)
    frames = len(points)
    names = [f"{i:06d}" for i in range(frames)] if names is None else list(names)
    arrays = {
        **_pack_points(points),
        "labels": np.asarray(labels, np.int8),
        "visible": np.asarray(visible, np.int32),
        "name": np.array([name.encode() for name in names], dtype=np.bytes_),
    }
    for key in pose_shapes(category.num_parts):
        arrays[key] = np.asarray(getattr(pose, key), np.float32)
    optional = {"visibility": visibility, "video": video, "frame": frame, "instance": instance}
    for key, value in optional.items():
        if value is not None:
            arrays[key] = np.asarray(value, _OPTIONAL[key])
    _check_arrays(str(path), arrays, category)
    facts = {
        **(attributes or {}),
        "format": FORMAT,
        "format_version": FORMAT_VERSION,
        "category": category.name,
        "split": split,
        "mask_source": mask_source,
        "units": "meters, radians",
    }

    temporary = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        with h5py.File(temporary, "w") as file:
            for key, array in arrays.items():
                file.create_dataset(key, data=array)
            for key, value in facts.items():
                file.attrs[key] = value
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def check_writable(path: str | Path, overwrite: bool = False) -> None:
    """Refuses an existing file (unless told) and a folder that does not exist or is read-only.

    Raises:
      CaperError: what stands in the way; call it before long work.
    """
    path = Path(path)
    if path.is_dir():
        raise CaperError(f"{path}: is a folder, give the name of a file")
    if path.exists() and not overwrite:
        raise CaperError(
            f"{path}: exists already; choose another name or overwrite it (--overwrite)"
        )
    if not path.parent.is_dir():
        raise CaperError(f"{path}: the folder {path.parent} does not exist")
    if not os.access(path.parent, os.W_OK):
        raise CaperError(f"{path}: no permission to write in {path.parent}")


class Hdf5Dataset(DatasetReader):
    """Frames of one file written by ``write``; the whole file is read into memory at once.

    Attributes:
      video, frame: [F] int32 number of the video and of the frame in it; None when the file holds
        single frames.
      instance: [F] int32 number of the object shown; None when unknown.
      attributes: everything the file says about itself.
    """

    format = FORMAT
    title = FORMAT
    has_videos = True
    checked = True

    def __init__(
        self,
        root: str | Path,
        category: str | None = None,
        split: str | None = None,
        num_points: int | None = None,
        official_split: bool = False,
        on_broken: Callable[[CaperError], None] | None = None,
    ):
        """Reads and checks the file.

        Args:
          root: the file.
          category: name the file must have, or None to take the file's.
          split: name the file must have, or None to take the file's.
          num_points: not used, the file has its own number.
          official_split: a file of ours has none.
          on_broken: not used, there is one file.

        Raises:
          CaperError: no such file, truncated or corrupted (names the field), another format,
            category or split, or arrays that break the conventions.
        """
        if official_split:
            self._check_official()
        path = self.root = Path(root)
        with _opened(path) as file:
            self.attributes = _read_attributes(path, file)
            for key, wanted in (("category", category), ("split", split)):
                if wanted is not None and self.attributes[key] != wanted:
                    raise CaperError(
                        f"{path}: holds {key} {self.attributes[key]!r}, not {wanted!r}"
                    )
            self.category = categories.registered(self.attributes["category"])
            keys = [*_fields(self.category), *(key for key in _OPTIONAL if key in file)]
            arrays = {key: _read(path, file, key) for key in keys}
        _check_arrays(str(path), arrays, self.category)
        self.split = self.attributes["split"]
        self.mask_source = self.attributes["mask_source"]
        self.names: Sequence[str] = [name.decode() for name in arrays.pop("name")]
        self.video, self.frame, self.instance = (
            arrays.pop(key, None) for key in ("video", "frame", "instance")
        )
        self._arrays = arrays

    @classmethod
    def categories_in(cls, root: Path) -> list[str]:
        """The category that a file holds; CaperError for one that is not registered."""
        with _opened(root) as file:
            return [categories.registered(_read_attributes(root, file)["category"]).name]

    @classmethod
    def splits_in(cls, root: Path, category: Category) -> list[str]:
        """The split that a file holds."""
        with _opened(root) as file:
            return [_read_attributes(root, file)["split"]]

    def list_frames(self) -> dict[str, Path]:
        return dict.fromkeys(self.names, self.root)

    def videos(self) -> dict[str, list[int]]:
        """Name of every video -> indices of its frames, in the order of time; {} for frames."""
        videos: dict[str, list[int]] = {}
        if self.video is not None and self.frame is not None:
            for index in np.lexsort((self.frame, self.video)):
                videos.setdefault(f"{self.video[index]:05d}", []).append(int(index))
        return videos

    def __len__(self) -> int:
        return len(self.names)

    def __getitem__(self, index: int, /) -> Frame:
        arrays = self._arrays
        offsets = arrays["points"][index] * arrays["points_scale"][index]
        return Frame(
            name=self.names[index],
            points=(offsets + arrays["points_mean"][index]).astype(np.float32),
            labels=arrays["labels"][index].astype(np.int32),
            truth=ArticulatedPose(
                **{key: arrays[key][index] for key in pose_shapes(self.category.num_parts)}
            ),
            visible=arrays["visible"][index],
            visibility=arrays["visibility"][index] if "visibility" in arrays else None,
            instance=None if self.instance is None else str(self.instance[index]),
        )

    def read_frame(self, name: str, path: Path) -> Frame:
        return self[list(self.names).index(name)]


@contextmanager
def _opened(path: Path) -> Iterator[h5py.File]:
    if path.is_dir():
        raise CaperError(
            f"{path}: no such file but a folder (format {FORMAT!r} is one .h5 file; name the "
            "folder's own format)"
        )
    if not path.is_file():
        raise CaperError(f"{path}: no such file (format {FORMAT!r} is one .h5 file)")
    try:
        with h5py.File(path, "r") as file:
            yield file
    except CaperError:
        raise
    except OSError as error:
        raise CaperError(f"{path}: truncated or not an HDF5 file ({error})") from error
    except (RuntimeError, KeyError, TypeError, ValueError) as error:  # what h5py makes of damage
        raise CaperError(f"{path}: corrupted HDF5 file ({error})") from error


class _Attributes(Schema):
    """What every file of this format says about itself."""

    format: Literal["caper"]
    format_version: Literal[1]
    category: str
    split: str
    mask_source: str
    units: str


def _read_attributes(path: Path, file: h5py.File) -> dict[str, Any]:
    """What the file says about itself; CaperError where it is not of this format."""
    facts = {key: _plain(value) for key, value in file.attrs.items()}
    check_values(
        _Attributes, facts, f"{path}: no file of format {FORMAT!r} version {FORMAT_VERSION}"
    )
    return facts


def _fields(category: Category) -> list[str]:
    stacked = ["points", "points_mean", "points_scale", "labels", "visible", "name"]
    return stacked + list(pose_shapes(category.num_parts))


def _pack_points(points: np.ndarray) -> dict[str, np.ndarray]:
    """int16 points [F, N, 3], their means [F, 1, 3] and scales [F, 1, 1] (meters per level)."""
    if points.ndim != 3 or points.shape[-1] != 3 or 0 in points.shape:
        raise CaperError(f"points must be [F, N, 3], got {points.shape}")
    mean = points.mean(1, keepdims=True, dtype=np.float64)
    scale = np.abs(points - mean).max((1, 2), keepdims=True) / _LEVELS
    scale = np.maximum(scale, np.finfo(np.float32).tiny)
    with np.errstate(invalid="ignore"):  # NaN is reported by _check_arrays through the mean
        packed = np.clip(np.rint((points - mean) / scale), -_LEVELS, _LEVELS).astype(np.int16)
    return {
        "points": packed,
        "points_mean": mean.astype(np.float32),
        "points_scale": scale.astype(np.float32),
    }


def _check_arrays(where: str, arrays: dict[str, np.ndarray], category: Category) -> None:
    """Shapes, dtypes, ranges and conventions of a whole file; names every bad field."""
    frames, num_points = (*arrays["points"].shape, 0, 0)[:2]
    parts = category.num_parts
    expected: dict[str, tuple[Any, ...]] = {  # shape, dtype and range
        "points": ((frames, num_points, 3), np.int16),
        "points_mean": ((frames, 1, 3), np.float32),
        "points_scale": ((frames, 1, 1), np.float32),
        "labels": ((frames, num_points), np.int8, -1, parts - 1),
        "visible": ((frames, parts), np.int32, 0),
        "visibility": ((frames, parts), np.float32, 0, 1),
        "video": ((frames,), np.int32, 0),
        "frame": ((frames,), np.int32, 0),
        "instance": ((frames,), np.int32),
        **{key: ((frames, *shape), np.float32) for key, shape in pose_shapes(parts).items()},
    }
    checks = [array_problem(key, arrays[key], *expected[key]) for key in expected if key in arrays]
    problems = [problem for problem in checks if problem is not None]
    names = arrays["name"]
    if names.shape != (frames,) or names.dtype.kind != "S":
        problems.append(f"name is {names.dtype} {names.shape}, expected bytes ({frames},)")
    elif len(set(names.tolist())) != frames:
        problems.append("name has duplicates")
    else:
        try:
            b"\n".join(names.tolist()).decode()
        except UnicodeDecodeError:
            problems.append("name is not UTF-8")
    if not problems:
        problems += _video_problems(arrays)
        pose = ArticulatedPose(**{key: arrays[key] for key in pose_shapes(parts)})
        problems += pose_problems(pose, category)
    if problems:
        raise CaperError(f"{where}: {'; '.join(problems)}")


def _video_problems(arrays: dict[str, np.ndarray]) -> list[str]:
    if ("video" in arrays) != ("frame" in arrays):
        return ["video and frame must be given together"]
    if "video" in arrays:
        pairs = np.stack([arrays["video"], arrays["frame"]], axis=1)
        if len(np.unique(pairs, axis=0)) < len(pairs):
            return ["video and frame name a frame twice"]
    return []


def _read(path: Path, file: h5py.File, key: str) -> np.ndarray:
    item = file.get(key)
    if not isinstance(item, h5py.Dataset):
        raise CaperError(f"{path}: lacks the field {key!r}; the file is incomplete")
    if item.dtype.kind not in "fiS":
        raise CaperError(f"{path}: field {key!r} has type {item.dtype}, expected numbers or bytes")
    try:
        return item[()]
    except OSError as error:
        raise CaperError(f"{path}: field {key!r} is corrupted ({error})") from error


def _plain(value: Any) -> Any:
    """A Python number or text for an attribute."""
    if isinstance(value, bytes):
        return value.decode(errors="replace")
    return value.item() if isinstance(value, np.generic) else value
