"""What the package computes today, kept as arrays, to be compared after a change.

    python benchmarks/golden.py record outputs/golden      # before
    python benchmarks/golden.py compare outputs/golden     # after, on the same machine

Estimates of all demo frames, one tracked video each of a box and a laptop, training steps of both
encoders, one generated batch per category, and an exported model. ``compare`` prints every array
that is not equal to the bit, with the largest difference, and exits with 1 if there is any.
"""

from __future__ import annotations

import importlib.util
import sys
import tempfile
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import caper_jax as caper
from caper_jax.config import (
    FastEncoderConfig,
    GeneratorConfig,
    HeadConfig,
    HSEncoderConfig,
    LossConfig,
    NetworkConfig,
    RotationClassifierConfig,
)
from caper_jax.data.clouds import cloud_from_depth
from caper_jax.data.images import read_depth, read_intrinsics, read_mask
from caper_jax.export import export_estimator
from caper_jax.synthetic.frames import Generator
from caper_jax.synthetic.videos import VideoGenerator
from caper_jax.training.objective import Objective
from caper_jax.training.optimizer import Optimizer
from caper_jax.training.step import TrainState, compile_step

DEMO = Path(caper.__file__).parent / "assets" / "demo"
SMALL = HeadConfig(widths=(16, 16, 16))


def flat(tree: Any) -> dict[str, np.ndarray]:
    """Arrays of a pytree by number: names may change, their order does not."""
    return {f"{i:03d}": np.asarray(leaf) for i, leaf in enumerate(jax.tree.leaves(tree))}


def demo_cloud(folder: Path) -> np.ndarray:
    depth, mask = read_depth(folder / "depth.png"), read_mask(folder / "mask.png")
    return cloud_from_depth(depth, mask, read_intrinsics(folder / "intrinsics.json")).points


def estimates(category: str) -> dict[str, np.ndarray]:
    estimator = caper.load(category)
    found = {}
    for folder in sorted(DEMO.glob(f"{category}_*")):
        prediction = estimator(demo_cloud(folder))
        arrays = {**vars(prediction.pose), **vars(prediction)}
        arrays.pop("pose")
        found |= {
            f"{folder.name}/{i:02d}": np.asarray(a)
            for i, a in enumerate(arrays.values())
            if a is not None
        }
    return found


def track(category: str) -> dict[str, np.ndarray]:
    config = GeneratorConfig(instances=8, noise=("kinect",))
    generator = VideoGenerator(caper.categories.get(category), config, "cam", 12, "test", 3)
    video = generator.batch(jax.random.key(5), 1)
    tracker = caper.load_tracker(category)
    results = [tracker(np.asarray(points)) for points in np.asarray(video.points[0])]
    return flat((video, results))


def batch(category: str) -> dict[str, np.ndarray]:
    config = GeneratorConfig(
        instances=16, occlusion=0.5, erosion=0.5, table=0.5, clutter=0.5, holes=0.5
    )
    generator = Generator(caper.categories.get(category), config, "train", 1)
    return flat(generator.batch(jax.random.key(7), 8))


def training(encoder: str) -> dict[str, np.ndarray]:
    category = caper.categories.get("box")
    network = NetworkConfig(
        encoder=encoder,
        hs=HSEncoderConfig(channels=(8, 8, 16, 16, 16), neighbors=6, supports=2),
        fast=FastEncoderConfig(centers=16, stride=1, width=16, blocks=1, last=16),
        root_heads=SMALL,
        pooled_heads=SMALL,
        point_heads=SMALL,
        rotation_classifier=RotationClassifierConfig(16),
        num_points=128,
    )
    loss = LossConfig()
    generator = Generator(category, GeneratorConfig(instances=8, grid=16, num_points=128))
    task = Objective(category, network, loss)
    name = "ranger" if encoder == "hs" else "adamw"
    optimizer = Optimizer(name=name, learning_rate=1e-3)
    variables = task.init(jax.random.key(0))
    state = TrainState.create(variables, optimizer, 3)
    step = compile_step(task, optimizer)
    metrics = []
    for number in range(3):
        data = generator.batch(jax.random.key(number), 4)
        one = jnp.ones(1)
        state, found = step(state, one * 0.1, one, data)
        metrics.append({name: found[name] for name in ("loss", "gradient_norm", "root_deg")})
    # By content: weights are in dicts, whose order changes with names.
    leaves = [np.asarray(leaf) for leaf in jax.tree.leaves((state, metrics))]
    return flat(sorted(leaves, key=lambda a: (a.shape, str(a.dtype), a.tobytes())))


def exported(category: str) -> dict[str, np.ndarray]:
    old_name = {"points_per_part": "seen"}
    with tempfile.TemporaryDirectory() as folder:
        export_estimator(caper.load(category), folder, platforms=("cpu",))
        spec = importlib.util.spec_from_file_location("run", Path(folder) / "run.py")
        assert spec and spec.loader
        runner = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(runner)
        cloud = runner.sample(demo_cloud(DEMO / f"{category}_0"))
        found = runner.estimate(cloud[None])
    # In the order of the record, which had the joints in the rest frame only.
    found = {old_name.get(name, name): array for name, array in found.items()}
    names = sorted(name for name in found if not name.endswith("_camera"))
    return {f"{i:02d}": np.asarray(found[name]) for i, name in enumerate(names)}


CASES = {
    **{f"estimate_{name}": (estimates, name) for name in caper.categories.names()},
    **{f"batch_{name}": (batch, name) for name in caper.categories.names()},
    **{f"track_{name}": (track, name) for name in ("box", "laptop")},
    **{f"training_{name}": (training, name) for name in ("fast", "hs")},
    "export_box": (exported, "box"),
}


def main() -> int:
    action, folder, *chosen = sys.argv[1:]
    directory = Path(folder)
    directory.mkdir(parents=True, exist_ok=True)
    different = 0
    for name in chosen or CASES:
        function, argument = CASES[name]
        arrays = function(argument)
        path = directory / f"{name}.npz"
        if action == "record":
            np.savez_compressed(path, **arrays)
            print(f"{name}: {len(arrays)} arrays", flush=True)
            continue
        with np.load(path) as stored:
            before = {key: stored[key] for key in stored.files}
        problems = [] if before.keys() == arrays.keys() else ["other arrays than before"]
        for key in before.keys() & arrays.keys():
            old, new = before[key], arrays[key]
            if old.shape != new.shape or old.dtype != new.dtype:
                problems.append(f"{key}: {old.shape} {old.dtype} -> {new.shape} {new.dtype}")
            elif old.tobytes() != new.tobytes():
                gap = np.abs(old.astype(float) - new.astype(float)).max()
                problems.append(f"{key} {old.shape}: differs by up to {gap:.3g}")
        different += bool(problems)
        print(f"{name}: {'; '.join(sorted(problems)) or 'equal'}", flush=True)
    return int(different > 0)


if __name__ == "__main__":
    raise SystemExit(main())
