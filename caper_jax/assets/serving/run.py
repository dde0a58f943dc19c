"""python run.py cloud.npy poses.npz: poses from a cloud [N, 3] or a batch [B, N, 3], in meters.

Camera frame: x right, y down, z forward. Needs jax, numpy and flatbuffers, nothing else.
manifest.json says what comes out, in which frame and unit. In a program that serves::

    from run import estimate, sample, warm_up
    warm_up()                                   # compiles; from then on a call takes milliseconds
    poses = estimate(sample(cloud)[None])
"""

import json
import sys
from pathlib import Path

import numpy as np
from jax import block_until_ready, export, jit, tree

MANIFEST = json.loads(Path(__file__).with_name("manifest.json").read_text("utf-8"))
SHAPE = MANIFEST["inputs"]["points"]["shape"]  # [batch, points, 3]; an open batch is a string
MODEL = export.deserialize(bytearray(Path(__file__).with_name(MANIFEST["model"]).read_bytes()))
estimate = jit(MODEL.call)


def warm_up(batch=1):  # compiles for this batch, or for the one of the model
    size = batch if isinstance(SHAPE[0], str) else SHAPE[0]
    block_until_ready(estimate(np.ones((size, *SHAPE[1:]), np.float32)))


def sample(points):  # without what is no measurement, as many points as the model takes, evenly
    points = points[(np.abs(points) <= 50).all(-1) & (points != 0).any(-1)]
    assert len(points) >= 48, f"only {len(points)} usable points, 48 are needed"
    if len(points) > SHAPE[1]:  # into rows of the image, to and fro
        x, y = (points[:, :2] / np.maximum(points[:, 2:], max(points[:, 2].mean() / 2, 1e-6))).T
        x, y = ((w - w.mean()) / max(w.std(), 1e-9) * f for w, f in ((x, 8192), (y, 32 * 12**-0.5)))
        points = points[np.lexsort((y % 1 * 8 // 1, np.where(y % 2 < 1, x, -x) // 1, y // 1))]
    points = points[((np.arange(SHAPE[1]) + 0.5) * len(points) / SHAPE[1]).astype(int)]
    distinct = len(np.unique(points, axis=0))
    assert distinct >= 48, f"only {distinct} usable points differ, 48 are needed"
    return points


if __name__ == "__main__":
    source, target = sys.argv[1:] if len(sys.argv) == 3 else sys.exit(__doc__)
    clouds = np.stack([sample(cloud) for cloud in np.array(np.load(source), np.float32, ndmin=3)])
    batches = clouds[:, None] if SHAPE[0] == 1 else clouds[None]
    found = tree.map(lambda *rows: np.concatenate(rows), *map(estimate, batches))
    for number in np.flatnonzero(found["reason"]):  # of the clouds that are not plausible
        reason = MANIFEST["reasons"][found["reason"][number]]
        print(f"warning: cloud {number}: {reason}", file=sys.stderr)
    np.savez(target, **found)
