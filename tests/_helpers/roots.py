"""Small roots in every layout, of objects made of boxes: known poses, exact depth and labels.

NumPy casts the rays and SciPy does the kinematics and the changes of frames.
"""

from __future__ import annotations

import json
import pickle
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image as Picture
from scipy.spatial.transform import Rotation

from caper_jax import categories
from caper_jax.articulation.category import ObjectModel
from caper_jax.articulation.pose import ArticulatedPose
from caper_jax.data import hdf5
from caper_jax.geometry import solids
from caper_jax.synthetic.artimage_writer import LayoutWriter
from caper_jax.synthetic.images import Image

SIZE = (96, 72)  # width, height
CAMERA = np.array([[120.0, 0.0, 47.0], [0.0, 118.0, 36.0], [0.0, 0.0, 1.0]])
OBJECTS = (101, 102)


@dataclass(frozen=True)
class Thing:
    """An object at rest in our canonical frame, meters: boxes and joints on the root."""

    category: str
    center: np.ndarray
    size: np.ndarray
    axis: np.ndarray
    pivot: np.ndarray

    @property
    def kinds(self) -> tuple[str, ...]:
        return categories.get(self.category).joint_types

    def scaled(self, factor: float) -> Thing:
        lengths = {key: factor * getattr(self, key) for key in ("center", "size", "pivot")}
        return replace(self, **lengths)


def thing(category: str, boxes: Any, axis: Any, pivot: Any) -> Thing:
    """With the origin at the middle of the whole box."""
    center, size = np.array(boxes, float).swapaxes(0, 1)
    origin = ((center - size / 2).min(0) + (center + size / 2).max(0)) / 2
    return Thing(category, center - origin, size, np.array(axis, float), np.array(pivot) - origin)


BOX = thing(
    "box",
    [((0, 0, 0), (0.2, 0.06, 0.12)), ((0, 0.035, 0), (0.2, 0.01, 0.12))],
    [(-1, 0, 0)],
    [(0, 0.03, -0.06)],
)
LAPTOP = thing(
    "laptop",
    [((0, 0, 0), (1.2, 0.06, 0.8)), ((0, 0.44, -0.42), (1.2, 0.8, 0.04))],
    [(-1, 0, 0)],
    [(0, 0.03, -0.4)],
)
DRAWER = thing(
    "drawer",
    [((0, 0, 0), (1.0, 1.3, 0.8))] + [((0, y, 0.03), (0.9, 0.3, 0.8)) for y in (-0.4, 0.0, 0.4)],
    [(0, 0, 1)] * 3,
    [(0, y, 0.4) for y in (-0.4, 0.0, 0.4)],
)
EYEGLASSES = thing(
    "eyeglasses",
    [((0, 0, 0), (1.4, 0.4, 0.1))] + [((x, 0, -0.7), (0.05, 0.1, 1.3)) for x in (-0.65, 0.65)],
    [(0, -1, 0), (0, 1, 0)],
    [(x, 0, -0.05) for x in (-0.65, 0.65)],
)


def joint_motion(thing: Thing, joint: int, state: float) -> np.ndarray:
    """[4, 4] of one part against the root."""
    motion = np.eye(4)
    if thing.kinds[joint] == "prismatic":
        motion[:3, 3] = state * thing.axis[joint]
    else:
        turn = Rotation.from_rotvec(state * thing.axis[joint])
        motion[:3, :3] = turn.as_matrix()
        motion[:3, 3] = thing.pivot[joint] - turn.apply(thing.pivot[joint])
    return motion


def motions(thing: Thing, states: Any) -> np.ndarray:
    """[K, 4, 4] of all parts against the root."""
    return np.stack([np.eye(4), *(joint_motion(thing, j, s) for j, s in enumerate(states))])


def posed(thing: Thing, seed: int, states: Any = None) -> ArticulatedPose:
    """Seen from the front and above, the whole object in the image."""
    rng = np.random.default_rng(seed)
    if states is None:
        reach = [1.0 if kind == "revolute" else 0.4 for kind in thing.kinds]
        states = rng.uniform(0.1, 1.0, len(reach)) * reach
    turn = Rotation.from_euler("XY", [180 + rng.uniform(15, 40), rng.uniform(-40, 40)], True)
    root = np.eye(4)
    root[:3, :3] = turn.as_matrix()
    diagonal = np.linalg.norm((np.abs(thing.center) + thing.size / 2).max(0) * 2)
    root[:3, 3] = rng.uniform(-0.1, 0.1, 3) * diagonal + (0, 0, 2.5 * diagonal)
    parts = root @ motions(thing, states)
    return ArticulatedPose(
        rotation=parts[:, :3, :3],
        translation=parts[:, :3, 3],
        size=thing.size,
        box_center=thing.center,
        joint_axis=thing.axis,
        joint_pivot=thing.pivot,
        joint_state=np.array(states, float),
    )


def matrices(pose: ArticulatedPose) -> np.ndarray:
    """[K, 4, 4] of the parts, rest-canonical frame -> camera."""
    parts = np.tile(np.eye(4), (len(pose.size), 1, 1))
    parts[:, :3, :3], parts[:, :3, 3] = pose.rotation, pose.translation
    return parts


def render(pose: ArticulatedPose) -> Image:
    """Depth and parts of boxes by casting a ray per pixel."""
    width, height = SIZE
    v, u = np.mgrid[:height, :width]
    rays = np.stack([u, v, np.ones_like(u)], -1) @ np.linalg.inv(CAMERA).T
    depth, parts = np.full((height, width), np.inf), np.full((height, width), -1, np.int32)
    for k, (size, center) in enumerate(zip(pose.size, pose.box_center, strict=True)):
        origin = -pose.rotation[k].T @ pose.translation[k] - center
        with np.errstate(divide="ignore"):
            inverse = 1 / (rays @ pose.rotation[k])
        sides = np.stack([(s * size / 2 - origin) * inverse for s in (-1, 1)])
        enter, leave = sides.min(0).max(-1), sides.max(0).min(-1)
        nearer = (enter <= leave) & (enter > 0) & (enter < depth)
        depth[nearer], parts[nearer] = enter[nearer], k
    return Image(np.where(parts >= 0, depth, 0).astype(np.float32), parts, CAMERA, pose)


def write_json(path: Path, content: Any) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(content))


def write_depth(path: Path, depth: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    Picture.fromarray(np.round(depth * 1000).astype(np.uint16)).save(path)


def write_camera(path: Path) -> None:
    camera = {"width": SIZE[0], "height": SIZE[1], "intrinsic_matrix": CAMERA.T.ravel().tolist()}
    write_json(path, camera)


def artimage(folder: Path, shown: Thing = LAPTOP, splits: Any = ("train", "test")) -> Path:
    """Three frames per split, of one object each."""
    for urdf_id, split in zip(OBJECTS, splits, strict=False):
        writer = layout_writer(folder, shown, split, urdf_id)
        for seed in range(3):
            writer.add_frame(urdf_id, render(posed(shown, urdf_id + 10 * seed)))
        writer.close()
    return folder


def pm_videos(folder: Path, shown: Thing = LAPTOP) -> Path:
    """Two videos of three frames, for training and test."""
    for urdf_id, split in zip(OBJECTS, ("train", "test"), strict=True):
        writer = layout_writer(folder, shown, split, urdf_id)
        images = [render(posed(shown, urdf_id, [0.1 * i] * len(shown.kinds))) for i in range(3)]
        writer.add_video(urdf_id, images, moving_part=1)
        writer.close()
    return folder


def layout_writer(folder: Path, shown: Thing, split: str, urdf_id: int) -> LayoutWriter:
    model = ObjectModel(
        parts=[[solids.box(c, s / 2)] for c, s in zip(shown.center, shown.size, strict=True)],
        axis=shown.axis,
        pivot=shown.pivot,
        limits=np.tile([-1.0, 1.5], (len(shown.kinds), 1)),
    )
    writer = LayoutWriter(folder, categories.get(shown.category), split, CAMERA, SIZE)
    writer.add_object(urdf_id, model)
    return writer


# ReArtMix: boxes are stored flat open, z up, at a scale of their own.
REART_AXES = np.eye(3)[[1, 2, 0]]  # the files' frame -> ours
REART_SCALE = 0.9


def reart_meta(urdf_id: int) -> dict[str, Any]:
    """Entry of a box in urdf_metas.json."""
    stored = BOX.scaled(1 / REART_SCALE)
    corners = []
    for motion, center, size in zip(
        motions(stored, [np.pi]), stored.center, stored.size, strict=True
    ):
        ends = np.array([center - size / 2, center + size / 2])
        corners.append(np.sort(ends @ motion[:3, :3].T + motion[:3, 3], axis=0) @ REART_AXES)
    whole = np.array([np.min(corners, axis=(0, 1)), np.max(corners, axis=(0, 1))])
    return {
        "id": urdf_id,
        "category_name": "box",
        "corner_pts": np.array([whole, *corners])[:, :, None].tolist(),
        "joint_types": ["revolute"],
        "joint_parents": [1],
        "joint_children": [2],
        "joint_xyz": [(stored.pivot[0] @ REART_AXES)[[2, 0, 1]].tolist()],
        "joint_rpy": [(-stored.axis[0] @ REART_AXES)[[2, 0, 1]].tolist()],
    }


def reart_instance(number: int, urdf_id: int, image: Image) -> dict[str, Any]:
    stored = BOX.scaled(1 / REART_SCALE)
    links = []
    for k, (pose, motion) in enumerate(
        zip(matrices(image.pose), motions(stored, [np.pi]), strict=True)
    ):
        axes, scale = np.eye(4), np.diag([*[REART_SCALE] * 3, 1.0])
        axes[:3, :3] = REART_AXES
        matrix = pose @ scale @ np.linalg.inv(motion) @ axes
        links.append(
            {
                "link_category_id": k + 1,
                "transformation": matrix.tolist(),
                "segmentation": polygons(image.parts == k),
            }
        )
    return {"id": number, "category_id": 1, "urdf_id": urdf_id, "links": links}


def polygons(mask: np.ndarray) -> list[list[int]]:
    """A polygon per run of pixels in a row."""
    runs = []
    for row, line in enumerate(mask):
        steps = np.diff(np.concatenate([[0], line.astype(int), [0]]))
        for start, end in zip(np.flatnonzero(steps == 1), np.flatnonzero(steps == -1), strict=True):
            runs.append([int(start), row, int(end) - 1, row, int(end) - 1, row])
    return runs


def reart_annotation(image: Image, instances: list[dict[str, Any]], depth: str) -> dict[str, Any]:
    return {
        "color_path": depth.replace("png", "jpg"),
        "depth_path": depth,
        "width": SIZE[0],
        "height": SIZE[1],
        "instances": instances,
    }


def reartmix(folder: Path) -> Path:
    """Three images of one box each."""
    write_camera(folder / "camera_intrinsic.json")
    write_json(folder / "urdf_metas.json", {"urdf_metas": [reart_meta(i) for i in OBJECTS]})
    names = []
    for seed in range(3):
        name, urdf_id = f"scene1/{seed:06d}", OBJECTS[seed % 2]
        image = render(posed(BOX, seed))
        write_depth(folder / f"depth/{name}.png", image.depth)
        instances = [reart_instance(0, urdf_id, image)]
        annotation = reart_annotation(image, instances, f"{name}.png")
        write_json(folder / f"annotations/{name}.json", annotation)
        names.append(f"{name}_0\n")
    (folder / "train.txt").write_text("".join(names))
    return folder


def reart_videos(folder: Path) -> Path:
    """A video of three frames."""
    data = folder / "Data"
    write_camera(data / "camera_intrinsic.json")
    for seed in range(3):
        image = render(posed(BOX, 7, [0.3 * seed]))
        write_depth(data / f"depth/box/00000/{seed:06d}.png", image.depth)
        instances = [reart_instance(0, 5, image)]
        annotation = reart_annotation(image, instances, f"box/00000/{seed:06d}.png")
        write_json(data / f"new_anno_test/box/00000/{seed:06d}.json", annotation)
    flags = data / "new_anno_test/flag/box"
    flags.mkdir(parents=True)
    (flags / "train.txt").write_text("000000.json\n000001.json\n000002.json\n")
    meta, home = reart_meta(5), folder / "URDF/box/5"
    home.mkdir(parents=True)
    clouds = [np.array(corners) for corners in np.reshape(meta["corner_pts"], (-1, 2, 3))]
    (home / "model_pts.pkl").write_bytes(pickle.dumps(clouds))
    xyz, axis = (text(meta[key][0]) for key in ("joint_xyz", "joint_rpy"))
    (home / "mobility_for_unity_align.urdf").write_text(
        f'<robot><joint name="base_link_link1_joint" type="revolute"><origin xyz="{xyz}"/>'
        f'<axis xyz="{axis}"/><parent link="base_link"/><child link="link1"/></joint></robot>'
    )
    return folder


def text(vector: Any) -> str:
    return " ".join(f"{value:.15g}" for value in vector)


def caper(path: Path, shown: Thing = BOX, **changes: Any) -> Path:
    """Three frames in the project's own format."""
    images = [render(posed(shown, seed)) for seed in range(3)]
    points, labels = [], []
    for image in images:
        rows, columns = np.nonzero(image.parts >= 0)
        picked = np.linspace(0, len(rows) - 1, 256).astype(int)
        rows, columns = rows[picked], columns[picked]
        rays = np.stack([columns, rows, np.ones_like(rows)], -1) @ np.linalg.inv(CAMERA).T
        points.append(rays * image.depth[rows, columns, None])
        labels.append(image.parts[rows, columns])
    fields = vars(images[0].pose)
    arguments = {
        "category": categories.get(shown.category),
        "split": "test",
        "points": np.stack(points),
        "labels": np.stack(labels),
        "pose": ArticulatedPose(
            **{key: np.stack([getattr(image.pose, key) for image in images]) for key in fields}
        ),
        "visible": np.stack([np.bincount(row, minlength=len(shown.size)) for row in labels]),
        "instance": np.array([1, 2, 1]),
    }
    hdf5.write(path, **(arguments | changes))
    return path
