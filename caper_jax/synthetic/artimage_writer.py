"""Writes generated frames in the layouts of ArtImage and PM-Videos, as artimage.py reads them.

Objects are stored at rest (every rest state is 0) and in our frame, with the files' conventions:
the URDF permutes coordinates, children of revolute joints turn by minus the state about the axis,
states are degrees or meters. Depth is 16-bit millimeters and 0 off the object; masks hold the
part's number, 255 off the object. The color image is a shaded picture of the depth: generated
objects have no colors. Polygons are left empty.
"""

from __future__ import annotations

import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any
from xml.sax.saxutils import quoteattr

import numpy as np
from PIL import Image as Picture

from caper_jax.articulation.category import Category, ObjectModel
from caper_jax.data.images import read_json
from caper_jax.data.readers.artimage_models import ALIGNED, POINT_ORDER, POINTS, RAW, REST_STATES
from caper_jax.errors import CaperError
from caper_jax.geometry.solids import bounds, surface_points
from caper_jax.synthetic.images import Image

_POINTS_PER_PART = 2048
_BACKGROUND = 255
# Our coordinates in the order of the URDF.
_URDF_ORDER = np.argsort(POINT_ORDER)


class LayoutWriter:
    """Adds one category's frames of one split to a root, which then is complete.

    Example:
      writer = LayoutWriter(root, category, "train", intrinsics, (640, 640))
      writer.add_object(900000, model)
      writer.add_frame(900000, image)
      writer.close()
    """

    def __init__(
        self,
        root: str | Path,
        category: Category,
        split: str,
        intrinsics: np.ndarray,
        image_size: tuple[int, int],
    ):
        """Prepares the root; frames of other splits that it holds stay.

        Args:
          root: folder to make, or one that this class made with the same camera.
          category: what all frames show.
          split: its text file will list the frames.
          intrinsics: [3, 3] of the camera of all frames.
          image_size: (width, height) pixels.

        Raises:
          CaperError: the root has another camera or frames of this split already.
        """
        self.category, self.split = category, split
        conversion = category.datasets.get("artimage")
        self._category_id = getattr(conversion, "category_id", 0)
        self.root, self.home = Path(root), Path(root) / category.name
        self._list = self.home / f"{split}.txt"
        if self._list.is_file() and self._list.read_text().strip():
            raise CaperError(f"{self._list}: lists frames already; choose another folder")
        camera = {
            "width": image_size[0],
            "height": image_size[1],
            "intrinsic_matrix": np.asarray(intrinsics, float).T.ravel().tolist(),
        }
        path = self.root / "camera_intrinsic.json"
        if path.is_file() and read_json(path) != camera:
            raise CaperError(f"{path}: another camera; choose another folder")
        self._states: dict[str, Any] = {}
        if (self.home / "urdf" / REST_STATES).is_file():
            self._states = read_json(self.home / "urdf" / REST_STATES)
        (self.home / "train").mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps(camera))
        numbers = [int(p.stem) for p in (self.home / "train").glob("**/annotations/*.json")]
        videos = [int(p.name) for p in (self.home / "train").iterdir() if p.name.isdigit()]
        self._next, self._next_video = max(numbers, default=-1) + 1, max(videos, default=-1) + 1
        self._names: list[str] = []

    def add_object(self, urdf_id: int, model: ObjectModel) -> None:
        """Writes an object; its frames refer to it by ``urdf_id``.

        Args:
          urdf_id: its number, new in this root.
          model: at rest, origin at the center of its box.

        Raises:
          CaperError: the root holds an object of this number, maybe of a run that was cut off.
        """
        home = self.home / "urdf" / str(urdf_id)
        # Of a run that was cut off, folders are there and rest states are not.
        if str(urdf_id) in self._states or home.exists():
            raise CaperError(
                f"{self.home}/urdf: holds an object {urdf_id} already; choose another folder, or, "
                f"after a run that was cut off, delete {self.home} and write all its splits again"
            )
        (home / POINTS).mkdir(parents=True)
        rng = np.random.default_rng(urdf_id)
        for k, solids in enumerate(model.parts):
            points = surface_points(solids, _POINTS_PER_PART, rng)
            np.savetxt(home / POINTS / f"{k}.xyz", points, "%.9f")
        low, high = bounds([solid for part in model.parts for solid in part])
        _write_json(home / "bounding_box.json", {"min": low.tolist(), "max": high.tolist()})
        text = _urdf(urdf_id, model, self.category)
        for name in (ALIGNED, RAW):
            (home / name).write_text(text)
        children = range(1, self.category.num_parts)
        self._states[str(urdf_id)] = {str(k): {"state": 0.0} for k in children}

    def add_frame(self, urdf_id: int, image: Image) -> None:
        """Writes one frame of ArtImage."""
        self._write_frame(self.home / "train", urdf_id, image, {})

    def add_video(self, urdf_id: int, images: Iterable[Image], moving_part: int) -> None:
        """Writes one video of PM-Videos, in which ``moving_part`` moves."""
        folder = self.home / "train" / f"{self._next_video:05d}"
        self._next_video += 1
        for image in images:
            self._write_frame(folder, urdf_id, image, {"sort_part": moving_part})

    def close(self) -> None:
        """Writes what describes the whole: rest states and lists of frames."""
        (self.home / "urdf").mkdir(exist_ok=True)
        _write_json(self.home / "urdf" / REST_STATES, self._states)
        for split in ("train", "test", self.split):
            (self.home / f"{split}.txt").touch()
        self._list.write_text("".join(f"{name}\n" for name in self._names))

    def _write_frame(self, folder: Path, urdf_id: int, image: Image, more: dict[str, Any]) -> None:
        name = f"{self._next:06d}"
        self._next += 1
        self._names.append(f"{name}.json")
        for kind in ("annotations", "depth", "category_mask", "color"):
            (folder / kind).mkdir(parents=True, exist_ok=True)
        on_object = image.parts >= 0
        depth = np.where(on_object, image.depth, 0.0)
        millimeters = np.clip(np.round(depth * 1000), 0, 65535).astype(np.uint16)
        Picture.fromarray(millimeters).save(folder / "depth" / f"{name}.png")
        labels = np.where(on_object, image.parts, _BACKGROUND).astype(np.uint8)
        mask = np.repeat(labels[..., None], 3, axis=-1)
        Picture.fromarray(mask).save(folder / "category_mask" / f"{name}.png")
        Picture.fromarray(_shaded(depth, image.intrinsics)).save(
            folder / "color" / f"{name}.jpg", quality=90
        )
        rows, columns = np.nonzero(on_object)
        box = [0, 0, 0, 0]
        if len(rows):
            box = [columns.min(), rows.min(), columns.max() + 1, rows.max() + 1]
        height, width = depth.shape
        instance = {
            "id": 1,
            "category_id": self._category_id,
            "urdf_id": urdf_id,
            "bbox": [int(value) for value in box],
            "links": self._links(image),
        }
        annotation = {
            "color_path": f"color/{name}.jpg",
            "depth_path": f"depth/{name}.png",
            "width": width,
            "height": height,
            "instances": [instance],
            **more,
        }
        _write_json(folder / "annotations" / f"{name}.json", annotation)

    def _links(self, image: Image) -> list[dict[str, Any]]:
        links = []
        for k in range(self.category.num_parts):
            pose = np.eye(4)
            pose[:3, :3], pose[:3, 3] = image.pose.rotation[k], image.pose.translation[k]
            link = {"link_category_id": k, "transformation": pose.tolist(), "segmentation": []}
            if k > 0:
                state = float(image.pose.joint_state[k - 1])
                revolute = self.category.joint_types[k - 1] == "revolute"
                link["state"] = float(np.degrees(state)) if revolute else state
            links.append(link)
        return links


def _urdf(urdf_id: int, model: ObjectModel, category: Category) -> str:
    """Joints in the coordinates and with the sign of the public files."""
    lines = ['<?xml version="1.0"?>', f"<robot name={quoteattr(str(urdf_id))}>"]
    lines.append('  <link name="base"/>')
    lines += [f'  <link name="{k}"/>' for k in range(category.num_parts)]
    lines += [
        '  <joint name="joint_0" type="fixed">',
        '    <origin xyz="0 0 0" rpy="0 0 0"/>',
        '    <parent link="base"/>',
        '    <child link="0"/>',
        "  </joint>",
    ]
    for j, joint in enumerate(category.joints):
        # Counted from the joint of the parent, unless that is the root.
        origin = model.pivot[j] - (model.pivot[joint.parent - 1] if joint.parent else 0.0)
        axis = -model.axis[j] if joint.type == "revolute" else model.axis[j]
        lines += [
            f'  <joint name="joint_{j + 1}" type="{joint.type}">',
            f'    <origin xyz="{_text(origin)}" rpy="0 0 0"/>',
            f'    <axis xyz="{_text(axis)}"/>',
            f'    <parent link="{joint.parent}"/>',
            f'    <child link="{j + 1}"/>',
            f'    <limit lower="{model.limits[j, 0]:.9g}" upper="{model.limits[j, 1]:.9g}"/>',
            "  </joint>",
        ]
    return "\n".join([*lines, "</robot>", ""])


def _text(vector: np.ndarray) -> str:
    return " ".join(f"{value:.12g}" for value in vector[_URDF_ORDER] + 0.0)  # no "-0"


def _shaded(depth: np.ndarray, intrinsics: np.ndarray) -> np.ndarray:
    """[H, W, 3] uint8: how much the surface faces the camera, black where there is none."""
    shown = np.where(depth > 0, depth, np.nan)
    along_y, along_x = np.gradient(shown)
    slope_x = along_x * intrinsics[0, 0] / shown
    slope_y = along_y * intrinsics[1, 1] / shown
    facing = 1.0 / np.sqrt(1.0 + slope_x**2 + slope_y**2)
    # At the rim there is no gradient.
    light = np.where(depth > 0, 60 + 180 * np.nan_to_num(facing, nan=0.5), 0)
    return np.repeat(light.astype(np.uint8)[..., None], 3, axis=-1)


def _write_json(path: Path, content: Any) -> None:
    path.write_text(json.dumps(content) + "\n")
