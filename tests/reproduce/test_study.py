"""Files of studies: what they train, and what is wrong with them."""

from __future__ import annotations

import dataclasses

import pytest

from caper_jax.config import preset
from caper_jax.errors import CaperError
from caper_jax.reproduce.study import read_study, runs_of, shipped_studies, trainings

HEAD = 'title = "t"\nbaseline = "full"\nsteps = 7\n'


def study(tmp_path, text):
    path = tmp_path / "study.toml"
    path.write_text(HEAD + text)
    return read_study(path)


@pytest.mark.parametrize("name", sorted(shipped_studies()))
def test_shipped_studies_compare_different_things(name):
    found = read_study(name)
    assert len(found.seed_list) >= 8
    runs = [run for run in runs_of(found) if run.category == "box" and run.seed == 0]
    assert [run.variant for run in runs] == list(found.variants)
    seen = [(run.training, run.network, str(run.tracker)) for run in runs]
    assert len(set(seen)) == len(seen)


def test_the_forerunner_lacks_both_ideas():
    runs = {run.variant: run.training.network for run in runs_of(read_study("ablations"))}
    assert (runs["full"].vertical_correction, runs["full"].joints) == (True, "voting")
    both = runs["efficientcaper"]
    assert (both.vertical_correction, both.joints) == (False, "direct")


def test_runs_by_variant_and_seed(tmp_path):
    found = study(
        tmp_path,
        """
seeds = [3, 5]
categories = ["box", "laptop"]
settings.training.batch_size = 4
[variants.full]
[variants."a b".loss.weights]
state = 2.0
""",
    )
    runs = runs_of(found, ("training.learning_rate=0.5",))
    assert [(run.category, run.variant, run.seed) for run in runs] == [
        (category, variant, seed)
        for category in ("box", "laptop")
        for variant in ("full", "a b")
        for seed in (3, 5)
    ]
    last = runs[-1]
    assert last.member == "laptop/a_b_7steps_seed5"
    training = last.training.training
    assert (training.steps, training.minutes, training.seed, training.data_seed) == (7, None, 5, 3)
    assert (training.batch_size, training.learning_rate) == (4, 0.5)
    assert last.training.loss.weights.state == 2.0
    assert runs[0].training.loss == preset("ablation").loss


def test_seeds_may_see_data_of_their_own(tmp_path):
    found = study(tmp_path, "shared_data = false\nseeds = 2\n[variants.full]\n")
    assert [run.training.training.stream for run in runs_of(found)] == [0, 1]


def test_variants_that_differ_in_use_share_their_training(tmp_path):
    found = study(
        tmp_path,
        """
seeds = 1
[variants.full]
[variants.once.estimate]
refine_steps = 0
[variants.alone.tracker.registration]
steps = 0
""",
    )
    full, once, alone = runs_of(found)
    assert len(trainings([full, once, alone])) == 1
    assert once.network == dataclasses.replace(full.network, refine_steps=0)
    assert alone.tracker == {"registration": {"steps": 0}}
    assert full.member == "box/ablation_7steps_seed0"  # as every study with that preset names it


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("seeds = [1, 2, 1]\n[variants.full]\n", "study.toml: seeds: 1 stands there more than"),
        ("seeds = []\n[variants.full]\n", "seeds"),
        ("[variants.other]\n", "baseline 'full'"),
        ("[variants.full.network]\njoint = 'direct'\n", r"variant 'full'.*network\.joint\b"),
        ("[variants.full.estimate]\nrefine_steps = -1\n", "variant 'full', estimate"),
        ("[variants.full.tracker]\nwindow = 1\n", "variant 'full', tracker.*window"),
        ("preset = 'slow'\n[variants.full]\n", "preset"),
        ("colour = 1\n[variants.full]\n", "colour"),
    ],
)
def test_mistakes_are_named(text, message, tmp_path):
    with pytest.raises(CaperError, match=message):
        runs_of(study(tmp_path, text))


def test_a_missing_file_is_named_with_the_studies_that_ship(tmp_path):
    with pytest.raises(CaperError, match=r"nowhere\.toml is neither .*ablations, .*table9"):
        read_study(tmp_path / "nowhere.toml")
