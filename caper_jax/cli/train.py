"""``caper train``: trains a category's networks on generated data, or resumes a run."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from caper_jax.cli import common
from caper_jax.cli.common import Count, Positive, Settings, Size
from caper_jax.errors import CaperError

if TYPE_CHECKING:
    from caper_jax.config import RunConfig

EXAMPLES = (
    ("--category box --minutes 30 --out runs/box", "the fast preset, half an hour"),
    ("--category box --config configs/fast.toml --out runs/box", "your settings"),
    ("--category box --from runs/box --minutes 10 --out runs/box2", "goes on from a model"),
    ("--category box --from box --minutes 10 --out runs/mine", "from the one that ships"),
    ("--category laptop --preset paper --steps 1000 --out runs/paper", "as published"),
    ("--category box --data ROOT --format artimage --epochs 250 --out runs/own", "your own data"),
    ("--category box --training.learning-rate 1e-3 --out runs/try", "one setting"),
    ("--category all --from runs/box --minutes 60 --out runs", "each into runs/<category>"),
)


SECTIONS = {
    "network": "sizes of both stages",
    "data": "generated frames",
    "loader": "how --data is read",
    "loss": "weights and targets",
    "training": "optimizer and budget",
}


@dataclass(frozen=True)
class Train:
    """Trains both stages of a category on endless generated data.

    The same command resumes a run that was stopped or killed. Writes metrics.jsonl and
    checkpoints, and at the end a model (weights.npz, model.json) for --weights of the other
    commands, and curves.png.

    Attributes:
      category: e.g. box, or FILE.py:NAME for one of your own; several with commas, or all, one
        after the other, each into a folder of its own in --out
      out: folder of the run
      preset: fast, paper or ablation (default: fast; with --from the network of that model)
      config: TOML file of settings over the preset's
      initial: start from the weights of this model, or of the one that ships for a category,
        instead of random ones; one of another category gives its encoders; a folder of models
        gives each category its own
      data: a dataset's folder or .h5 file to train on instead of generated frames
      format: layout of --data (default: the configuration's, or caper)
      split: split of --data (default: the configuration's, or train)
      minutes: of training (default: the configuration's, or 60); compiling comes before, the fit
        of the refiner and of the standard deviations after
      steps: length in steps instead: reproducible to the bit
      epochs: length in passes over --data instead; likewise
      seed: of shapes, frames and weights (default: 0)
      init_weight_average: with --from, how much of that model is in the weights that are written
        (default: 0)
      calibration_frames: on which the trained model learns how wrong it is (default: 4096; 0: it
        never says)
      settings: "section.key=value"
    """

    category: tuple[str, ...]
    out: Path
    preset: Literal["fast", "paper", "ablation"] | None = None
    config: Path | None = None
    initial: Annotated[Path | None, tyro.conf.arg(name="from")] = None
    data: Path | None = None
    format: str | None = None
    split: str | None = None
    minutes: Positive | None = None
    steps: Count | None = None
    epochs: Positive | None = None
    seed: Size | None = None
    init_weight_average: float | None = None
    calibration_frames: Size | None = None
    settings: Annotated[tuple[str, ...], tyro.conf.Suppress] = ()


def parse(argv: Sequence[str]) -> Train:
    options, settings = common.parse_with_settings(
        Train, argv, EXAMPLES, Settings(SECTIONS, default_sections)
    )
    bounds = (options.minutes, options.steps, options.epochs)
    if sum(bound is not None for bound in bounds) > 1:
        raise CaperError("give one of --minutes, --steps and --epochs")
    if options.data is None:
        for option in ("format", "split"):
            if getattr(options, option) is not None:
                raise CaperError(f"--{option} goes with --data")
    common.check_folder(options.out, "--out")
    return dataclasses.replace(options, settings=tuple(settings))


def default_sections() -> Mapping[str, Any]:
    """The sections of a run by name, as the fast preset has them."""
    from caper_jax.config import LoaderConfig, preset

    fast = preset("fast")
    return vars(dataclasses.replace(fast, loader=LoaderConfig("caper", "ROOT")))


def run(options: Train) -> int:
    """Runs the command; returns its exit code."""
    names = common.chosen_categories(options.category)
    initial = None if options.initial is None else common.model_folder(options.initial)
    if len(names) == 1 and common.ALL not in options.category:
        return _train(names[0], options, options.out, initial)
    for name in names:
        print(f"{name}:", flush=True)
        own = initial
        if own is not None and (own / name).is_dir():
            own /= name
        code = _train(name, options, options.out / name, own)
        if code:
            return code
    return 0


def _train(category: str, options: Train, out: Path, initial: Path | None) -> int:
    """Trains one category; returns the exit code."""
    from caper_jax.training import train

    result = train.train(_configuration(category, options, initial), out, initial)
    if not result.finished:  # which says itself where it stopped
        return common.EXIT_INTERRUPTED
    print(f"trained {int(result.state.step)} steps; the model is in {out}")
    _plot(category, out)
    return 0


def _plot(category: str, out: Path) -> None:
    """Writes curves.png beside the metrics it shows."""
    import jax

    from caper_jax.training.run_directory import METRICS_FILE, read_metrics
    from caper_jax.visualization.plots import training_curves, write_plot

    if jax.process_index() or not (out / METRICS_FILE).is_file():
        return
    if rows := read_metrics(out / METRICS_FILE):
        write_plot(out / "curves.png", training_curves(f"Training of {category}", rows))


def _configuration(category: str, options: Train, initial: Path | None) -> RunConfig:
    """The run that the options describe; ``initial`` as for ``train.train``."""
    from caper_jax.config import override, preset, update
    from caper_jax.training.train import preset_of

    if initial is not None and options.preset is None:
        config = preset_of(initial, category)
    else:
        config = preset(options.preset or "fast", category)
    config = _with_dataset(config, options)
    if options.config is not None:
        # A file may say how --data is read, and does not replace it.
        config = _with_dataset(update(config, options.config), options)
    if config.loader is None and any(s.startswith("loader.") for s in options.settings):
        raise CaperError("--loader.* goes with --data, or a [loader] in the configuration")
    given = {
        "training.minutes": options.minutes,
        "training.steps": options.steps,
        "training.epochs": options.epochs,
        "training.seed": options.seed,
        "init_weight_average": options.init_weight_average,
        "calibration_frames": options.calibration_frames,
    }
    main = [f"{key}={value}" for key, value in given.items() if value is not None]
    config = override(config, *options.settings, *main)
    if config.category != category:
        raise CaperError(
            f"--category says {category}, the configuration {config.category}: remove one"
        )
    return config


def _with_dataset(config: RunConfig, options: Train) -> RunConfig:
    """The configuration with --data, --format and --split in it."""
    from caper_jax.config import LoaderConfig

    if options.data is None:
        return config
    source = config.loader or LoaderConfig("caper", "")
    loader = dataclasses.replace(
        source,
        format=options.format or source.format,
        split=options.split or source.split,
        root=str(options.data),
    )
    return dataclasses.replace(config, loader=loader)
