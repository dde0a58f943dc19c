"""python run.py cloud.npy poses.npz: poses from a cloud [N, 3] or a batch [B, N, 3], in meters.

Camera frame: x right, y down, z forward. Needs jax and numpy, nothing else. manifest.json says
what comes out. In a program: ``from run import estimate, sample``."""

import json
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
from jax import ShapeDtypeStruct, export, jit, lax, tree

MANIFEST = json.loads(Path(__file__).with_name("manifest.json").read_text("utf-8"))
SHAPE, OUTPUTS = MANIFEST["inputs"]["points"]["shape"], MANIFEST["outputs"]


def outline(x):  # the model's inputs and outputs; what happens in between is in its file
    return {k: lax.full((*x.shape[:1], *v["shape"][1:]), 0, v["dtype"]) for k, v in OUTPUTS.items()}


def sample(points):  # without what is no measurement, as many points as the model takes, evenly
    points = points[(np.abs(points) <= 50).all(-1) & (points != 0).any(-1)]
    assert len(points) >= 16, f"only {len(points)} usable points"
    if len(points) > SHAPE[1]:  # into rows of the image, to and fro
        x, y = (points[:, :2] / np.maximum(points[:, 2:], max(points[:, 2].mean() / 2, 1e-6))).T
        x, y = ((w - w.mean()) / max(w.std(), 1e-9) * f for w, f in ((x, 8192), (y, 32 * 12**-0.5)))
        points = points[np.lexsort((y % 1 * 8 // 1, np.where(y % 2 < 1, x, -x) // 1, y // 1))]
    return points[((np.arange(SHAPE[1]) + 0.5) * len(points) / SHAPE[1]).astype(int)]


like = ShapeDtypeStruct(export.symbolic_shape(", ".join(map(str, SHAPE))), np.float32)
outlined = export.export(jit(outline, keep_unused=True), platforms=MANIFEST["platforms"])(like)
model = Path(__file__).with_name("model.stablehlo").read_bytes()
estimate = jit(replace(outlined, mlir_module_serialized=model, **MANIFEST["convention"]).call)

if __name__ == "__main__":
    source, target = sys.argv[1:] if len(sys.argv) == 3 else sys.exit(__doc__)
    clouds = np.stack([sample(cloud) for cloud in np.array(np.load(source), np.float32, ndmin=3)])
    batches = clouds[:, None] if SHAPE[0] == 1 else clouds[None]
    np.savez(target, **tree.map(lambda *rows: np.concatenate(rows), *map(estimate, batches)))
