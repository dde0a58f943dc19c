"""``caper train``: trains a category's networks on generated data, or resumes a run."""

from __future__ import annotations

import argparse
import dataclasses
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from caper_jax.cli import common
from caper_jax.errors import CaperError

if TYPE_CHECKING:
    from caper_jax.config import RunConfig


ALL = "all"


def build_parser() -> argparse.ArgumentParser:
    parser = common.create_parser(
        "train",
        "Trains both stages of a category on endless generated data. The same command resumes a\n"
        "run that was stopped or killed. Writes metrics.jsonl and checkpoints, and at the end a\n"
        "model (weights.npz, model.json) for --weights of the other commands, and curves.png.",
        [
            ("--category box --minutes 30 --out runs/box", "the fast preset, half an hour"),
            (
                "--category box --config configs/fast.toml --minutes 30 --out runs/box",
                "your settings",
            ),
            ("--category box --from runs/box --minutes 10 --out runs/box2", "goes on from a model"),
            ("--category box --from box --minutes 10 --out runs/mine", "from the one that ships"),
            ("--category laptop --preset paper --steps 1000 --out runs/paper", "as published"),
            ("--category box --data ROOT --format artimage --out runs/own", "your own data"),
            (
                "--category box --set training.learning_rate=1e-3 --steps 500 --out runs/try",
                "one setting",
            ),
            ("--category all --from runs/box --minutes 60 --out runs", "each into runs/<category>"),
        ],
    )
    parser.add_argument(
        "--category",
        required=True,
        help="e.g. box, or FILE.py:NAME for one of your own, or all, one after the other",
    )
    parser.add_argument(
        "--preset", help="fast or paper (default: fast; with --from the network of that model)"
    )
    parser.add_argument("--config", type=Path, help="TOML file of settings over the preset's")
    parser.add_argument(
        "--set",
        action="append",
        default=[],
        metavar="KEY=VALUE",
        dest="overrides",
        help="one setting, e.g. training.batch_size=8; may be repeated",
    )
    parser.add_argument(
        "--from",
        type=common.model_folder,
        dest="initial",
        metavar="DIR",
        help="start from the weights of this model, or of the one that ships for a category, "
        "instead of random ones; one of another category gives its encoders; a folder of models "
        "gives each category its own",
    )
    parser.add_argument(
        "--data",
        type=Path,
        help="a dataset's folder or .h5 file to train on instead of generated frames",
    )
    parser.add_argument(
        "--format", help="layout of --data (default: the configuration's, or caper)"
    )
    parser.add_argument("--split", help="split of --data (default: the configuration's, or train)")
    budget = parser.add_mutually_exclusive_group()
    budget.add_argument(
        "--minutes",
        type=common.positive_float,
        help="minutes of training (default: the configuration's, or 60); compiling comes before, "
        "the fit of sides and confidence after",
    )
    budget.add_argument(
        "--steps", type=common.positive_int, help="length in steps: reproducible to the bit"
    )
    parser.add_argument(
        "--seed", type=common.non_negative_int, help="of shapes, frames and weights (default: 0)"
    )
    parser.add_argument("--out", required=True, type=Path, help="folder of the run")
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """Runs the command; returns its exit code."""
    arguments = build_parser().parse_args(sys.argv[1:] if argv is None else argv)
    common.check_folder(arguments.out, "--out")
    from caper_jax import categories

    if arguments.category != ALL:
        return _train(arguments.category, arguments, arguments.out, arguments.initial)
    for name in categories.names():
        print(f"{name}:", flush=True)
        initial = arguments.initial
        if initial is not None and (initial / name).is_dir():
            initial /= name
        code = _train(name, arguments, arguments.out / name, initial)
        if code:
            return code
    return 0


def _train(category: str, arguments: argparse.Namespace, out: Path, initial: Path | None) -> int:
    """Trains one category; returns the exit code."""
    from caper_jax.training import train as run

    result = run.train(_configuration(category, arguments, initial), out, initial)
    if not result.finished:  # which says itself where it stopped
        return common.EXIT_INTERRUPTED
    print(f"trained {int(result.state.step)} steps; the model is in {out}")
    _plot(category, out)
    return 0


def _plot(category: str, out: Path) -> None:
    """Writes curves.png beside the metrics it shows."""
    import jax

    from caper_jax.training.run_directory import METRICS_FILE, read_metrics
    from caper_jax.visualization.curves import training_curves, write_curves

    if jax.process_index() or not (out / METRICS_FILE).is_file():
        return
    if rows := read_metrics(out / METRICS_FILE):
        write_curves(out / "curves.png", training_curves(f"Training of {category}", rows))


def _configuration(category: str, arguments: argparse.Namespace, initial: Path | None) -> RunConfig:
    """The run that the arguments describe; ``initial`` as for ``run.train``."""
    from caper_jax.config import override, update
    from caper_jax.training import train as run

    if initial is not None and arguments.preset is None:
        config = run.preset_of(initial, category)
    else:
        config = run.preset(arguments.preset or "fast", category)
    config = _with_dataset(config, arguments)
    if arguments.config is not None:
        # A file may say how --data is read, and does not replace it.
        config = _with_dataset(update(config, arguments.config), arguments)
    if config.loader is None and any(o.startswith("loader.") for o in arguments.overrides):
        raise CaperError("--set loader.* goes with --data, or a [loader] in the configuration")
    config = override(config, *arguments.overrides)
    if config.category != category:
        raise CaperError(
            f"--category says {category}, the configuration {config.category}: remove one"
        )
    budget = {"minutes": arguments.minutes, "steps": arguments.steps}
    if any(value is not None for value in budget.values()):
        config = dataclasses.replace(
            config, training=dataclasses.replace(config.training, **budget)
        )
    if arguments.seed is not None:
        training = dataclasses.replace(config.training, seed=arguments.seed)
        config = dataclasses.replace(config, training=training)
    return config


def _with_dataset(config: RunConfig, arguments: argparse.Namespace) -> RunConfig:
    """The configuration with --data, --format and --split in it."""
    from caper_jax.config import LoaderConfig

    if arguments.data is None:
        for option in ("format", "split"):
            if getattr(arguments, option) is not None:
                raise CaperError(f"--{option} goes with --data")
        return config
    given = {"format": arguments.format, "split": arguments.split, "root": str(arguments.data)}
    given = {name: value for name, value in given.items() if value is not None}
    source = config.loader or LoaderConfig("caper", given["root"])
    return dataclasses.replace(config, loader=dataclasses.replace(source, **given))
