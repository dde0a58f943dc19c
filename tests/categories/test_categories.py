"""Categories as data: the registry, refused definitions, and the conventions of every category."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from _helpers.shapes import boxes
from _helpers.solid_points import loose

from caper_jax import categories
from caper_jax.articulation.category import Category, Joint, Symmetry
from caper_jax.errors import CaperError
from caper_jax.synthetic.instances import draw_instances

NAMES = categories.names()
# Weights and files refer to parts, joints and directions by number: parts, directions, and type and
# parent of each joint.
NUMBERS = {
    "box": ("base, lid", "xz", "r0"),
    "cutter": ("body, blade", "xy", "p0"),
    "dishwasher": ("body, door", "yz", "r0"),
    "drawer": ("body, drawer1, drawer2, drawer3", "yz", "p0 p0 p0"),
    "eyeglasses": ("frame, temple at -x, temple at +x", "yz", "r0 r0"),
    "laptop": ("base, lid", "yz", "r0"),
    "robotarm": (
        "base, link 1, link 2, link 3, link 4, link 5, link 6",
        "yz",
        "r0 r1 r2 r3 r4 r5",
    ),
    "scissors": ("root blade, other blade", "xy", "r0"),
    "stapler": ("base, arm", "yz", "r0"),
}
# A pen may lie a hair above the floor of its box, the lid's hinge stand off its edge.
SLACK = {"box": 0.003, "laptop": 0.003, "eyeglasses": 0.0015}


@pytest.fixture(scope="module", params=NAMES)
def drawn(request):
    """(category, training instances centered as the generator uses them, boxes [n, K, 2, 3])."""
    category = categories.get(request.param)
    models = draw_instances(category, 200, "train", 0)
    return category, models, np.array([boxes(model) for model in models])


def test_numbers_keep_their_meaning():
    assert set(NUMBERS) == set(NAMES)
    for name, (parts, directions, joints) in NUMBERS.items():
        category = categories.get(name)
        assert category.parts == tuple(parts.split(", "))
        assert "".join(category.directions) == directions
        assert " ".join(f"{j.type[0]}{j.parent}" for j in category.joints) == joints


def test_declared_means_are_those_of_the_training_instances(drawn):
    """Of whole objects centered on their origin; the mean diagonal is 2 network units."""
    category, _, boxes = drawn
    low, high = boxes[:, :, 0].min(1), boxes[:, :, 1].max(1)
    np.testing.assert_allclose(low + high, 0.0, atol=1e-12)
    size, center = boxes[:, :, 1] - boxes[:, :, 0], boxes.mean(2)
    assert (size > 0).all()
    diagonal = np.linalg.norm(high - low, axis=-1).mean()
    np.testing.assert_allclose(category.mean_size, size.mean(0), atol=0.03 * diagonal)
    np.testing.assert_allclose(category.mean_center, center.mean(0), atol=0.03 * diagonal)
    assert 2 / diagonal == pytest.approx(category.unit, rel=0.1)


def test_joints_are_unit_axes_near_the_object_with_limits_of_the_category(drawn):
    category, models, boxes = drawn
    widest = np.array([joint.limits for joint in category.joints])
    for model, box in zip(models, boxes, strict=True):
        np.testing.assert_allclose(np.linalg.norm(model.axis, axis=-1), 1.0, atol=1e-12)
        assert (np.abs(model.pivot) <= 1.2 * np.abs(box).max((0, 1))).all()
        low, high = model.limits.T
        assert (low < high).all() and (low <= 0).all() and (high >= 0).all()
        assert (low >= widest[:, 0] - 1e-9).all() and (high <= widest[:, 1] + 1e-9).all()


def test_each_part_is_one_piece(drawn):
    category, models, _ = drawn
    for model in models[:25]:
        for part in model.parts:
            assert loose(part, SLACK.get(category.name, 1e-3)) == []


def test_splits_and_categories_share_no_instances():
    """And the same split and seed give the same instances."""
    sizes = []
    for split, seed in (("train", 0), ("val", 0), ("test", 0), ("train", 1), ("train", 0)):
        drawn = draw_instances(categories.get("robotarm"), 20, split, seed)
        sizes.append(np.array([boxes(model) for model in drawn]))
    np.testing.assert_array_equal(sizes[0], sizes[-1])
    assert len(np.unique(np.concatenate(sizes[:-1]).reshape(80, -1), axis=0)) == 80


@pytest.mark.parametrize("name", ["box", "laptop"])
def test_clamshells_rest_and_open_as_agreed(name):
    """x along the hinge, y up, z to the front; positive opens.

    A box rests closed: the lid lies on the base, in front of its hinge, and swings up. A laptop
    rests open by 90 deg: the lid stands above its hinge behind the base, and leans back.
    """
    for model in draw_instances(categories.get(name), 50, "test", 1):
        (base, lid), pivot = boxes(model), model.pivot[0]
        np.testing.assert_allclose(np.abs(model.axis), [[1, 0, 0]], atol=1e-12)
        assert pivot[2] < 0
        center = lid.mean(0)
        speed = np.cross(model.axis[0], center - pivot)  # of the lid as its state grows
        if name == "box":
            assert center[1] > base.mean(0)[1] and center[2] > pivot[2] and speed[1] > 0
        else:
            assert lid[1, 1] > base[1, 1] and center[1] > pivot[1] and speed[2] < 0


def test_names_are_sorted_and_known():
    assert {"box", "laptop"} <= set(NAMES)
    assert list(NAMES) == sorted(NAMES)
    assert all(categories.get(name).name == name for name in NAMES)


def test_unknown_names_are_errors_with_the_nearest_one():
    with pytest.raises(CaperError, match=r"category 'labtop'; did you mean 'laptop'\?.*box"):
        categories.get("labtop")
    with pytest.raises(CaperError, match=r"category 'zzz' \(known: .*box"):
        categories.get("zzz")


def test_a_name_is_registered_once(monkeypatch):
    monkeypatch.setattr(categories, "_REGISTRY", dict(categories._REGISTRY))
    box = categories.get("box")
    assert categories.register(box) is box  # the same definition again does no harm
    with pytest.raises(CaperError, match="'box' is already registered"):
        categories.register(dataclasses.replace(box, unit=1.0))
    crate = categories.register(dataclasses.replace(box, name="crate"))
    assert categories.get("crate") is crate and "crate" in categories.names()


EYE = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
MIRROR = ((-1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))


def define(**changes) -> Category:
    values = {
        "name": "chain",
        "parts": ("a", "b", "c"),
        "joints": (Joint("revolute", 0, (0.0, 1.0)), Joint("prismatic", 1, (0.0, 0.2))),
        "directions": ("x", "y"),
        "directions_reason": "",
        "unit": 2.0,
        "mean_size": ((1.0, 1.0, 1.0),) * 3,
        "mean_center": ((0.0, 0.0, 0.0),) * 3,
    }
    return Category(**(values | changes))


def test_a_definition_counts_its_parts():
    category = define()
    assert (category.num_parts, category.num_joints) == (3, 2)
    assert category.joint_types == ("revolute", "prismatic")
    assert category.parents == (0, 1)


@pytest.mark.parametrize(
    "changes",
    [
        {"parts": ("a", "b")},
        {"joints": (Joint("revolute", 0, (0, 1)), Joint("revolute", 2, (0, 1)))},
        {"joints": (Joint("revolute", -1, (0, 1)),) * 2},
        {"joints": (Joint("revolute", 0, (1.0, 1.0)),) * 2},
        {"joints": (Joint("revolute", 0, (0, np.inf)),) * 2},
        {"joints": (Joint("revolut", 0, (0, 1)),) * 2},
        {"directions": ("y", "w")},
        {"directions": ("y", "y")},
        {"mean_size": ((1.0, 1.0, 0.0),) * 3},
        {"mean_size": ((1.0, 1.0, 1.0),) * 2},
        {"mean_center": ((0.0, 0.0, np.nan),) * 3},
        {"mean_center": ((0.0, 0.0),) * 3},
        {"unit": -1.0},
        {"closed": "shut"},
        {"symmetries": (Symmetry((0, 1), EYE, "why"),)},
        {"symmetries": (Symmetry((2, 1, 0), MIRROR, "why"),)},
    ],
)
def test_mistakes_in_a_definition_name_the_category(changes):
    with pytest.raises(CaperError, match="category 'chain'"):
        define(**changes)


def test_a_scaled_category_draws_no_shapes_of_another_size():
    box = categories.get("box")
    assert box.scaled(1.0) is box and box.scaled(2.0).shape is None


def test_declared_equivalences_are_half_turns_that_exchange_parts():
    for name in NAMES:
        category = categories.get(name)
        for symmetry in category.symmetries:
            assert isinstance(symmetry, Symmetry) and symmetry.reason
            order = np.array(symmetry.permutation)
            assert sorted(order) == list(range(category.num_parts))
            assert (order[order] == np.arange(len(order))).all()
            turn = np.array(symmetry.rotation)
            np.testing.assert_allclose(turn @ turn, np.eye(3), atol=1e-12)
            np.testing.assert_allclose(turn @ turn.T, np.eye(3), atol=1e-12)
            assert np.linalg.det(turn) > 0
