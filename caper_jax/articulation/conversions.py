"""How a category's objects in public datasets become ours: small records, kept with the category.

A category's ``datasets`` maps the name of a family of datasets to one of these records. Readers
hold what is the same for all categories of a layout; what differs from category to category stands
here. Families are "artimage" (ArtImage, PM-Videos), "captra" and "reart" (ReArtMix, ReArt-Videos).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np


@dataclass(frozen=True)
class NotConvertible:
    """A dataset has the category, but not as ours.

    Attributes:
      reason: ends the sentence "<dataset> has ...".
    """

    reason: str


@dataclass(frozen=True)
class RestObject:
    """An object at the rest pose of a file, in the file's frame.

    Attributes:
      points: K arrays [n, 3] meters, the parts' surfaces.
      axis: [J, 3] unit axes; a positive state turns or slides the child by plus the state.
      pivot: [J, 3] meters, points on the axes.
      opening: [J] +1 where a positive state leads into the joint's range, -1 where it leads out.
    """

    points: list[np.ndarray]
    axis: np.ndarray
    pivot: np.ndarray
    opening: np.ndarray


@dataclass(frozen=True)
class AxisMap:
    """How a file's frame, parts and joints become ours.

    Attributes:
      rotation: [3, 3], the file's frame -> our axes.
      order: part k is link ``order[k]`` of the file.
      signs: [J] our state of joint j (in our order) is ``signs[j]`` times the file's.
    """

    rotation: np.ndarray
    order: tuple[int, ...]
    signs: np.ndarray


@dataclass(frozen=True)
class Front:
    """What tells the front of an object that stands upright (y up), and its joints in our frame.

    Attributes:
      shown_by: "slide" (the direction in which its joints open), or the side of the root on which
        the moving parts lie at rest: "ahead" or "behind".
      axes: [J] unit axes in our frame, positive opens.
      sorted_by: our axis along which the moving parts are numbered, or None to keep their order.
    """

    shown_by: Literal["slide", "ahead", "behind"]
    axes: tuple[tuple[int, int, int], ...]
    sorted_by: int | None = None


@dataclass(frozen=True)
class ArtImageConversion:
    """A category in ArtImage and PM-Videos.

    Attributes:
      category_id: number in the annotations; None for a category that the dataset lacks.
      test_objects: of the official test split.
      axes: tells canonical axes from the object at rest: a ``Front``, or a function of the object
        and of the file that errors name; None where the files have our frame.
      moved_by_base: points are moved by the difference between the base joints of the aligned and
        the raw URDF, as public loaders do for this category alone.
    """

    category_id: int | None = None
    test_objects: tuple[int, ...] = ()
    axes: Front | Callable[[RestObject, str], AxisMap] | None = None
    moved_by_base: bool = False


@dataclass(frozen=True)
class CaptraConversion:
    """A category in CAPTRA's SAPIEN data.

    Attributes:
      folder: its name in the files.
      test_objects: of the official test split.
      front: tells canonical axes from the object at rest; None leaves that to the category's rule
        for URDF files.
      lower_root: of two parts, the lower one is our root.
    """

    folder: str
    test_objects: tuple[int, ...] = ()
    front: Front | None = None
    lower_root: bool = False


@dataclass(frozen=True)
class StoredObject:
    """An object as ReArt-48's files store it, in their frame (z up) and at their scale.

    Attributes:
      low, high: [K, 3] boxes of the parts.
      axis: [J, 3] unit joint axes, positive opens.
      pivot: [J, 3] points on them.
    """

    low: np.ndarray
    high: np.ndarray
    axis: np.ndarray
    pivot: np.ndarray


@dataclass(frozen=True)
class ReArtConversion:
    """A category in ReArtMix and ReArt-Videos.

    Attributes:
      category_id: number in the annotations.
      names: in urdf_metas.json; the first is also the folder's in ReArt-Videos.
      axes: [3][3] rotation, file frame -> our canonical frame.
      opening: [3] about or along which the joint opens, in the file's frame, to within 45 deg.
      stored_state: our state (radians, meters) of an object as the file stores it.
      square_at_rest: the parts are square to the axes at rest, not as the file stores them.
      test_objects: of the official test split of ReArt-Videos.
    """

    category_id: int
    names: tuple[str, ...]
    axes: tuple[tuple[float, float, float], ...]
    opening: tuple[float, float, float]
    stored_state: Callable[[StoredObject], float]
    square_at_rest: bool = False
    test_objects: tuple[int, ...] = ()


Conversion = ArtImageConversion | CaptraConversion | ReArtConversion | NotConvertible
