"""Boxes and laptops: variety, real sizes, solid construction, and what they cost to draw."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from _helpers.shapes import boxes as boxes_of
from _helpers.shapes import kinds, motion, moved
from _helpers.solid_points import inside

from caper_jax import categories
from caper_jax.geometry.solids import bounds
from caper_jax.synthetic.instances import build_bank, draw_instances

# Length, height and depth of the base of the eight measured ReArt-48 boxes span these ranges, mm.
MEASURED = ((201, 243), (24, 38), (74, 94))

FIXTURES = {"box": "boxes", "laptop": "laptops"}


@pytest.fixture(scope="module")
def boxes():
    return draw_instances(categories.get("box"), 300, "train", 11)


@pytest.fixture(scope="module")
def laptops():
    return draw_instances(categories.get("laptop"), 300, "train", 11)


def sizes(models, part):
    return np.array([np.ptp(boxes_of(model)[part], axis=0) for model in models])


@pytest.mark.parametrize("name", ["box", "laptop"])
def test_slots_stay_few(name, request):
    """The ray caster pays for every slot of every kind pair."""
    models = request.getfixturevalue(FIXTURES[name])
    slots = {key: group.valid.shape[1] for key, group in build_bank(models).groups.items()}
    assert sum(slots.values()) <= 28 and len(slots) <= 6


def test_sizes_are_those_of_real_boxes(boxes):
    base = sizes(boxes, 0) * 1000
    assert base[:, 0].min() > 90 and base[:, 0].max() < 420
    assert 15 < base[:, 1].min() < 30 and 180 < base[:, 1].max() < 260
    like = np.ones(len(base), bool)
    for axis, (low, high) in enumerate(MEASURED):
        like &= (base[:, axis] > 0.95 * low) & (base[:, axis] < 1.05 * high)
    assert like.mean() > 0.1  # of all, those within the ranges of the measured ones


def test_bases_of_boxes_are_hollow_and_hold_what_is_in_them(boxes):
    held = 0
    for model in boxes:
        base = model.parts[0]
        tray, soft = base[0], "ellipsoid" in kinds(base)
        low, high = tray.extent()
        middle = np.array([[tray.center[0], high[1] - 1e-4, tray.center[2]]])
        assert not inside(tray, middle).any()
        for solid in base[6:] if soft else base[1:]:  # a soft tray is six solids
            own_low = solid.extent()[0]
            at_the_back = solid.center[2] < low[2] + 0.12 * (high - low)[2]  # hinges
            if own_low[1] < low[1] + 1e-3 or at_the_back:  # feet
                continue
            outer = replace(tray, hole=None)
            corners = solid.center + 0.999 * (solid.corners() - solid.center)
            assert inside(outer, corners).all()
            held += 1
    assert held > 300


def test_all_kinds_of_boxes_occur(boxes):
    bases = [kinds(model.parts[0]) for model in boxes]
    lids = [kinds(model.parts[1]) for model in boxes]
    assert {base[0] for base in bases} == {"box-box", "frustum-box"}  # upright, tapered
    assert any("ellipsoid" in base for base in bases)  # soft cases
    firsts = {lid[0] for lid in lids}
    assert firsts == {"box", "box-box", "cylinder-box", "frustum-box"}  # plate, shell, dome, slope
    assert any("ellipsoid" in lid for lid in lids)  # soft, or with a knob
    heights = sizes(boxes, 0)[:, 1] / sizes(boxes, 0)[:, 2]
    assert heights.min() < 0.35 and heights.max() > 1.0  # flat and deep


def test_sizes_are_those_of_real_laptops(laptops):
    base, lid = sizes(laptops, 0) * 1000, sizes(laptops, 1) * 1000
    assert 245 < base[:, 0].min() < 270 and 390 < base[:, 0].max() < 420
    assert base[:, 1].min() < 14 and base[:, 1].max() > 34  # thin and thick
    assert (lid[:, 0] < 1.01 * base[:, 0]).all()
    assert (lid[:, 2] > 3.5).all() and (lid[:, 2] < 16).all()


def test_all_kinds_of_laptops_occur(laptops):
    bases = [kinds(model.parts[0]) for model in laptops]
    lids = [kinds(model.parts[1]) for model in laptops]
    assert {base[0] for base in bases} == {"box", "box-box", "frustum"}
    assert {lid[0] for lid in lids} == {"box", "box-box", "frustum"}
    round_corners = [lid.count("cylinder") == 2 for lid in lids]
    assert 0.3 < np.mean(round_corners) < 0.5
    # The narrowest bezel, sideways: half the lid's width less that of the recess.
    bezels = [
        model.parts[1][0].half[0] - model.parts[1][0].hole.half[0]
        for model in laptops
        if model.parts[1][0].hole is not None
    ]
    assert min(bezels) < 0.004 and max(bezels) > 0.015


def test_tops_of_laptops_are_level_at_any_body(laptops):
    """Whatever the underside, the keyboard lies in one plane, in front of the hinge."""
    for model in laptops:
        base = model.parts[0][0]
        if base.kind != "frustum":
            continue
        low, high = bounds([base])
        z = low[2] + (high - low)[2] * np.array([0.1, 0.5, 0.9])
        spots = np.stack([0 * z, 0 * z + high[1] - 1e-4, z], axis=1)
        assert inside(base, spots).all()


@pytest.mark.parametrize("name", ["box", "laptop"])
def test_lids_swing_clear_of_their_bases(name, request):
    """A point in the middle of the lid's far edge leaves the base as its state grows."""
    for model in request.getfixturevalue(FIXTURES[name])[:100]:
        low, high = boxes_of(model)[1]
        edge = np.array([0.0, (low[1] + high[1]) / 2, high[2]])
        if name == "laptop":
            edge = np.array([0.0, high[1], (low[2] + high[2]) / 2])
        swung = moved(edge, motion(model, 0, np.radians(30)))
        assert not any(inside(solid, swung[None]).any() for solid in model.parts[0])
        assert swung[1] > edge[1] if name == "box" else swung[2] < edge[2]
