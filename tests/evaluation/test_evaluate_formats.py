"""In every format, the data's own truth scores perfectly: readers, protocol and metrics agree."""

import json

import pytest
from _helpers.formats import FORMATS, write_root

from caper_jax import cli
from caper_jax.data.readers import formats


def test_every_format_is_here():
    assert sorted(FORMATS) == list(formats(labeled=True))


@pytest.mark.parametrize("format", FORMATS)
def test_the_truth_scores_perfectly(tmp_path, format):
    category, _ = FORMATS[format]
    root = write_root(format, tmp_path)
    arguments = ["evaluate", "--category", category, "--format", format, "--data", str(root)]
    assert cli.main([*arguments, "--predictor", "truth", "--out", str(tmp_path / "out")]) == 0
    metrics = json.loads((tmp_path / "out/metrics.json").read_text())
    assert metrics["format"] == format and metrics["failures"] == 0
    assert metrics["frames"] == (6 if category == "laptop" else 3)
    for table in (metrics, metrics["up_to_symmetry"]):
        for part in table["parts"]:
            for statistic in ("mean", "median"):
                assert part["rotation_deg"][statistic] == part["translation_m"][statistic] == 0
                assert part["iou_full"][statistic] == part["iou_size"][statistic] == 1
        for joint in table["joints"]:
            for error in ("axis_deg", "pivot_m", "state"):
                assert joint[error]["mean"] == joint[error]["median"] == 0
