"""What generated frames look like, as a section of a configuration."""

from __future__ import annotations

from dataclasses import dataclass

from caper_jax.data.synthetic.masks import OCCLUDERS
from caper_jax.data.synthetic.sensor import PRESETS
from caper_jax.errors import CaperError, check_fractions, check_least, unknown_name

_FRACTIONS = (
    "occlusion", "erosion", "table", "clutter", "spill", "residue", "dropout", "holes",
)  # fmt: skip

LEAST = {"instances": 1, "grid": 8, "num_points": 16}


@dataclass(frozen=True)
class GeneratorConfig:
    """What the generated frames look like.

    Rates are fractions of frames, drawn independently of each other; a disturbance that would
    leave less than 30 % of the object's pixels leaves the frame as it is.

    Attributes:
      instances: shapes in the bank.
      grid: rays per side over the object's projected box.
      num_points: points per frame.
      noise: sensor presets, one drawn per frame (none, gauss3mm, kinect, realsense).
      occlusion: rate of frames with a part of the object hidden by something in front.
      occluders: how it hides, one drawn per frame: "edge" all beyond a line, "strip" a band
        across the image, "blob" an ellipse.
      erosion: rate of frames whose mask is too tight, by 1 to 3 % of the grid's side; frames that
        take in the table are spared.
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
      measure_visibility: fill ``Batch.visibility``.
    """

    instances: int = 2000
    grid: int = 96
    num_points: int = 1024
    noise: tuple[str, ...] = ("kinect",)
    occlusion: float = 0.0
    occluders: tuple[str, ...] = ("edge",)
    erosion: float = 0.0
    table: float = 0.0
    clutter: float = 0.0
    spill: float = 0.1
    residue: float = 0.0
    dropout: float = 0.0
    holes: float = 0.0
    depth_scale: float = 0.0
    measure_visibility: bool = False

    def __post_init__(self) -> None:
        check_least("data", self, **LEAST)
        check_fractions("data", self, _FRACTIONS)
        if not 0.0 <= self.depth_scale <= 0.1:
            raise CaperError(
                f"data.depth_scale is a relative error from 0 to 0.1, got {self.depth_scale}"
            )
        if not self.noise:
            raise CaperError("data.noise needs at least one preset; use ['none'] for clean depth")
        if not self.occluders:
            raise CaperError("data.occluders needs at least one; set data.occlusion = 0 for none")
        for name, known in (("noise", PRESETS), ("occluders", OCCLUDERS)):
            for value in getattr(self, name):
                if value not in known:
                    raise unknown_name(f"data.{name} entry", value, known)
