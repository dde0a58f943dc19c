"""No two of training, calibration and test draw the same cameras or joint states."""

from __future__ import annotations

import types
from itertools import combinations

import jax
import jax.numpy as jnp
import numpy as np
from _helpers.objectives import BOX

from caper_jax.config import GeneratorConfig
from caper_jax.data.types import Batch
from caper_jax.synthetic import frames
from caper_jax.synthetic.frames import Generator, articulated_pose, collect_frames
from caper_jax.training.fit_uncertainty import BATCH, mixed_frames
from caper_jax.training.step import data_key

SEED = 0  # that of published tables and of runs
CONFIG = GeneratorConfig(instances=4, grid=8, num_points=16, noise=("none",))


def undrawn(key, instance, category, config, mix):
    """``frames.render_frame`` without the picture."""
    keys = frames.FrameKeys(*jax.random.split(key, 8))
    state, poses, _ = frames.draw_state_and_poses(keys.scene, instance, category)
    pose = articulated_pose(instance, state, poses)
    return Batch(jnp.zeros((16, 3)), jnp.zeros(16, jnp.int32), pose)


def cameras_and_states(batches, split):
    """What was drawn, whichever instance it is of: root rotations, and shares of the range."""
    limits = np.asarray(Generator(BOX, CONFIG, split, SEED).bank.limits)
    rotations, shares = [], []
    for batch in batches:
        low, high = np.moveaxis(limits[np.asarray(batch.instance)], -1, 0)
        shares.append((np.asarray(batch.pose.joint_state) - low) / (high - low))
        rotations.append(np.asarray(batch.pose.rotation)[:, 0].reshape(-1, 9))
    return [
        {tuple(row) for row in np.round(np.concatenate(rows), 4).tolist()}
        for rows in (rotations, shares)
    ]


def test_training_calibration_and_test_share_no_draw(monkeypatch):
    monkeypatch.setattr(frames, "render_frame", undrawn)
    sizes = types.SimpleNamespace(num_points=16)
    estimator = types.SimpleNamespace(category=BOX, network=sizes)

    def named(split):
        drawn = collect_frames(Generator(BOX, CONFIG, split, SEED), SEED, 100)
        return [types.SimpleNamespace(pose=drawn["pose"], instance=drawn["instance"])]

    def fitted(split):
        return list(mixed_frames(estimator, [CONFIG], split, 4 * BATCH, SEED, "drawing"))

    train = Generator(BOX, CONFIG, "train", SEED)
    steps = [train.batch(data_key(SEED, n), 16) for n in range(8)]
    drawn = {
        "steps of training": cameras_and_states(steps, "train"),
        **{
            f"frames of {split}": cameras_and_states(named(split), split)
            for split in ("test", "val")
        },
        **{
            f"fit on {split}": cameras_and_states(fitted(split), split)
            for split in ("train", "val")
        },
    }
    for name, (rotations, shares) in drawn.items():
        assert len(rotations) >= 98 and len(shares) >= 90, name
    for (one, first), (other, second) in combinations(drawn.items(), 2):
        assert not first[0] & second[0], (one, other)
        # Of so many numbers of four digits a few agree by chance.
        assert len(first[1] & second[1]) < 10, (one, other)
