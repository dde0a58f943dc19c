"""``caper generate --urdf``: frames of objects imported from URDF files with meshes."""

from __future__ import annotations

import argparse
import json
import math
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from caper_jax.cli import common
from caper_jax.errors import CaperError

if TYPE_CHECKING:
    from caper_jax.articulation.category import Category
    from caper_jax.data.urdf import ImportedObject, ImportOptions

_OPTIONS = ("up", "front", "rest", "parts", "scale")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds --urdf and what goes with it."""
    group = parser.add_argument_group(
        "objects from URDF files",
        "How a file is understood is drawn to <out>_check/NAME.png and written to NAME.txt: look\n"
        "at them, and correct with these options what was not detected rightly. NAME.json has the\n"
        "map from the file's joint values to states and back.",
    )
    group.add_argument(
        "--urdf",
        type=Path,
        metavar="PATH",
        help="show this object instead of generated shapes: a URDF file, its folder (e.g. one of "
        "PartNet-Mobility), or a folder of such folders",
    )
    group.add_argument(
        "--up", type=_direction, help="the file's direction that is up (canonical y), e.g. z"
    )
    group.add_argument(
        "--front",
        type=_direction,
        help="the file's direction that is canonical z, e.g. --front=-x, or three numbers 0,1,0",
    )
    group.add_argument(
        "--rest",
        type=_states,
        help="states of the file's joints at rest, degrees or meters: one number, or "
        "JOINT=NUMBER,... (a link's name stands for the joint that carries it)",
    )
    group.add_argument(
        "--parts",
        type=lambda text: tuple(text.split(",")),
        metavar="LINK,...",
        help="one link of each part, in the order of the category's parts",
    )
    group.add_argument(
        "--scale",
        type=_scale,
        help="factor for all lengths, or mean for the category's mean size (default: 1)",
    )


def _direction(text: str) -> tuple[float, ...]:
    """Argument type: x, -y, +z, or three numbers."""
    name = text.lstrip("+-")
    if name in ("x", "y", "z") and len(text) - len(name) <= 1:
        return tuple((-1.0 if text[0] == "-" else 1.0) * (name == axis) for axis in "xyz")
    try:
        numbers = tuple(float(part) for part in text.split(","))
    except ValueError:
        numbers = ()
    if len(numbers) != 3 or not all(map(math.isfinite, numbers)) or not any(numbers):
        raise argparse.ArgumentTypeError(f"{text!r} is neither x, y, z, -x, ... nor three numbers")
    return numbers


def _states(text: str) -> dict[str, float]:
    """Argument type: a number, or NAME=NUMBER,...; "" stands for all joints."""
    states = {}
    for item in text.split(","):
        name, _, number = item.rpartition("=")
        try:
            states[name.strip()] = float(number)
        except ValueError:
            states[name] = math.nan
    if not all(map(math.isfinite, states.values())) or ("" in states and len(states) > 1):
        raise argparse.ArgumentTypeError(f"{text!r} is neither a number nor JOINT=NUMBER,...")
    return states


def _scale(text: str) -> float | str:
    """Argument type: a factor, or "mean"."""
    return text if text == "mean" else common.positive_float(text)


def check_options(arguments: argparse.Namespace) -> None:
    """Refuses options that have no meaning with, or without, --urdf.

    Raises:
      CaperError: names them.
    """
    if arguments.urdf is None:
        for option in _OPTIONS:
            if getattr(arguments, option) is not None:
                raise CaperError(f"--{option} belongs to --urdf PATH")
        return
    for option in ("videos", "images", "layout"):
        if getattr(arguments, option):
            raise CaperError(f"--urdf and --{option} exclude each other")


def write_urdf_frames(arguments: argparse.Namespace) -> None:
    """Imports the objects, draws the check pictures and writes the frames.

    Args:
      arguments: those of ``caper generate``.

    Raises:
      CaperError: nothing to import, or an object (the only one) that cannot be.
    """
    import numpy as np

    from caper_jax import __version__, categories
    from caper_jax.data import hdf5
    from caper_jax.data.urdf import ImportOptions
    from caper_jax.progress import progress
    from caper_jax.synthetic.urdf_frames import render_frames
    from caper_jax.visualization.model_check import write_model_check

    category = categories.get(arguments.category)
    hdf5.check_writable(arguments.out, arguments.overwrite)
    options = ImportOptions(
        up=None if arguments.up is None else np.array(arguments.up),
        front=None if arguments.front is None else np.array(arguments.front),
        rest=arguments.rest or {},
        parts=arguments.parts,
        scale=None if arguments.scale == "mean" else arguments.scale or 1.0,
    )
    objects = _import_all(arguments.urdf, category, options)
    check = arguments.out.with_name(f"{arguments.out.stem}_check")
    for item in objects:
        write_model_check(check / f"{item.name}.png", item)
        (check / f"{item.name}.txt").write_text("\n".join(item.notes) + "\n", encoding="utf-8")
        report = json.dumps(item.report(), indent=1) + "\n"
        (check / f"{item.name}.json").write_text(report, encoding="utf-8")
    if len(objects) == 1:
        print("\n".join(objects[0].notes))
    with progress("rendering", total=arguments.frames) as bar:
        batch = render_frames(
            objects,
            arguments.frames,
            noise=arguments.noise,
            num_points=arguments.points,
            grid=arguments.grid,
            split=arguments.split,
            seed=arguments.seed,
            report=bar.update,
        )
    hdf5.write(
        arguments.out,
        category=category,
        split=arguments.split,
        **vars(batch),
        names=[
            f"{category.name}_{objects[which].name}_{index:06d}"
            for index, which in enumerate(np.asarray(batch.instance))
        ],
        attributes={
            "generator": __version__,
            "source": "urdf",
            "noise": arguments.noise,
            "seed": arguments.seed,
            "instances": len(objects),
            "grid": arguments.grid,
        },
        overwrite=arguments.overwrite,
    )
    print(
        f"written: {arguments.out} ({arguments.frames} frames of {arguments.points} points, "
        f"{len(objects)} objects); look at {check}"
    )


def _import_all(path: Path, category: Category, options: ImportOptions) -> list[ImportedObject]:
    """Every object that maps onto the category; the others are named on standard error."""
    from dataclasses import replace

    from caper_jax.data.urdf.canonical import import_urdf
    from caper_jax.data.urdf.load import find_models

    files = find_models(path)
    objects, first = [], None
    for file in files:
        try:
            item = import_urdf(file, category, options)
            # The folders of several files differ, their names need not.
            name = item.name if len(files) == 1 else file.parent.name
            objects.append(replace(item, name=name))
        except CaperError as error:
            if len(files) == 1:
                raise
            first = first or error
            print(f"passed over: {error}", file=sys.stderr)
    if not objects:
        raise CaperError(f"--urdf {path}: none of {len(files)} objects could be used; {first}")
    if len(files) > 1:
        print(f"imported: {len(objects)} of {len(files)} objects")
    return objects
