"""What networks see of a cloud: no strays, turned to the viewing ray, level, in raster order."""

from __future__ import annotations

import flax.struct
import jax.numpy as jnp
from jaxtyping import Array, Float, Integer, Shaped

from caper_jax.articulation.category import Category
from caper_jax.geometry.frames import level_rotation, multiply, rotate, view_rotation
from caper_jax.geometry.outliers import Inliers, find_inliers
from caper_jax.geometry.raster_order import from_raster_order, raster_order, to_raster_order


@flax.struct.dataclass
class Selection:
    """The points of a batch of clouds that belong to the object, in raster order.

    Attributes:
      order: raster order of the points as they came.
      inliers: which of them, in that order.
    """

    order: Integer[Array, "B N"]
    inliers: Inliers

    def pick(self, values: Shaped[Array, "B N C"]) -> Shaped[Array, "B N C"]:
        """Rows of the selection, from rows for the points that came."""
        return self.inliers.apply(to_raster_order(values, self.order))

    def spread_labels(self, labels: Integer[Array, "B N"]) -> Integer[Array, "B N"]:
        """Labels of the points that came, from those of the selection; -1 for strays."""
        own = self.inliers.undo(labels[..., None])
        own = jnp.where(self.inliers.kept[..., None], own, -1)
        return from_raster_order(own, self.order)[..., 0]


def select(points: Float[Array, "B N 3"]) -> Selection:
    """Sorts a cloud and finds what lies alone (``geometry.outliers``)."""
    order = raster_order(points)
    return Selection(order, find_inliers(to_raster_order(points, order)))


@flax.struct.dataclass
class ObservedCloud:
    """A batch of clouds as the networks take them.

    Attributes:
      cloud: viewing frame, network units (meters times ``Category.unit``), raster order; without
        strays, in whose places others are repeated.
      view: camera -> viewing frame, see ``viewing_frame``.
      selection: which of the points that came these are.
      gravity: unit vector in the viewing frame, zeros where it is unknown; None without.
    """

    cloud: Float[Array, "B N 3"]
    view: Float[Array, "B 3 3"]
    selection: Selection
    gravity: Float[Array, "B 3"] | None = None


def observe(
    points: Float[Array, "B N 3"], category: Category, gravity: Float[Array, "B 3"] | None = None
) -> ObservedCloud:
    """Leaves out strays, and turns the ray to the mean of the others into the optical axis.

    Args:
      points: camera frame, meters, in any order.
      category: static.
      gravity: unit vector in the camera frame; the cloud is leveled by it, whatever roll the
        camera has. Zeros where it is unknown.
    """
    selection = select(rotate(viewing_frame(points, category, gravity), points))
    kept = selection.pick(points)
    view = viewing_frame(kept, category, gravity)
    seen = None if gravity is None else rotate(view, gravity[:, None])[:, 0]
    return ObservedCloud(rotate(view, kept) * category.unit, view, selection, seen)


def viewing_frame(
    points: Float[Array, "B N 3"], category: Category, gravity: Float[Array, "B 3"] | None
) -> Float[Array, "B 3 3"]:
    """The rotation from the camera to the frame in which networks see a cloud.

    The ray to the mean of the points becomes the optical axis (``geometry.frames.view_rotation``);
    then gravity, where it is known, points down the image. Arguments as for ``observe``.
    """
    view = view_rotation(points, category.viewpoint.camera_roll)
    if gravity is None:
        return view
    return multiply(level_rotation(rotate(view, gravity[:, None])[:, 0]), view)
