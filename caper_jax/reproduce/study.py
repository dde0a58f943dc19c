"""What a study compares, as its TOML file says it, and the trainings that it takes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from importlib import resources
from pathlib import Path
from typing import Annotated, Any, Literal

from annotated_types import MinLen

from caper_jax import categories
from caper_jax.config import (
    Count,
    NetworkConfig,
    RunConfig,
    Seed,
    TrackerConfig,
    from_dict,
    merge,
    override,
    preset,
    read_toml,
    section,
)
from caper_jax.errors import CaperError, unknown_name

Measure = Literal["whole", "root", "tracking"]
# Tables of a variant that change how its trained model is used, not how it is trained.
_IN_USE = ("estimate", "tracker")


@section
@dataclass(frozen=True)
class Study:
    """Variants of a training, each with several seeds, on some categories.

    Attributes:
      title: of the report.
      variants: name -> its settings, as the tables of a configuration file: [variants.NAME.loss]
        and so on; empty for the preset as it is. [variants.NAME.estimate] holds settings of the
        network that change how the trained model is used (``refine_steps``, ``refiner.width``,
        ``rotation_classifier.margin``), [variants.NAME.tracker] those of the tracker. Variants that
        differ in these two alone share their trainings.
      baseline: the variant that all others are compared with.
      categories: names, or FILE.py:NAME.
      preset: that all variants start from.
      settings: of all variants, in the same form.
      seeds: how many, from 0 on, or a list.
      steps: of each training; None for those of the preset.
      shared_data: all seeds see the same frames in the same order, which are generated once;
        otherwise each seed has its own, which all variants see.
      frames: unseen frames per category on which every model is measured.
      measure: "whole", errors of the estimator; "root", of the root's pose by stage I alone; or
        "tracking", of the tracker on videos.
    """

    title: str
    variants: Annotated[dict[str, dict[str, Any]], MinLen(1)]
    baseline: str
    categories: Annotated[tuple[str, ...], MinLen(1)] = ("box",)
    preset: Literal["fast", "paper", "ablation"] = "ablation"
    settings: dict[str, Any] = field(default_factory=dict)
    seeds: Count | tuple[Seed, ...] = 8
    steps: Count | None = None
    shared_data: bool = True
    frames: Count = 1000
    measure: Measure = "whole"

    def __post_init__(self) -> None:
        if self.baseline not in self.variants:
            raise unknown_name("baseline", self.baseline, self.variants)
        seeds = self.seed_list
        if not seeds:
            raise CaperError("seeds: give a number or a list of them")
        if repeated := sorted({seed for seed in seeds if seeds.count(seed) > 1}):
            raise CaperError(
                f"seeds: {', '.join(map(str, repeated))} stands there more than once; a repeated "
                "seed repeats the same training"
            )

    @property
    def seed_list(self) -> tuple[int, ...]:
        """The seeds."""
        return tuple(range(self.seeds)) if isinstance(self.seeds, int) else tuple(self.seeds)


@dataclass(frozen=True)
class Run:
    """One model of a study: a variant with a seed.

    Attributes:
      category: its own name.
      variant, seed: of the study.
      member: name of its training; variants that differ in their use share it.
      training: the training itself.
      network: with which the trained model is used.
      tracker: settings of its tracker, in the form of a configuration file.
    """

    category: str
    variant: str
    seed: int
    member: str
    training: RunConfig
    network: NetworkConfig
    tracker: dict[str, Any]


def shipped_studies() -> dict[str, Path]:
    """Name -> file of the studies that come with the package: those of the paper's ablations."""
    folder = Path(str(resources.files("caper_jax") / "assets" / "ablations"))
    return {path.stem: path for path in sorted(folder.glob("*.toml"))}


def read_study(source: str | Path) -> Study:
    """A study from its TOML file, or a shipped one by its name.

    Raises:
      CaperError: no such file or study; an unknown key, a wrong value, a repeated seed.
    """
    known = shipped_studies()
    path = known.get(str(source), Path(source))
    if str(source) not in known and not path.is_file():
        names = ", ".join(known)
        raise CaperError(f"{source} is neither a file nor a study that ships ({names})")
    return from_dict(Study, read_toml(path), str(path))


def runs_of(study: Study, extra: tuple[str, ...] = ()) -> list[Run]:
    """All models of a study, by category, variant and seed.

    Args:
      study: what is compared.
      extra: "section.key=value" of all trainings, over the study's own settings.

    Raises:
      CaperError: an unknown category or setting, or a wrong value; names the variant.
    """
    found = []
    for given in study.categories:
        name = categories.get(given).name
        names: dict[RunConfig, str] = {}  # training with seed 0 -> how it is called
        for variant, changes in study.variants.items():
            where = f"variant {variant!r}"
            base = merge(preset(study.preset, given), study.settings, "settings")
            training = {k: v for k, v in changes.items() if k not in _IN_USE}
            base = override(merge(base, training, where), *extra)
            if study.steps is not None:
                limits = replace(base.training, steps=study.steps, minutes=None)
                base = replace(base, training=limits)
            network = merge(base.network, changes.get("estimate", {}), f"{where}, estimate")
            tracker = changes.get("tracker", {})
            merge(TrackerConfig(), tracker, f"{where}, tracker")  # checks it
            # Not named after a study: several that lie in one folder share what they share.
            member = names.setdefault(base, _file_name(variant if training else study.preset))
            for seed in study.seed_list:
                own = replace(base.training, seed=seed)
                if study.shared_data:
                    own = replace(own, data_seed=study.seed_list[0])
                found.append(
                    Run(
                        category=name,
                        variant=variant,
                        seed=seed,
                        member=f"{name}/{member}_{base.training.steps}steps_seed{seed}",
                        training=replace(base, training=own),
                        network=network,
                        tracker=tracker,
                    )
                )
    return found


def trainings(runs: list[Run]) -> Mapping[str, RunConfig]:
    """Member -> its training, each once."""
    return {run.member: run.training for run in runs}


def _file_name(variant: str) -> str:
    return "".join(c if c.isalnum() or c in "-_." else "_" for c in variant)
