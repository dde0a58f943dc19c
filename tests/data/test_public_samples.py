"""Readers of public layouts against ground truth that another program computed from their files."""

import numpy as np
import pytest

from caper_jax.data.readers import open_dataset
from caper_jax.data.types import validate

SAMPLES = {  # folder -> format, categories
    "artimage_sample": ("artimage", ("laptop", "drawer", "dishwasher")),
    "pm_videos_sample": ("pm-videos", ("laptop",)),
    "reartmix_box": ("reartmix", ("box",)),
}
CASES = [(folder, name) for folder, (_, names) in SAMPLES.items() for name in names]
FIELDS = {  # of ArticulatedPose -> name in truth.npz, largest difference (meters, radians)
    "rotation": ("R", 1e-5),
    "translation": ("t", 1e-5),
    "size": ("size", 1e-4),
    "box_center": ("box_centre", 1e-4),
    "joint_axis": ("joint_axis", 1e-5),
    "joint_pivot": ("joint_pivot", 1e-4),
    "joint_state": ("joint_state", 1e-5),
}


@pytest.fixture(scope="module", params=CASES, ids=" ".join)
def sample(request, shared_data):
    """Format, root, category, dataset, its frames, and the truth of the category."""
    folder, name = request.param
    with np.load(shared_data / folder / "truth.npz") as file:
        truth = {key.partition("/")[2]: file[key] for key in file.files if f"{name}/" in key}
    format, root = SAMPLES[folder][0], shared_data / folder
    dataset = open_dataset(format, root, name)
    return format, root, name, dataset, [dataset[i] for i in range(len(dataset))], truth


def test_every_annotated_object_is_a_frame(sample):
    format, root, name, dataset, _, truth = sample
    names = truth["name"].tolist()
    if format == "pm-videos":
        names = [f"{video}/{frame}" for video, frame in zip(truth["video"], names, strict=True)]
    assert list(dataset.names) == names and dataset.split == "all"
    kind = "polygons" if format == "reartmix" else "part masks"
    assert dataset.mask_source == f"annotated {kind}"
    if format == "reartmix":
        train = open_dataset(format, root, name, "train")
        assert list(train.names) == (root / "train.txt").read_text().split()
        return
    for split in set(truth["split"].tolist()):
        expected = np.array(names)[truth["split"] == split].tolist()
        for official in (False, True):
            listed = open_dataset(format, root, name, split, official_split=official)
            assert list(listed.names) == expected


def test_ground_truth_agrees_with_an_independent_program(sample):
    format, _, _, dataset, frames, truth = sample
    for field, (key, tolerance) in FIELDS.items():
        expected = truth[key]
        if dataset.category.joint_types[0] == "revolute":
            # The file's axis is the one about which the child turns by minus the state.
            expected = -expected if field == "joint_axis" else expected
            if field == "joint_state" and format != "reartmix":
                expected = np.radians(expected)
        found = np.stack([getattr(frame.truth, field) for frame in frames])
        np.testing.assert_allclose(found, expected, atol=tolerance, rtol=0, err_msg=field)
    if "pixels" in truth:
        np.testing.assert_array_equal([frame.visible for frame in frames], truth["pixels"])


def test_frames_keep_the_conventions(sample):
    """Labels, depth, intrinsics and poses belong together: points lie in the boxes of parts."""
    format, _, _, dataset, frames, _ = sample
    near, least = (0.005, 0.998) if format == "reartmix" else (0.01, 0.99)
    outside = []
    for frame in frames:
        validate(frame, dataset.category)
        assert frame.points.shape == (1024, 3)
        assert frame.visible.sum() == frame.mask.sum()
        pose = frame.truth
        rotation, shift = pose.rotation[frame.labels], pose.translation[frame.labels]
        local = np.einsum("nji,nj->ni", rotation, frame.points - shift)
        excess = np.abs(local - pose.box_center[frame.labels]) - pose.size[frame.labels] / 2
        outside.append(np.linalg.norm(np.maximum(excess, 0), axis=-1))
    assert np.mean(np.concatenate(outside) < near) > least


def test_positive_states_open(sample):
    """Laptop: the lid leans back; dishwasher: the door sinks; drawer: it comes out of the front."""
    _, _, name, _, frames, _ = sample
    pose = frames[0].truth
    motion = np.cross(pose.joint_axis, pose.box_center[1:] - pose.joint_pivot)[0]
    if name == "drawer":
        assert (pose.joint_axis[:, 2] > 0.99).all()
        assert (np.diff(pose.box_center[1:, 1]) > 0).all()
    elif name == "dishwasher":
        assert motion[1] < 0
    elif name == "laptop":
        assert motion[2] < 0
