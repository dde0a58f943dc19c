"""CAPTRA's SAPIEN data: rendered depth of moving PartNet-Mobility objects, single and in videos.

Layout of a root folder, read unchanged::

    urdf/<category>/<instance>/mobility.urdf      the objects
    render/<category>/<instance>/<track>/cloud/<frame>.npz, gt/<frame>.pkl      for training
    render_seq/<category>/<instance>/<track>/...  videos, for tests

An .npz holds one pickled dictionary ``all_dict``: camera_matrix [3, 3], depth (OpenGL's z-buffer, 0
to 1, 1 where there is nothing), seg (number of the link; higher ones are ground and robot), near
and far. A .pkl holds ``camera_pose`` and, by number of the link, ``link_pose``: (position,
quaternion wxyz) in the world, of a camera that looks along x with y to its left and z up. Pickles
are read without running what they name (safe_pickle.py).

The layout is what the public loader opens; no data of it could be read. Not verified are: that
frames of render/ are numbered apart from those of render_seq/ (they are told apart here), that
every object stands upright in its URDF with y up, and its rest pose. Lengths are PartNet's, read as
meters.

An object is a URDF with links ``base``, ``link_0``, ``link_1``, ... whose meshes are placed in
their link by the origin of their <visual>. One link hangs on the base by a fixed joint and is the
root, the first or the last of them; the others hang on the root. The files know no rest pose:
states count from the pose that the object was modeled in. The rest pose follows from the parts and
the ranges of the joints as for any imported URDF (data/urdf/rules.py), canonical axes as for
ArtImage's objects, or, for a category without a ``Front``, as for any imported URDF. Of a pair of
scissors the root is the blade with the longer handle, and x halves the angle between the tips.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any
from xml.etree import ElementTree

import numpy as np
from pydantic import PlainValidator
from scipy.spatial.transform import Rotation

from caper_jax import categories
from caper_jax.arrays import checked_array, finite_array
from caper_jax.articulation.category import Category
from caper_jax.articulation.conversions import AxisMap, CaptraConversion, RestObject
from caper_jax.articulation.mesh_object import MeshObject
from caper_jax.data import safe_pickle
from caper_jax.data.images import check_values
from caper_jax.data.readers.annotations import (
    Model,
    ScaledPose,
    labeled_frame,
    pose_of_parts,
)
from caper_jax.data.readers.artimage_models import canonical_axes, rest_model
from caper_jax.data.readers.base import ALL, DatasetReader, Schema, group_videos, in_natural_order
from caper_jax.data.types import Frame
from caper_jax.data.urdf.xml import UrdfJoint, number_of, parse_urdf, read_joints, read_shapes
from caper_jax.errors import CaperError, unknown_name
from caper_jax.geometry.meshes import Mesh, join

_PLACES = {"train": "render", "test": "render_seq"}
# Axes of the files' camera (ahead, left, up) -> OpenCV's (right, down, ahead).
_CAMERA_AXES = np.array([[0.0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1]])


def _placed(pose: Any) -> np.ndarray:
    """[4, 4] of (position [3], quaternion [4] wxyz); ValueError for anything else."""
    position, quaternion = pose if isinstance(pose, (tuple, list)) and len(pose) == 2 else ((), ())
    position, quaternion = finite_array(position, (3,)), finite_array(quaternion, (4,))
    if not abs(np.linalg.norm(quaternion) - 1) < 1e-3:
        raise ValueError("must have a unit quaternion")
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_quat(quaternion, scalar_first=True).as_matrix()
    matrix[:3, 3] = position
    return matrix


_Pose = Annotated[np.ndarray, PlainValidator(_placed)]


class _Truth(Schema):
    """Content of gt/<frame>.pkl; link_pose is a list, or a dictionary by number of the link."""

    camera_pose: _Pose
    link_pose: dict[int, _Pose] | list[_Pose]


class _Image(Schema):
    """Content of cloud/<frame>.npz."""

    camera_matrix: np.ndarray
    depth: np.ndarray
    seg: np.ndarray
    near: Any
    far: Any


class CaptraDataset(DatasetReader):
    """The frames of one category; names are ``<instance>/<track>/<frame>``, e.g. 10040/0/17.

    Where both folders are read, names begin with theirs: ``render_seq/10040/0/17``. The split
    "train" is render/, "test" is render_seq/.
    """

    format = "captra"
    title = "CAPTRA"
    mask_source = "simulated segmentation"
    family = "captra"
    has_official_split = True
    has_videos = True

    @classmethod
    def categories_in(cls, root: Path) -> list[str]:
        known = {name: cls._folder(categories.registered(name)) for name in cls.known_categories()}
        return [
            name
            for name, folder in known.items()
            if (root / "urdf" / folder).is_dir()
            and any((root / place / folder).is_dir() for place in _PLACES.values())
        ]

    @classmethod
    def splits_in(cls, root: Path, category: Category) -> list[str]:
        folder = cls._folder(category)
        return [split for split, place in _PLACES.items() if (root / place / folder).is_dir()]

    @classmethod
    def _folder(cls, category: Category) -> str:
        return cls.conversion_of(category).folder

    def open(self) -> None:
        if self.split not in (ALL, *_PLACES):
            raise unknown_name("split of CAPTRA", self.split, (ALL, *_PLACES))
        self._urdfs = self.root / "urdf" / self.conversion.folder
        self.need_folder(self._urdfs)

    def list_frames(self) -> dict[str, Path]:
        files = {}
        for place in _PLACES.values() if self.split == ALL else (_PLACES[self.split],):
            for path in (self.root / place / self.conversion.folder).glob("*/*/cloud/*.npz"):
                name = f"{path.parts[-4]}/{path.parts[-3]}/{path.stem}"
                files[f"{place}/{name}" if self.split == ALL else name] = path
        return in_natural_order(files)

    def videos(self) -> dict[str, list[int]]:
        """Name of every track of render_seq/ -> indices of its frames in the order of time."""
        tracks = group_videos(self.names)
        files = [self._files[name] for name in self.names]
        return {
            name: indices
            for name, indices in tracks.items()
            if files[indices[0]].parts[-6] == _PLACES["test"]
        }

    def object_of(self, path: Path) -> str:
        return path.parts[-4]

    def read_model(self, object_id: str) -> Model:
        return read_model(self._urdfs / object_id, self.category, self.conversion)

    def read_frame(self, name: str, path: Path) -> Frame:
        instance = self.object_of(path)
        model: Model = self._model(instance)
        poses = _read_poses(path.parent.parent / "gt" / f"{path.stem}.pkl", model.links)
        truth = pose_of_parts(model, poses, self.category, str(path), scaled=False)
        depth, seg, intrinsics = _read_image(path)
        part_of_link = np.full(self.category.num_parts + 1, -1)
        part_of_link[list(model.links)] = np.arange(self.category.num_parts)
        known = (seg >= 0) & (seg < self.category.num_parts) & (depth > 0)
        labels = part_of_link[np.where(known, seg, -1)]
        return labeled_frame(name, depth, labels, intrinsics, truth, self.num_points, instance)


def _read_poses(path: Path, links: tuple[int, ...]) -> list[ScaledPose]:
    """Link -> camera (OpenCV) of links."""
    truth = check_values(_Truth, safe_pickle.load(path), str(path))
    world_to_camera = _CAMERA_AXES @ np.linalg.inv(truth.camera_pose)
    poses = []
    for link in links:
        try:
            pose = world_to_camera @ truth.link_pose[link]
        except (KeyError, IndexError):
            raise CaperError(f"{path}: link_pose lacks {link}") from None
        poses.append(ScaledPose(1.0, pose[:3, :3], pose[:3, 3]))
    return poses


def _read_image(path: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Depth [H, W] float32 meters (0: nothing), link of every pixel [H, W], intrinsics [3, 3]."""
    image = check_values(_Image, safe_pickle.load_npz(path, "all_dict"), f"{path}: all_dict")
    near, far = (
        float(checked_array(f"{path}: {key}", getattr(image, key), ())) for key in ("near", "far")
    )
    buffer = checked_array(f"{path}: depth", image.depth, (None, None), low=0, high=1)
    buffer = buffer.astype(np.float64)
    seg = checked_array(f"{path}: seg", image.seg, buffer.shape)
    camera = checked_array(f"{path}: camera_matrix", image.camera_matrix, (3, 3))
    if camera[0, 0] <= 0 or camera[1, 1] <= 0:
        raise CaperError(f"{path}: camera_matrix is no pinhole camera, got {camera.tolist()}")
    if not 0 < near < far:
        raise CaperError(f"{path}: must have 0 < near < far, got {near:g} and {far:g}")
    depth = np.where(buffer < 1, near * far / (far + buffer * (near - far)), 0.0)
    return depth.astype(np.float32), seg.astype(np.int64), camera.astype(np.float64)


# The objects.


def read_model(folder: Path, category: Category, conversion: CaptraConversion) -> Model:
    """Reads one object and brings it to our rest pose and frame.

    Args:
      folder: the object's folder, which holds mobility.urdf and its meshes.
      category: gives the parts and the types of joints.
      conversion: of the category.

    Returns:
      The model; its file frames are those of the URDF's links.

    Raises:
      CaperError: missing or broken files, or an object that does not fit the category.
    """
    path = folder / "mobility.urdf"
    robot = parse_urdf(path)
    joints = {number_of(joint.child): joint for joint in read_joints(robot, path)}
    root = _root(joints, path, category)
    links = [root, *(link for link in range(category.num_parts) if link != root)]
    visuals = [_read_visuals(robot, path, link) for link in links]

    # Everything in the frame of the root's mesh, which is upright, as the file holds it.
    upright = np.linalg.inv(visuals[0][0])
    moving = [joints[link] for link in links[1:]]
    poses = [upright, *(upright @ joint.origin for joint in moving)]
    reference = MeshObject(
        parts=tuple(mesh.moved(pose) for (_, mesh), pose in zip(visuals, poses, strict=True)),
        kinds=tuple(joint.kind for joint in moving),
        parents=category.parents,
        axis=np.array([p[:3, :3] @ j.axis for j, p in zip(moving, poses[1:], strict=True)]),
        pivot=np.array([pose[:3, 3] for pose in poses[1:]]),
        limits=np.array([joint.limits for joint in moving]),
    )
    rule = category.urdf_rule
    if conversion.lower_root:
        first, second = (mesh.bounds()[:, 1].mean() for mesh in reference.parts)
        exchanged = second < first
    else:
        exchanged = rule.root is not None and rule.root(reference) == 1
    if exchanged:
        reference, links, poses = reference.exchanged(), links[::-1], poses[::-1]

    states = rule.rest(reference)
    at_rest = reference.at(states)
    low, high = at_rest.limits.T
    rest = RestObject(
        points=[mesh.vertices for mesh in at_rest.parts],
        axis=at_rest.axis,
        pivot=at_rest.pivot,
        opening=np.where(high >= -low, 1.0, -1.0),
    )
    if conversion.front is None:
        axes = _urdf_axes(at_rest, category)
    else:
        axes = canonical_axes(rest, category, conversion.front, str(path))
    model = rest_model(rest, reference.poses(states) @ np.array(poses), axes)
    return replace(model, links=tuple(links[part] for part in axes.order))


def _urdf_axes(at_rest: MeshObject, category: Category) -> AxisMap:
    """As the category's rule for URDF files has them, with joints that open about up."""
    up, front, _ = category.urdf_rule.axes(at_rest)
    front = front - (front @ up) * up
    y, z = up / np.linalg.norm(up), front / np.linalg.norm(front)
    rotation = np.stack([np.cross(y, z), y, z])
    return AxisMap(rotation, tuple(range(category.num_parts)), np.sign(at_rest.axis @ y))


def _root(joints: dict[int | None, UrdfJoint], path: Path, category: Category) -> int:
    """The link that all others hang on; checks the tree against the category's."""
    links = set(range(category.num_parts))
    roots = [n for n in links if n not in joints or joints[n].kind == "fixed"]
    tree = {link: (joint.kind, number_of(joint.parent)) for link, joint in joints.items()}
    if len(roots) == 1:
        moving = {link: place for link, place in tree.items() if link != roots[0]}
        on_base = tree.get(roots[0], (None, None))[1] is None
        if on_base and moving == dict.fromkeys(
            links - {roots[0]}, (category.joint_types[0], roots[0])
        ):
            return roots[0]
    raise CaperError(
        f"{path}: joints (link: type, parent) are {tree}, but {category.name} has "
        f"{category.num_joints} {category.joint_types[0]} joint(s) on one root, of links link_0 to "
        f"link_{category.num_parts - 1}"
    )


def _read_visuals(robot: ElementTree.Element, path: Path, number: int) -> tuple[np.ndarray, Mesh]:
    """Pose [4, 4] of a link's first mesh in the link, and all its meshes in the link's frame."""
    link = robot.find(f"link[@name='link_{number}']")
    shapes = [] if link is None else read_shapes(link, "visual", path)
    if not shapes:
        raise CaperError(f"{path}: no link_{number} with a mesh")
    if not all(len(mesh.faces) for _, mesh in shapes):
        raise CaperError(f"{path}, link_{number}: a mesh has no faces")
    return shapes[0][0], join([mesh for _, mesh in shapes])
