"""Single-frame estimation: points -> root pose -> canonical cloud -> joints -> parts (Sec 5)."""

from __future__ import annotations

from functools import partial
from importlib import resources
from pathlib import Path
from typing import Any

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Bool, Float, Int, Shaped

from caper_jax import categories
from caper_jax.arrays import unit_gravity
from caper_jax.articulation.category import Category
from caper_jax.articulation.pose import Array, ArticulatedPose, joints_in_camera
from caper_jax.config import NetworkConfig, from_dict
from caper_jax.data.clouds import MIN_POINTS, are_sampled, sample_points
from caper_jax.errors import CaperError
from caper_jax.models import uncertainty
from caper_jax.models.check_weights import check_variables
from caper_jax.models.files import CARD_FILE, read_model
from caper_jax.models.hypotheses import MOST, Hypotheses, state_hypotheses
from caper_jax.models.observation import observe
from caper_jax.models.pipeline import articulated_pose, refinements, run_stages
from caper_jax.models.plausibility import box_fit, judge, widening
from caper_jax.models.uncertainty import Calibration


@flax.struct.dataclass
class Prediction:
    """Result of the estimator; leading axes ``*batch`` are those of its input.

    Attributes:
      pose: poses and boxes of the parts, and the joints; camera frame, meters. Joint axes and
        pivots are in the root's rest frame: see ``joints_in_camera``.
      points: what the networks were given, camera frame, meters: the input itself when it has as
        many points as they take, else points picked evenly from it.
      labels: part of each of ``points``, int32; -1 for strays, which the networks did not see.
      confidence: of the root's two directions, in (0, 1) (Sec 5.1.1).
      degenerate: the two directions were parallel or zero, so that the rotation is arbitrary.
      points_per_part: how many of ``points`` show each part, int32; a part with fewer than
        ``uncertainty.HIDDEN_POINTS`` is hidden, and known through its joints alone.
      plausible: whether this can be an object of the category, whole, alone and in meters; where it
        is False, nothing else here should be believed.
      reason: why not, int32, an index into ``plausibility.REASONS``; 0 where it is plausible.
        ``implausible_because`` puts it into words.
      plausibility: in (0, 1); below 0.5 lies one in a hundred right objects. None where the model
        has no classifier: then cloud size and number of points alone decide.
      size_ratio: size of the cloud over that usual in the category: 5 for depth in the wrong unit
        of a fifth of a millimeter.
      distinct_points: how many different points the object has, int32, strays left out.
      evidence: what the standard deviations follow from, see ``uncertainty.evidence`` and
        ``plausibility.BoxFit``.
      rotation_std, translation_std: standard deviations about and along each axis of the camera,
        radians and meters; the truth lies within 2.5 of them nine times in ten. None, as is the
        next, where the model is not calibrated. See ``uncertainty.pose_covariance``.
      state_std: radians or meters; the truth lies within 1.64 of them nine times in ten.
      size_std: meters, along each axis of the part; the true extent lies within 1.64 of it nine
        times in ten. None where the calibration is older than this.
      hypotheses: the readings of the cloud that are likeliest, H of them, with probabilities; the
        first is ``pose``. None where the model was not fitted to tell.
    """

    pose: ArticulatedPose
    points: Float[Array, "*batch M 3"]
    labels: Int[Array, "*batch M"]
    confidence: Float[Array, "*batch 2"]
    degenerate: Bool[Array, "*batch"]
    points_per_part: Int[Array, "*batch K"]
    plausible: Bool[Array, "*batch"]
    reason: Int[Array, "*batch"]
    size_ratio: Float[Array, "*batch"]
    distinct_points: Int[Array, "*batch"]
    evidence: Float[Array, "*batch K E"]
    plausibility: Float[Array, "*batch"] = None
    rotation_std: Float[Array, "*batch K"] = None
    translation_std: Float[Array, "*batch K"] = None
    state_std: Float[Array, "*batch J"] = None
    size_std: Float[Array, "*batch K 3"] = None
    hypotheses: Hypotheses | None = None

    def joints_in_camera(
        self,
    ) -> tuple[Float[Array, "*batch J 3"], Float[Array, "*batch J 3"]]:
        """Joint axes (unit vectors) and pivots (meters) in the camera frame."""
        return joints_in_camera(self.pose)


def estimate(
    variables: dict[str, Any],
    points: Shaped[ArrayLike, "..."],
    category: Category,
    network: NetworkConfig,
    calibration: Calibration | None = None,
    gravity: Float[ArrayLike, "B 3"] | None = None,
    hypotheses: int = 1,
) -> Prediction:
    """The pure function under ``Estimator``: jit, vmap and differentiate it at will.

    Differentiable with respect to ``variables`` and ``points`` (labels and the choice of
    neighbors are not). vmap over stacked variables runs several models on one cloud.

    Args:
      variables: {"params": {"root", "parts"}, "batch_stats": {...}} as trained; with
        ``network.refiner.width`` also "refiner" among "params"; "plausibility" where it was
        fitted.
      points: [B, N, 3] meters, camera frame, finite; half precision is computed with in float32.
      category: static.
      network: static.
      calibration: gives the standard deviations.
      gravity: [B, 3] unit vectors in the camera frame, the way things fall; zeros where it is
        unknown. Clouds are leveled by it, whatever roll the camera has, and objects that stand as
        they are used are not read as lying (``Category.stands``).
      hypotheses: static, H readings to state, at most 4. With 1 only the probability of the answer
        is computed, at no cost; each other one costs a pass of stage II where the answer is in
        doubt.

    Returns:
      Prediction with leading axis B and M = N.

    Raises:
      CaperError: points or gravity of another shape, no floats, or more readings than a model can
        state: one that was not fitted for it can state one.
    """
    if jnp.ndim(points) != 3 or jnp.shape(points)[-1] != 3:
        raise CaperError(f"points must be [B, N, 3], got {jnp.shape(points)}")
    points = jnp.asarray(points)
    if not jnp.issubdtype(points.dtype, jnp.floating):
        raise CaperError(f"points must be floats, in meters, got {points.dtype}")
    # Moments of points cancel in half precision, without any NaN.
    points = points.astype(jnp.promote_types(points.dtype, jnp.float32))
    _check_number(hypotheses, variables)
    if gravity is not None:
        if jnp.shape(gravity) != (len(points), 3):
            raise CaperError(f"gravity must be [{len(points)}, 3], got {jnp.shape(gravity)}")
        gravity = jnp.asarray(gravity, points.dtype)
    observed = observe(points, category, gravity)
    cloud = observed.cloud
    outputs = run_stages(variables, cloud, category, network, observed.gravity)
    refined = refinements(variables, outputs, cloud, category, network)[-1]
    labels = outputs.segmentation.argmax(-1).astype(jnp.int32)
    labels = observed.selection.spread_labels(labels)
    fit = box_fit(refined, outputs.segmentation, outputs.evidence, observed, category)
    verdict = judge(fit, points.shape[1], variables["params"].get("plausibility"))
    prediction = Prediction(
        pose=articulated_pose(refined, observed.view, category),
        points=points,
        labels=labels,
        confidence=outputs.confidence,
        degenerate=outputs.degenerate,
        points_per_part=uncertainty.points_per_part(labels, category.num_parts),
        plausible=verdict.plausible,
        reason=verdict.reason,
        size_ratio=verdict.size_ratio,
        distinct_points=fit.distinct,
        evidence=jnp.concatenate([outputs.evidence, fit.evidence], axis=-1),
        plausibility=None if verdict.score is None else jax.nn.sigmoid(verdict.score),
    )
    if "hypotheses" in variables["params"]:
        stated = state_hypotheses(
            variables, observed, outputs, refined, fit, category, network, hypotheses
        )
        prediction = prediction.replace(hypotheses=stated)  # type: ignore[attr-defined]
    if calibration is None:
        return prediction
    rotation, translation, state = uncertainty.radii(calibration, prediction.evidence)
    seen = uncertainty.foreshortening(prediction.pose.rotation, prediction.pose.translation)
    size = uncertainty.size_radii(calibration, prediction.evidence, seen)
    if verdict.score is not None:
        wider = widening(verdict.score)[:, None]
        rotation, translation = jnp.minimum(rotation * wider, np.pi), translation * wider
        size = None if size is None else size * wider[..., None]
        low, high = category.network_state_bounds.T.astype(state.dtype)
        state = jnp.minimum(state * wider, high - low)
    state_units = jnp.asarray(category.state_units, state.dtype)
    return prediction.replace(  # type: ignore[attr-defined]
        rotation_std=rotation / uncertainty.RADIUS_3D,
        translation_std=translation / uncertainty.RADIUS_3D / category.unit,
        state_std=state / uncertainty.RADIUS_1D / state_units,
        size_std=None if size is None else size / uncertainty.RADIUS_1D / category.unit,
    )


def _check_number(hypotheses: int, variables: dict[str, Any]) -> None:
    """Raises CaperError unless a model can state so many readings."""
    if not 1 <= hypotheses <= MOST:
        raise CaperError(f"hypotheses must be from 1 to {MOST}, got {hypotheses}")
    if hypotheses > 1 and "hypotheses" not in variables["params"]:
        raise CaperError(
            f"the model was not fitted to state {hypotheses} hypotheses; fit it with caper "
            "calibrate, or ask for 1"
        )


class Estimator:
    """A trained model of one category, for clouds on the host.

    Within jit, vmap or grad call the pure ``estimate``, or ``function``, which is ``estimate`` with
    the category, the network and the calibration of this model.

    Attributes:
      category: its definition.
      network: sizes of the networks.
      variables: weights, as ``estimate`` takes them.
      card: what the model was trained on, where and for how long.
      calibration: what its standard deviations follow from, if the card has it.
      hypotheses: how many readings it states.
      function: ``(variables, points [B, N, 3], gravity=None) -> Prediction``, pure.
    """

    def __init__(
        self,
        category: Category,
        network: NetworkConfig,
        variables: dict[str, Any],
        card: dict[str, Any] | None = None,
        hypotheses: int = 1,
    ) -> None:
        _check_number(hypotheses, variables)
        self.category = category
        self.network = network
        self.hypotheses = hypotheses
        self.variables = jax.device_put(variables)
        self.card = card or {}
        self.calibration = None
        if "calibration" in self.card:
            source = f"model card of {category.name}"
            section = self.card["calibration"]
            self.calibration = uncertainty.from_card(section, category.num_parts, source)
        self.function = partial(
            estimate,
            category=category,
            network=network,
            calibration=self.calibration,
            hypotheses=hypotheses,
        )
        self._jitted = jax.jit(self.function)

    def __call__(self, points: Any, gravity: Any = None) -> Prediction:
        """Estimates one cloud or a batch.

        Any number of points is taken: clouds are sampled to what the networks see, so that a
        varying number never recompiles, and points that are NaN, infinite, exactly zero or beyond
        50 m are left out. Arrays traced by jit, grad or vmap cannot be sampled and go to
        ``function`` as they are.

        Args:
          points: [N, 3] or [B, N, 3] meters, camera frame (OpenCV), in any order.
          gravity: [3] or [B, 3], the way things fall, in the camera frame and of any length: (0, 1,
            0) for a level camera. An accelerometer at rest gives the opposite. By default the
            camera is taken to be level within 15 deg.

        Returns:
          Prediction with the leading axes of ``points``.

        Raises:
          CaperError: wrong shape or dtype, fewer than 48 usable points that differ, points in
            millimeters, or a gravity that is no direction.
        """
        if isinstance(points, jax.core.Tracer):
            _check_shape(points.shape)
            clouds = points if points.ndim == 3 else points[None]
            down = None if gravity is None else jnp.broadcast_to(gravity, (len(clouds), 3))
            prediction = self.function(self.variables, clouds, gravity=down)
        else:
            sampled = self.sampled(points)
            unit = None if gravity is None else unit_gravity(gravity, len(sampled))
            prediction = self._jitted(self.variables, sampled, gravity=unit)
        if np.ndim(points) == 3:
            return prediction
        return jax.tree.map(lambda array: array[0], prediction)

    def sampled(self, points: Any) -> Float[np.ndarray, "B N 3"]:
        """The points that the networks are given for what ``__call__`` takes, on the host.

        Returns:
          [B, num_points, 3] float32.

        Raises:
          CaperError: as ``__call__``.
        """
        try:
            clouds = np.asarray(points)
        except ValueError as error:
            raise CaperError(
                f"points is no array ({error}); give clouds of different sizes one at a time"
            ) from error
        _check_shape(clouds.shape)
        count = self.network.num_points
        if clouds.ndim == 2:
            return sample_points(clouds, count).points[None]
        if are_sampled(clouds, count):
            return clouds.astype(np.float32)
        names = [f"points[{i}]" if len(clouds) > 1 else "points" for i in range(len(clouds))]
        return np.stack(
            [
                sample_points(cloud, count, where=name).points
                for cloud, name in zip(clouds, names, strict=True)
            ]
        )


def _check_shape(shape: tuple[int, ...]) -> None:
    """Raises CaperError unless the shape is one cloud's or a batch's."""
    if len(shape) not in (2, 3) or shape[-1] != 3:
        raise CaperError(f"points must be [N, 3] or [B, N, 3], got shape {shape}")
    if shape[0] == 0 and len(shape) == 3:
        raise CaperError("points holds no cloud: its batch axis is empty")
    if shape[-2] < MIN_POINTS:
        raise CaperError(
            f"only {shape[-2]} of {shape[-2]} points in points are usable; at least {MIN_POINTS} "
            "points of the object are needed"
        )


def shipped_weights() -> Path:
    """The folder of the models in the package, one folder per category."""
    return Path(str(resources.files("caper_jax"))) / "assets" / "weights"


def load(
    category: str | Category,
    weights: str | Path | None = None,
    object_scale: float = 1.0,
    camera_roll: float = 0.0,
    calibrated: bool = True,
    hypotheses: int | None = 1,
) -> Estimator:
    """The estimator of a category.

    Args:
      category: the category itself, its name (e.g. "box"), or "FILE.py:NAME" (see
        ``categories.get``).
      weights: a model directory (weights.npz, model.json) as training writes it; by default the
        one that ships with the package.
      object_scale: how many times as large the objects are as those the model was trained on; the
        shipped models know real sizes, PartNet's objects in PM-Videos and ArtImage are larger.
      camera_roll: degrees by which upright things appear rotated clockwise in the image, 180
        for a camera upside down; the shipped models know level cameras, within 15 deg.
      calibrated: whether to read the calibration in the card; without it, or where there is none,
        there are no standard deviations.
      hypotheses: how many readings of a cloud to state, at most 4, see ``Prediction.hypotheses``;
        None for as many as the model can state.

    Raises:
      CaperError: unknown category, no model of it in the package, a damaged model, or one of
        another category.

    Example:
      estimator = load("box")
      prediction = estimator(points)   # points [B, N, 3]
      prediction.pose.rotation         # [B, 2, 3, 3]
    """
    definition = categories.get(category)
    name = definition.name  # however it was given
    directory = shipped_weights() / name if weights is None else Path(weights)
    if weights is None and not directory.is_dir():
        shipped = sorted(path.name for path in shipped_weights().glob("*/"))
        raise CaperError(
            f"no weights for {name!r} ship with the package (there are some for "
            f"{', '.join(shipped) or 'no category'}); train some and pass their folder as weights"
        )
    card, variables = read_model(directory)
    if card.get("category") != name:
        raise CaperError(f"{directory} holds a model of {card.get('category')!r}, not {name!r}")
    if not calibrated:
        card = {name: value for name, value in card.items() if name != "calibration"}
    network = network_of(card, directory)
    check_variables(directory, variables, definition, network)
    definition = definition.scaled(object_scale).rolled(camera_roll)
    if hypotheses is None:
        hypotheses = MOST if "hypotheses" in variables["params"] else 1
    return Estimator(definition, network, variables, card, hypotheses)


def network_of(card: dict[str, Any], directory: Path) -> NetworkConfig:
    """The network that the card of the model in ``directory`` describes.

    Raises:
      CaperError: the card describes none, or one that this version does not know.
    """
    try:
        sizes = card["run"]["network"]
    except (KeyError, TypeError) as error:
        raise CaperError(f"{directory / CARD_FILE} lacks run.network; train again") from error
    return from_dict(NetworkConfig, sizes, str(directory / CARD_FILE))
