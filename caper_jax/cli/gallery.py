"""``caper gallery``: a picture of a category's generated shapes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from caper_jax.cli import common
from caper_jax.cli.common import Count, Size

if TYPE_CHECKING:
    from caper_jax.articulation.category import Category

EXAMPLES = (
    ("--out gallery.png", "all categories"),
    ("--category box,laptop --instances 12 --seed 3 --out some.png", "some of them"),
    ("--category microwave.py:MICROWAVE --out mine.png", "your own"),
)
_MEASURED = 200  # shapes whose sizes are averaged


@dataclass(frozen=True)
class Gallery:
    """Draws generated instances, parts colored, in random states before random cameras.

    One row per category; the unit and the mean sizes that the category states and its shapes have
    are printed. Look at both before you train on shapes of your own.

    Attributes:
      out: the PNG to write
      category: a name, several with commas, FILE.py:NAME, or all
      instances: per row
      split: whose instances
      seed: of shapes, states and cameras
    """

    out: Path
    category: tuple[str, ...] = ()
    instances: Count = 8
    split: Literal["train", "val", "test"] = "train"
    seed: Size = 0


def parse(argv: Sequence[str]) -> Gallery:
    options = common.parse(Gallery, argv, EXAMPLES)
    common.check_folder(options.out.parent, "--out")
    return options


def run(options: Gallery) -> int:
    """Runs the command; returns its exit code."""
    from caper_jax import categories
    from caper_jax.visualization.gallery import write_gallery

    chosen = [categories.get(name) for name in common.chosen_categories(options.category)]
    options.out.parent.mkdir(parents=True, exist_ok=True)
    write_gallery(options.out, chosen, options.instances, options.split, options.seed)
    for category in chosen:
        print("\n".join(_sizes(category, options.seed)))
    print(f"written: {options.out}")
    return 0


def _sizes(category: Category, seed: int) -> list[str]:
    """Lines with a category's unit and mean sizes beside those of shapes drawn in training."""
    from caper_jax.synthetic.instances import statistics

    drawn = statistics(category, _MEASURED, seed)["mean_size"]
    lines = [f"{category.name}: unit {category.unit:g} (network units per meter)"]
    for name, stated, mean in zip(category.parts, category.mean_size, drawn, strict=True):
        lines.append(
            f"  {name}: mean size {_meters(stated)}, of {_MEASURED} shapes {_meters(mean)}"
        )
    return lines


def _meters(size: Sequence[float]) -> str:
    return " x ".join(f"{extent:.3f}" for extent in size) + " m"
