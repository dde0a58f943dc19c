"""ReArtMix: real RGB-D frames with several articulated objects each (ReArt-48 models).

Layout of a root folder, read unchanged::

    camera_intrinsic.json    Open3D pinhole camera
    urdf_metas.json          boxes of the parts, joint axes and pivots of every model
    annotations/<scene>/NNNNNN.json, depth/<scene>/NNNNNN.png, color/<scene>/NNNNNN.jpg
    train.txt, test.txt      lines ``<scene>/NNNNNN_<instance>``

The files keep a uniform scale s in every transformation, ``[s R | t]``, and hold the parts at a
state of their own; frames come out in this project's conventions (metres, rest-canonical frames,
positive states open).
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image, ImageDraw

from caper_jax import categories
from caper_jax.articulation.category import Category
from caper_jax.articulation.pose import ArticulatedPose
from caper_jax.data.cloud import MIN_POINTS, cloud_from_depth
from caper_jax.data.images import read_depth, read_intrinsics, read_json
from caper_jax.data.reartmix_models import CONVERSIONS, Model, read_model
from caper_jax.data.schema import Frame
from caper_jax.errors import CaperError, unknown_name

FORMAT = "reartmix"
ALL = "all"
_SCALE_TOLERANCE = 1e-3
_INSTANCE_KEYS = ("id", "category_id", "urdf_id", "links")


class ReArtMixDataset:
    """Every annotated instance of one category, one ``Frame`` each.

    An instance that shows too little for a cloud has no points: to an evaluation, a failure.

    Attributes:
      category, format, split, mask_source, names: see ``Dataset``; names are the lines of
        train.txt, e.g. ``scene6/000003_0``.
    """

    format = FORMAT
    mask_source = "annotated polygons"

    def __init__(
        self, root: str | Path, category: str, split: str | None = None, num_points: int = 1024
    ):
        """Lists the instances; depth and polygons are read frame by frame.

        Args:
          root: the folder that holds annotations/, depth/ and urdf_metas.json.
          category: name of the category to read; the others in the images are left out.
          split: "train" or "test" for the instances of <split>.txt; None or "all" for all.
          num_points: points per frame.

        Raises:
          CaperError: not a ReArtMix folder, a split it does not have, a category it does not hold
            or whose rest pose is not known, or broken files.
        """
        self.root = Path(root)
        self.category: Category = categories.get(category)
        if category not in CONVERSIONS:
            raise unknown_name("ReArtMix category", category, CONVERSIONS)
        self._conversion = CONVERSIONS[category]
        for name in ("annotations", "depth"):
            if not (self.root / name).is_dir():
                raise CaperError(f"{self.root}: no ReArtMix folder (it lacks {name}/)")
        self.split = split or ALL
        self._num_points = num_points
        self._intrinsics = read_intrinsics(self.root / "camera_intrinsic.json")
        self._models = self._load_models()
        self.names: Sequence[str] = self._list_names()
        self._annotation = lru_cache(maxsize=4)(self._read_annotation)

    def __len__(self) -> int:
        return len(self.names)

    def __getitem__(self, index: int, /) -> Frame:
        name = self.names[index]
        image_name, _, instance_id = name.rpartition("_")
        annotation = self._annotation(image_name)
        instance = next(i for i in annotation["instances"] if i["id"] == int(instance_id))
        where = f"{self._path(image_name)}, instance {instance_id}"
        links = _ordered_links(instance, self.category.num_parts, where)

        depth = read_depth(self.root / "depth" / annotation["depth_path"])
        label_image = _draw_labels(links, depth.shape, where)
        mask = label_image >= 0
        points, pixels = np.zeros((0, 3), np.float32), np.zeros((0, 2), np.int32)
        if np.count_nonzero(mask & (depth > 0)) >= MIN_POINTS:
            cloud = cloud_from_depth(depth, mask, self._intrinsics, self._num_points)
            points, pixels = cloud.points, cloud.pixels
        return Frame(
            name=name,
            points=points,
            labels=label_image[pixels[:, 0], pixels[:, 1]].astype(np.int32),
            truth=self._truth(instance, links, where),
            visible=np.bincount(label_image[mask], minlength=self.category.num_parts),
            depth=depth,
            mask=mask,
            intrinsics=self._intrinsics,
        )

    def _truth(self, instance: dict[str, Any], links: list[dict], where: str) -> ArticulatedPose:
        if instance["urdf_id"] not in self._models:
            raise CaperError(f"{where}: urdf_id {instance['urdf_id']} is not in urdf_metas.json")
        model = self._models[instance["urdf_id"]]
        scales, rotations, shifts = zip(
            *(_split_transformation(link["transformation"], where) for link in links), strict=True
        )
        file_rotation, scale = np.stack(rotations), scales[0]
        rotation = file_rotation @ model.to_file_rotation
        moved = np.einsum("kij,kj->ki", file_rotation, model.to_file_shift)
        translation = np.stack(shifts) + scale * moved

        conversion = self._conversion
        states = []
        for j, joint in enumerate(self.category.joints):
            parent, child = joint.parent, j + 1
            if joint.type == "revolute":
                # The files turn the child by minus the state about the stored axis.
                relative = file_rotation[parent].T @ file_rotation[child]
                file_state = -_angle_about(relative, model.file_axis[j])
                state = conversion.sign * (file_state - conversion.rest_state)
                middle = sum(joint.limits) / 2
                state = middle + (state - middle + np.pi) % (2 * np.pi) - np.pi
            else:
                offset = file_rotation[parent].T @ (shifts[child] - shifts[parent])
                file_state = float(offset @ model.file_axis[j])
                state = conversion.sign * (file_state - scale * conversion.rest_state)
            states.append(state)
        return ArticulatedPose(
            rotation=rotation.astype(np.float32),
            translation=translation.astype(np.float32),
            size=(scale * model.size).astype(np.float32),
            box_center=(scale * model.center).astype(np.float32),
            joint_axis=model.axis.astype(np.float32),
            joint_pivot=(scale * model.pivot).astype(np.float32),
            joint_state=np.array(states, np.float32),
        )

    def _load_models(self) -> dict[int, Model]:
        path = self.root / "urdf_metas.json"
        content = read_json(path)
        models = {}
        try:
            for meta in content["urdf_metas"]:
                if meta["category_name"] == self.category.name:
                    where = f"{path}, model {meta['id']}"
                    models[meta["id"]] = read_model(meta, self.category, self._conversion, where)
        except (KeyError, TypeError, ValueError, IndexError) as error:
            if isinstance(error, CaperError):
                raise
            raise CaperError(f"{path}: unexpected content ({error!r})") from error
        if not models:
            raise CaperError(f"{path}: describes no {self.category.name}")
        return models

    def _list_names(self) -> list[str]:
        """Names of the split's instances of this category, in the order of the files."""
        folder = self.root / "annotations"
        if self.split == ALL:
            wanted = None
            images = [
                str(path.relative_to(folder).with_suffix(""))
                for path in sorted(folder.glob("**/*.json"))
            ]
        else:
            path = self.root / f"{self.split}.txt"
            if not path.is_file():
                present = sorted(p.stem for p in self.root.glob("*.txt"))
                raise CaperError(
                    f"{self.root}: no split {self.split!r} (no {path.name}); it has "
                    f"{', '.join([ALL, *present])}"
                )
            wanted = path.read_text(encoding="utf-8").split()
            images = list(dict.fromkeys(name.rpartition("_")[0] for name in wanted))
        found: dict[str, bool] = {}
        for image in images:
            for instance in self._read_annotation(image)["instances"]:
                ours = instance["category_id"] == self._conversion.category_id
                found[f"{image}_{instance['id']}"] = ours
        unknown = [name for name in wanted or () if name not in found]
        if unknown:
            raise CaperError(f"{path}: names {unknown[0]!r}, which no annotation describes")
        names = [name for name in wanted or found if found[name]]
        if not names:
            raise CaperError(
                f"{self.root}: split {self.split!r} shows no instance of {self.category.name!r}"
            )
        return names

    def _path(self, image_name: str) -> Path:
        return self.root / "annotations" / f"{image_name}.json"

    def _read_annotation(self, image_name: str) -> dict[str, Any]:
        path = self._path(image_name)
        content = read_json(path)
        if not isinstance(content, dict):
            raise CaperError(f"{path}: no ReArtMix annotation, it is no JSON object")
        missing = [key for key in ("depth_path", "instances") if key not in content]
        for instance in content.get("instances", ()):
            missing += [key for key in _INSTANCE_KEYS if key not in instance]
        if missing:
            raise CaperError(f"{path}: no ReArtMix annotation, it lacks {missing[0]!r}")
        return content


def _ordered_links(instance: dict[str, Any], num_parts: int, where: str) -> list[dict[str, Any]]:
    """The links in the order of the parts; ``link_category_id`` counts from 1."""
    try:
        links = {link["link_category_id"] - 1: link for link in instance["links"]}
        ordered = [links[part] for part in range(num_parts)]
        for link in ordered:
            link["transformation"], link["segmentation"]
    except (KeyError, TypeError) as error:
        raise CaperError(f"{where}: a link lacks {error}") from error
    if len(instance["links"]) != num_parts:
        raise CaperError(f"{where}: {len(instance['links'])} links, expected {num_parts}")
    return ordered


def _split_transformation(value: Any, where: str) -> tuple[float, np.ndarray, np.ndarray]:
    """Scale, rotation [3, 3] and translation [3] of ``[s R | t]``."""
    matrix = np.asarray(value, np.float64)
    if matrix.shape != (4, 4) or not np.isfinite(matrix).all():
        raise CaperError(f"{where}: transformation must be 4x4 finite numbers")
    determinant = np.linalg.det(matrix[:3, :3])
    if determinant <= 0:
        raise CaperError(f"{where}: transformation has determinant {determinant:.3g}")
    scale = float(np.cbrt(determinant))
    rotation = matrix[:3, :3] / scale
    drift = np.abs(rotation.T @ rotation - np.eye(3)).max()
    if drift > _SCALE_TOLERANCE:
        raise CaperError(f"{where}: transformation is no scaled rotation (off by {drift:.2g})")
    return scale, rotation, matrix[:3, 3]


def _draw_labels(links: list[dict[str, Any]], shape: tuple[int, ...], where: str) -> np.ndarray:
    """[H, W] int: part of every pixel, -1 outside; polygons include their outline."""
    canvas = Image.new("L", (shape[1], shape[0]), 0)
    draw = ImageDraw.Draw(canvas)
    for part, link in enumerate(links):
        for polygon in link["segmentation"]:
            if len(polygon) % 2:
                raise CaperError(f"{where}: a polygon has an odd number of coordinates")
            if len(polygon) >= 6:
                draw.polygon(polygon, fill=part + 1)
    return np.asarray(canvas).astype(np.int64) - 1


def _angle_about(rotation: np.ndarray, axis: np.ndarray) -> float:
    """Signed angle about a unit axis, (-pi, pi], of a rotation [3, 3] about (nearly) that axis."""
    skew = np.array(
        [
            rotation[2, 1] - rotation[1, 2],
            rotation[0, 2] - rotation[2, 0],
            rotation[1, 0] - rotation[0, 1],
        ]
    )
    return float(np.arctan2(skew @ axis / 2, (np.trace(rotation) - 1) / 2))
