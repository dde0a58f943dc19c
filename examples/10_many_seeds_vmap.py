"""Many trainings at once: seeds and loss weights side by side in one compiled program.

    python examples/10_many_seeds_vmap.py --steps 500

One run says little: an ablation needs several seeds per variant. ``caper.train_many`` trains all
whose shapes agree under one vmap; each ends as ``caper.train`` would, with a model directory of its
own. Prints mean and spread over seeds of what each variant learned. ``caper ablate`` does the same
from a file, and compares the variants with intervals; ``caper.train_step`` is the plain function
below both, for grids of your own.
"""

import argparse
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
from small import small

import caper_jax as caper

STATE_WEIGHTS = (0.0, 6.0, 24.0)  # of the joint state's loss; the paper's is 6


def main(category: str, seeds: int, steps: int, batch_size: int, out: Path) -> None:
    base = small(caper.preset("fast", category), steps)
    training = replace(base.training, batch_size=batch_size, data_seed=0)  # all see the same data

    runs = {}
    for weight in STATE_WEIGHTS:
        loss = replace(base.loss, weights=replace(base.loss.weights, state=weight))
        for seed in range(seeds):
            own = replace(training, seed=seed)
            runs[f"weight{weight:g}/seed{seed}"] = replace(base, loss=loss, training=own)
    results = {result.name: result for result in caper.train_many(runs, out)}

    names = ("root_deg", "state1_deg")
    print(f"{len(runs)} trainings of {steps} steps, mean +- spread over seeds")
    print("state weight | " + " | ".join(f"{name:>16}" for name in names))
    for weight in STATE_WEIGHTS:
        of_seed = [results[f"weight{weight:g}/seed{seed}"] for seed in range(seeds)]
        cells = []
        for name in names:
            values = np.array([last_tenth(result.directory, name) for result in of_seed])
            cells.append(f"{values.mean():7.2f} +- {values.std(ddof=1):5.2f}")
        print(f"{weight:12g} | " + " | ".join(f"{cell:>16}" for cell in cells))


def last_tenth(directory: Path, name: str) -> float:
    """Mean of a metric over the last tenth of a run."""
    lines = [json.loads(line) for line in (directory / "metrics.jsonl").read_text().splitlines()]
    return float(np.mean([line[name] for line in lines[-max(len(lines) // 10, 1) :]]))


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("--category", default="box")
    parser.add_argument("--seeds", type=int, default=4)
    parser.add_argument("--steps", type=int, default=500)
    parser.add_argument("--batch-size", type=int, default=16)
    parser.add_argument("--out", type=Path, default=Path("outputs") / "examples" / "many_seeds")
    main(**vars(parser.parse_args()))
