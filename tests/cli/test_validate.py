"""``caper validate``: clean data pass in every format; all that is wrong is listed in one run."""

import json
import os

import h5py
import numpy as np
import pytest
from _helpers import roots
from _helpers.formats import FORMATS, write_root
from PIL import Image

from caper_jax import cli
from caper_jax.cli.validate import format_report
from caper_jax.data.readers.artimage import ArtImageDataset
from caper_jax.data.validation import CategoryReport, Problem


def run(format, root, *options):
    return cli.main(["validate", "--format", format, "--data", str(root), *options])


def report_of(tmp_path, format, root, *options):
    file = tmp_path / "report.json"
    code = run(format, root, "--json", str(file), *options)
    return code, json.loads(file.read_text())["categories"]


def messages(report):
    return [problem["message"] for problem in report["problems"]]


def edit_json(path, edit):
    content = json.loads(path.read_text())
    edit(content)
    path.write_text(json.dumps(content))


@pytest.mark.parametrize("format", FORMATS)
def test_clean_data_pass(tmp_path, capsys, format):
    (tmp_path / "root").mkdir()
    root = write_root(format, tmp_path / "root")
    code, (report,) = report_of(tmp_path, format, root)
    category, _ = FORMATS[format]
    frames = 6 if category == "laptop" else 3
    assert code == 0 and report["problems"] == []
    assert report["category"] == category and report["frames"] == frames
    assert report["instances"] == (1 if format == "reart-videos" else 2)
    assert sum(report["splits"].values()) == frames
    assert report["few_points"] == report["bad_frames"] == 0
    out = capsys.readouterr().out.splitlines()
    assert out[0].split()[:3] == ["category", "frames", "objects"]
    assert out[1].split()[:5] == [category, str(frames), str(report["instances"]), "0", "0"]
    assert out[2:] == ["", "no problems"]


def test_everything_wrong_with_images_is_listed_at_once(tmp_path, capsys):
    root = roots.artimage(tmp_path / "root")
    home = root / "laptop/train"

    def wrong_matrix(annotation):
        annotation["instances"][0]["links"][0]["transformation"] = np.diag([1, 1, -1, 1]).tolist()

    def not_a_number(annotation):
        annotation["instances"][0]["links"][1]["transformation"][0][3] = float("nan")

    (home / "annotations/000000.json").write_text('{"instances": [')
    (home / "depth/000001.png").unlink()
    edit_json(home / "annotations/000002.json", wrong_matrix)
    edit_json(home / "annotations/000003.json", not_a_number)
    mask = home / "category_mask/000004.png"
    labels = np.asarray(Image.open(mask))
    Image.fromarray(np.where(labels < 2, 1 - labels, labels)).save(mask)  # exchanged
    depth = home / "depth/000005.png"
    Image.fromarray(np.zeros_like(np.asarray(Image.open(depth)))).save(depth)
    (root / "laptop/test.txt").write_text("000003.json\n000099.json\n")

    code, (report,) = report_of(tmp_path, "artimage", root)
    assert code == 1
    found = messages(report)
    expected = [
        r"test.txt: names '000099.json', which has no annotation",
        "000000.json: broken JSON",
        "depth/000001.png: no such file",
        "000002.json, link 0: transformation must be a scaled rotation, has determinant -1",
        "000003.json, link 1: transformation must be 4 x 4 finite numbers",
        "000004: labels: put only",
        "000004: labels: put only",
    ]
    assert len(found) == len(expected)
    for message, part in zip(found, expected, strict=True):
        assert part in message
    assert report["splits"] == {"test": None, "train": 3}
    assert (report["frames"], report["bad_frames"], report["few_points"]) == (6, 5, 1)
    assert [problem["frame"] for problem in report["problems"][1:3]] == ["000000", "000001"]
    assert {"frame": "000004", "field": "labels", "message": found[-1]} in report["problems"]
    out = capsys.readouterr().out
    assert "test ?, train 3" in out and all(message in out for message in found)


def test_one_split_alone(tmp_path):
    root = roots.artimage(tmp_path / "root")
    (root / "laptop/train/annotations/000000.json").write_text("")  # of the training set
    code, (report,) = report_of(tmp_path, "artimage", root, "--split", "test")
    assert code == 0 and report["frames"] == 3 and report["splits"] == {"test": 3, "train": 3}


def test_a_category_that_cannot_be_opened_does_not_hide_the_others(tmp_path, capsys):
    root = roots.artimage(tmp_path)
    roots.artimage(tmp_path, roots.BOX)
    for path in (root / "laptop/urdf").glob("*/part_point_sample/1.xyz"):
        path.unlink()
    assert run("artimage", root) == 1
    out = capsys.readouterr().out
    rows = [line.split()[:5] for line in out.splitlines()[1:3]]
    assert rows == [["box", "6", "2", "0", "0"], ["laptop", "6", "-", "0", "6"]]
    # One line per broken model, not one per frame.
    assert out.count("1.xyz: no such file (points of a part) (3 frames)") == 2
    (root / "camera_intrinsic.json").write_text("{}")
    assert run("artimage", root, "--category", "box") == 1
    assert "camera_intrinsic.json: no camera matrix" in capsys.readouterr().out


def test_broken_annotations_of_reartmix_hide_nothing(tmp_path):
    root = roots.reartmix(tmp_path / "root")
    (root / "annotations/scene1/000000.json").write_text("[")
    (root / "depth/scene1/000001.png").unlink()
    code, (report,) = report_of(tmp_path, "reartmix", root)
    first, second = messages(report)
    assert code == 1
    assert "000000.json: broken JSON" in first and "000001.png: no such file" in second
    assert report["frames"] == 2 and report["splits"] == {"train": 2}


def test_what_no_reader_expects_is_a_problem_too(tmp_path, monkeypatch):
    """One frame, or one split, must not cost the report of the others."""
    root = roots.artimage(tmp_path / "root")
    get, open_one = ArtImageDataset.__getitem__, ArtImageDataset.list_frames

    def item(self, index):
        if self.names[index] == "000001":
            raise RecursionError("too\ndeep")
        return get(self, index)

    def listed(self):
        if self.split == "train":
            raise IndexError("far out")
        return open_one(self)

    monkeypatch.setattr(ArtImageDataset, "__getitem__", item)
    monkeypatch.setattr(ArtImageDataset, "list_frames", listed)
    code, (report,) = report_of(tmp_path, "artimage", root)
    assert code == 1 and report["frames"] == 6 and report["bad_frames"] == 1
    assert report["splits"] == {"test": 3, "train": None}
    assert messages(report) == [
        f"{root}: unreadable (IndexError: far out)",
        "000001: unreadable (RecursionError: too deep)",
    ]


def test_file_names_that_are_not_utf_8_are_escaped(tmp_path, capsys):
    root = roots.artimage(tmp_path / "root")
    broken = os.fsencode(root / "laptop/train/annotations") + b"/B\xfcchse.json"
    with open(broken, "w") as file:
        file.write("{")
    code, (report,) = report_of(tmp_path, "artimage", root)
    assert code == 1 and "B\udcfcchse.json: broken JSON" in messages(report)[0]
    assert r"B\udcfcchse.json: broken JSON" in capsys.readouterr().out


def test_damaged_files(tmp_path, capsys):
    path = roots.caper(tmp_path / "box.h5")
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2])
    assert run("caper", path) == 1
    assert "box.h5: truncated or not an HDF5 file" in capsys.readouterr().out
    path.write_bytes(whole)
    with h5py.File(path, "r+") as file:
        file["labels"][1, 2] = 7
        file["joint_state"][2] = np.nan
    code, (report,) = report_of(tmp_path, "caper", path)
    assert code == 1 and report["frames"] == 0
    (message,) = set(messages(report))
    assert "labels must be from -1 to 1" in message
    assert "joint_state has NaN or infinite entries at [2, 0]" in message


def test_poses_of_other_frames_are_noticed(tmp_path):
    """Each pose is right in itself, but belongs to another cloud."""
    path = roots.caper(tmp_path / "box.h5")
    with h5py.File(path, "r+") as file:
        for key in ("rotation", "translation", "joint_state"):
            file[key][...] = np.roll(file[key][...], 1, axis=0)
    code, (report,) = report_of(tmp_path, "caper", path)
    assert code == 1 and report["bad_frames"] == 3
    assert all(problem["field"] == "labels" for problem in report["problems"])


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--format", "artimages"], "unknown format 'artimages'"),
        (["--category", "box"], "holds laptop, but no box"),
        (["--category", "laptpo"], "unknown category 'laptpo'; did you mean 'laptop'"),
        (["--split", "val"], "no split 'val'; it lists test, train"),
        (["--data", "absent"], "absent: no such folder"),
        (["--format", "reartmix"], "holds no reartmix data of a known category"),
        (["--format", "caper"], "no such file but a folder (format 'caper' is one .h5 file; name"),
        (["--format", "caper", "--data", "no.h5"], "no.h5: no such file (format 'caper'"),
        (["--workers", "0"], "--workers must be at least 1"),
    ],
)
def test_mistakes_in_the_arguments_are_code_2(tmp_path, capsys, options, message):
    assert run("artimage", roots.artimage(tmp_path), *options) == 2
    captured = capsys.readouterr()
    assert message in captured.err and captured.out == ""


def test_the_report_does_not_replace_the_data(tmp_path, capsys):
    path = roots.caper(tmp_path / "box.h5")
    (tmp_path / "link.json").symlink_to(path)
    whole = path.read_bytes()
    for report in (path, tmp_path / "link.json"):
        assert run("caper", path, "--json", str(report)) == 2
        assert "is the data; give the report another name" in capsys.readouterr().err
    assert path.read_bytes() == whole


def test_at_most_twenty_problems_on_the_terminal():
    problems = [Problem(f"{i:06d}: size: must be positive", f"{i:06d}", "size") for i in range(33)]
    report = CategoryReport("box", {"train": 33}, 33, 2, 0, 33, problems)
    lines = format_report([report]).split("\n")
    assert lines[3:23] == [problem.message for problem in problems[:20]]
    assert lines[23] == "and 13 more (--json FILE keeps them all)" and len(lines) == 24
