"""Export a model and run it where caper_jax is not installed.

    python examples/11_export_and_serve.py

Writes outputs/examples/serving: the model as StableHLO with its weights, manifest.json (shapes,
units and frames of what goes in and comes out) and run.py, which needs jax and numpy alone. Then
runs run.py in a process of its own, as a server would, and compares its poses with the estimator's.
"""

import argparse
import subprocess
import sys
from pathlib import Path

import jax
import numpy as np

import caper_jax as caper


def main(category: str, out: Path) -> None:
    estimator = caper.load(category)
    folder = out / "serving"
    manifest = caper.export_estimator(estimator, folder, platforms=("cpu", "cuda"))
    size = sum(path.stat().st_size for path in folder.iterdir()) / 1e6
    print(f"{folder}: {size:.1f} MB, for {', '.join(manifest['platforms'])}")
    for name, output in manifest["outputs"].items():
        print(f"  {name} {output['shape']} [{output['unit']}]")

    sensor = caper.GeneratorConfig(instances=2, noise=("kinect",))
    generator = caper.Generator(estimator.category, sensor, split="test")
    points = np.asarray(generator.batch(jax.random.key(0), 1).points[0])  # [1024, 3] meters
    np.save(folder / "cloud.npy", points)

    command = [sys.executable, "run.py", "cloud.npy", "poses.npz"]
    print("$", " ".join(["python", *command[1:]]))
    subprocess.run(command, cwd=folder, check=True)

    served, pose = np.load(folder / "poses.npz"), estimator(points).pose
    for name in ("rotation", "translation", "joint_state"):
        difference = np.abs(served[name][0] - np.asarray(getattr(pose, name))).max()
        print(f"{name}: largest difference {difference:.1e}")


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("--category", default="box")
    parser.add_argument("--out", type=Path, default=Path("outputs/examples"))
    main(**vars(parser.parse_args()))
