"""From a URDF to an object in this project's frames: rest pose, canonical axes, senses of joints.

The canonical frame has its origin at the center of the whole object's box at rest. Its axes are
those that ``rules`` finds, or that the user names.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from caper_jax.articulation.category import Category
from caper_jax.data.urdf.folders import PARTNET_CLASSES
from caper_jax.data.urdf.load import UrdfModel, read_urdf
from caper_jax.data.urdf.parts import PartTree, map_parts
from caper_jax.data.urdf.reference import Reference, reference
from caper_jax.data.urdf.rules import Rule, rule_of
from caper_jax.errors import CaperError, unknown_name

_TRAVEL = 0.9  # share of a slide's way that is used, as by generated shapes
_STRAIGHT = np.radians(15)
_ROTATIONS = np.array(
    [
        matrix
        for order in itertools.permutations(range(3))
        for signs in itertools.product((1.0, -1.0), repeat=3)
        if np.linalg.det(matrix := np.eye(3)[list(order)] * np.array(signs)[:, None]) > 0
    ]
)


@dataclass(frozen=True)
class ImportOptions:
    """What the user says about a URDF; all else is detected.

    Attributes:
      up: [3] the file's direction that becomes canonical y, or None.
      front: [3] the file's direction that becomes canonical z, or None.
      rest: states of the file's joints at rest, by the name of the joint or of the link it
        carries; degrees or meters. "" stands for all joints that the parts keep.
      parts: one link of each part in the category's order, or None.
      scale: factor for all lengths, or None for the category's mean size.
    """

    up: np.ndarray | None = None
    front: np.ndarray | None = None
    rest: Mapping[str, float] = field(default_factory=dict)
    parts: tuple[str, ...] | None = None
    scale: float | None = 1.0


@dataclass(frozen=True)
class ImportedObject:
    """An articulated object with meshes, in the conventions of this project.

    Attributes:
      name: of the object.
      category: its category.
      reference: parts and joints at rest, canonical frame, meters; K parts in order.
      size, box_center: [K, 3] meters.
      states: [J, 2] range from which states are drawn, radians or meters from rest.
      joint_names: J names in the file.
      notes: what was found and decided, for people, a line each.
    """

    name: str
    category: Category
    reference: Reference
    size: np.ndarray
    box_center: np.ndarray
    states: np.ndarray
    joint_names: tuple[str, ...]
    notes: tuple[str, ...]


def import_urdf(
    path: str | Path, category: Category, options: ImportOptions | None = None
) -> ImportedObject:
    """Reads a URDF and brings it to a category's conventions.

    Raises:
      CaperError: a file that cannot be read, parts that do not map, a frame or a range of joints
        that cannot be right; the message says which option settles it.
    """
    return bring(read_urdf(path), category, options or ImportOptions())


def bring(model: UrdfModel, category: Category, options: ImportOptions) -> ImportedObject:
    """``import_urdf`` for a URDF that has been read."""
    classes = PARTNET_CLASSES.get(category.name, ())
    if model.object_class and classes and model.object_class not in classes:
        raise CaperError(f"{model.path}: PartNet-Mobility calls it {model.object_class!r}")
    given = _rest_by_joint(model, options.rest)
    held = given if "" not in options.rest else {}
    tree = map_parts(model, category, options.parts, held)
    rule = rule_of(category.name)
    raw = reference(model, tree)
    if rule.root is not None and options.parts is None and rule.root(raw) == 1:
        tree = tree.exchanged()
        raw = reference(model, tree)
    names = [part.joint.name for part in tree.joints]
    found = np.array([given.get(name, np.nan) for name in names], np.float64)
    if np.isnan(found).any():
        found = np.where(np.isnan(found), rule.rest(raw), found)
    # What mimics a joint is where that joint's rest state puts it, not its state 0.
    resting = tree.locked | dict(zip(names, found.tolist(), strict=True))
    at_rest = reference(model.following(resting), tree).at(found)
    rotation, about_frame = _axes(model, rule, at_rest, options)
    scale, about_scale = _scale(at_rest, category, options.scale)
    pose = np.eye(4)
    pose[:3, :3] = rotation
    pose[:3, 3] = -at_rest.moved(pose).bounds().mean(0)
    canonical = at_rest.moved(pose, scale)
    if rule.order is not None and options.parts is None:
        order = _order(canonical, rule.order)
        canonical, found = canonical.ordered(order), found[order]
        names = [names[row] for row in order]
        tree = _reordered(tree, order)
    if rule.opening is not None:
        canonical = _opened(model, canonical, rule.opening(canonical), names)
    boxes = np.array([mesh.bounds() for mesh in canonical.parts])
    if (np.ptp(boxes, axis=1) <= 0).any():
        flat = category.parts[int(np.argmin(np.ptp(boxes, axis=1).min(-1)))]
        raise CaperError(f"{model.path}: part {flat!r} has no thickness")
    states = _states(model, canonical, category, names)
    return ImportedObject(
        name=model.name,
        category=category,
        reference=canonical,
        size=np.ptp(boxes, axis=1),
        box_center=boxes.mean(1),
        states=states,
        joint_names=tuple(names),
        notes=(
            *_part_notes(model, tree, category),
            *_joint_notes(canonical, names, found, states),
            about_frame,
            about_scale,
        ),
    )


def _rest_by_joint(model: UrdfModel, rest: Mapping[str, float]) -> dict[str, float]:
    """Rest states in radians or meters by the joint's name, for the joints that are named."""
    carried = {joint.child: joint for joint in model.joints}
    known = carried | {joint.name: joint for joint in model.joints}
    found = {}
    for name, state in rest.items():
        if name and name not in known:
            raise CaperError(f"{model.path}: --rest: {unknown_name('joint', name, known)}")
        chosen = [known[name]] if name else model.joints
        for joint in chosen:
            turns = joint.kind == "revolute"
            found[joint.name] = float(np.radians(state)) if turns else state
    return found


def _axes(
    model: UrdfModel, rule: Rule, at_rest: Reference, options: ImportOptions
) -> tuple[np.ndarray, str]:
    """Rotation [3, 3] from the file's frame to the canonical one, and a note on it."""
    up, front, assumed = rule.frame(at_rest)
    given = [d for d in (options.up, options.front) if d is not None]
    up = up if options.up is None else np.asarray(options.up, np.float64)
    front = front if options.front is None else np.asarray(options.front, np.float64)
    if options.up is None and options.front is not None:
        z, y = _orthonormal(model, front, up)
    else:
        y, z = _orthonormal(model, up, front)
    rotation = np.stack([np.cross(y, z), y, z])
    # Half the trace tells how far a rotation is from the nearest with the file's own axes.
    traces = np.einsum("nij,ij->n", _ROTATIONS, rotation)
    nearest = _ROTATIONS[np.argmax(traces)]
    angle = float(np.degrees(np.arccos(np.clip((traces.max() - 1) / 2, -1, 1))))
    along = all(np.abs(d).max() > 1 - 1e-9 for d in (d / np.linalg.norm(d) for d in given))
    # A first joint that is oblique to those axes says that the object is.
    straight = np.abs(at_rest.axis[0]).max() > np.cos(_STRAIGHT)
    snapped = along and straight and angle <= rule.snap
    rotation = nearest if snapped else rotation
    source = " and ".join(
        f"{name} {'given' if option is not None else 'assumed' if name in assumed else 'detected'}"
        for name, option in (("up", options.up), ("front", options.front))
    )
    note = ", ".join(f"{name} = {_named(row)}" for name, row in zip("xyz", rotation, strict=True))
    tail = "" if snapped or angle < 1e-3 else f"; {angle:.0f} deg off the file's axes"
    return rotation, f"frame: {note} of the file ({source}{tail})"


def _orthonormal(
    model: UrdfModel, first: np.ndarray, second: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    first = first / np.linalg.norm(first)
    rest = second - (second @ first) * first
    if np.linalg.norm(rest) < 0.3 * np.linalg.norm(second):
        raise CaperError(
            f"{model.path}: up and front come out nearly the same; give both --up and --front"
        )
    return first, rest / np.linalg.norm(rest)


def _named(row: np.ndarray) -> str:
    """``+x`` for an axis of the file, else three numbers."""
    index = int(np.argmax(np.abs(row)))
    if abs(row[index]) > 1 - 1e-9:
        return f"{'+' if row[index] > 0 else '-'}{'xyz'[index]}"
    return f"({', '.join(f'{value:.3f}' for value in row)})"


def _scale(at_rest: Reference, category: Category, scale: float | None) -> tuple[float, str]:
    """The factor for lengths; a note says how the object compares with the category's mean."""
    center, size = np.array(category.mean_center), np.array(category.mean_size)
    extent = (center + size / 2).max(0) - (center - size / 2).min(0)
    ratio = float(np.linalg.norm(np.ptp(at_rest.bounds(), axis=0)) / np.linalg.norm(extent))
    if scale is None:
        return 1 / ratio, f"size: scaled by {1 / ratio:.4g} to the mean of {category.name}"
    ratio *= scale
    hint = "" if 0.4 < ratio < 2.5 else "; are its lengths meters? (--scale)"
    return scale, f"size: {ratio:.2f} times the mean of {category.name}{hint}"


def _order(canonical: Reference, axis: int) -> list[int]:
    """Joints by the place of their parts along an axis; by x where they are level."""
    places = np.array([mesh.bounds().mean(0) for mesh in canonical.parts[1:]])
    level = 0.02 * np.linalg.norm(np.ptp(canonical.bounds(), axis=0))
    return sorted(
        range(canonical.num_joints),
        key=lambda row: (round(places[row, axis] / level), places[row, 0]),
    )


def _reordered(tree: PartTree, order: Sequence[int]) -> PartTree:
    links = (tree.links[0], *(tree.links[row + 1] for row in order))
    return replace(tree, links=links, joints=tuple(tree.joints[row] for row in order))


def _opened(
    model: UrdfModel, canonical: Reference, opening: np.ndarray, names: Sequence[str]
) -> Reference:
    """With every joint's positive sense along the direction that opens."""
    lengths = np.linalg.norm(opening, axis=-1)
    along = (canonical.axis * opening).sum(-1) / np.maximum(lengths, 1e-12)
    for name, cosine in zip(names, along, strict=True):
        if abs(cosine) < 0.5:
            raise CaperError(
                f"{model.path}: the axis of {name} lies across the one it should have; give "
                "--up and --front, and look at the check picture"
            )
    return canonical.flipped(np.sign(along))


def _states(
    model: UrdfModel, canonical: Reference, category: Category, names: Sequence[str]
) -> np.ndarray:
    """Ranges to draw from: turns within the category's too, slides to 90 % of their travel."""
    states = canonical.limits.copy()
    for row, (joint, name) in enumerate(zip(category.joints, names, strict=True)):
        low, high = states[row]
        if joint.type == "revolute":
            states[row] = max(low, joint.limits[0]), min(high, joint.limits[1])
            if states[row, 1] - states[row, 0] < 1e-3:
                has, wants = np.degrees([low, high]), np.degrees(joint.limits)
                raise CaperError(
                    f"{model.path}: {name} turns from {has[0]:.0f} to {has[1]:.0f} deg from the "
                    f"rest pose, {category.name} from {wants[0]:.0f} to {wants[1]:.0f}: wrong rest "
                    "pose or sense; give --rest, --up or --front"
                )
        elif not np.isfinite(high - low):
            raise CaperError(f"{model.path}: {name} slides without limits; add a <limit>")
        else:
            states[row] = (low, high) if low < 0 < high else (low * _TRAVEL, high * _TRAVEL)
    return states


def _part_notes(model: UrdfModel, tree: PartTree, category: Category) -> list[str]:
    labels = {name: f" ({label})" for name, label in model.labels.items()}
    notes = [
        f"{part}: {', '.join(name + labels.get(name, '') for name in links)}"
        for part, links in zip(category.parts, tree.links, strict=True)
    ]
    return notes + list(tree.notes)


def _joint_notes(
    canonical: Reference, names: Sequence[str], rest: np.ndarray, states: np.ndarray
) -> list[str]:
    notes = []
    for row, name in enumerate(names):
        turns = canonical.kinds[row] == "revolute"
        factor, unit = (180 / np.pi, "deg") if turns else (1.0, "m")
        low, high = states[row] * factor
        notes.append(
            f"{name}: rest at {rest[row] * factor:.4g} {unit} of the file, states "
            f"{low:.4g} to {high:.4g} {unit}"
        )
    return notes
