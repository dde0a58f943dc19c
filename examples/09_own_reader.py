"""A dataset reader of one's own, checked with the ground truth.

    python examples/09_own_reader.py

The dataset is a folder of .npz files, one a frame, that this script writes first. A reader says
which categories and frames a folder holds and turns a file into a ``caper.Frame``; its poses must
be in meters, camera frame, from the rest frame of the conventions. Evaluated with its own truth, a
reader that is right scores 0 deg and an IoU of 1: that is what this script prints, and with --model
the errors of the shipped model.
"""

import argparse
from dataclasses import fields
from pathlib import Path

import jax
import numpy as np

import caper_jax as caper

POSE = [field.name for field in fields(caper.ArticulatedPose)]


def write_dataset(root: Path, category: str, frames: int) -> None:
    """root/CATEGORY/0000.npz and on: points [N, 3], labels [N], and the arrays of the pose."""
    sensor = caper.GeneratorConfig(instances=frames, noise=("kinect",))
    generator = caper.Generator(caper.categories.get(category), sensor, split="test")
    batch = jax.device_get(generator.batch(jax.random.key(0), frames))
    (root / category).mkdir(parents=True, exist_ok=True)
    for number in range(frames):
        pose = {name: getattr(batch.pose, name)[number] for name in POSE}
        path = root / category / f"{number:04d}.npz"
        np.savez(path, points=batch.points[number], labels=batch.labels[number], **pose)


class NpzReader(caper.DatasetReader):
    """Frames of ``write_dataset``."""

    format = "npz"
    mask_source = "rendered"  # how the object was told from its surroundings

    @classmethod
    def categories_in(cls, root: Path) -> list[str]:
        return [folder.name for folder in root.iterdir() if folder.is_dir()]

    def list_frames(self) -> dict[str, Path]:
        folder = self.root / self.category.name
        return {path.stem: path for path in sorted(folder.glob("*.npz"))}

    def read_frame(self, name: str, path: Path) -> caper.Frame:
        arrays = dict(np.load(path))  # never unpickles
        pose = caper.ArticulatedPose(**{key: arrays[key] for key in POSE})
        return caper.Frame(name, arrays["points"], arrays["labels"], pose)


def truth(frames, points) -> caper.ArticulatedPose:
    """The predictor that knows: poses [B, K, ...] of B frames and their clouds [B, N, 3]."""
    return jax.tree.map(lambda *rows: np.stack(rows), *[frame.truth for frame in frames])


def main(category: str, frames: int, model: bool, out: Path) -> None:
    root = out / "npz_dataset"
    write_dataset(root, category, frames)
    caper.register_reader("npz", NpzReader)
    dataset = caper.open_dataset("npz", root, category)
    print(f"{len(dataset)} frames of {dataset.category.name}, split {dataset.split}")

    predictors = {"truth": truth}
    if model:
        estimator = caper.load(category)
        predictors["model"] = lambda _, points: estimator(points).pose
    for name, predictor in predictors.items():
        evaluation = caper.evaluate(dataset, predictor)
        errors = caper.pose_errors(evaluation.estimate, evaluation.truth, dataset.category)
        rotation, iou = np.median(errors.rotation_deg, 0), np.median(errors.iou_full, 0)
        for part, degrees, overlap in zip(dataset.category.parts, rotation, iou, strict=True):
            print(f"{name}, {part}: {degrees:.2f} deg, IoU {overlap:.3f} (medians)")


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("--category", default="box")
    parser.add_argument("--frames", type=int, default=16)
    parser.add_argument("--model", action="store_true", help="evaluate the shipped model, too")
    parser.add_argument("--out", type=Path, default=Path("outputs/examples"))
    main(**vars(parser.parse_args()))
