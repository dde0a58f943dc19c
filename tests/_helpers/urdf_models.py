"""Writes small URDF models of boxes, as people and PartNet-Mobility lay them out."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import trimesh

# PartNet-Mobility models have y up and z to the front; this joint stands them on z, front to -x.
PARTNET_BASE = "1.5707963267948966 0 -1.5707963267948966"


class Robot:
    """Collects links and joints, then writes the file and its meshes."""

    def __init__(self, folder: Path, name: str = "thing") -> None:
        self.folder, self.name = folder, name
        self._body: list[str] = []
        (folder / "meshes").mkdir(parents=True, exist_ok=True)

    def link(self, name: str, *boxes, origin="0 0 0", prefix="", suffix=".obj") -> Robot:
        """A link with one mesh per box: (center [3], size [3], optional rotation [3, 3])."""
        visuals = []
        for index, (center, size, *turn) in enumerate(boxes):
            pose = np.eye(4)
            pose[:3, 3] = center
            pose[:3, :3] = turn[0] if turn else np.eye(3)
            mesh = trimesh.creation.box(extents=size, transform=pose)
            file = f"meshes/{name}_{index}{suffix}"
            mesh.export(self.folder / file)
            visuals.append(
                f'<visual><origin xyz="{origin}"/><geometry>'
                f'<mesh filename="{prefix}{file}"/></geometry></visual>'
            )
        self._body.append(f'<link name="{name}">{"".join(visuals)}</link>')
        return self

    def joint(
        self, name: str, kind: str, parent: str, child: str, *, xyz: Sequence[float] = (0, 0, 0),
        rpy: str = "0 0 0", axis: Sequence[float] = (1, 0, 0), limits=None, extra: str = "",
    ) -> Robot:  # fmt: skip
        limit = (
            f'<limit lower="{float(limits[0])!r}" upper="{float(limits[1])!r}"/>' if limits else ""
        )
        self._body.append(
            f'<joint name="{name}" type="{kind}"><parent link="{parent}"/>'
            f'<child link="{child}"/><origin xyz="{_text(xyz)}" rpy="{rpy}"/>'
            f'<axis xyz="{_text(axis)}"/>{limit}{extra}</joint>'
        )
        return self

    def write(self, file: str = "thing.urdf") -> Path:
        path = self.folder / file
        path.write_text(f'<robot name="{self.name}">{"".join(self._body)}</robot>')
        return path


def _text(numbers: Sequence[float]) -> str:
    return " ".join(repr(float(number)) for number in numbers)


def turn_x(degrees: float) -> np.ndarray:
    cos, sin = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    return np.array([[1, 0, 0], [0, cos, -sin], [0, sin, cos]])


def partnet_files(folder: Path, model_class: str, nodes: Sequence[tuple[str, str, str]]) -> None:
    """mobility_v2.json, meta.json and semantics.txt for links (joint, name) with parents."""
    content = [
        {"id": index, "parent": -1, "joint": joint, "name": name, "parts": [], "jointData": {}}
        for index, (_, joint, name) in enumerate(nodes)
    ]
    (folder / "mobility_v2.json").write_text(json.dumps(content))
    (folder / "meta.json").write_text(json.dumps({"model_cat": model_class}))
    lines = [f"{link} {joint} {name}\n" for link, joint, name in nodes]
    (folder / "semantics.txt").write_text("".join(lines))


LAPTOP_BASE, LAPTOP_LID = (1.3, 0.06, 0.9), (1.3, 0.8, 0.04)


def partnet_laptop(folder: Path) -> Path:
    """Modeled 110 deg open; a positive state closes it, from -40 to 110 deg."""
    # Raw PartNet axes. The hinge runs along x through (0, 0.03, -0.45), the lid's box stands on it
    # in the open position: leaning back by 20 deg.
    hinge = np.array([0.0, 0.03, -0.45])
    lean = turn_x(-20)
    lid = (lean @ [0, 0.4, -0.02], LAPTOP_LID, lean)
    robot = Robot(folder).link("base")
    robot.link("link_1", ((0, 0, 0), LAPTOP_BASE))
    robot.link("link_0", lid)
    robot.joint("joint_1", "fixed", "base", "link_1", rpy=PARTNET_BASE)
    limits = (np.radians(-40), np.radians(110))
    robot.joint("joint_0", "revolute", "link_1", "link_0", xyz=hinge, limits=limits)
    nodes = [("link_0", "hinge", "screen"), ("link_1", "static", "base_body")]
    partnet_files(folder, "Laptop", nodes)
    return robot.write("mobility.urdf")


DRAWER_SIZE, DRAWER_LEVELS = (0.7, 0.22, 0.5), (-0.25, 0.0, 0.25)


def partnet_drawer(folder: Path) -> Path:
    """A cabinet with three drawers (top, bottom and middle in the file), a door and a knob."""
    robot = Robot(folder).link("base")
    walls = [((0, 0, -0.28), (0.8, 0.8, 0.04)), ((0.38, 0, 0), (0.04, 0.8, 0.6))]
    walls += [((-0.38, 0, 0), (0.04, 0.8, 0.6)), ((0, -0.39, 0), (0.8, 0.02, 0.6))]
    robot.link("link_3", *walls)
    for index, level in enumerate((2, 0, 1)):
        robot.link(f"link_{index}", ((0, DRAWER_LEVELS[level], 0.05), DRAWER_SIZE))
    robot.link("link_4", ((0, 0, 0.02), (0.3, 0.1, 0.01)))
    robot.link("link_5", ((0, 0, 0.31), (0.03, 0.03, 0.02)))
    robot.joint("joint_3", "fixed", "base", "link_3", rpy=PARTNET_BASE)
    for index in range(3):
        robot.joint(
            f"joint_{index}", "prismatic", "link_3", f"link_{index}", axis=(0, 0, 1),
            limits=(0.0, 0.4),
        )  # fmt: skip
    robot.joint(
        "joint_4", "revolute", "link_3", "link_4", xyz=(0, 0.4, 0.2), axis=(0, 1, 0),
        limits=(0.0, 1.5),
    )  # fmt: skip
    robot.joint("joint_5", "prismatic", "link_0", "link_5", axis=(0, 0, 1), limits=(0.0, 0.01))
    nodes = [(f"link_{i}", "slider", "drawer") for i in range(3)]
    nodes += [("link_3", "heavy", "cabinet_body"), ("link_4", "hinge", "door")]
    partnet_files(folder, "StorageFurniture", nodes)
    return robot.write("mobility.urdf")


def serial_arm(folder: Path) -> Path:
    """Seven revolute joints at odd angles, an empty flange and two mimicking fingers."""
    rng = np.random.default_rng(3)
    robot = Robot(folder).link("world").link("link0", ((0, 0, 0.05), (0.2, 0.2, 0.1)))
    robot.joint("mount", "fixed", "world", "link0", xyz=(0.1, 0.2, 0))
    for k in range(1, 8):
        robot.link(f"link{k}", ((0.02, 0.01, 0.06), (0.07, 0.08, 0.2)), origin="0.01 0 0.02")
        rpy = "0 0 0" if k == 1 else _text(rng.uniform(-0.3, 0.3, 3))
        robot.joint(
            f"joint{k}", "revolute" if k != 4 else "continuous", f"link{k - 1}", f"link{k}",
            xyz=(0.0, 0.02 * k, 0.12), rpy=rpy, axis=(0, 0, 1) if k % 2 else (0, 1, 0),
            limits=None if k == 4 else (-2.0, 1.5),
        )  # fmt: skip
    robot.link("flange").joint("flange_joint", "fixed", "link7", "flange", xyz=(0, 0, 0.15))
    for side in (1, 2):
        robot.link(f"finger{side}", ((0, 0, 0.03), (0.01, 0.02, 0.06)))
        mimic = '<mimic joint="finger1_joint"/>' if side == 2 else ""
        robot.joint(
            f"finger{side}_joint", "prismatic", "flange", f"finger{side}", axis=(1, 0, 0),
            limits=(0.01, 0.04), extra=mimic,
        )  # fmt: skip
    return robot.write("arm.urdf")
