"""One frame with its estimate, the lines that pictures draw of it, and its errors as a table.

Everything is in the camera's frame (OpenCV: x right, y down, z forward), meters.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import jax
import numpy as np
from jaxtyping import Bool, Float

from caper_jax.articulation.category import Category
from caper_jax.articulation.pose import ArticulatedPose
from caper_jax.data.types import Frame, pose_shapes
from caper_jax.errors import CaperError
from caper_jax.estimator import Prediction
from caper_jax.evaluation.metrics import PoseErrors, pose_errors, pose_errors_up_to_symmetry
from caper_jax.evaluation.report import text_table
from caper_jax.geometry import boxes
from caper_jax.lie import so3
from caper_jax.models import plausibility
from caper_jax.models.hypotheses import possible_others

# Okabe and Ito's colors, which color-blind readers can tell apart; yellow, hard to see on white,
# comes last.
PART_COLORS = ("#0072B2", "#E69F00", "#009E73", "#CC79A7", "#D55E00", "#56B4E9", "#F0E442")

# Corners in the order of ``boxes.corners``, as signs; an edge joins corners that differ in one.
CORNER_SIGNS = np.array([(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], float)
BOX_EDGES = tuple(
    (a, b)
    for a in range(8)
    for b in range(a + 1, 8)
    if np.sum(CORNER_SIGNS[a] != CORNER_SIGNS[b]) == 1
)
# Four corners of every face, in turn around it: those with x = -1, x = 1, y = -1, ...
BOX_FACES = ((0, 1, 3, 2), (4, 5, 7, 6), (0, 1, 5, 4), (2, 3, 7, 6), (0, 2, 6, 4), (1, 3, 7, 5))

NEAREST = 1e-3  # meters; what is nearer to the camera's plane has no place in its image


@dataclass(frozen=True)
class Scene:
    """What one picture shows.

    Attributes:
      name: title of the frame.
      category: names of the parts, joint types and tree.
      points: [N, 3] object points.
      labels: [N] predicted part of every point, 0 to K - 1; -1 for strays.
      pose: the estimate, arrays without batch axes ([K, ...] and [J, ...]).
      truth: ground truth of the same form, if known.
      depth: [H, W] meters, 0 where there is none, if known.
      mask: [H, W] bool, the object in ``depth``, if known.
      intrinsics: [3, 3] of ``depth``; needed with it.
      warning: why the estimate should not be believed, in one line; "" where it may be.
      others: other readings of the cloud, each with its probability, likeliest first.

    Raises:
      CaperError: shapes that do not fit together, or numbers that are not finite.
    """

    name: str
    category: Category
    points: np.ndarray
    labels: np.ndarray
    pose: ArticulatedPose
    truth: ArticulatedPose | None = None
    depth: np.ndarray | None = None
    mask: np.ndarray | None = None
    intrinsics: np.ndarray | None = None
    warning: str = ""
    others: tuple[tuple[float, ArticulatedPose], ...] = ()

    @classmethod
    def of_frame(
        cls,
        frame: Frame,
        category: Category,
        points: Any,
        labels: Any,
        pose: ArticulatedPose,
        warning: str = "",
        others: tuple[tuple[float, ArticulatedPose], ...] = (),
    ) -> Scene:
        """A frame of data with its estimate; what the depth image does not measure is 0 there."""
        depth = frame.depth
        return cls(
            name=frame.name,
            category=category,
            points=np.asarray(points),
            labels=np.asarray(labels),
            pose=jax.tree.map(np.asarray, pose),
            truth=frame.truth,
            depth=None if depth is None else np.nan_to_num(depth, posinf=0.0, neginf=0.0),
            mask=frame.mask,
            intrinsics=frame.intrinsics,
            warning=warning,
            others=others,
        )

    @classmethod
    def of_prediction(cls, frame: Frame, category: Category, prediction: Prediction) -> Scene:
        """A frame with what the estimator says of it, without batch axes."""
        others = []
        if prediction.hypotheses is not None:
            stated = prediction.hypotheses
            for index in possible_others(prediction):
                pose = jax.tree.map(lambda leaf, i=index: np.asarray(leaf)[i], stated.pose)
                others.append((float(stated.probability[index]), pose))
        return cls.of_frame(
            frame,
            category,
            *(prediction.points, prediction.labels, prediction.pose),
            warning=plausibility.implausible_because(prediction, category),
            others=tuple(others),
        )

    def __post_init__(self) -> None:
        for name, array, shape in self._shapes():
            if np.shape(array) != shape or not np.isfinite(array).all():
                problem = f"must be finite numbers {shape}, got shape {np.shape(array)}"
                raise CaperError(f"scene {self.name!r}: {name} {problem}")
        if not np.isin(self.labels, np.arange(-1, self.category.num_parts)).all():
            last = self.category.num_parts - 1
            raise CaperError(f"scene {self.name!r}: labels must be parts 0 to {last}, or -1")

    def _shapes(self) -> Iterator[tuple[str, Any, tuple[int, ...]]]:
        """Name, array and expected shape of everything that is given."""
        count = len(self.points)
        yield "points", self.points, (count, 3)
        yield "labels", self.labels, (count,)
        for name, pose in self.poses:
            for key, shape in pose_shapes(self.category.num_parts).items():
                yield f"{name} {key}", getattr(pose, key), shape
        if self.depth is not None:
            yield "intrinsics", self.intrinsics if self.intrinsics is not None else (), (3, 3)
            if self.mask is not None:
                yield "mask", self.mask, np.shape(self.depth)

    @property
    def object_points(self) -> np.ndarray:
        """[M, 3] the points but for strays; all, if there are no others."""
        kept = self.labels >= 0
        return np.asarray(self.points)[kept] if kept.any() else np.asarray(self.points)

    @property
    def poses(self) -> tuple[tuple[str, ArticulatedPose], ...]:
        """The estimate, the truth where it is known, and other readings, by name."""
        estimate = (("estimate", self.pose),)
        others = tuple((f"reading {n}", pose) for n, (_, pose) in enumerate(self.others, start=2))
        known = (("truth", self.truth),) if self.truth is not None else ()
        return (*estimate, *known, *others)


def part_color(part: int) -> str:
    """Hex color of a part; the colors repeat after the last."""
    return PART_COLORS[part % len(PART_COLORS)]


def box_corners(pose: ArticulatedPose) -> Float[np.ndarray, "parts 8 3"]:
    """[K, 8, 3] corners of all parts' boxes in the camera's frame, in ``CORNER_SIGNS`` order."""
    arrays = (pose.rotation, pose.translation, pose.box_center, pose.size)
    with jax.enable_x64(True):
        return np.asarray(boxes.corners(*(np.asarray(array, np.float64) for array in arrays)))


def joint_lines(
    pose: ArticulatedPose, category: Category
) -> tuple[Float[np.ndarray, "joints 3"], Float[np.ndarray, "joints 3"]]:
    """The joints' axes in the camera's frame.

    Axes and pivots are given in the root's rest frame; at rest all parts share that frame, so the
    pose of the part that a joint is mounted on carries them to the camera, however deep the tree.

    Returns:
      ([J, 3] unit directions, [J, 3] points on the axes, meters).
    """
    parents = list(category.parents)
    rotation = np.asarray(pose.rotation, float)[parents]
    axis = np.einsum("jab,jb->ja", rotation, np.asarray(pose.joint_axis, float))
    pivot = np.einsum("jab,jb->ja", rotation, np.asarray(pose.joint_pivot, float))
    return axis, pivot + np.asarray(pose.translation, float)[parents]


def joint_segments(pose: ArticulatedPose, category: Category) -> Float[np.ndarray, "joints 2 3"]:
    """The piece of every joint's axis to draw, a little longer than the part that it carries.

    A revolute joint's piece lies on its axis, beside the part. A prismatic joint has a direction
    but no place, so its piece goes through the middle of the part.

    Returns:
      [J, 2, 3] start and end; the axis points from start to end.
    """
    axis, point = joint_lines(pose, category)
    corners = box_corners(pose)[1:]
    middle = corners.mean(1)
    along = np.einsum("jni,ji->jn", corners - middle[:, None], axis)
    reach = along.max(1) + 0.12 * np.linalg.norm(np.ptp(corners, axis=1), axis=-1)
    on_axis = point + np.sum((middle - point) * axis, -1, keepdims=True) * axis
    turning = np.array([joint.type == "revolute" for joint in category.joints])
    middle = np.where(turning[:, None], on_axis, middle)
    offset = reach[:, None] * axis
    return np.stack([middle - offset, middle + offset], axis=1)


def hidden_edges(
    corners: Float[np.ndarray, "8 3"], eye: Float[np.ndarray, 3]
) -> Bool[np.ndarray, 12]:
    """Which edges of one box its own faces hide.

    Args:
      corners: [8, 3] in ``CORNER_SIGNS`` order.
      eye: [3] position of the viewer, same frame; far away for an orthographic view.

    Returns:
      [12] bool in ``BOX_EDGES`` order: both faces at the edge look away from the viewer.
    """
    middle = corners.mean(0)
    centers = [corners[list(face)].mean(0) for face in BOX_FACES]
    away = [np.dot(center - middle, center - eye) >= 0 for center in centers]
    beside = [
        [is_away for is_away, face in zip(away, BOX_FACES, strict=True) if a in face and b in face]
        for a, b in BOX_EDGES
    ]
    return np.array([all(faces) for faces in beside])


def project(
    points: Float[np.ndarray, "*batch 3"], intrinsics: Float[np.ndarray, "3 3"]
) -> Float[np.ndarray, "*batch 2"]:
    """Pixels [..., 2] of camera points [..., 3] in front of the camera; pixel centers are whole."""
    image = np.asarray(points, float) @ np.asarray(intrinsics, float).T
    return image[..., :2] / image[..., 2:]


def crop_box(scene: Scene, margin: float = 0.06) -> tuple[np.ndarray, np.ndarray]:
    """The square of the image that shows the object and the estimate, but no wildly wrong one.

    Args:
      scene: without intrinsics, the image plane at 1 m stands for the image.
      margin: share of the larger extent to add on all sides.

    Returns:
      (low [2], high [2]) pixels; may reach beyond the image.
    """
    intrinsics = np.eye(3) if scene.intrinsics is None else scene.intrinsics
    pixels = project(scene.object_points, intrinsics)
    low, high = pixels.min(0), pixels.max(0)
    most = (high - low).max()
    segments = joint_segments(scene.pose, scene.category)
    drawn = np.concatenate([box_corners(scene.pose).reshape(-1, 3), segments.reshape(-1, 3)])
    drawn = project(drawn[drawn[:, 2] > NEAREST], intrinsics)
    if len(drawn):
        low = np.maximum(np.minimum(low, drawn.min(0)), low - most)
        high = np.minimum(np.maximum(high, drawn.max(0)), high + most)
    half = max(float((high - low).max()) * (0.5 + margin), 1e-6)
    return (low + high) / 2 - half, (low + high) / 2 + half


def depth_range(scene: Scene) -> tuple[float, float]:
    """Depths that the colors span: those of the object and half as much again on both sides."""
    near, far = np.percentile(scene.object_points[:, 2], (1, 99))
    reach = max(0.5 * (far - near), 0.01)
    return float(near - reach), float(far + reach)


def format_state(state: float, joint_type: str) -> str:
    """A joint state as text: ``87.3°`` or ``12.4 cm``."""
    return f"{np.degrees(state):.1f}°" if joint_type == "revolute" else f"{100 * state:.1f} cm"


def joint_name(category: Category, joint: int) -> str:
    """``base – lid``: the part that a joint is mounted on and the one it carries."""
    return f"{category.parts[category.parents[joint]]} – {category.parts[joint + 1]}"


def scene_errors(scene: Scene) -> dict[str, PoseErrors]:
    """Errors of the estimate by label: "error" and, where it differs, "up to symmetry".

    Returns:
      Errors of one frame (F = 1); empty without ground truth.
    """
    if scene.truth is None:
        return {}
    estimate, truth = _batched(scene.pose), _batched(scene.truth)
    errors = {"error": pose_errors(estimate, truth, scene.category)}
    best = pose_errors_up_to_symmetry(estimate, truth, scene.category)
    if not np.array_equal(best.rotation_deg, errors["error"].rotation_deg):
        errors["up to symmetry"] = best
    return errors


def format_scene(scene: Scene) -> str:
    """The estimate as a table of parts and one of joints, each with its errors below it.

    Positions, rotation vectors and sizes are those of the parts in the camera's frame; axes and
    pivots are in the root's rest frame.
    """
    pose, category, errors = scene.pose, scene.category, scene_errors(scene)
    with jax.enable_x64(True):
        vectors = np.degrees(np.asarray(so3.log(np.asarray(pose.rotation, np.float64))))
    rows = []
    for part, name in enumerate(category.parts):
        size = 100 * np.asarray(pose.size)[part]
        position = np.asarray(pose.translation)[part]
        rows.append([name, _triple(position, 3), _triple(vectors[part], 1), _triple(size, 1)])
        rows += [[f"  {label}", *part_errors(error, part)] for label, error in errors.items()]
    lines = text_table(["part", "position [m]", "rotation vector [deg]", "size [cm]"], rows)
    rows = []
    for index, joint in enumerate(category.joints):
        pivot = _triple(np.asarray(pose.joint_pivot)[index], 3) if joint.type == "revolute" else "-"
        state = format_state(float(pose.joint_state[index]), joint.type)
        axis = _triple(np.asarray(pose.joint_axis)[index], 3)
        rows.append([joint_name(category, index), axis, pivot, state])
        for label, error in errors.items():
            rows.append([f"  {label}", *joint_errors(error, index, joint.type)])
    lines += ["", *text_table(["joint", "axis (rest)", "pivot (rest) [m]", "state"], rows)]
    return "\n".join([*lines, "", "parts: camera frame; joints: rest frame of the root"])


def part_errors(errors: PoseErrors, part: int) -> tuple[str, str, str]:
    """Error of position and rotation, and the IoU of the boxes, of the first frame."""
    return (
        f"{1000 * errors.translation_m[0, part]:.1f} mm",
        f"{errors.rotation_deg[0, part]:.2f}°",
        f"IoU {errors.iou_full[0, part]:.2f}",
    )


def joint_errors(errors: PoseErrors, joint: int, joint_type: str) -> tuple[str, str, str]:
    """Error of axis, pivot ("-" where there is none) and state, of the first frame."""
    axis = f"{errors.axis_deg[0, joint]:.2f}°"
    if joint_type == "revolute":
        pivot = f"{1000 * errors.pivot_m[0, joint]:.1f} mm"
        return axis, pivot, f"{errors.state[0, joint]:.2f}°"
    return axis, "-", f"{100 * errors.state[0, joint]:.2f} cm"


def _batched(pose: ArticulatedPose) -> ArticulatedPose:
    return jax.tree.map(lambda array: np.asarray(array)[None], pose)


def _triple(values: np.ndarray, digits: int) -> str:
    # Adding 0 turns -0.0 into 0.0.
    return " ".join(f"{value:.{digits}f}" for value in np.round(values, digits) + 0.0)
