"""Which links of a URDF make which part of a category.

A category wants K parts on K - 1 joints, a star (every part on the root) or a chain. A URDF has as
many links and joints as its author liked: fixed ones, frames without geometry, buttons, wheels,
fingers. Joints that are not wanted are locked and their links merged; what cannot be decided is
an error that names the candidates, to be settled by naming the parts' links.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from caper_jax.articulation.category import Category
from caper_jax.data.urdf.load import UrdfModel
from caper_jax.data.urdf.xml import UrdfJoint
from caper_jax.errors import CaperError, unknown_name

# A piece below this share of the smallest wanted part (diagonals) is a button, a key or a wheel.
_MINOR = 0.5


@dataclass(frozen=True)
class PartJoint:
    """A joint that stays movable.

    Attributes:
      joint: as in the file.
      parent: index of the part it hangs on; joint j carries part j + 1.
      reversed: the file's child is our parent, so the axis turns round.
    """

    joint: UrdfJoint
    parent: int
    reversed: bool


@dataclass(frozen=True)
class PartTree:
    """Links per part and the joints between parts.

    Attributes:
      links: K tuples of link names, root first.
      joints: K - 1.
      locked: state of every joint of the file that moves there but not here.
      notes: which joints were locked, a line each.
    """

    links: tuple[tuple[str, ...], ...]
    joints: tuple[PartJoint, ...]
    locked: dict[str, float]
    notes: tuple[str, ...]

    def exchanged(self) -> PartTree:
        """Two parts, the other one the root."""
        joints = tuple(replace(joint, reversed=not joint.reversed) for joint in self.joints)
        return replace(self, links=self.links[::-1], joints=joints)


def map_parts(
    model: UrdfModel,
    category: Category,
    chosen: Sequence[str] | None = None,
    rest: Mapping[str, float] | None = None,
) -> PartTree:
    """Maps a URDF's links onto a category's parts.

    Args:
      model: the file.
      category: what it shows.
      chosen: K names of links, one of each part in the category's order, or None to find them.
      rest: states at which joints that get locked are held; 0, or the limit nearest to it, else.

    Raises:
      CaperError: too few or too many joints of the right type, or a tree of another form; the
        message lists what there is.
    """
    tree = _LinkTree(model, rest or {})
    if chosen is not None:
        root, joints = _chosen_joints(tree, category, chosen)
    elif category.parents == tuple(range(category.num_joints)) and category.num_joints > 1:
        root, joints = model.root, _chain_joints(tree, category)
    elif set(category.parents) == {0}:
        root, joints = _star_joints(tree, category)
    else:
        raise CaperError(
            f"{model.path}: the parts of {category.name} make neither a star nor a chain; name "
            f"one link of each with --parts ({', '.join(category.parts)})"
        )
    return _cut(tree, category, root, joints)


class _LinkTree:
    """The file's links and movable joints, with the size of what each joint carries."""

    def __init__(self, model: UrdfModel, rest: Mapping[str, float]) -> None:
        self.model = model
        self.movable = {j.name: j for j in model.joints if j.moves}
        self.by_child = {joint.child: joint for joint in model.joints}
        self.children: dict[str, list[UrdfJoint]] = {}
        for joint in model.joints:
            self.children.setdefault(joint.parent, []).append(joint)
        self.hold = {
            name: float(rest.get(name, np.clip(0.0, *joint.limits)))
            for name, joint in self.movable.items()
        }
        poses = model.link_poses(self.hold)
        self.boxes = {
            name: mesh.moved(poses[name]).bounds()
            for name, mesh in model.links.items()
            if mesh is not None
        }
        self.size = {
            name: self.diagonal(self.below(joint.child)) for name, joint in self.movable.items()
        }

    def below(self, link: str, stop: frozenset[str] = frozenset()) -> list[str]:
        """A link and all links under it, not past the joints named in ``stop``."""
        found = [link]
        for name in found:
            found += [j.child for j in self.children.get(name, ()) if j.name not in stop]
        return found

    def diagonal(self, links: Sequence[str]) -> float:
        """Of the box around links at state 0, meters; 0 without geometry."""
        boxes = [self.boxes[name] for name in links if name in self.boxes]
        if not boxes:
            return 0.0
        return float(np.linalg.norm(np.max(boxes, 0)[1] - np.min(boxes, 0)[0]))

    def rigid(self, link: str) -> list[str]:
        """The links fixed to one from above, seen downwards."""
        return self.below(link, frozenset(self.movable))

    def above(self, link: str) -> list[UrdfJoint]:
        """Movable joints from a link up to the root, nearest first."""
        found = []
        while link in self.by_child:
            joint = self.by_child[link]
            if joint.name in self.movable:
                found.append(joint)
            link = joint.parent
        return found

    def describe(self, joints: Sequence[UrdfJoint]) -> str:
        if not joints:
            return "none"
        shown = [f"{j.name} ({j.kind}, carries {j.child}{self.label(j.child)})" for j in joints]
        rest = len(shown) - 8
        return ", ".join(shown[:8]) + (f" and {rest} more" if rest > 0 else "")

    def label(self, link: str) -> str:
        return f" = {self.model.labels[link]}" if link in self.model.labels else ""


def _star_joints(tree: _LinkTree, category: Category) -> tuple[str, list[UrdfJoint]]:
    """The root's link and one joint per further part, none of them below another."""
    model, wanted = tree.model, list(category.joint_types)
    root = model.root
    candidates = [j for j in tree.movable.values() if tree.size[j.name] > 0]
    candidates = _without_empty_links(tree, candidates, wanted)
    fitting = [j for j in candidates if j.kind in wanted]
    chosen: list[UrdfJoint] = []
    for kind in dict.fromkeys(wanted):
        ranked = sorted(
            (j for j in fitting if j.kind == kind), key=lambda j: tree.size[j.name], reverse=True
        )
        first: list[UrdfJoint] = []
        for joint in ranked:
            if not any(_nested(tree, joint, other) for other in first):
                first.append(joint)
        count = wanted.count(kind)
        hung, apart = _seat_of_root(tree, first, count)
        root = hung or root
        if len(apart) < count:
            raise _misfit(tree, category, f"it has {len(apart)} {kind} joint(s) that fit", fitting)
        least = _MINOR * tree.size[apart[count - 1].name]
        if len(apart) > count and tree.size[apart[count].name] > least:
            raise _misfit(tree, category, f"{len(apart)} {kind} joints fit alike", apart)
        upon = [j for j in ranked if j not in first and tree.size[j.name] > least]
        if upon:
            raise _misfit(tree, category, f"{kind} joints follow one another", [*apart, *upon])
        chosen += apart[:count]
    return _root_by_name(tree, category, root, chosen), chosen


def _nested(tree: _LinkTree, one: UrdfJoint, other: UrdfJoint) -> bool:
    return one in tree.above(other.child) or other in tree.above(one.child)


def _without_empty_links(
    tree: _LinkTree, joints: list[UrdfJoint], wanted: Sequence[str]
) -> list[UrdfJoint]:
    """Of two joints with nothing but frames between them, keeps the one of a wanted type."""
    dropped: set[str] = set()
    for joint in joints:
        if tree.diagonal(tree.rigid(joint.child)) > 0:
            continue
        onwards = [j for j in joints if joint in tree.above(j.child)[1:2]]
        if joint.kind in wanted and not any(j.kind in wanted for j in onwards):
            dropped.update(j.name for j in onwards)
        else:
            dropped.add(joint.name)
    return [joint for joint in joints if joint.name not in dropped]


def _seat_of_root(
    tree: _LinkTree, joints: list[UrdfJoint], count: int
) -> tuple[str | None, list[UrdfJoint]]:
    """Where the root of the file is empty or a mere screw, the largest part on it is our root."""
    own = tree.diagonal(tree.below(tree.model.root, frozenset(j.name for j in joints)))
    if len(joints) != count + 1 or own > _MINOR * min(tree.size[j.name] for j in joints):
        return None, joints
    return joints[0].child, joints[1:]


def _root_by_name(
    tree: _LinkTree, category: Category, root: str, joints: Sequence[UrdfJoint]
) -> str:
    """The child's link as the root where only the root bears a name that a child should have."""
    words = category.urdf_rule.child_words
    if len(joints) != 1 or not words:
        return root
    child = tree.below(joints[0].child)
    rest = [name for name in tree.model.links if name not in child]

    def named(links: Sequence[str]) -> bool:
        texts = [f"{name} {tree.model.labels.get(name, '')}".lower() for name in links]
        return any(word in text for word in words for text in texts)

    return joints[0].child if named(rest) and not named(child) else root


def _chain_joints(tree: _LinkTree, category: Category) -> list[UrdfJoint]:
    """The first joints, of the wanted types in order, on the way from the root to a tip."""
    wanted = category.joint_types
    found: dict[tuple[str, ...], list[UrdfJoint]] = {}
    longest: list[UrdfJoint] = []
    for link in tree.model.links:
        taken: list[UrdfJoint] = []
        for joint in reversed(tree.above(link)):
            if len(taken) < len(wanted) and joint.kind == wanted[len(taken)]:
                taken.append(joint)
        longest = max(longest, taken, key=len)
        if len(taken) == len(wanted) and tree.size[taken[-1].name] > 0:
            found[tuple(joint.name for joint in taken)] = taken
    if not found:
        has = f"its longest chain has {len(longest)} of them"
        raise _misfit(tree, category, has, longest)
    if len(found) > 1:
        tips = [joints[-1] for joints in found.values()]
        raise _misfit(tree, category, f"{len(found)} chains fit, to these joints", tips)
    return next(iter(found.values()))


def _misfit(
    tree: _LinkTree, category: Category, has: str, joints: Sequence[UrdfJoint]
) -> CaperError:
    kinds = category.joint_types
    needs = " and ".join(f"{kinds.count(kind)} {kind}" for kind in dict.fromkeys(kinds))
    form = "on the root" if set(category.parents) == {0} else "in a chain"
    return CaperError(
        f"{tree.model.path}: {category.name} needs {needs} joint(s) {form}, but {has}: "
        f"{tree.describe(joints)}. Name one link of each part with --parts "
        f"({', '.join(category.parts)})"
    )


def _chosen_joints(
    tree: _LinkTree, category: Category, chosen: Sequence[str]
) -> tuple[str, list[UrdfJoint]]:
    """The joints between links that were named, each part's on the way to its parent."""
    path = tree.model.path
    for name in chosen:
        if name not in tree.model.links:
            raise CaperError(f"{path}: --parts: {unknown_name('link', name, tree.model.links)}")
    if len(chosen) != category.num_parts:
        raise CaperError(
            f"{path}: --parts names {len(chosen)} links, {category.name} has "
            f"{category.num_parts} parts ({', '.join(category.parts)})"
        )
    joints: list[UrdfJoint] = []
    for child, wanted in enumerate(category.joints, start=1):
        up, down = tree.above(chosen[child]), tree.above(chosen[wanted.parent])
        # Nearest to the child first: its own way up, then the other way down to the parent.
        between = [j for j in up if j not in down] + [j for j in reversed(down) if j not in up]
        fitting = [j for j in between if j.kind == wanted.type and j not in joints]
        if not fitting:
            raise CaperError(
                f"{path}: --parts: no {wanted.type} joint lies between {chosen[wanted.parent]!r} "
                f"and {chosen[child]!r}; between them: {tree.describe(between)}"
            )
        joints.append(fitting[0])
    return chosen[0], joints


def _cut(tree: _LinkTree, category: Category, root: str, kept: Sequence[UrdfJoint]) -> PartTree:
    """The parts that are left when the kept joints are the only ones that move."""
    model, names = tree.model, frozenset(joint.name for joint in kept)
    heads = [model.root, *(joint.child for joint in kept)]
    pieces = [tree.below(head, names) for head in heads]
    piece_of = {link: index for index, piece in enumerate(pieces) for link in piece}
    # From our root outwards, for it need not be the file's.
    order, joints = [piece_of[root]], dict[int, tuple[UrdfJoint, int, bool]]()
    for piece in order:
        for joint in kept:
            ends = piece_of[joint.parent], piece_of[joint.child]
            for here, there, reversed_ in ((*ends, False), (*ends[::-1], True)):
                if here == piece and there not in order:
                    order.append(there)
                    joints[there] = (joint, here, reversed_)
    # Parts in the order of the joints that are kept; the tree must be the category's.
    children = sorted(joints, key=lambda piece: kept.index(joints[piece][0]))
    parts = [piece_of[root], *children]
    part_joints = tuple(
        PartJoint(joints[piece][0], parts.index(joints[piece][1]), joints[piece][2])
        for piece in children
    )
    if tuple(joint.parent for joint in part_joints) != category.parents:
        form = ", ".join(f"{j.joint.child} on part {j.parent}" for j in part_joints)
        raise CaperError(
            f"{model.path}: the parts hang together otherwise than those of {category.name} "
            f"({form}); name one link of each with --parts ({', '.join(category.parts)})"
        )
    for part, piece in zip(category.parts, parts, strict=True):
        if not any(model.links[name] for name in pieces[piece]):
            raise CaperError(f"{model.path}: part {part!r} ({pieces[piece]}) has no geometry")
    locked = {name: state for name, state in tree.hold.items() if name not in names}
    notes = []
    for joint in model.joints:
        if joint.name in locked:
            notes.append(f"locked: {joint.name} ({joint.kind}) at {locked[joint.name]:g}")
        elif joint.remark:
            notes.append(f"locked: {joint.name} ({joint.remark})")
    return PartTree(
        tuple(tuple(pieces[piece]) for piece in parts), part_joints, locked, tuple(notes)
    )
