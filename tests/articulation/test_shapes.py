"""Drawn shapes: what a category may leave out, and what is refused before anything is generated."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from _helpers.microwave import MICROWAVE, shape

from caper_jax.articulation.category import Category
from caper_jax.errors import CaperError
from caper_jax.geometry.boxes import rest_diagonal
from caper_jax.synthetic.instances import build_bank, draw_instances, statistics

NEEDED = {
    name: getattr(MICROWAVE, name)
    for name in ("name", "parts", "joints", "directions", "directions_reason")
}


def test_unit_and_mean_sizes_may_be_left_out():
    category = Category(**NEEDED, shape=shape)
    assert category.unit == pytest.approx(MICROWAVE.unit, rel=0.03)
    np.testing.assert_allclose(category.mean_size, MICROWAVE.mean_size, atol=0.01)
    np.testing.assert_allclose(category.mean_center, MICROWAVE.mean_center, atol=0.01)
    # The same every time, and what is given stays.
    again = Category(**NEEDED, shape=shape, unit=3.0)
    assert again == replace(category, unit=3.0) and hash(again) == hash(replace(again))
    with pytest.raises(CaperError, match="mean_size"):
        Category(**NEEDED)


def test_statistics_are_the_means_of_the_bank():
    found = statistics(MICROWAVE, 40, 3)
    bank = build_bank(draw_instances(MICROWAVE, 40, "train", 3))
    np.testing.assert_allclose(found["mean_size"], bank.size.mean(0), atol=1e-6)
    np.testing.assert_allclose(found["mean_center"], bank.box_center.mean(0), atol=1e-6)
    diagonals = rest_diagonal(bank.size, bank.box_center)
    assert found["mean_diagonal"] == pytest.approx(diagonals.mean(), rel=1e-6)
    assert found["unit"] * found["mean_diagonal"] == pytest.approx(2)


@pytest.mark.parametrize(
    ("wrong", "named"),
    [
        (
            {"unit": 0.5, "mean_size": ((0.1, 0.1, 0.1),) * 2},
            r"unit 0\.5 .drawn: 2\.\d+.; mean_size",
        ),
        ({"unit": 2.8e-3}, "unit 0.0028"),  # millimeters
        ({"mean_center": ((0.0, 0.0, 0.0),) * 2}, r"mean_center .*0\.1[89]"),
    ],
)
def test_placeholders_are_named_with_what_was_drawn(wrong, named):
    wrong = replace(MICROWAVE, **wrong)
    with pytest.raises(CaperError, match=named) as error:
        draw_instances(wrong, 4, "train", 0)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("change", "named"),
    [
        (lambda model: replace(model, axis=2 * model.axis), "'door' has an axis of length 2"),
        (lambda model: replace(model, limits=np.degrees(model.limits)), "radians"),
        (lambda model: replace(model, limits=model.limits[:, ::-1]), "no range"),
        (lambda model: replace(model, parts=model.parts[:1]), "body, door"),
        (lambda model: replace(model, parts=[model.parts[0], []]), "body, door"),
        (lambda model: replace(model, pivot=np.zeros(3)), r"pivot has shape \(3,\)"),
        (lambda model: replace(model, axis=np.full((1, 3), np.nan)), "axis has NaN"),
        (lambda model: model.parts, "list is no ObjectModel"),
    ],
)
def test_objects_that_are_no_instance_are_explained(change, named):
    wrong = replace(MICROWAVE, shape=lambda rng: change(shape(rng)))
    with pytest.raises(CaperError, match=f"'microwave': .*{named}"):
        draw_instances(wrong, 2, "train", 0)


def test_a_category_without_shapes_or_split_says_what_to_do():
    with pytest.raises(CaperError, match=r"Category\.shape.*--data"):
        draw_instances(replace(MICROWAVE, shape=None), 2, "train", 0)
    with pytest.raises(CaperError, match=r"unknown split 'trian'.*train, val, test"):
        draw_instances(MICROWAVE, 2, "trian", 0)
