"""Numbers of tracks: what counts, and what lengths are divided by."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from _helpers.frames import random_pose
from _helpers.tracks import BOX, KnownTracker, disturbed, track, write_videos

from caper_jax.errors import CaperError
from caper_jax.evaluation.metrics import object_diagonal
from caper_jax.evaluation.tracking import (
    summarize_tracks,
    track_errors,
    track_video,
)


@pytest.fixture
def video(tmp_path):
    """(dataset, the frames of its first video)."""
    dataset = write_videos(tmp_path / "box.h5", videos=1, frames=5)
    return dataset, [dataset[index] for index in range(5)]


def summary(tracks, start="truth"):
    return summarize_tracks(tracks, BOX, start, "projection", "predicted")


def test_a_tracker_that_is_right_scores_perfectly(video):
    """But for the first frame, where it is far off and says so: it is not scored."""
    dataset, frames = video
    found = track_video(KnownTracker(dataset), "00000", frames)
    assert found.frames == [frame.name for frame in frames]
    assert found.lost.tolist() == found.keyframe.tolist() == [True] + [False] * 4
    table = summary([found])
    assert (table["videos"], table["frames"], table["lost"], table["keyframes"]) == (1, 4, 0, 0)
    for part in table["parts"]:
        assert part["rotation_deg"]["mean"] < 1e-3
        assert part["translation_relative"]["mean"] < 1e-6
        assert part["iou_full"]["mean"] == pytest.approx(1.0, abs=1e-4)
    errors = track_errors(found, BOX)
    np.testing.assert_allclose(errors.rotation_deg[0], 90.0, atol=1e-3)


@pytest.mark.parametrize("start", ["truth", "estimator"])
def test_ground_truth_is_given_once_or_never(video, start):
    dataset, frames = video
    tracker = KnownTracker(dataset)
    track_video(tracker, "00000", frames, start)
    assert any(tracker.resets) == (start == "truth")
    assert tracker.labels == [False] * 6  # the first frame twice: once to compile


def test_lost_frames_count_with_the_pose_that_was_held():
    truth = random_pose(6, 1)
    held = {name: values.copy() for name, values in vars(truth).items()}
    for values in held.values():
        values[3:5] = values[2]
    lost = np.array([True, False, False, True, True, False])
    found = track("a", truth, dataclasses.replace(truth, **held))
    table = summary([dataclasses.replace(found, lost=lost)])
    assert (table["frames"], table["lost"]) == (5, 2)
    turn = truth.rotation[2, 0].T @ truth.rotation[3:5, 0]
    degrees = np.degrees(np.arccos((np.trace(turn, axis1=1, axis2=2) - 1) / 2))
    assert table["parts"][0]["rotation_deg"]["mean"] == pytest.approx(degrees.sum() / 5, rel=1e-3)


def test_lengths_are_relative_to_the_whole_object_at_rest():
    """Boxes of 2 x 2 x 2 about 0 and of 2 x 1 x 1 about y = 3 span 2 x 4.5 x 2."""
    truth = random_pose(2, 2)
    truth = dataclasses.replace(
        truth,
        size=np.float32([[[2, 2, 2], [2, 1, 1]]] * 2),
        box_center=np.float32([[[0, 0, 0], [0, 3, 0]]] * 2),
    )
    span = np.sqrt(2**2 + 4.5**2 + 2**2)
    np.testing.assert_allclose(object_diagonal(truth), span, rtol=1e-6)
    found = track("a", truth, disturbed(truth, share=0.1))
    errors = track_errors(found, BOX)
    np.testing.assert_allclose(errors.translation_m, 0.1 * span, rtol=1e-4)
    np.testing.assert_allclose(errors.translation_relative, 0.1, rtol=1e-4)
    assert summary([found])["parts"][1]["translation_relative"]["mean"] == pytest.approx(
        0.1, rel=1e-4
    )


def test_what_the_data_lack_is_named(video):
    dataset, frames = video
    tracker = KnownTracker(dataset)
    with pytest.raises(CaperError, match="video 'a' has no frames"):
        track_video(tracker, "a", [])
    blind = [dataclasses.replace(frame, truth=None) for frame in frames]
    with pytest.raises(CaperError, match="no ground truth to start from"):
        track_video(tracker, "a", blind)
    with pytest.raises(CaperError, match="video 'a' has no ground truth"):
        track_errors(track_video(tracker, "a", [frames[0], *blind[1:]]), BOX)
    bare = [dataclasses.replace(frame, labels=None) for frame in frames]
    with pytest.raises(CaperError, match="no part labels to give"):
        track_video(tracker, "a", bare, given_masks=True)
