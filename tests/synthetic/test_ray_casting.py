"""The ray caster: every kind of solid and differences of two, against float64."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from caper_jax.articulation.category import ObjectModel
from caper_jax.errors import CaperError
from caper_jax.geometry.solids import Solid, bounds, box, cone, cylinder, ellipsoid, frustum
from caper_jax.synthetic.instances import build_bank
from caper_jax.synthetic.ray_casting import FAR, cast, part_depths, projected_bounds

KINDS = ("box", "cylinder", "ellipsoid", "frustum", "cone")
FLAT = ("box", "frustum")
# The caster treats a solid and its hole apart: every kind twice as either is enough.
PAIRS = [(kind, None) for kind in KINDS] + list(zip(KINDS, KINDS, strict=True))
PAIRS += list(zip(KINDS, (*KINDS[2:], *KINDS[:2]), strict=True))
IDS = ["-".join(filter(None, pair)) for pair in PAIRS]
DRAWS = 2  # random solids per pair
SIDE = 72  # rays per side


def random_solid(rng: np.random.Generator, kind: str, center, scale: float, hole=None) -> Solid:
    """Half extents of 5 to 100 % of ``scale``, meters, turned at random."""
    half = scale * rng.uniform(0.05, 1.0, 3)
    rotation = Rotation.random(rng=rng).as_matrix()
    if kind == "frustum":
        return frustum(center, half, rng.uniform(0.1, 1.0, 2), rotation, hole)
    if kind == "cone":
        return cone(center, half, rng.uniform(0.1, 1.0), rotation, hole)
    make = {"box": box, "cylinder": cylinder, "ellipsoid": ellipsoid}[kind]
    return make(center, half, rotation, hole)


def random_pair(rng: np.random.Generator, kind: str, hole: str | None) -> Solid:
    """A solid of the first kind minus one of the second that leaves something of it."""
    if hole is None:
        return random_solid(rng, kind, np.zeros(3), 0.1)
    while True:
        cut = random_solid(rng, hole, rng.uniform(-0.07, 0.07, 3), 0.12)
        solid = random_solid(rng, kind, np.zeros(3), 0.1, cut)
        try:
            bounds([solid])
        except CaperError:  # swallowed
            continue
        return solid


class Scene:
    """One solid of every pair in each of DRAWS instances, each a part with a pose of its own."""

    def __init__(self) -> None:
        rng = np.random.default_rng(0)
        self.solids = [[random_pair(rng, *pair) for pair in PAIRS] for _ in range(DRAWS)]
        parts = len(PAIRS)
        nothing = np.zeros((parts - 1, 3))
        self.bank = build_bank(
            [
                ObjectModel([[solid] for solid in row], nothing, nothing, nothing[:, :2])
                for row in self.solids
            ]
        )
        self.poses = np.tile(np.eye(4, dtype=np.float32), (DRAWS, parts, 1, 1))
        turns = Rotation.random(DRAWS * parts, rng=rng).as_matrix()
        self.poses[..., :3, :3] = turns.reshape(DRAWS, parts, 3, 3)
        low, high = (-0.4, -0.3, 0.6), (0.4, 0.3, 2.0)
        self.poses[..., :3, 3] = rng.uniform(low, high, (DRAWS, parts, 3))
        groups = jax.tree.map(jnp.asarray, self.bank.groups)
        self.seen = jax.tree.map(np.asarray, jax.jit(self._look)(groups, self.poses))

    @staticmethod
    def _look(groups, poses):
        """Each instance's parts, each looked at alone: rays [D, K, 2, R] and depths [D, K, R]."""

        def look(groups, poses, k):
            alone = {
                name: group.replace(valid=group.valid & (jnp.array(group.part) == k))
                for name, group in groups.items()
            }
            low, high = projected_bounds(alone, poses)
            steps = (jnp.arange(SIDE) + 0.37) / SIDE
            x, y = jnp.meshgrid(*(low[:, None] + steps * (high - low)[:, None]))
            rays = jnp.stack([x.ravel(), y.ravel()])
            depth, part = cast(alone, poses, rays)
            return rays, jnp.where(part == k, depth, FAR)

        def all_parts(frame):
            return jax.lax.map(lambda k: look(*frame, k), jnp.arange(len(PAIRS)))

        return jax.lax.map(all_parts, (groups, poses))

    def view(self, draw: int, index: int):
        """The solid, its pose [4, 4] and rays [R, 3] in float64, and depths [R] of the caster."""
        (rays, depth), pose = self.seen, self.poses[draw, index].astype(np.float64)
        x, y = rays[draw, index].astype(np.float64)
        rays = np.stack([x, y, np.ones_like(x)], axis=-1)
        return self.solids[draw][index], pose, rays, depth[draw, index]


@pytest.fixture(scope="module")
def scene():
    return Scene()


def _unit_rays(solid: Solid, pose, rays):
    """Origin [3] and directions [R, 3] of camera rays in the unit solid's frame, float64."""
    to_unit = np.linalg.inv(pose[:3, :3] @ (solid.rotation * solid.half))
    offset = pose[:3, :3] @ solid.center + pose[:3, 3]
    return -to_unit @ offset, rays @ to_unit.T


def _inside(solid: Solid, points):
    """Whether points [..., 3] of the unit frame lie in the unit solid: the definitions."""
    x, y, z = np.moveaxis(points, -1, 0)
    if solid.kind == "ellipsoid":
        return x**2 + y**2 + z**2 <= 1
    wide, deep = (1 + (taper - 1) * (z + 1) / 2 for taper in solid.taper)
    if solid.kind in FLAT:
        return (np.abs(x) <= wide) & (np.abs(y) <= deep) & (np.abs(z) <= 1)
    return (np.hypot(x, y) <= wide) & (np.abs(z) <= 1)


def _crossings(solid: Solid, origin, direction):
    """Depths [R, M] at which rays cross the surfaces that bound the unit solid."""
    planes, quadrics = [], []
    if solid.kind == "ellipsoid":
        quadrics.append(np.diag([1.0, 1.0, 1.0, -1.0]))
    else:
        planes += [(0, 0, 1, -1), (0, 0, 1, 1)]
        slope = (np.array(solid.taper) - 1) / 2
        middle = (np.array(solid.taper) + 1) / 2
        if solid.kind in FLAT:
            for sign in (-1, 1):
                planes.append((sign, 0, -slope[0], -middle[0]))
                planes.append((0, sign, -slope[1], -middle[1]))
        else:
            width = np.array([0, 0, slope[0], middle[0]])
            quadrics.append(np.diag([1.0, 1.0, 0.0, 0.0]) - np.outer(width, width))
    start = np.append(origin, 1.0)
    along = np.concatenate([direction, np.zeros((len(direction), 1))], axis=1)
    found = [-(np.array(plane) @ start) / (along @ np.array(plane)) for plane in planes]
    for quadric in quadrics:
        a = np.einsum("ri,ij,rj->r", along, quadric, along)
        b, c = 2 * along @ quadric @ start, start @ quadric @ start
        root = np.sqrt(np.where(b**2 >= 4 * a * c, b**2 - 4 * a * c, np.nan))
        found += [(-b - root) / (2 * a), (-b + root) / (2 * a)]
    return np.stack(found, axis=1)


def first_hit(solid: Solid, pose, rays):
    """Depth [R] of the first point of each ray in the solid but not in its hole, or FAR; float64.

    Cuts the ray at every bounding surface and asks the definition of the solid between cuts.
    """
    frame = _unit_rays(solid, pose, rays)
    crossings = _crossings(solid, *frame)
    if solid.hole is not None:
        hole_frame = _unit_rays(solid.hole, pose, rays)
        crossings = np.concatenate([crossings, _crossings(solid.hole, *hole_frame)], axis=1)
    crossings = np.sort(np.where(np.isfinite(crossings), crossings, FAR), axis=1)
    middle = (crossings[:, :-1] + crossings[:, 1:]) / 2
    kept = _inside(solid, frame[0] + middle[..., None] * frame[1][:, None])
    if solid.hole is not None:
        kept &= ~_inside(solid.hole, hole_frame[0] + middle[..., None] * hole_frame[1][:, None])
    first = kept.argmax(axis=1)
    return np.where(kept.any(axis=1), crossings[np.arange(len(rays)), first], FAR)


@pytest.mark.parametrize("index", range(len(PAIRS)), ids=IDS)
def test_agrees_with_the_definition_in_float64(scene, index):
    errors = []
    for draw in range(DRAWS):
        solid, pose, rays, depth = scene.view(draw, index)
        expected = first_hit(solid, pose, rays)
        assert ((depth < FAR) == (expected < FAR)).mean() > 0.999
        errors.append(np.abs(depth - expected)[(depth < FAR) & (expected < FAR)])
    errors = np.concatenate(errors)
    assert len(errors) > 1500
    assert np.median(errors) < 3e-7
    # What grazes a surface or passes an edge of the hole may be farther off.
    assert (errors > 1e-5).mean() < 1e-3


def test_nearest_part_wins_and_parts_are_seen_alone():
    """Two plates behind each other: the far one shows where the near one is not."""
    pair = [[box((0, 0, 0), (0.1, 0.1, 0.01))], [box((0.05, 0, 0.2), (0.1, 0.1, 0.01))]]
    nothing = np.zeros((1, 3))
    bank = build_bank([ObjectModel(pair, nothing, nothing, nothing[:, :2])])
    groups = jax.tree.map(lambda values: jnp.asarray(values[0]), bank.groups)
    poses = jnp.tile(jnp.eye(4).at[2, 3].set(1.0), (2, 1, 1))
    rays = (jnp.array([0.0, 0.11, -0.09, 0.3]), jnp.zeros(4))
    alone = jax.jit(part_depths)(groups, poses, rays)
    np.testing.assert_allclose(alone, [[0.99, FAR, 0.99, FAR], [1.19, 1.19, FAR, FAR]], rtol=1e-6)
    depth, part = jax.jit(cast)(groups, poses, rays)
    np.testing.assert_allclose(depth, [0.99, 1.19, 0.99, FAR], rtol=1e-6)
    assert part.tolist() == [0, 1, 0, -1]


def test_the_inside_of_a_hollow_solid_is_seen_from_within_its_hole():
    room = box((0, 0, 0), (2, 2, 2), hole=box((0, 0, 0), (1.5, 1.5, 1.5)))
    nothing = np.zeros((0, 3))
    bank = build_bank([ObjectModel([[room]], nothing, nothing, nothing[:, :2])])
    groups = jax.tree.map(lambda values: jnp.asarray(values[0]), bank.groups)
    depth, part = jax.jit(cast)(groups, jnp.eye(4)[None], (jnp.array([0.0, 0.5]), jnp.zeros(2)))
    np.testing.assert_allclose(depth, 1.5, rtol=1e-6)
    assert part.tolist() == [0, 0]
