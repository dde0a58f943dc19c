"""scissors in URDF files: tips, handles, and the rest pose with the tips 20 deg apart."""

from __future__ import annotations

import numpy as np

from caper_jax.articulation.mesh_object import MeshObject
from caper_jax.articulation.urdf_rule import CanonicalAxes, UrdfRule, snap_state


def _tip(ref: MeshObject, part: int) -> np.ndarray:
    """Unit vector from the pivot to the tip of a blade, the part's narrower end.

    A tip that is round or cut off counts by its middle.
    """
    plane = ref.across(0)
    flat = (ref.parts[part].vertices - ref.pivot[0]) @ plane.T
    along = plane @ ref.direction(part, 0)
    side = np.array([-along[1], along[0]])
    ahead, aside = flat @ along, flat @ side
    spread = {
        sign: np.ptp(aside[sign * ahead > 0.25 * (sign * ahead).max()]) for sign in (1.0, -1.0)
    }
    sign = min(spread, key=lambda end: spread[end])
    reach = np.hypot(ahead, aside) * (sign * ahead > 0)
    end = reach > 0.97 * reach.max()
    angles = np.arctan2(aside[end], sign * ahead[end])
    angle = (angles.min() + angles.max()) / 2
    return (np.cos(angle) * sign * along + np.sin(angle) * side) @ plane


def _tips(ref: MeshObject) -> tuple[np.ndarray, np.ndarray, float]:
    """The two tips, and the sense in which the other blade opens."""
    root, other = _tip(ref, 0), _tip(ref, 1)
    apart = ref.turn(0, root, other)
    low, high = ref.limits[0]
    middle = apart + (low + high) / 2 if np.isfinite(high - low) else apart
    sense = float(np.sign(middle if abs(middle) > np.radians(2) else apart)) or 1.0
    return root, other, sense


def _apart(ref: MeshObject) -> np.ndarray:
    """The tips 20 deg apart, on the side to which they open."""
    root, other, sense = _tips(ref)
    return np.array(
        [snap_state(sense * np.radians(20) - ref.turn(0, root, other), ref.limits[0], 5.0)]
    )


def _axes(ref: MeshObject) -> CanonicalAxes:
    """x to the tips, y along the pivot so that the root's tip is at +z."""
    root, other, sense = _tips(ref)
    up = sense * ref.axis[0]
    return CanonicalAxes(up, np.cross(root + other, up))


def _longer_handle(ref: MeshObject) -> int:
    """The half whose handle reaches farther from the pivot is the root."""
    plane = ref.across(0)
    reach = []
    for part, tip in enumerate(_tips(ref)[:2]):
        flat = (ref.parts[part].vertices - ref.pivot[0]) @ plane.T
        handle = flat[flat @ (plane @ tip) < 0]
        reach.append(np.linalg.norm(handle, axis=-1).max(initial=0.0))
    return 1 if reach[1] > 1.03 * reach[0] else 0


def _blade_axes(ref: MeshObject) -> np.ndarray:
    """The other blade goes away from the root's."""
    root, other, _ = _tips(ref)
    return np.cross(root, other)[None] / np.linalg.norm(np.cross(root, other))


URDF_RULE = UrdfRule(
    rest=_apart,
    axes=_axes,
    opening=_blade_axes,
    snap=6.0,
    root=_longer_handle,
    partnet_classes=("Scissors",),
)
