"""Exact ray casting of an articulated object made of solids (one instance; vmap over batches).

A ray is ``depth * (x, y, 1)``: the parameter survives every affine map, so the parameter found in
a unit solid's frame *is* the depth. A solid minus a convex hole is hit at its near side unless
that lies inside the hole, then where the ray leaves the hole. No iteration, no mesh.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp

from caper_jax.data.synthetic.bank import SolidGroup

FAR = 1e9
_UNIT_CORNERS = [[x, y, z] for x in (-1.0, 1.0) for y in (-1.0, 1.0) for z in (-1.0, 1.0)]


def _matvec(matrix, vector):
    """[..., 3, 3] @ [..., 3] elementwise: exact in float32 on every backend (no TF32)."""
    return (matrix * vector[..., None, :]).sum(-1)


def _slab(origin, direction):
    inverse = 1.0 / jnp.where(jnp.abs(direction) < 1e-12, 1e-12, direction)
    first, second = (-1.0 - origin) * inverse, (1.0 - origin) * inverse
    return jnp.minimum(first, second), jnp.maximum(first, second)


def _box_interval(origin, direction, taper):
    near, far = zip(*(_slab(o, d) for o, d in zip(origin, direction, strict=True)), strict=True)
    enter = jnp.maximum(jnp.maximum(near[0], near[1]), near[2])
    return enter, jnp.minimum(jnp.minimum(far[0], far[1]), far[2])


def _cylinder_interval(origin, direction, taper):
    near, far = _slab(origin[2], direction[2])
    a = direction[0] ** 2 + direction[1] ** 2
    # Distance of the axis from the ray, by the cross product: the usual b^2 - ac cancels in
    # float32 when the unit solid is small against the distance.
    cross = origin[0] * direction[1] - origin[1] * direction[0]
    discriminant = a - cross**2
    root = jnp.sqrt(jnp.maximum(discriminant, 0.0))
    middle = -(origin[0] * direction[0] + origin[1] * direction[1])
    inverse = 1.0 / jnp.maximum(a, 1e-12)
    hit = discriminant > 0
    near = jnp.maximum(near, jnp.where(hit, (middle - root) * inverse, FAR))
    return near, jnp.minimum(far, jnp.where(hit, (middle + root) * inverse, -FAR))


def _ellipsoid_interval(origin, direction, taper):
    (x, y, z), (u, v, w) = origin, direction
    a = u**2 + v**2 + w**2
    discriminant = a - (x * v - y * u) ** 2 - (y * w - z * v) ** 2 - (z * u - x * w) ** 2
    root = jnp.sqrt(jnp.maximum(discriminant, 0.0))
    middle = -(x * u + y * v + z * w)
    inverse = 1.0 / jnp.maximum(a, 1e-12)
    hit = discriminant > 0
    return (
        jnp.where(hit, (middle - root) * inverse, FAR),
        jnp.where(hit, (middle + root) * inverse, -FAR),
    )


def _width(origin, direction, taper):
    """Half width along a ray, start and slope: 1 at z = -1 and ``taper`` at z = 1."""
    slope = 0.5 * (taper - 1.0)
    return 0.5 * (taper + 1.0) + slope * origin[2], slope * direction[2]


def _frustum_interval(origin, direction, taper):
    near, far = _slab(origin[2], direction[2])
    for axis in (0, 1):
        width, slope = _width(origin, direction, taper[axis])
        for side in (-1.0, 1.0):
            # Inside the half space where distance + depth * rate <= 0.
            distance, rate = side * origin[axis] - width, side * direction[axis] - slope
            crossing = -distance / jnp.where(jnp.abs(rate) < 1e-12, 1e-12, rate)
            near = jnp.where(rate < 0, jnp.maximum(near, crossing), near)
            far = jnp.where(rate < 0, far, jnp.minimum(far, crossing))
    return near, far


def _cone_interval(origin, direction, taper):
    near, far = _slab(origin[2], direction[2])
    (x, y, _), (u, v, _) = origin, direction
    width, slope = _width(origin, direction, taper[0])
    # a t^2 + 2 b t + c <= 0 inside; the discriminant b^2 - ac as a sum of cross products.
    a = u**2 + v**2 - slope**2
    b = x * u + y * v - width * slope
    c = x**2 + y**2 - width**2
    discriminant = (u * width - x * slope) ** 2 + (v * width - y * slope) ** 2
    discriminant -= (x * v - y * u) ** 2
    # The two roots without cancellation, one as q / a and one as c / q.
    q = jnp.maximum(jnp.sqrt(jnp.maximum(discriminant, 0.0)) + jnp.abs(b), 1e-12)
    one, other = q / jnp.where(jnp.abs(a) < 1e-12, 1e-12, a), c / q
    enter = jnp.where(b > 0, -one, other)
    leave = jnp.where(b > 0, -other, one)
    # A ray steeper than the side (a < 0) crosses the side of this half of the double cone once.
    across = a >= 0
    enter = jnp.where(across | (slope > 0), enter, -FAR)
    leave = jnp.where(across | (slope <= 0), leave, FAR)
    hit = ~across | (discriminant > 0)
    near = jnp.maximum(near, jnp.where(hit, enter, FAR))
    return near, jnp.minimum(far, jnp.where(hit, leave, -FAR))


_INTERVAL = {
    "box": _box_interval,
    "cylinder": _cylinder_interval,
    "ellipsoid": _ellipsoid_interval,
    "frustum": _frustum_interval,
    "cone": _cone_interval,
}


def _to_unit_frame(to_unit, center, pose, rays):
    """Origin (3 scalars) and directions (3 arrays [R]) of camera rays in the unit solid's frame."""
    rotation, translation = pose[:3, :3], pose[:3, 3]
    origin = _matvec(to_unit, -_matvec(rotation.T, translation) - center)
    # to_unit @ rotation.T, elementwise.
    turn = (to_unit[:, None, :] * rotation[None, :, :]).sum(-1)
    x, y = rays
    direction = [turn[i, 0] * x + turn[i, 1] * y + turn[i, 2] for i in range(3)]
    return origin, direction


def cast(groups: dict[str, SolidGroup], poses, rays):
    """First hit of each ray.

    Args:
      groups: one instance's solids (no leading instance axis).
      poses: [K, 4, 4] part rest frame -> camera.
      rays: (x [R], y [R]); directions (x, y, 1) in the camera frame.

    Returns:
      depth [R] metres (``FAR`` where nothing is hit) and part [R] int32 (-1 where nothing).
    """
    carry = (jnp.full(rays[0].shape, FAR), jnp.full(rays[0].shape, -1, jnp.int32))
    for name, group in groups.items():
        kinds = name.split("-")

        def body(carry, solid, kinds=kinds):
            depth, part = carry
            pose = poses[solid.part]
            origin, direction = _to_unit_frame(solid.to_unit, solid.center, pose, rays)
            near, far = _INTERVAL[kinds[0]](origin, direction, solid.taper)
            hit = near
            if len(kinds) == 2:
                frame = _to_unit_frame(solid.hole_to_unit, solid.hole_center, pose, rays)
                hole_near, hole_far = _INTERVAL[kinds[1]](frame[0], frame[1], solid.hole_taper)
                inside = (hole_near < hole_far) & (near >= hole_near) & (near <= hole_far)
                hit = jnp.where(inside, hole_far, near)
            better = solid.valid & (near < far) & (hit < far) & (hit > 1e-3) & (hit < depth)
            return (jnp.where(better, hit, depth), jnp.where(better, solid.part, part)), None

        # A scan with a running minimum: 2-4 times faster on a CPU than vmap and argmin.
        carry, _ = jax.lax.scan(body, carry, group)
    return carry


def projected_bounds(groups: dict[str, SolidGroup], poses):
    """Bounds (low [2], high [2]) of the object on the plane z = 1, from its solids' corners."""
    corners = jnp.asarray(_UNIT_CORNERS)
    low, high = jnp.full(2, FAR), jnp.full(2, -FAR)
    for group in groups.values():
        pose = poses[group.part]
        points = _matvec(group.half_axes[:, None], corners) + group.center[:, None]
        points = _matvec(pose[:, None, :3, :3], points) + pose[:, None, :3, 3]
        plane = points[..., :2] / points[..., 2:]
        valid = group.valid[:, None, None]
        low = jnp.minimum(low, jnp.where(valid, plane, FAR).min((0, 1)))
        high = jnp.maximum(high, jnp.where(valid, plane, -FAR).max((0, 1)))
    return low, high
