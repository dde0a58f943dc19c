"""``caper demo``: estimates on the depth frames that ship with the package."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from statistics import median
from typing import TYPE_CHECKING

import numpy as np

from caper_jax.cli import common
from caper_jax.errors import CaperError, unknown_name

if TYPE_CHECKING:
    from caper_jax.articulation.category import Category
    from caper_jax.articulation.pose import ArticulatedPose
    from caper_jax.estimator import Prediction
    from caper_jax.visualization.scene import Scene

EXAMPLES = (
    ("", "all categories"),
    ("--category box", "one category"),
    ("--out /tmp/demo", "another folder than outputs/demo"),
)
TIMED_CALLS = 10  # per frame, after the first


@dataclass(frozen=True)
class Demo:
    """Estimates the objects in the depth frames that ship with the package.

    Compares them with the ground truth, and draws them: a picture per category, and one page to
    turn in a browser.

    Attributes:
      category: a name, several with commas, or all
      out: folder for pictures and page
    """

    category: tuple[str, ...] = ()
    out: Path = Path("outputs/demo")


def parse(argv: Sequence[str]) -> Demo:
    options = common.parse(Demo, argv, EXAMPLES)
    common.check_folder(options.out, "--out")
    _find_frames(options.category)
    return options


def run(options: Demo) -> int:
    """Runs the command; returns its exit code."""
    from caper_jax import categories
    from caper_jax.visualization.page import write_page
    from caper_jax.visualization.picture import write_picture

    scenes: list[Scene] = []
    written = []
    for name, folders in _find_frames(options.category).items():
        category = categories.get(name)
        own = _run_category(category, folders)
        written.append(write_picture(options.out / f"{name}.png", own))
        scenes += own
    page = write_page(options.out / "index.html", scenes, "Estimated poses")
    print("pictures:", ", ".join(str(path) for path in written))
    print(f"page:     {page} (open it in a browser: turn the objects, move their joints)")
    return 0


def demo_folder() -> Path:
    """Where the frames lie: ``<category>_<number>/`` with depth, mask, intrinsics and truth."""
    return Path(str(resources.files("caper_jax"))) / "assets" / "demo"


def _find_frames(chosen: Sequence[str]) -> dict[str, list[Path]]:
    """Folders of the frames to run, by category.

    Raises:
      CaperError: a category without frames, or no frames at all.
    """
    frames: dict[str, list[Path]] = {}
    for folder in sorted(demo_folder().glob("*_*")):
        frames.setdefault(folder.name.rpartition("_")[0], []).append(folder)
    if not frames:
        raise CaperError(f"no demo frames in {demo_folder()}; install the package again")
    names = common.chosen_categories(chosen, frames)
    for name in names:
        if name not in frames:
            raise unknown_name("category of demo frames", name, [*frames, common.ALL])
    return {name: frames[name] for name in names}


def _run_category(category: Category, folders: Sequence[Path]) -> list[Scene]:
    """Estimates the frames one by one, as a live camera would, and prints what it finds."""
    from caper_jax.data.clouds import cloud_from_depth
    from caper_jax.data.images import read_depth, read_intrinsics, read_mask
    from caper_jax.data.types import Frame
    from caper_jax.estimator import load
    from caper_jax.progress import progress
    from caper_jax.visualization.scene import Scene, format_scene

    scenes: list[Scene] = []
    first = 0.0
    seconds: list[float] = []
    calls = 1 + TIMED_CALLS * len(folders)
    with progress(f"{category.name}: loading, compiling, estimating", total=calls) as bar:
        estimator = load(category.name, hypotheses=None)
        for folder in folders:
            depth, mask = read_depth(folder / "depth.png"), read_mask(folder / "mask.png")
            intrinsics = read_intrinsics(folder / "intrinsics.json", depth.shape)
            points = cloud_from_depth(depth, mask, intrinsics).points
            if not scenes:
                first = _timed(estimator, points)[1]
                bar.update(1)
            for _ in range(TIMED_CALLS):
                prediction, spent = _timed(estimator, points)
                seconds.append(spent)
                bar.update(1)
            truth = _read_truth(folder / "truth.json", category)
            name = folder.name.replace("_", " ")
            frame = Frame(name, points, truth=truth, depth=depth, mask=mask, intrinsics=intrinsics)
            scenes.append(Scene.of_prediction(frame, category, prediction))
    for scene in scenes:
        print(f"\n{scene.name}\n{format_scene(scene)}")
    print(
        f"\n{category.name}: {1000 * median(seconds):.1f} ms per frame (median of {len(seconds)}), "
        "four looks at\n"
        f"doubted ones included; first call, with compilation, {first:.1f} s\n"
    )
    return scenes


def _timed(
    estimator: Callable[[np.ndarray], Prediction], points: np.ndarray
) -> tuple[Prediction, float]:
    """The estimate of one frame, without batch axes, and the seconds it took."""
    import jax

    began = time.perf_counter()
    # Fetching the arrays waits for them: JAX returns before it has computed.
    prediction = jax.device_get(estimator(points[None]))
    spent = time.perf_counter() - began
    return jax.tree.map(lambda array: np.asarray(array)[0], prediction), spent


def _read_truth(path: Path, category: Category) -> ArticulatedPose:
    """Ground truth under the names of ``ArticulatedPose``; states in degrees or meters.

    Raises:
      CaperError: missing or broken file, or numbers that are no pose of this category.
    """
    from caper_jax.articulation.pose import ArticulatedPose
    from caper_jax.data.images import read_json
    from caper_jax.data.types import pose_problems, pose_shapes

    content = read_json(path)
    try:
        arrays = {key: np.asarray(content[key], float) for key in pose_shapes(category.num_parts)}
        turning = np.array([kind == "revolute" for kind in category.joint_types], bool)
        states = arrays["joint_state"]
        arrays["joint_state"] = np.where(turning, np.radians(states), states)
    except (KeyError, TypeError, ValueError) as error:
        raise CaperError(f"{path}: no pose of {category.name} ({error})") from error
    truth = ArticulatedPose(**arrays)
    problems = pose_problems(truth, category)
    if problems:
        raise CaperError(f"{path}: {'; '.join(problems)}")
    return truth
