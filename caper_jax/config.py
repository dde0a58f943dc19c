"""Every setting of the package, the two presets, and how settings are read and written.

Each section of a configuration file is one frozen dataclass below; bounds stand in the types and
are checked by pydantic where values come from outside (TOML, JSON, model cards, the command line),
never on values that JAX traces. ``preset`` gives the two presets; a TOML file names only what
differs from one.
"""

from __future__ import annotations

import dataclasses
import json
import tomllib
import types
import typing
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

import jax
from annotated_types import Ge, Gt, Le, Lt, MinLen

from caper_jax.errors import CaperError, describe_problem, unknown_name

T = TypeVar("T")
Count = Annotated[int, Ge(1)]
Size = Annotated[int, Ge(0)]
Positive = Annotated[float, Gt(0)]
NonNegative = Annotated[float, Ge(0)]
Fraction = Annotated[float, Ge(0), Le(1)]
Seed = Annotated[int, Ge(0), Lt(2**32)]
# The grid has a margin that holds no wider rim.
MaskExtent = tuple[Annotated[float, Ge(0), Le(0.08)], Annotated[float, Ge(0), Le(0.08)]]

SensorName = Literal["none", "gauss3mm", "kinect", "realsense"]
OccluderName = Literal["edge", "strip", "blob"]
IncrementKind = Literal["lie", "euclidean"]
HeatmapKind = Literal["exponential", "scaled", "linear"]
OptimizerName = Literal["ranger", "adamw"]
BatchNormExtent = Literal["global", "local"]
KeyframePolicy = Literal["none", "fixed", "dynamic", "promote"]


def section(cls: type[T]) -> type[T]:
    """Marks a dataclass whose fields pydantic checks strictly where they are read."""
    cls.__pydantic_config__ = {"extra": "forbid", "allow_inf_nan": False}  # type: ignore[attr-defined]
    return cls


# ---------------------------------------------------------------------------- networks (Sec 5)


@section
@dataclass(frozen=True)
class HSEncoderConfig:
    """Sizes of the HS-Encoder (Sec 5.1.1).

    Attributes:
      channels: of the surface layer and the four HS layers.
      neighbors: k at full resolution; at most an eighth of the points after pooling.
      supports: directions per kernel.
      pooling: factor between resolutions.
      feature_space: receptive fields by distance in feature space (RF-F); otherwise every layer
        shares the neighbors in space.
      global_feature: append the maximum of the last layer to every point's feature.
    """

    channels: tuple[Count, Count, Count, Count, Count] = (128, 128, 256, 256, 512)
    neighbors: Count = 20
    supports: Count = 7
    pooling: Count = 4
    feature_space: bool = True
    global_feature: bool = True


@section
@dataclass(frozen=True)
class FastEncoderConfig:
    """Sizes of the fast encoder (ours).

    Attributes:
      centers: points that get local moments in training; evenly over the cloud.
      eval_centers: the same when a trained model is used: with more of them the same weights
        are more accurate.
      center_order: "scan", the centers follow the raster order of the cloud, in which any even pick
        is spread evenly over the image, or "random", they are at fixed random places of it
        (ablation).
      stride: the moments are taken over every stride-th point.
      scales: standard deviations of the Gaussian windows, relative to the cloud's radius.
      width: features per center.
      blocks: residual layers, each with a global feature.
      last: channels of the last layer.
      global_feature: append the maximum of the last layer to every point's feature.
    """

    centers: Count = 128
    eval_centers: Count = 256
    center_order: Literal["scan", "random"] = "scan"
    stride: Count = 1
    scales: Annotated[tuple[Annotated[float, Ge(1e-3)], ...], MinLen(1)] = (0.1, 0.2, 0.4)
    width: Count = 128
    blocks: Size = 2
    last: Count = 384
    global_feature: bool = True


@section
@dataclass(frozen=True)
class HeadConfig:
    """Sizes of a decoder.

    Attributes:
      widths: channels of the first, second and (after pooling) third layer.
      dropout: rate before the last layer, in training.
      pool_first: pool the last level (maximum and mean) before the first layer, which then runs
        once per cloud instead of once per point, without batch norm: a fraction of the cost, for
        encoders whose last layer already sees the whole cloud.
    """

    widths: tuple[Count, Count, Count] = (1024, 256, 256)
    dropout: Annotated[float, Ge(0), Lt(1)] = 0.2
    pool_first: bool = False


@section
@dataclass(frozen=True)
class RotationClassifierConfig:
    """The head that tells an object from its quarter and half turns (``models.rotation_classes``).

    Attributes:
      width: channels; 0: there is no such head.
      margin: nats by which a rotation must lead before the estimator applies it.
    """

    width: Size = 0
    margin: NonNegative = 0.0


@section
@dataclass(frozen=True)
class RefinerConfig:
    """The network that corrects an estimate by the sides of its boxes (``models.refiner``).

    Attributes:
      width: channels; 0: there is no such network.
      iterations: how often it corrects, each time from the last.
      frames: generated frames to fit it on, once both stages are trained. Models trained on a
        dataset have none.
    """

    width: Size = 0
    iterations: Count = 2
    frames: Size = 40_000


@section
@dataclass(frozen=True)
class NetworkConfig:
    """Both stages; the same sizes for each, separate weights.

    Attributes:
      encoder: "hs", "fast", or the name of a registered one (``models.encoders.register``).
      hs: sizes of the HS-Encoder.
      fast: sizes of the fast encoder.
      root_heads: decoders of stage I.
      pooled_heads: decoders of stage II with one output per cloud (state, sizes).
      point_heads: decoders of stage II with one output per point (segmentation, joints).
      increment: how stage II gives the root's pose increment (Sec 5.3.2): "lie", a twist of se(3)
        (Eq 14), or "euclidean", two axes and a translation regressed as they are (Table 9).
      refine_steps: how often the single-frame estimator corrects the root pose by that increment
        before it estimates the parts.
      rotation_classifier: the head for quarter and half turns.
      refiner: the correction by the sides of boxes.
      rotation: what stage I regresses: "decoupled", two directions (Sec 5.1.1), or "quaternion",
        the whole rotation at once (the conventional method of Fig 11).
      vertical_correction: share what the two directions lack of a right angle by their confidence
        (Eq 3); else the first stays and the second gives way (ablation).
      joints: "voting" by points (Sec 5.2.1), or "direct", axis and pivot from pooled features
        (ablation; with ``vertical_correction`` off, the row EfficientCAPER of Table 1).
      num_points: points per cloud that the networks see.
      point_stride: in training the point-wise decoders see every n-th point only; they treat
        points alike, so this costs gradients, not coverage.
    """

    encoder: str = "fast"
    hs: HSEncoderConfig = HSEncoderConfig()
    fast: FastEncoderConfig = FastEncoderConfig()
    root_heads: HeadConfig = HeadConfig()
    pooled_heads: HeadConfig = HeadConfig()
    point_heads: HeadConfig = HeadConfig()
    increment: IncrementKind = "lie"
    refine_steps: Size = 1
    rotation_classifier: RotationClassifierConfig = RotationClassifierConfig()
    refiner: RefinerConfig = RefinerConfig()
    rotation: Literal["decoupled", "quaternion"] = "decoupled"
    vertical_correction: bool = True
    joints: Literal["voting", "direct"] = "voting"
    num_points: Count = 1024
    point_stride: Count = 1

    def __post_init__(self) -> None:
        strides = {"point_stride": self.point_stride, "fast.stride": self.fast.stride}
        for name, stride in strides.items():
            if stride > self.num_points:
                raise CaperError(
                    f"network.{name} must be at most network.num_points = {self.num_points}, "
                    f"got {stride}"
                )


# ------------------------------------------------------------------------------------- data


@section
@dataclass(frozen=True)
class GeneratorConfig:
    """What the generated frames look like.

    Rates are fractions of frames, drawn independently of each other; a disturbance that would
    leave less than 30 % of the object's pixels leaves the frame as it is.

    Attributes:
      instances: number of different shapes.
      grid: rays per side over the object's projected box.
      num_points: points per frame.
      noise: sensor presets, one drawn per frame.
      occlusion: rate of frames with a part of the object hidden by something in front.
      occluders: how it hides, one drawn per frame: "edge" all beyond a line, "strip" a band
        across the image, "blob" an ellipse.
      erosion: rate of frames whose mask is too tight; frames that take in the table are spared.
      erosion_range: by how much, least and most, of the grid's side; at least by a pixel.
      table: rate of frames whose mask takes in the table along a stretch of the silhouette; the
        table is the plane through the object's lowest point.
      clutter: rate of frames whose mask takes in a blob of another surface, in front of the
        silhouette or behind it.
      spill: largest number of pixels of table, and of clutter, as a fraction of the object's;
        each frame draws its own. These points have label -1.
      residue: largest fraction of lone points that belong to something behind the object; each
        frame draws its own. These points have label -1.
      dropout: largest fraction of lone pixels without depth; each frame draws its own.
      holes: rate of frames with 1 to 4 blobs without depth.
      depth_scale: standard deviation of the camera's relative error of all depths, one per frame.
      specks: largest fraction of points that lie anywhere in a ball around the object, of 1.5
        times its radius; each frame draws its own. These points have label -1.
      speckle: largest fraction of points that are moved along their rays, nearer or farther, by a
        tenth of the object's diagonal on average; each frame draws its own. These have label -1.
      flying: largest fraction of flying pixels among those where the depth jumps to something
        behind: they lie anywhere between the two; each frame draws its own. They have label -1.
      rim: rate of frames whose mask is too wide all around and takes in the table or, in half of
        all frames, a wall; the rest of the rim has no depth. These points have label -1.
      rim_range: by how much, least and most, of the grid's side.
      hand: rate of frames with a hand that touches the object and hides what is behind it: in the
        mask, with label -1, or not, one as often as the other.
      cable: rate of frames with a cable: in front of the object, in the mask (label -1) or not, or
        right behind it and in the mask, each as often as the others.
      few_points: rate of frames with fewer distinct points, from 48 (log-uniform), repeated evenly;
        in half of them 70 to 95 % of these are of one part.
      measure_visibility: fill ``Batch.visibility``.
    """

    instances: Count = 2000
    grid: Annotated[int, Ge(8)] = 96
    num_points: Annotated[int, Ge(16)] = 1024
    noise: Annotated[tuple[SensorName, ...], MinLen(1)] = ("kinect",)
    occlusion: Fraction = 0.0
    occluders: Annotated[tuple[OccluderName, ...], MinLen(1)] = ("edge",)
    erosion: Fraction = 0.0
    erosion_range: MaskExtent = (0.0, 0.03)
    table: Fraction = 0.0
    clutter: Fraction = 0.0
    spill: Fraction = 0.1
    residue: Fraction = 0.0
    dropout: Fraction = 0.0
    holes: Fraction = 0.0
    depth_scale: Annotated[float, Ge(0), Le(0.1)] = 0.0
    specks: Fraction = 0.0
    speckle: Fraction = 0.0
    flying: Fraction = 0.0
    rim: Fraction = 0.0
    rim_range: MaskExtent = (0.015, 0.08)
    hand: Fraction = 0.0
    cable: Fraction = 0.0
    few_points: Fraction = 0.0
    measure_visibility: bool = False

    def __post_init__(self) -> None:
        for name in ("erosion_range", "rim_range"):
            least, most = getattr(self, name)
            if least > most:
                raise CaperError(f"data.{name} goes from {least} down to {most}; least comes first")


@section
@dataclass(frozen=True)
class LoaderConfig:
    """How a dataset is fed to training.

    Attributes:
      format: layout of the data (``data.readers.formats(labeled=True)``).
      root: file or folder.
      split: split to train on; none for all there is.
      workers: threads that read ahead.
      prefetch: batches kept ready.
      cache_gib: memory for frames that were read once; a set that fits is read once only.
    """

    format: str
    root: str
    split: str | None = "train"
    workers: Count = 2
    prefetch: Size = 4
    cache_gib: NonNegative = 2.0


# --------------------------------------------------------------------------------- training


@section
@dataclass(frozen=True)
class LossWeights:
    """Weights of Eqs 22 and 23 as the paper gives them, and of the two dense joint targets.

    A pytree: vmap over weights trains variants side by side. ``heatmap`` and ``offset`` supervise
    Eqs 4 and 5, which the paper defines but does not weigh; ``rotation_class`` is ours (see
    ``models.rotation_classes``).
    """

    rotation: NonNegative = 8.0
    translation: NonNegative = 10.0
    confidence: NonNegative = 1.0
    location: NonNegative = 1.0
    direction: NonNegative = 1.0
    state: NonNegative = 6.0
    scale: NonNegative = 1.0
    segmentation: NonNegative = 0.1
    twist: NonNegative = 1.0
    heatmap: NonNegative = 1.0
    offset: NonNegative = 1.0
    rotation_class: NonNegative = 1.0


@section
@dataclass(frozen=True)
class LossConfig:
    """What the loss depends on besides the network.

    A pytree, but for ``heatmap`` and ``root_input``: its numbers may be traced.

    Attributes:
      weights: of Eqs 22 and 23.
      heatmap: form of Eq 5: "exponential" (as printed), "scaled" or "linear".
      heatmap_gate: share of the farthest point's distance beyond which points do not vote (Eq 5).
      state_penalty: alpha of Eq 20.
      root_noise_deg: stage II sees clouds canonicalized with a root pose that is off by a rotation
        with this standard deviation about each axis...
      root_noise: ... and a translation with this standard deviation, in network units...
      root_noise_spread: ... both times a factor drawn log-uniformly, per sample, between this
        and one over this: errors of keyframes and of motion between frames, small and large.
      predicted_root: fraction of samples canonicalized with stage I's own (detached) prediction,
        where that is within 25 deg of the truth; with a rotation classifier, of the truth after a
        quarter or half turn.
      rotated_root: with a rotation classifier, fraction of samples whose reference is rotated by a
        quarter or half turn on purpose, half of them by half turns; there, only the rotation class
        and the increment are learned.
      root_input: what stage I sees: the "whole" object, or the "root" part's points alone, by true
        labels (Table 7).
    """

    weights: LossWeights = LossWeights()
    heatmap: HeatmapKind = "exponential"
    heatmap_gate: Annotated[float, Gt(0), Le(1)] = 0.2
    state_penalty: NonNegative = 20.0
    root_noise_deg: NonNegative = 4.0
    root_noise: NonNegative = 0.03
    root_noise_spread: Annotated[float, Ge(1)] = 4.0
    predicted_root: Fraction = 0.5
    rotated_root: Fraction = 0.2
    root_input: Literal["whole", "root"] = "whole"


def _as_pytree(cls: type, static: tuple[str, ...] = ()) -> None:
    names = [f.name for f in dataclasses.fields(cls)]
    traced = [name for name in names if name not in static]
    jax.tree_util.register_dataclass(cls, data_fields=traced, meta_fields=list(static))


STATIC_LOSS = ("heatmap", "root_input")  # settings of the loss that are no numbers
_as_pytree(LossWeights)
_as_pytree(LossConfig, STATIC_LOSS)


@section
@dataclass(frozen=True)
class TrainingConfig:
    """How to train; a run is bounded by ``steps``, ``minutes`` or ``epochs``, exactly one of them.

    Attributes:
      batch_size: samples per step over all devices.
      learning_rate: base rate; see ``training.optimizer.flat_and_anneal`` for its course.
      optimizer: "ranger" or "adamw".
      warmup: steps of linear warm-up.
      clip_norm: bound on the global norm of the gradient.
      weight_decay: decoupled weight decay.
      steps: length of the run in steps; the result is then a function of the seed.
      minutes: length of the run in minutes of training, summed over resumes; compiling the step
        does not count.
      epochs: length of the run in passes over a dataset, which has an end where generated frames
        have none; rounded up to whole steps.
      seed: every random number of the run follows from it.
      data_seed: shapes and frames follow from this one instead, so that runs with other seeds see
        the same data in the same order; None for ``seed``.
      steps_per_dispatch: steps compiled into one call, to hide the cost of calling.
      log_steps: steps averaged into one line of metrics.jsonl.
      checkpoint_minutes: time between checkpoints.
      checkpoint_steps: steps between checkpoints, besides those by time; 0 for none.
      keep_checkpoints: newest checkpoints to keep.
      max_bad_steps: stop after so many steps without a finite gradient in a row.
      batch_norm: over several devices: "global", as one device would train with the whole batch,
        or "local", each on its own rows, which needs one sum per step.
      save_memory: compute the gradients of both stages one after the other, which holds half as
        much at once; the numbers are the same to rounding.
    """

    ALTERNATIVES: typing.ClassVar = ("steps", "minutes", "epochs")

    batch_size: Count = 16
    learning_rate: Positive = 1e-4
    optimizer: OptimizerName = "ranger"
    warmup: Size = 1000
    clip_norm: Positive = 5.0
    weight_decay: NonNegative = 0.0
    steps: Count | None = None
    minutes: Positive | None = None
    epochs: Positive | None = None
    seed: Seed = 0
    data_seed: Seed | None = None
    steps_per_dispatch: Count = 1
    log_steps: Count = 50
    checkpoint_minutes: Positive = 5.0
    checkpoint_steps: Size = 0
    keep_checkpoints: Count = 3
    max_bad_steps: Count = 50
    batch_norm: BatchNormExtent = "global"
    save_memory: bool = True

    def __post_init__(self) -> None:
        bounds = {name: getattr(self, name) for name in self.ALTERNATIVES}
        if sum(bound is not None for bound in bounds.values()) != 1:
            given = ", ".join(f"{name}={bound}" for name, bound in bounds.items())
            raise CaperError(f"training needs one of steps, minutes and epochs, got {given}")

    @property
    def stream(self) -> int:
        """Seed of shapes and frames."""
        return self.seed if self.data_seed is None else self.data_seed


# Every sensor, and a little of everything that masks and cameras do wrong: what a network must bear
# that has only seen generated data when it meets a real camera.
TRAINING_DATA = GeneratorConfig(
    instances=4000,
    grid=64,
    noise=("none", "gauss3mm", "kinect", "realsense"),
    occlusion=0.1,
    occluders=("edge", "strip", "blob"),
    erosion=0.1,
    table=0.1,
    clutter=0.05,
    spill=0.05,
    residue=0.01,
    dropout=0.1,
    holes=0.1,
)


@section
@dataclass(frozen=True)
class RunConfig:
    """All that defines a training run; the sections of a configuration file.

    Attributes:
      category: its name, or FILE.py:NAME (see ``categories.get``).
      network: sizes.
      data: generated frames.
      loader: a dataset to train on instead of generated frames.
      loss: weights and targets.
      training: optimizer and budget.
      init_weight_average: how much of the model that a run starts from is in the weights it
        writes, the rest being what it trained; their average is often better than either. That
        model must be of the same category.
      calibration_frames: unseen generated frames to calibrate the trained model on, 0 or at least
        2,560 (``training.fit_uncertainty``). Models trained on a dataset are not calibrated.
    """

    category: str
    network: NetworkConfig
    data: GeneratorConfig = TRAINING_DATA
    loader: LoaderConfig | None = None
    loss: LossConfig = LossConfig()
    training: TrainingConfig = TrainingConfig(minutes=60.0)
    init_weight_average: Annotated[float, Ge(0), Lt(1)] = 0.0
    calibration_frames: Size = 4096

    def __post_init__(self) -> None:
        refiner = self.network.refiner
        # It is fitted at the end of a run, too late to say that it cannot be.
        if self.loader is None and refiner.width and refiner.frames < 1024:
            raise CaperError(f"network.refiner.frames must be at least 1024, got {refiner.frames}")
        if 0 < self.calibration_frames < 2560:
            raise CaperError(
                f"calibration_frames must be 0 or at least 2560, got {self.calibration_frames}"
            )
        if self.training.epochs is not None and self.loader is None:
            raise CaperError(
                f"training.epochs = {self.training.epochs} needs a dataset (--data, or a [loader] "
                "in the configuration): generated frames have no end; give steps or minutes"
            )
        if self.data.num_points != self.network.num_points:
            raise CaperError(
                f"data.num_points = {self.data.num_points} and network.num_points = "
                f"{self.network.num_points} must agree"
            )


# --------------------------------------------------------------------------------- tracking


@section
@dataclass(frozen=True)
class RegistrationConfig:
    """How a cloud is registered; lengths in network units (objects are about 2 across).

    Attributes:
      steps: Gauss-Newton steps per frame, each with new matches; 0 leaves the network's increment.
      gaussians: number of Gaussians of one keyframe.
      capacity: largest number of Gaussians kept; the oldest give way.
      stride: every n-th point of a cloud is registered.
      window: standard deviation of the window around each of them.
      noise: standard deviation added to their covariance: sensor and shape.
      robust: Mahalanobis distance at which a match counts a quarter.
      wrong_part: distance that a match across two parts must be closer by: labels may be wrong.
      share: weight of a match; below one, as neighboring points repeat each other.
      root_rotation, root_translation, joint: standard deviations of what the prediction misses:
        radians, units, radians or units.
      network_rotation, network_translation, network_joint: likewise, of the network's answer.
      hold: how far a root must seem to move before it moves, as a squared Mahalanobis distance:
        one that stands still then does not tremble, or drift where little of it is in view.
    """

    steps: Size = 3
    gaussians: Count = 256
    capacity: Count = 512
    stride: Count = 2
    window: Positive = 0.08
    noise: Positive = 0.01
    robust: Positive = 3.0
    wrong_part: NonNegative = 0.1
    share: Positive = 0.25
    root_rotation: Positive = 0.1
    root_translation: Positive = 0.1
    joint: Positive = 0.2
    network_rotation: Positive = 0.05
    network_translation: Positive = 0.05
    network_joint: Positive = 0.05
    hold: NonNegative = 30.0

    def __post_init__(self) -> None:
        if self.gaussians > self.capacity:
            raise CaperError(
                f"registration.gaussians = {self.gaussians} must be at most "
                f"registration.capacity = {self.capacity}"
            )


@section
@dataclass(frozen=True)
class TrackerConfig:
    """How a tracker works; the defaults are what the shipped models are measured with.

    Attributes:
      policy: when a frame becomes the keyframe that increments refer to (Sec 5.3.2, Alg 1).
        "dynamic": when the energy exceeds ``threshold`` or the share of unmatched points
        ``max_unmatched``; its pose then comes from the static estimator. "fixed": every
        ``interval`` frames, likewise. "none": every frame, with the tracked pose and nothing else
        kept, so that errors add up. "promote": like "dynamic", but with the tracked pose (errata:
        the reading of Algorithm 1's l. 8 in the code it goes back to); the static estimator only
        helps where the track is lost.
      interval: of "fixed", in frames.
      threshold: phi of Eq 16, relative to the object's diagonal.
      max_unmatched: share of points off the surface seen so far that asks for a new keyframe.
      kalman: weigh the static estimator's pose at a keyframe against the tracked one by their
        variances; off, the keyframe takes the estimator's as it is (the paper's text).
      use_prediction: let the network see the cloud canonicalized by the predicted pose, a step on
        from the keyframe's, instead of the keyframe's own; the increment is the same, but small.
      registration: of the cloud to the surface seen so far; ``registration.steps = 0`` leaves the
        network's increment alone (the paper's tracker).
      damping: how much of the velocity is kept from frame to frame.
      velocity_gain: how much of what the prediction missed goes into the velocity.
      gate_deg, gate: rotation and distance (network units) beyond which a static estimate or the
        network contradicts the track, not only differs from it.
      patience: frames in a row that contradict the track before the static estimator may replace
        it; it does so where it fits its own boxes clearly better.
      min_confidence: least confidence in both of the root's directions (Eq 18) at which a static
        estimate may correct or replace a track: from a closed drawer's back any side may be the
        front.
      init_frames: frames after a start from the static estimator in which it is queried again, as
        long as it is confident: its poses are averaged, and vote on quarter and half turns.
      log_odds: nats by which such an estimate, a quarter or half turn from the track, speaks for
        that turn, and one that is not speaks against.
      flip_log_odds: sum over frames of the log odds that the track is off by a quarter or half
        turn, at which that turn is made: of stage II's, at most 1 nat per frame, for networks with
        a rotation classifier; or of the votes.
      max_box_residual: mean distance of the points from their parts' boxes, relative to the
        object's diagonal, above which a frame contradicts the track.
      max_match_cost: share of unmatched points above which a frame contradicts the track.
      static_rotation, static_translation, static_joint: standard deviations of the static
        estimator: radians, units, radians or units.
      drift_rotation, drift_translation, drift_joint: likewise, what one change of keyframe adds.
    """

    policy: KeyframePolicy = "dynamic"
    interval: Count = 10
    threshold: NonNegative = 0.03
    max_unmatched: NonNegative = 0.12
    kalman: bool = True
    use_prediction: bool = True
    registration: RegistrationConfig = RegistrationConfig()
    damping: NonNegative = 0.8
    velocity_gain: NonNegative = 1.0
    gate_deg: NonNegative = 15.0
    gate: NonNegative = 0.4
    patience: Count = 3
    min_confidence: Fraction = 0.5
    init_frames: Size = 5
    log_odds: NonNegative = 1.5
    flip_log_odds: NonNegative = 2.0
    max_box_residual: NonNegative = 0.03
    max_match_cost: NonNegative = 0.5
    static_rotation: Positive = 0.1
    static_translation: Positive = 0.1
    static_joint: Positive = 0.15
    drift_rotation: NonNegative = 0.01
    drift_translation: NonNegative = 0.01
    drift_joint: NonNegative = 0.02


# ---------------------------------------------------------------------------------- presets

PAPER = RunConfig(
    category="",
    # As published: stage I, then stage II. Correcting stage I's pose is ours.
    network=NetworkConfig(encoder="hs", refine_steps=0),
)
FAST = RunConfig(
    category="",
    network=NetworkConfig(
        encoder="fast",
        root_heads=HeadConfig(widths=(256, 256, 256), dropout=0.0, pool_first=True),
        pooled_heads=HeadConfig(widths=(256, 256, 256), dropout=0.0, pool_first=True),
        point_heads=HeadConfig(widths=(64, 64, 64), dropout=0.0),
        rotation_classifier=RotationClassifierConfig(width=64),
        refiner=RefinerConfig(width=256),
        point_stride=4,
    ),
    # exp(-D) is nearly constant inside the gate; a penalty of 20 drowns every other loss where
    # states near zero are common. Increments weigh as much as absolute rotations, and confidences
    # by their mean over both directions, with which the shipped models were trained.
    loss=LossConfig(
        heatmap="linear", state_penalty=1.0, weights=LossWeights(confidence=0.5, twist=8.0)
    ),
    training=TrainingConfig(
        optimizer="adamw", learning_rate=2e-3, warmup=200, weight_decay=1e-4, minutes=60.0
    ),
)
# Many trainings side by side: the fast preset with a quarter of the points and half the width.
ABLATION = replace(
    FAST,
    network=replace(
        FAST.network,
        fast=FastEncoderConfig(centers=64, eval_centers=128, width=64, last=192),
        root_heads=replace(FAST.network.root_heads, widths=(128, 128, 128)),
        pooled_heads=replace(FAST.network.pooled_heads, widths=(128, 128, 128)),
        point_heads=replace(FAST.network.point_heads, widths=(32, 32, 32)),
        rotation_classifier=RotationClassifierConfig(width=32),
        refiner=RefinerConfig(),
        num_points=256,
    ),
    data=replace(TRAINING_DATA, instances=1000, grid=32, num_points=256),
    training=replace(FAST.training, steps=3000, minutes=None, warmup=100),
    calibration_frames=0,
)
PRESETS = {"paper": PAPER, "fast": FAST, "ablation": ABLATION}


def preset(name: str, category: str = "") -> RunConfig:
    """The run of a preset.

    Args:
      name: "paper" as published, "fast" for two CPU cores, "ablation" for many runs on them.
      category: its name.

    Raises:
      CaperError: unknown name.
    """
    if name not in PRESETS:
        raise unknown_name("preset", name, PRESETS)
    return replace(PRESETS[name], category=category)


# ------------------------------------------------------------------------ reading and writing


def override(config: T, *assignments: str) -> T:
    """A copy of a configuration with some values replaced, all checked together.

    Args:
      config: a section.
      *assignments: "section.key=value"; the value in TOML, where strings need no quotes, lists no
        brackets, and ``none`` stands for None.

    Example:
      override(config, "training.learning_rate=1e-3", "data.noise=none,kinect")

    Raises:
      CaperError: no such key, or a value of the wrong type or out of range.
    """
    values = to_dict(config)
    for assignment in assignments:
        key, equals, text = (part.strip() for part in assignment.partition("="))
        if not key or not equals:
            raise CaperError(f"setting {assignment!r}: write section.key=value")
        _assign(values, type(config), key, text)
    return from_dict(type(config), values)


def update(config: T, path: str | Path) -> T:
    """A copy of a configuration with the values of a TOML file in the place of its own.

    Raises:
      CaperError: the file cannot be read, or holds an unknown key or a wrong value.
    """
    return merge(config, read_toml(path), str(path))


def read_toml(path: str | Path) -> dict[str, Any]:
    """The content of a TOML file.

    Raises:
      CaperError: the file cannot be read, or is not TOML.
    """
    try:
        return tomllib.loads(Path(path).read_text(encoding="utf-8"))
    except OSError as error:
        raise CaperError(f"cannot read configuration {path}: {error.strerror}") from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise CaperError(f"{path} is not valid TOML: {error}") from error


def merge(config: T, changes: dict[str, Any], where: str = "") -> T:
    """A copy of a configuration with nested plain values in the place of its own.

    Args:
      config: a section.
      changes: {"training": {"steps": 100}} and the like.
      where: the file or argument the values come from, for error messages.

    Raises:
      CaperError: an unknown key or a wrong value.
    """
    values = to_dict(config)
    _merge(values, changes, type(config))
    return from_dict(type(config), values, where)


def check(config: T) -> T:
    """The configuration itself, once pydantic has checked it as if it had been read.

    Raises:
      CaperError: a value of the wrong type or out of range.
    """
    return from_dict(type(config), to_dict(config), type(config).__name__)


def from_dict(cls: type[T], values: dict[str, Any], where: str = "") -> T:
    """A section from nested dicts of plain values.

    Args:
      cls: a section.
      values: by field name; a field that is absent takes its default.
      where: the file or argument the values come from, for error messages.

    Raises:
      CaperError: unknown or missing key, wrong type, or a value out of range.
    """
    from pydantic import TypeAdapter, ValidationError  # 0.1 s that ``import caper_jax`` spares

    try:
        # As JSON: there, and only there, strict validation takes lists for tuples.
        return TypeAdapter(cls).validate_json(json.dumps(values), strict=True)
    except ValidationError as error:
        problem = _first_problem(cls, error)
    except (CaperError, TypeError) as error:  # of a section, or a TOML date, which JSON lacks
        problem = str(error)
    raise CaperError(f"{where}: {problem}" if where else problem)


def _first_problem(cls: type, error: Any) -> str:
    """What pydantic found first; an unknown key with those of its section."""
    problem = error.errors()[0]
    if problem["type"] not in ("unexpected_keyword_argument", "extra_forbidden"):
        return describe_problem(error)
    *parents, name = map(str, problem["loc"])
    for parent in parents:
        cls = _field_types(cls)[parent]
    return str(_unknown_key(parents, name, cls))


def to_dict(config: Any) -> dict[str, Any]:
    """Nested dicts of plain values (tuples become lists), as JSON and ``from_dict`` take them."""
    return json.loads(json.dumps(dataclasses.asdict(config)))


def _merge(values: dict[str, Any], changes: dict[str, Any], cls: type) -> None:
    """Puts nested changes into nested values; what does not fit is left to ``from_dict``."""
    for key in changes:
        _unset_alternatives(values, cls, key)
    for key, change in changes.items():
        if isinstance(change, dict) and isinstance(values.get(key), dict):
            _merge(values[key], change, _field_types(cls)[key])
        else:
            values[key] = change


def _assign(values: dict[str, Any], cls: type, key: str, text: str) -> None:
    """Puts the value of "a.b" into nested dicts, typed by the section."""
    *parents, name = key.split(".")
    for depth, parent in enumerate(parents):
        types_ = _field_types(cls)
        if parent not in types_:
            raise _unknown_key(parents[:depth], parent, cls)
        cls = types_[parent]
        if not dataclasses.is_dataclass(cls):
            raise CaperError(f"{'.'.join(parents[: depth + 1])} is not a section")
        if values.get(parent, {}) is None:
            raise CaperError(f"{key}: this configuration has no {parent}")
        values = values.setdefault(parent, {})
    if name not in _field_types(cls):
        raise _unknown_key(parents, name, cls)
    kind = typing.get_type_hints(cls)[name]
    if type(None) in typing.get_args(kind) and text.lower() == "none":
        values[name] = None
        return
    if dataclasses.is_dataclass(_field_types(cls)[name]):
        raise CaperError(f"{key} is a section; name a key in it")
    values[name] = _value(text, _field_types(cls)[name])
    _unset_alternatives(values, cls, name)


def _value(text: str, kind: Any) -> Any:
    """A setting's text as a plain value; whether it fits the field is checked with all others."""
    if typing.get_origin(kind) is tuple and not text.startswith("["):
        item = typing.get_args(kind)[0]
        return [_value(part.strip(), item) for part in text.split(",")]
    if kind is bool and text in ("True", "False"):  # as --help-settings spells them
        return text == "True"
    try:
        value = tomllib.loads(f"value = {text}")["value"]
    except tomllib.TOMLDecodeError:
        return text  # a string without quotes, or a mistake that the check names
    # A name may read as a number, a date or a boolean.
    return text if kind is str and not isinstance(value, str) else value


def _unset_alternatives(values: dict[str, Any], cls: type, key: str) -> None:
    """Of the fields that a section lists in ``ALTERNATIVES``, naming one unsets the others."""
    alternatives = getattr(cls, "ALTERNATIVES", ())
    if key in alternatives:
        values.update((other, None) for other in alternatives if other != key)


def _field_types(cls: type) -> dict[str, Any]:
    """Field -> type, without ``| None``."""
    hints = typing.get_type_hints(cls)
    return {field.name: _without_none(hints[field.name]) for field in dataclasses.fields(cls)}


def _without_none(kind: Any) -> Any:
    """``T`` of ``T | None``, other types as they are."""
    inner = [a for a in typing.get_args(kind) if a is not type(None)]
    optional = typing.get_origin(kind) in (typing.Union, types.UnionType)
    return inner[0] if optional and len(inner) == 1 else kind


def _unknown_key(parents: Sequence[str], name: str, cls: type) -> CaperError:
    prefix = "".join(f"{parent}." for parent in parents)
    return unknown_name("key", prefix + name, (prefix + known for known in _field_types(cls)))
