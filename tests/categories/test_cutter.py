"""Cutters: conventions, real sizes, mechanics and variety of the drawn instances."""

from __future__ import annotations

import numpy as np
import pytest
from _helpers.shapes import boxes, kinds, sample
from _helpers.solid_points import inside

from caper_jax import categories
from caper_jax.synthetic.instances import draw_instances

# Length, height and width of the body, and length and width of the blade with its carrier, of the
# nine measured ReArt-48 cutters, mm.
MEASURED = [
    (105.2, 13.5, 22.2, 107.1, 14.1),
    (145.1, 16.7, 33.9, 133.7, 20.7),
    (153.5, 15.1, 32.7, 128.9, 21.2),
    (146.0, 16.6, 30.3, 126.0, 18.6),
    (163.2, 19.7, 28.5, 77.8, 22.2),
    (106.4, 14.1, 22.8, 108.5, 12.4),
    (153.0, 18.6, 31.2, 123.4, 20.1),
    (153.7, 13.3, 31.4, 128.0, 21.1),
    (153.6, 10.6, 29.9, 123.7, 21.2),
]


@pytest.fixture(scope="module")
def cutters():
    return draw_instances(categories.get("cutter"), 200, "train", 3)


def slides_on_the_edge(model):
    body, blade = boxes(model)
    return blade[0, 2] < body[0, 2]


def test_the_blade_rests_in_the_body_and_comes_out_along_x(cutters):
    for model in cutters:
        body, blade = boxes(model)
        np.testing.assert_array_equal(model.axis, [[1.0, 0.0, 0.0]])
        assert (body[1] - body[0]).argmax() == 0
        assert -0.006 < blade[1, 0] - body[1, 0] < 0  # the tip lies just behind the mouth
        assert blade[0, 0] > body[0, 0]
        plate = np.array(model.parts[1][0].extent())
        assert (plate[0] > body[0]).all() and (plate[1] < body[1]).all()
        low, high = model.limits[0]
        assert low == 0 and 0.008 < high <= 0.115
        # The carrier stays in the body however far the blade comes out.
        carrier = np.array(model.parts[1][1].extent())[:, 0]
        assert carrier[0] + high < body[1, 0] - 0.002


def test_the_slider_stands_out_of_the_flat_face_or_the_narrow_side(cutters):
    on_edge = np.array([slides_on_the_edge(model) for model in cutters])
    assert 5 < on_edge.sum() < 40
    for model, edge in zip(cutters, on_edge, strict=True):
        body, blade = boxes(model)
        out = body[0, 2] - blade[0, 2] if edge else blade[1, 1] - body[1, 1]
        assert out < 0.014
        # Only a wheel at the end of the body may stand higher than a low slider.
        at = model.parts[1][-1].center[0]
        spans = [solid.extent() for solid in model.parts[0]]
        face = max(high[1] for low, high in spans if low[0] < at < high[0])
        assert out > 0 if edge else blade[1, 1] > face + 0.0005


def test_the_slider_passes_everything_on_the_body(cutters):
    rng = np.random.default_rng(0)
    for model in cutters:
        points = sample(rng, model.parts[1][3:], 40)
        for state in np.linspace(0, model.limits[0, 1], 5):
            at = points + model.axis[0] * state
            assert not any(inside(solid, at, 1e-4).any() for solid in model.parts[0])


def test_the_tip_is_cut_at_an_angle(cutters):
    for model in cutters:
        plate = model.parts[1][0]
        points = sample(np.random.default_rng(0), [plate], 4000)
        across = (points[:, 2] - plate.center[2]) / plate.half[2]
        reach = [points[np.abs(across - side) < 0.2, 0].max() for side in (-0.9, 0.9)]
        assert abs(reach[1] - reach[0]) > 0.3 * plate.half[2]


def test_sizes_are_those_of_real_cutters(cutters):
    size = np.array([np.ptp(boxes(model).reshape(-1, 3), axis=0) for model in cutters])
    assert (size.min(0) > (0.055, 0.006, 0.008)).all()
    assert (size.max(0) < (0.2, 0.045, 0.07)).all()
    width = np.array([2 * model.parts[1][0].half[2] for model in cutters])
    assert (width < 0.014).sum() > 40 and (width > 0.016).sum() > 80  # slim and wide blades


def test_every_measured_cutter_has_one_like_it(cutters):
    size = np.array([np.ptp(boxes(model), axis=1) for model in cutters])
    drawn = np.concatenate([size[:, 0], size[:, 1, [0, 2]]], axis=-1)
    ratio = np.abs(np.log(drawn[:, None] / (np.array(MEASURED) / 1000))).max(-1).min(0)
    assert ratio.max() < 0.16


def test_travels_cover_the_measured_ones(cutters):
    high = np.array([model.limits[0, 1] for model in cutters])
    assert ((high > 0.065) & (high < 0.1)).sum() > 50


def test_all_kinds_occur(cutters):
    """Flat, round, tapered and bellied bodies; sleeves, noses, round ends, lanyard holes."""
    bodies = [kinds(model.parts[0]) for model in cutters]
    least = {"box-box": 80, "cylinder-box": 20, "cylinder": 40, "frustum-box": 15, "frustum": 15}
    least |= {"cone": 4, "ellipsoid-box": 4, "cylinder-cylinder": 4}
    for kind, count in least.items():
        assert sum(kind in row for row in bodies) >= count, kind
    sliders = [[s.kind for s in model.parts[1][3:]] for model in cutters]
    for kind in ("ellipsoid", "frustum", "cylinder", "box"):
        assert sum(kind in row for row in sliders) > 15, kind
