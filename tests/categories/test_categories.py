"""Categories as data: the registry, refused definitions, and the conventions of every category."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from caper_jax import categories
from caper_jax.articulation.category import Category, Joint, Symmetry
from caper_jax.errors import CaperError
from caper_jax.geometry.solids import bounds
from caper_jax.synthetic.instances import draw_instances

NAMES = categories.names()
INSTANCES = 300


@pytest.fixture(scope="module", params=NAMES)
def drawn(request):
    """(category, instances centered as the generator uses them, part boxes [n, K, 2, 3])."""
    category = categories.get(request.param)
    models = draw_instances(category, INSTANCES, "train", 0)
    boxes = np.array([[bounds(part) for part in model.parts] for model in models])
    return category, models, boxes


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
    ("changes", "message"),
    [
        ({"parts": ("a", "b")}, "2 parts need 1 joints"),
        ({"joints": (Joint("revolute", 0, (0, 1)), Joint("revolute", 2, (0, 1)))}, "part 2 must"),
        ({"joints": (Joint("revolute", -1, (0, 1)),) * 2}, "part 1 must come after its parent -1"),
        ({"joints": (Joint("revolute", 0, (1.0, 1.0)),) * 2}, "part 1 must have finite limits"),
        ({"joints": (Joint("revolute", 0, (0, np.inf)),) * 2}, "part 1 must have finite limits"),
        ({"joints": (Joint("revolut", 0, (0, 1)),) * 2}, "'revolut'; did you mean 'revolute'"),
        ({"directions": ("y", "w")}, "directions are two of x, y, z"),
        ({"mean_size": ((1.0, 1.0, 0.0),) * 3}, "mean_size must be positive"),
        ({"mean_center": ((0.0, 0.0, np.nan),) * 3}, "mean_center must be finite"),
        ({"unit": -1.0}, "unit and mean_size must be positive"),
        ({"closed": "shut"}, "closed is 'low', 'high' or None, got 'shut'"),
        ({"symmetries": (Symmetry((0, 1), EYE, "why"),)}, "must permute the parts"),
        ({"symmetries": (Symmetry((2, 1, 0), MIRROR, "why"),)}, "is not a rotation"),
        ({"directions": ("y", "y")}, "two directions must differ"),
        ({"mean_size": ((1.0, 1.0, 1.0),) * 2}, r"mean_size must be \[3, 3\]"),
        ({"mean_center": ((0.0, 0.0),) * 3}, r"mean_center must be \[3, 3\]"),
    ],
)
def test_mistakes_in_a_definition_name_the_category(changes, message):
    with pytest.raises(CaperError, match=f"category 'chain': .*{message}"):
        define(**changes)


def test_a_scaled_category_draws_no_shapes_of_another_size():
    box = categories.get("box")
    assert box.scaled(1.0) is box and box.scaled(2.0).shape is None


@pytest.mark.parametrize(
    ("name", "parts", "directions"),
    [("box", ("base", "lid"), ("x", "z")), ("laptop", ("base", "lid"), ("y", "z"))],
)
def test_numbers_keep_their_meaning(name, parts, directions):
    """Weights and files refer to parts, joints and directions by number."""
    category = categories.get(name)
    assert category.parts == parts
    assert category.directions == directions
    assert category.joint_types == ("revolute",) and category.parents == (0,)


def test_origin_is_the_center_of_the_whole_at_rest(drawn):
    _, _, boxes = drawn
    low, high = boxes[:, :, 0].min(1), boxes[:, :, 1].max(1)
    np.testing.assert_allclose(low + high, 0.0, atol=1e-12)


def test_means_are_those_of_the_training_instances(drawn):
    category, _, boxes = drawn
    size, center = boxes[:, :, 1] - boxes[:, :, 0], boxes.mean(2)
    assert (size > 0).all()
    largest = size.max(axis=(1, 2)).mean()
    np.testing.assert_allclose(category.mean_size, size.mean(0), atol=0.05 * largest)
    np.testing.assert_allclose(category.mean_center, center.mean(0), atol=0.05 * largest)


def test_networks_see_objects_of_about_unit_size(drawn):
    category, _, boxes = drawn
    diagonal = np.linalg.norm(boxes[:, :, 1].max(1) - boxes[:, :, 0].min(1), axis=-1)
    assert 0.5 < diagonal.mean() * category.unit < 4.0


def test_joints_are_unit_axes_near_the_object_with_limits_of_the_category(drawn):
    category, models, boxes = drawn
    widest = np.array([joint.limits for joint in category.joints])
    for model, box in zip(models, boxes, strict=True):
        np.testing.assert_allclose(np.linalg.norm(model.axis, axis=-1), 1.0, atol=1e-12)
        assert (np.abs(model.pivot) <= 1.2 * np.abs(box).max((0, 1))).all()
        low, high = model.limits.T
        assert (low < high).all() and (low <= 0).all() and (high >= 0).all()
        assert (low >= widest[:, 0] - 1e-9).all() and (high <= widest[:, 1] + 1e-9).all()


@pytest.mark.parametrize("name", ["box", "laptop"])
def test_clamshells_rest_and_open_as_agreed(name):
    """x along the hinge, y up, z to the front; positive opens.

    A box rests closed: the lid lies on the base, in front of its hinge, and swings up. A laptop
    rests open by 90 deg: the lid stands above its hinge behind the base, and leans back.
    """
    category = categories.get(name)
    for model in draw_instances(category, 50, "test", 1):
        (base, lid), pivot = (bounds(part) for part in model.parts), model.pivot[0]
        np.testing.assert_allclose(np.abs(model.axis), [[1, 0, 0]], atol=1e-12)
        assert pivot[2] < 0
        center = (lid[0] + lid[1]) / 2
        speed = np.cross(model.axis[0], center - pivot)  # of the lid as its state grows
        if name == "box":
            assert center[1] > (base[0] + base[1])[1] / 2 and center[2] > pivot[2]
            assert speed[1] > 0
        else:
            assert lid[1][1] > base[1][1] and center[1] > pivot[1]
            assert speed[2] < 0


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
