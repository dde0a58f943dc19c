"""Train the two networks of a category on generated data, from a preset.

    python examples/05_train_category.py --minutes 30

Writes a run directory, outputs/examples/box: its configuration, metrics.jsonl, checkpoints and, at
the end, the model. Stop it with Ctrl-C and run the same command again: it resumes where it was, and
a run bounded by steps ends with the same bits as if it had never stopped. Prints the first and last
loss, and how far the root's rotation and the joint state were off, in degrees.
"""

import argparse
import json
from dataclasses import replace
from pathlib import Path

from small import small

import caper_jax as caper


def main(category: str, minutes: float, quick: bool, out: Path) -> None:
    config = caper.preset("fast", category)  # "paper": the networks as published
    config = replace(config, training=replace(config.training, minutes=minutes))
    if quick:
        config = small(config, steps=4)
    directory = out / category
    result = caper.train(config, directory)
    if not result.finished:
        print(f"stopped at step {int(result.state.step)}; run the same command again to resume")
        return

    lines = (directory / "metrics.jsonl").read_text().splitlines()
    rows = [row for row in map(json.loads, lines) if "loss" in row]
    for name in ("loss", "root_deg", "state1_deg"):  # see the rows for all the others
        print(f"{name}: {rows[0][name]:.2f} -> {rows[-1][name]:.2f}")
    print(f"{int(result.state.step)} steps: caper.load('{category}', '{directory}')")


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("--category", default="box")
    parser.add_argument("--minutes", type=float, default=30.0, help="of training")
    parser.add_argument("--quick", action="store_true", help="a few steps of small networks")
    parser.add_argument("--out", type=Path, default=Path("outputs/examples"))
    main(**vars(parser.parse_args()))
