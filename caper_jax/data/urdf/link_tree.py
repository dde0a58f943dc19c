"""The links of a URDF as a tree: what hangs below what, and how large it is."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from caper_jax.data.urdf.load import UrdfJoint, UrdfModel


class LinkTree:
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
