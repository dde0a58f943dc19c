"""A root in the layout of CAPTRA's SAPIEN data; SciPy does what the reader must undo."""

from __future__ import annotations

import pickle
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from _helpers.roots import CAMERA, LAPTOP, OBJECTS, Thing, matrices, motions, posed, render, text
from caper_jax.articulation.pose import ArticulatedPose


@dataclass(frozen=True)
class Stored:
    """How a CAPTRA object is stored: link numbers, axes and states at which it was modeled.

    Attributes:
      links: part k is link ``links[k]``.
      quarters: turns about y of the files' axes against ours.
      states: [J] our states at the file's zero.
      senses: [J] +1 or -1, the file's sense of every joint against ours.
      limits: [J, 2] in the file's states.
      root: the part that hangs on the base, 1 only for objects of two parts.
    """

    links: tuple[int, ...]
    quarters: int
    states: tuple[float, ...]
    senses: tuple[int, ...]
    limits: tuple[tuple[float, float], ...]
    root: int = 0


STORED = {
    "laptop": Stored((0, 1), 1, (np.radians(20),), (-1,), ((-1.0, np.radians(110)),)),
    "drawer": Stored((3, 2, 0, 1), 3, (0.0,) * 3, (1, -1, 1), ((0, 0.5), (-0.5, 0), (0, 0.5))),
    "eyeglasses": Stored((2, 1, 0), 2, (0.0, 0.0), (1, -1), ((0, 1.5), (-1.5, 0))),
}
FOLDERS = {"laptop": "laptop", "drawer": "drawers", "eyeglasses": "glasses"}
VISUAL_TURN = Rotation.from_euler("xyz", [0.3, -0.2, 0.5])  # meshes against their links
NEAR, FAR = 0.1, 50.0


def captra(folder: Path, shown: Thing = LAPTOP) -> Path:
    """One object in one track of three frames under render/ and render_seq/."""
    for instance, place in zip(OBJECTS, ("render", "render_seq"), strict=True):
        write_object(folder, shown, instance)
        for number in (9, 10, 11):
            pose = posed(shown, 20 * instance + number)
            write_frame(folder, shown, f"{place}/{{}}/{instance}/0", number, pose)
    return folder


def link_frames(shown: Thing) -> np.ndarray:
    """[K, 4, 4] rest-canonical frame -> the link's frame, part by part."""
    stored = STORED[shown.category]
    links = []
    for k, motion in enumerate(motions(shown, stored.states)):
        own = np.eye(4)
        own[:3, :3] = VISUAL_TURN.as_matrix()
        own[:3, 3] = -own[:3, :3] @ link_origin(shown, k)
        # The meshes share one frame at the file's zero.
        links.append(own @ mesh_place(shown) @ motion)
    return np.stack(links)


def mesh_place(shown: Thing) -> np.ndarray:
    """[4, 4] canonical frame -> the frame that all meshes share."""
    place = np.eye(4)
    turn = Rotation.from_euler("y", 90 * STORED[shown.category].quarters, True)
    place[:3, :3], place[:3, 3] = turn.as_matrix(), (0.02, -0.05, 0.03)
    return place


def link_origin(shown: Thing, part: int) -> np.ndarray:
    """Where a link's frame stands in the frame of the meshes: on the joint, if it has one."""
    root = part == STORED[shown.category].root
    point = np.array([0.1, 0.2, 0.3]) if root else shown.pivot[max(part - 1, 0)]
    place = mesh_place(shown)
    return place[:3, :3] @ point + place[:3, 3]


def write_obj(path: Path, points: np.ndarray) -> None:
    """A box of corners [8, 3]; faces in the ways that OBJ files write them."""
    faces = "1 2 4 3", "5 7 8 6", "1 5 6 2", "3 4 8 7", "1/1/1 3/2/1 7//1 5", "-7 -5 -1 -3"
    lines = [f"v {text(p)}" for p in points] + ["vn 0 0 1", "usemtl m"]
    path.write_text("\n".join([*lines, *(f"f {face}" for face in faces), ""]))


def write_object(folder: Path, shown: Thing, instance: int) -> None:
    stored = STORED[shown.category]
    home = folder / "urdf" / FOLDERS[shown.category] / str(instance)
    (home / "textured_objs").mkdir(parents=True)
    at_zero = motions(shown, stored.states)
    lines = ['<robot name="r"><link name="base"/>']
    for k, link in enumerate(stored.links):
        corners = np.array(np.meshgrid(*[(-0.5, 0.5)] * 3, indexing="ij")).reshape(3, -1).T
        points = shown.center[k] + corners * shown.size[k]
        mesh = mesh_place(shown) @ at_zero[k]
        points = points @ mesh[:3, :3].T + mesh[:3, 3]
        write_obj(home / f"textured_objs/part-{link}.obj", points)
        xyz = text(-VISUAL_TURN.apply(link_origin(shown, k)))
        rpy = text(VISUAL_TURN.as_euler("xyz"))
        lines.append(
            f'<link name="link_{link}"><visual name="v"><origin xyz="{xyz}" rpy="{rpy}"/><geometry>'
            f'<mesh filename="textured_objs/part-{link}.obj"/></geometry></visual></link>'
        )
    root = stored.links[stored.root]
    lines.append(
        '<joint name="joint_r" type="fixed"><origin rpy="1.5707963267948966 0 -1.5707963267948966"'
        f'/><parent link="base"/><child link="link_{root}"/></joint>'
    )
    # The links' frames at the file's zero, where all are parallel.
    frames = at_zero @ np.linalg.inv(link_frames(shown))
    for j, kind in enumerate(shown.kinds):
        child = 0 if stored.root == 1 else j + 1
        offset = np.linalg.inv(frames[stored.root]) @ frames[child]
        axis = stored.senses[j] * frames[child][:3, :3].T @ shown.axis[j]
        low, high = stored.limits[j]
        lines.append(
            f'<joint name="joint_{j}" type="{kind}"><origin xyz="{text(offset[:3, 3])}"/>'
            f'<axis xyz="{text(2 * axis)}"/><parent link="link_{root}"/>'
            f'<child link="link_{stored.links[child]}"/><limit lower="{low}" upper="{high}"/>'
            "</joint>"
        )
    (home / "mobility.urdf").write_text("".join([*lines, "</robot>"]))


def write_frame(folder: Path, shown: Thing, place: str, number: int, pose: ArticulatedPose) -> None:
    track = folder / place.format(FOLDERS[shown.category])
    (track / "cloud").mkdir(parents=True, exist_ok=True)
    (track / "gt").mkdir(exist_ok=True)
    image, links = render(pose), STORED[shown.category].links
    with np.errstate(divide="ignore"):
        buffer = FAR * (1 - NEAR / image.depth) / (FAR - NEAR)
    seg = np.full(image.parts.shape, len(links))  # the ground
    for part, link in enumerate(links):
        seg[image.parts == part] = link
    content = {
        "camera_matrix": CAMERA,
        "depth": np.where(image.parts >= 0, buffer, 1.0).astype(np.float32),
        "seg": seg.astype(np.uint8),
        "near": NEAR,
        "far": FAR,
    }
    np.savez_compressed(track / f"cloud/{number}.npz", all_dict=content)

    # The camera, at some place in the world, looks along x with y to the left and z up.
    camera = np.eye(4)
    camera[:3, :3] = Rotation.from_euler("zyx", [0.4, 0.6, -0.1]).as_matrix()
    camera[:3, 3] = (0.5, -1.0, 2.0)
    looking = np.eye(4)
    looking[:3, :3] = Rotation.from_euler("xyz", [-90, 0, -90], True).as_matrix()
    poses = camera @ looking @ matrices(pose) @ np.linalg.inv(link_frames(shown))
    truth = {
        "camera_pose": position_and_quaternion(camera),
        "link_pose": {
            link: position_and_quaternion(p) for link, p in zip(links, poses, strict=True)
        },
    }
    (track / f"gt/{number}.pkl").write_bytes(pickle.dumps(truth))


def position_and_quaternion(pose: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return pose[:3, 3], Rotation.from_matrix(pose[:3, :3]).as_quat()[[3, 0, 1, 2]]
