"""What the paper reports for CAPER++, read from ``paper.json``, and what it leaves unsaid.

Parts are in the paper's order, root first, which is ours where the numbers of parts agree.

The paper gives translation errors in meters but not the size of its objects; ours are relative to
the diagonal of the object's box at rest. To compare, the paper's meters are divided by
"diagonal_m", assumed for three kinds of objects. "partnet" (ArtImage, PM-Videos): PartNet's units
are taken as meters, about 2 across. "reart" (ReArtMix, ReArt-Videos): mean over the 43 scanned
objects of ReArt-48 of the diagonals of their boxes, as the public urdf_metas.json of ReArtMix has
them. "robotarm": a Franka arm, about 1.1 m from the base plate to the top at zero angles.
"""

from __future__ import annotations

import json
from functools import cache
from importlib import resources
from typing import Any

from pydantic import BaseModel, ConfigDict


class _Data(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class Figures(_Data):
    """Errors of CAPER++ on one category.

    Attributes:
      rotation_deg: of each part.
      translation_m: of each part.
      iou_percent: "3D IoU" of each part; empty where the paper has none.
      diagonal_m: of the paper's objects, assumed.
    """

    rotation_deg: tuple[float, ...]
    translation_m: tuple[float, ...]
    iou_percent: tuple[float, ...] = ()
    diagonal_m: float

    def part(self, index: int) -> dict[str, float | None]:
        """The figures that stand beside our part: those in JSON and "translation_relative".

        Where the paper's objects have fewer parts (ReArt's drawers have one drawer, ours three),
        its last one stands beside each of ours that it lacks.
        """
        index = min(index, len(self.rotation_deg) - 1)
        return {
            "rotation_deg": self.rotation_deg[index],
            "translation_m": self.translation_m[index],
            "translation_relative": self.translation_m[index] / self.diagonal_m,
            "iou_percent": self.iou_percent[index] if self.iou_percent else None,
        }


class PaperTable(_Data):
    """One table of the paper.

    Attributes:
      title: number and subject.
      dataset: what it was measured on.
      objects: key of "diagonal_m".
      videos, frames: of the paper's test set, and of each of its videos. A table of single frames
        has no videos; the paper does not say how many frames, and ours are as many as this.
      categories: our names -> figures of CAPER++.
      variants: rows of an ablation: its name -> category -> figures.
    """

    title: str
    dataset: str
    objects: str
    videos: int
    frames: int
    categories: dict[str, Figures] = {}
    variants: dict[str, dict[str, Figures]] = {}

    def measured_on(self) -> str:
        """The paper's data, as a line above ours."""
        extent = f" ({self.videos} videos of {self.frames} frames)" if self.videos else ""
        return f"the paper measured on {self.dataset}{extent}, ours were measured on:"


class PoseFigures(_Data):
    """Mean errors of one row of Table 7 or 8."""

    rotation_deg: float
    translation_m: float


class OcclusionFigures(PoseFigures):
    """A row of Table 8: means over all parts of which this share is occluded."""

    occluded: tuple[float, float]


class Paper(_Data):
    """All figures.

    Attributes:
      frames_per_second: of the tracker, Table 6; on one RTX 3090.
      diagonal_m: kind of objects -> category -> assumed diagonal.
      tables: by the name of the subcommand that measures them.
      occlusion: Table 8, the drawers of ArtImage.
      root_input: Table 7, the root's pose after stage I on ArtImage: category -> input -> errors.
    """

    frames_per_second: float
    diagonal_m: dict[str, dict[str, float]]
    tables: dict[str, PaperTable]
    occlusion: tuple[OcclusionFigures, ...]
    root_input: dict[str, dict[str, PoseFigures]]


@cache
def paper() -> Paper:
    """The paper's figures, each with the assumed diagonal of its objects."""
    text = (resources.files("caper_jax") / "reproduce" / "paper.json").read_text("utf-8")
    content: dict[str, Any] = json.loads(text)
    for table in content["tables"].values():
        diagonals = content["diagonal_m"][table["objects"]]
        for figures in (table.get("categories", {}), *table.get("variants", {}).values()):
            for category, errors in figures.items():
                errors["diagonal_m"] = diagonals[category]
    return Paper.model_validate(content)
