"""Estimate the parts and joints of an object from one depth image.

    python examples/01_estimate.py [FOLDER]

FOLDER holds depth.png (16-bit, millimeters), mask.png (the object) and intrinsics.json; by default
it is a box that no network was trained on. Prints the pose of every part and the state of every
joint, and draws them over the image in outputs/examples/estimate.png. About ten seconds, most of
which are spent compiling.
"""

import argparse
from pathlib import Path

import jax
import numpy as np

import caper_jax as caper

DEMO = Path(__file__).parents[1] / "caper_jax" / "assets" / "demo" / "box_0"


def main(folder: Path, category: str, out: Path) -> None:
    depth = caper.read_depth(folder / "depth.png")  # [H, W] meters
    mask = caper.read_mask(folder / "mask.png")  # [H, W] bool
    intrinsics = caper.read_intrinsics(folder / "intrinsics.json")  # [3, 3] pixels
    points = caper.cloud_from_depth(depth, mask, intrinsics).points  # [1024, 3] meters

    estimator = caper.load(category)
    prediction = jax.device_get(estimator(points))
    pose = prediction.pose  # p_camera = rotation p_part + translation; x right, y down, z forward

    for k, part in enumerate(estimator.category.parts):
        origin, size = np.round(pose.translation[k], 3), np.round(pose.size[k], 3)
        print(f"{part}: origin {origin} m, size {size} m, rotation")
        print(np.array_str(pose.rotation[k], precision=3, suppress_small=True))
    for joint, state, std in zip(
        estimator.category.joints, pose.joint_state, prediction.state_std, strict=True
    ):
        if joint.type == "revolute":
            print(f"joint: {np.degrees(state):.1f} +- {np.degrees(std):.1f} deg from the rest pose")
        else:
            print(f"joint: {1000 * state:.1f} +- {1000 * std:.1f} mm from the rest pose")

    scene = caper.Scene(
        name=folder.name,
        category=estimator.category,
        points=prediction.points,
        labels=prediction.labels,
        pose=pose,
        depth=depth,
        mask=mask,
        intrinsics=intrinsics,
    )
    print("picture:", caper.write_picture(out / "estimate.png", [scene]))


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("folder", nargs="?", type=Path, default=DEMO)
    parser.add_argument("--category", default="box")
    parser.add_argument("--out", type=Path, default=Path("outputs/examples"))
    main(**vars(parser.parse_args()))
