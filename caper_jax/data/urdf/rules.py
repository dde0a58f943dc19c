"""Where each category's rest pose, axes and opening sense show in its geometry and joints.

A URDF says neither which way is up nor what is open. Every rule here reads it from the direction
of the joints, the side on which their range lies, and the shape of the parts; conventions of
modellers (z or y up, objects modeled closed or unfolded) only settle what is left.

Rest states are snapped to states that mean something in the file: 0, a limit, or 90 deg from one.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from caper_jax.data.urdf.reference import Reference

_X, _Y, _Z = np.eye(3)


class Frame(NamedTuple):
    """Canonical axes in the file's frame.

    Attributes:
      up, front: [3] canonical y and z; of any length, not quite at right angles.
      assumed: which of "up" and "front" only a convention says.
    """

    up: np.ndarray
    front: np.ndarray
    assumed: tuple[str, ...] = ()


@dataclass(frozen=True)
class Rule:
    """How a category is brought to its rest pose and canonical frame.

    Attributes:
      rest: [J] states, from the file's 0, of the object in the file's frame.
      frame: up and front in the file's frame, for the object at rest.
      opening: [J, 3] direction, canonical, about or along which each joint opens; None keeps the
        sense of the file.
      order: axis (0, 1, 2) along which parts on the root are numbered; None keeps the file's order.
      snap: degrees within which the frame is set to the axes of the file.
      root: which of two parts is the root; None takes the file's.
    """

    rest: Callable[[Reference], np.ndarray]
    frame: Callable[[Reference], Frame]
    opening: Callable[[Reference], np.ndarray] | None = None
    order: int | None = None
    snap: float = 35.0
    root: Callable[[Reference], int] | None = None


def rule_of(name: str) -> Rule:
    """The rule of a category; for one without: rest at state 0, z (or y) up, the file's senses."""
    return _RULES.get(name, Rule(rest=_zero, frame=_usual_frame))


def _snap(state: float, limits: np.ndarray, degrees: float, quarter: bool = False) -> float:
    """The first of 0, the limits and (if ``quarter``) 90 deg from them that is near a state."""
    ends = [float(end) for end in limits if np.isfinite(end)]
    turns = [end + sign * np.pi / 2 for end in ends for sign in (1, -1)] if quarter else []
    for candidate in (0.0, *ends, *turns):
        if abs(candidate - state) <= np.radians(degrees):
            return candidate
    return state


def _opens(ref: Reference, joint: int) -> float:
    """+1 or -1: the sign of the states to which a joint at the end of its range can go.

    The side on which more of its range lies; without a clear one, the side on which the object
    gets larger.
    """
    low, high = ref.limits[joint]
    if np.isfinite(high - low) and abs(high + low) > 0.2 * (high - low):
        return 1.0 if high + low > 0 else -1.0
    step = np.radians(60) if ref.kinds[joint] == "revolute" else 0.1 * np.ptp(ref.bounds())
    return 1.0 if ref.width(joint, step) >= ref.width(joint, -step) else -1.0


def _zero(ref: Reference) -> np.ndarray:
    return np.zeros(ref.num_joints)


def _closed(ref: Reference) -> np.ndarray:
    """Every joint at 0 or at the limit where the object is most compact, 0 if nearly as good.

    A range that starts a little before the lid is shut counts from 0 all the same.
    """
    states = []
    for joint in range(ref.num_joints):
        ends = [float(end) for end in ref.limits[joint] if np.isfinite(end)]
        if not ends and ref.kinds[joint] == "revolute":
            ends = [np.pi / 2, -np.pi / 2, np.pi]
        widths = {state: ref.width(joint, state) for state in (0.0, *ends)}
        best = min(widths, key=lambda state: widths[state])
        near = np.radians(5) if ref.kinds[joint] == "revolute" else 0.02 * np.ptp(ref.limits[joint])
        zero = abs(best) <= near or widths[0.0] <= 1.01 * widths[best]
        states.append(0.0 if zero else best)
    return np.array(states)


def _level(direction: np.ndarray) -> np.ndarray:
    """An axis of the file that is within 8 deg of a direction, else the direction.

    A wedge lies on the table with its underside, not with its middle.
    """
    index = int(np.argmax(np.abs(direction)))
    if abs(direction[index]) < np.cos(np.radians(8)):
        return direction
    return np.eye(3)[index] * np.sign(direction[index])


def _perpendicular(ref: Reference) -> np.ndarray:
    """laptop: the lid's plate at 90 deg to the base's, on the side to which it opens."""
    opening = ref.turn(0, _level(ref.direction(0, 0)), ref.direction(1, 0))
    if np.radians(10) < abs(opening) < np.radians(170):
        sense = np.sign(opening)
    elif abs(opening) <= np.radians(10):
        sense = _opens(ref, 0)
    else:  # modeled flat open: most of the range closes it
        sense = -_opens(ref, 0)
        opening = sense * abs(opening)
    return np.array([_snap(sense * np.pi / 2 - opening, ref.limits[0], 6.0, quarter=True)])


def _quarter_open(ref: Reference) -> np.ndarray:
    """dishwasher: 90 deg from closed."""
    closed = float(_closed(ref)[0])
    sense = _opens(ref.at(np.array([closed])), 0)
    return np.array([_snap(closed + sense * np.pi / 2, ref.limits[0], 6.0)])


def _unfolded(ref: Reference) -> np.ndarray:
    """eyeglasses: every temple at a right angle to the front, within its range."""
    states = []
    for joint in range(ref.num_joints):
        turn = ref.turn(joint, ref.direction(0, joint), ref.direction(joint + 1, joint))
        low, high = ref.limits[joint] + np.radians([-20, 20])
        choices = [sign * np.pi / 2 - turn for sign in (-3, -1, 1, 3)]
        inside = [state for state in choices if low <= state <= high] or choices
        state = min(inside, key=abs)
        states.append(_snap(state, ref.limits[joint], 20.0))
    return np.array(states)


def _tip(ref: Reference, part: int) -> np.ndarray:
    """scissors: unit vector from the pivot to the tip of a blade, the part's narrower end.

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


def _tips(ref: Reference) -> tuple[np.ndarray, np.ndarray, float]:
    """scissors: the two tips, and the sense in which the other blade opens."""
    root, other = _tip(ref, 0), _tip(ref, 1)
    apart = ref.turn(0, root, other)
    low, high = ref.limits[0]
    middle = apart + (low + high) / 2 if np.isfinite(high - low) else apart
    sense = float(np.sign(middle if abs(middle) > np.radians(2) else apart)) or 1.0
    return root, other, sense


def _apart(ref: Reference) -> np.ndarray:
    """scissors: the tips 20 deg apart, on the side to which they open."""
    root, other, sense = _tips(ref)
    return np.array([_snap(sense * np.radians(20) - ref.turn(0, root, other), ref.limits[0], 5.0)])


def _axis_near(direction: np.ndarray) -> np.ndarray:
    """A direction or its opposite, whichever points along a positive axis of the file."""
    return direction * np.sign(direction[np.argmax(np.abs(direction))])


def _usual_up(ref: Reference, across: np.ndarray) -> np.ndarray:
    """z, as in robotics, or y, as in graphics, where z lies along ``across``."""
    return _Z if abs(across[2]) < 0.7 else _Y


def _usual_frame(ref: Reference) -> Frame:
    return Frame(_Z, _X, ("up", "front"))


def _laptop_frame(ref: Reference) -> Frame:
    return Frame(ref.direction(1, 0), _level(ref.direction(0, 0)))


def _lid_frame(ref: Reference) -> Frame:
    """box and stapler, closed: front from the hinge along the lid, up where the lid swings."""
    front = ref.direction(1, 0)
    return Frame(_opens(ref, 0) * np.cross(ref.axis[0], front), front)


def _door_frame(ref: Reference) -> Frame:
    """dishwasher, open: front from the hinge along the door, up where the door closes."""
    front = ref.direction(1, 0)
    return Frame(_opens(ref, 0) * np.cross(ref.axis[0], front), front)


def _slide_frame(ref: Reference) -> Frame:
    """drawer: front where the drawers go, up along their stack."""
    front = ref.axis[0] * _opens(ref, 0)
    up = _stack(ref, front)
    if up is None:
        return Frame(_usual_up(ref, front), front, ("up",))
    return Frame(up, front)


def _stack(ref: Reference, front: np.ndarray) -> np.ndarray | None:
    """drawer: the direction across the front in which the drawers follow one another.

    None where they spread nearly as far the other way, or would be much taller than wide: such
    drawers stand side by side.
    """
    across = np.eye(3) - np.outer(front, front)
    centers = np.array([mesh.bounds().mean(0) for mesh in ref.parts[1:]]) @ across
    variance, directions = np.linalg.eigh(np.cov(centers.T))
    up = _axis_near(_level(directions[:, -1]))
    height, width = (
        np.mean([np.ptp(mesh.vertices @ direction) for mesh in ref.parts[1:]])
        for direction in (up, np.cross(up, front))
    )
    return up if variance[-1] > 4 * variance[-2] and height < 1.25 * width else None


def _cutter_frame(ref: Reference) -> Frame:
    """cutter: x where the blade goes, y out of the flat face, on the side of the slider.

    The face is where the blade, with its slider, clearly stands out of the handle; of a cutter
    without such a slider, the face across the handle's thin direction.
    """
    travel = ref.axis[0] * _opens(ref, 0)

    def shift(direction: np.ndarray) -> float:
        """Of the blade's middle from the handle's, as a share of the handle."""
        handle, blade = (part.vertices @ direction for part in ref.parts)
        apart = blade.max() + blade.min() - handle.max() - handle.min()
        return float(apart / 2 / np.ptp(handle))

    sides = [axis for axis in np.eye(3) if abs(axis @ travel) < 0.5]
    up = max(sides, key=lambda direction: abs(shift(direction)))
    if abs(shift(up)) < 0.24:
        across = np.eye(3) - np.outer(travel, travel)
        second = across @ ref.parts[0].moments()[2] @ across
        # The travel itself has the value 0; the thin direction comes next.
        up = np.linalg.eigh(second)[1][:, 1]
    up = up * np.sign(shift(up)) if abs(shift(up)) > 0.05 else _axis_near(up)
    return Frame(up, np.cross(travel, up))


def _glasses_frame(ref: Reference) -> Frame:
    back = np.sum([ref.direction(joint + 1, joint) for joint in range(ref.num_joints)], axis=0)
    return Frame(_axis_near(ref.axis[0]), -back)


def _scissors_frame(ref: Reference) -> Frame:
    """x to the tips, y along the pivot so that the root's tip is at +z."""
    root, other, sense = _tips(ref)
    up = sense * ref.axis[0]
    return Frame(up, np.cross(root + other, up))


def _longer_handle(ref: Reference) -> int:
    """scissors: the half whose handle reaches farther from the pivot is the root."""
    plane = ref.across(0)
    reach = []
    for part, tip in enumerate(_tips(ref)[:2]):
        flat = (ref.parts[part].vertices - ref.pivot[0]) @ plane.T
        handle = flat[flat @ (plane @ tip) < 0]
        reach.append(np.linalg.norm(handle, axis=-1).max(initial=0.0))
    return 1 if reach[1] > 1.03 * reach[0] else 0


def _arm_frame(ref: Reference) -> Frame:
    """robotarm: up along the first axis, from base to shoulder; front where the tip is at rest."""
    base, shoulder, tip = (ref.parts[part].bounds().mean(0) for part in (0, 1, -1))
    reach = tip - base
    up = ref.axis[0] * (1.0 if ref.axis[0] @ (shoulder - base) >= 0 else -1.0)
    level = reach - (reach @ up) * up
    if np.linalg.norm(level) < 0.03 * np.linalg.norm(np.ptp(ref.bounds(), axis=0)):
        # Straight up: x where z is up (robotics), z where y is up (graphics).
        return Frame(up, np.roll(_axis_near(up), 1), ("front",))
    return Frame(up, level)


def _temple_axes(ref: Reference) -> np.ndarray:
    """A temple folds to the middle: about -y at -x, about +y at +x."""
    sides = np.array([mesh.bounds()[:, 0].mean() for mesh in ref.parts[1:]])
    return np.sign(sides)[:, None] * _Y


def _blade_axes(ref: Reference) -> np.ndarray:
    """The other blade goes away from the root's."""
    root, other, _ = _tips(ref)
    return np.cross(root, other)[None] / np.linalg.norm(np.cross(root, other))


def _positive_axes(ref: Reference) -> np.ndarray:
    """robotarm: positive about the canonical axis that is nearest at rest."""
    return np.eye(3)[np.argmax(np.abs(ref.axis), axis=1)]


def _always(axis: np.ndarray) -> Callable[[Reference], np.ndarray]:
    return lambda ref: np.tile(axis, (ref.num_joints, 1))


_RULES = {
    "laptop": Rule(_perpendicular, _laptop_frame, _always(-_X)),
    "box": Rule(_closed, _lid_frame, _always(-_X)),
    "stapler": Rule(_closed, _lid_frame, _always(-_X)),
    "dishwasher": Rule(_quarter_open, _door_frame, _always(_X)),
    "drawer": Rule(_closed, _slide_frame, _always(_Z), order=1),
    "cutter": Rule(_closed, _cutter_frame, _always(_X)),
    "eyeglasses": Rule(_unfolded, _glasses_frame, _temple_axes, order=0, snap=20.0),
    "scissors": Rule(_apart, _scissors_frame, _blade_axes, snap=6.0, root=_longer_handle),
    "robotarm": Rule(_zero, _arm_frame, _positive_axes, snap=50.0),
}
