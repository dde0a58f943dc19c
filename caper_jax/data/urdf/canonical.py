"""From a URDF to an object in this project's frames: rest pose, canonical axes, senses of joints.

The canonical frame has its origin at the center of the whole object's box at rest. Its axes are
those that the category's ``urdf_rule`` detects, or that the user names.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from caper_jax.articulation.category import Category
from caper_jax.articulation.mesh_object import MeshObject
from caper_jax.articulation.urdf_rule import UrdfRule
from caper_jax.data.urdf import ImportedObject, ImportOptions, JointMap
from caper_jax.data.urdf.load import UrdfModel, read_urdf
from caper_jax.data.urdf.parts import PartTree, map_parts
from caper_jax.errors import CaperError, unknown_name
from caper_jax.geometry.boxes import rest_diagonal
from caper_jax.geometry.frames import CUBE_ROTATIONS
from caper_jax.geometry.meshes import join

_TRAVEL = 0.9  # share of a slide's way that is used, as by generated shapes
_STRAIGHT = np.radians(15)


def import_urdf(
    path: str | Path, category: Category, options: ImportOptions | None = None
) -> ImportedObject:
    """Reads a URDF and brings it to a category's conventions.

    Raises:
      CaperError: a file that cannot be read, parts that do not map, a frame or a range of joints
        that cannot be right; the message says which option settles it.
    """
    return import_model(read_urdf(path), category, options or ImportOptions())


def import_model(model: UrdfModel, category: Category, options: ImportOptions) -> ImportedObject:
    """``import_urdf`` for a URDF that has been read."""
    rule = category.urdf_rule
    classes = rule.partnet_classes
    if model.object_class and classes and model.object_class not in classes:
        raise CaperError(f"{model.path}: PartNet-Mobility calls it {model.object_class!r}")
    tree, rest, at_rest = _rest_pose(model, category, options)
    rotation, about_frame = _axes(model, rule, at_rest, options)
    scale, about_scale = _scale(at_rest, category, options.scale)
    pose = np.eye(4)
    pose[:3, :3] = rotation
    pose[:3, 3] = -at_rest.moved(pose).bounds().mean(0)
    canonical = at_rest.moved(pose, scale)
    if rule.order is not None and options.parts is None:
        order = _order(canonical, rule.order)
        canonical, rest, tree = canonical.ordered(order), rest[order], _reordered(tree, order)
    signs = np.ones(len(rest))
    if rule.opening is not None:
        signs = _opening_signs(model, canonical, rule.opening(canonical), tree)
        canonical = canonical.flipped(signs)
    boxes = np.array([mesh.bounds() for mesh in canonical.parts])
    if (np.ptp(boxes, axis=1) <= 0).any():
        flat = category.parts[int(np.argmin(np.ptp(boxes, axis=1).min(-1)))]
        raise CaperError(f"{model.path}: part {flat!r} has no thickness")
    joints = _joint_maps(model, category, tree, canonical, signs, scale, rest)
    return ImportedObject(
        name=model.name,
        category=category,
        at_rest=canonical,
        size=np.ptp(boxes, axis=1),
        box_center=boxes.mean(1),
        joints=joints,
        notes=(
            *_part_notes(model, tree, category),
            *(_joint_note(joint) for joint in joints),
            about_frame,
            about_scale,
        ),
    )


def _rest_pose(
    model: UrdfModel, category: Category, options: ImportOptions
) -> tuple[PartTree, np.ndarray, MeshObject]:
    """The parts, the file's joint values [J] at rest, and the object there in the file's frame."""
    rule = category.urdf_rule
    given = _rest_by_joint(model, options.rest)
    held = given if "" not in options.rest else {}
    tree = map_parts(model, category, options.parts, held)
    raw = _as_in_file(model, tree)
    if rule.root is not None and options.parts is None and rule.root(raw) == 1:
        tree = tree.exchanged()
        raw = _as_in_file(model, tree)
    names = [part.joint.name for part in tree.joints]
    rest = np.array([given.get(name, np.nan) for name in names], np.float64)
    if np.isnan(rest).any():
        rest = np.where(np.isnan(rest), rule.rest(raw), rest)
    # What mimics a joint is where that joint's rest state puts it, not its state 0.
    resting = tree.locked | dict(zip(names, rest.tolist(), strict=True))
    return tree, rest, _as_in_file(model.following(resting), tree).at(rest)


def _as_in_file(model: UrdfModel, tree: PartTree) -> MeshObject:
    """The object as the file holds it at state 0, in the frame of the file's root link.

    Joints that mimic others stand where ``tree.locked``, and state 0 of the rest, put them.
    """
    poses = model.link_poses(tree.locked)
    parts = []
    for links in tree.links:
        meshes = [(model.links[name], poses[name]) for name in links]
        parts.append(join([mesh.moved(pose) for mesh, pose in meshes if mesh is not None]))
    axes, pivots, limits = [], [], []
    for part in tree.joints:
        frame = poses[part.joint.parent] @ part.joint.origin
        # Seen from its child, a joint turns the other way.
        axes.append(frame[:3, :3] @ part.joint.axis * (-1.0 if part.reversed else 1.0))
        pivots.append(frame[:3, 3])
        limits.append(part.joint.limits)
    return MeshObject(
        tuple(parts),
        tuple(part.joint.kind for part in tree.joints),
        tuple(part.parent for part in tree.joints),
        np.array(axes),
        np.array(pivots),
        np.array(limits),
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
    model: UrdfModel, rule: UrdfRule, at_rest: MeshObject, options: ImportOptions
) -> tuple[np.ndarray, str]:
    """Rotation [3, 3] from the file's frame to the canonical one, and a note on it."""
    up, front, assumed = rule.axes(at_rest)
    given = [d for d in (options.up, options.front) if d is not None]
    up = up if options.up is None else np.asarray(options.up, np.float64)
    front = front if options.front is None else np.asarray(options.front, np.float64)
    if options.up is None and options.front is not None:
        z, y = _orthonormal(model, front, up)
    else:
        y, z = _orthonormal(model, up, front)
    rotation = np.stack([np.cross(y, z), y, z])
    # Half the trace tells how far a rotation is from the nearest with the file's own axes.
    traces = np.einsum("nij,ij->n", CUBE_ROTATIONS, rotation)
    nearest = CUBE_ROTATIONS[np.argmax(traces)].astype(np.float64)
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


def _scale(at_rest: MeshObject, category: Category, scale: float | None) -> tuple[float, str]:
    """The factor for lengths; a note says how the object compares with the category's mean."""
    mean = rest_diagonal(np.array(category.mean_size), np.array(category.mean_center))
    ratio = float(np.linalg.norm(np.ptp(at_rest.bounds(), axis=0)) / mean)
    if scale is None:
        return 1 / ratio, f"size: scaled by {1 / ratio:.4g} to the mean of {category.name}"
    ratio *= scale
    hint = "" if 0.4 < ratio < 2.5 else "; are its lengths meters? (--scale)"
    return scale, f"size: {ratio:.2f} times the mean of {category.name}{hint}"


def _order(canonical: MeshObject, axis: int) -> list[int]:
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


def _opening_signs(
    model: UrdfModel, canonical: MeshObject, opening: np.ndarray, tree: PartTree
) -> np.ndarray:
    """[J] -1 for joints whose positive sense goes against the direction that opens, else 1."""
    lengths = np.linalg.norm(opening, axis=-1)
    along = (canonical.axis * opening).sum(-1) / np.maximum(lengths, 1e-12)
    for part, cosine in zip(tree.joints, along, strict=True):
        if abs(cosine) < 0.5:
            raise CaperError(
                f"{model.path}: the axis of {part.joint.name} lies across the one it should have; "
                "give --up and --front, and look at the check picture"
            )
    return np.sign(along)


def _joint_maps(
    model: UrdfModel,
    category: Category,
    tree: PartTree,
    canonical: MeshObject,
    signs: np.ndarray,
    scale: float,
    rest: np.ndarray,
) -> tuple[JointMap, ...]:
    """The map of every joint, with the range of states to draw from."""
    maps = []
    for row, (part, wanted) in enumerate(zip(tree.joints, category.joints, strict=True)):
        factor = float(signs[row]) * (scale if wanted.type == "prismatic" else 1.0)
        low, high = canonical.limits[row]
        maps.append(
            JointMap(
                file_joint=part.joint.name,
                type=wanted.type,
                factor=factor,
                offset=0.0 - factor * float(rest[row]),
                file_limits=part.joint.limits,
                state_range=_state_range(model, category, row, part.joint.name, low, high),
            )
        )
    return tuple(maps)


def _state_range(
    model: UrdfModel, category: Category, row: int, name: str, low: float, high: float
) -> tuple[float, float]:
    """States to draw from: revolute ones within the category's too, slides to 90 % of their way."""
    wanted = category.joints[row]
    if wanted.type == "prismatic":
        if not np.isfinite(high - low):
            raise CaperError(f"{model.path}: {name} slides without limits; add a <limit>")
        travel = 1.0 if low < 0 < high else _TRAVEL
        return float(low * travel), float(high * travel)
    start, end = max(low, wanted.limits[0]), min(high, wanted.limits[1])
    if end - start < 1e-3:
        has, wants = np.degrees([low, high]), np.degrees(wanted.limits)
        raise CaperError(
            f"{model.path}: {name} turns from {has[0]:.0f} to {has[1]:.0f} deg from the rest "
            f"pose, {category.name} from {wants[0]:.0f} to {wants[1]:.0f}: wrong rest pose or "
            "sense; give --rest, --up or --front"
        )
    return float(start), float(end)


def _part_notes(model: UrdfModel, tree: PartTree, category: Category) -> list[str]:
    labels = {name: f" ({label})" for name, label in model.labels.items()}
    notes = [
        f"{part}: {', '.join(name + labels.get(name, '') for name in links)}"
        for part, links in zip(category.parts, tree.links, strict=True)
    ]
    return notes + list(tree.notes)


def _joint_note(joint: JointMap) -> str:
    factor, unit = (180 / np.pi, "deg") if joint.type == "revolute" else (1.0, "m")
    low, high = np.array(joint.state_range) * factor
    clipped = ", fewer than the file allows" if joint.report()["clipped"] else ""
    return (
        f"{joint.file_joint}: rest at {joint.value(0.0) * factor:.4g} {unit} of the file, states "
        f"{low:.4g} to {high:.4g} {unit}{clipped}; state = {joint.factor:.6g} * value "
        f"{joint.offset * factor:+.6g} {unit}"
    )
