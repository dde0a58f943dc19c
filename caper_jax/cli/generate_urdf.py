"""``caper generate --urdf``: frames of objects imported from URDF files with meshes."""

from __future__ import annotations

import json
import math
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from caper_jax.cli.generate import GRID, POINTS, Generate
from caper_jax.errors import CaperError

if TYPE_CHECKING:
    from caper_jax.articulation.category import Category
    from caper_jax.data.urdf import ImportedObject, ImportOptions


def _direction(option: str, text: str | None) -> tuple[float, ...] | None:
    """x, -y, +z, or three numbers."""
    if text is None:
        return None
    name = text.lstrip("+-")
    if name in ("x", "y", "z") and len(text) - len(name) <= 1:
        return tuple((-1.0 if text[0] == "-" else 1.0) * (name == axis) for axis in "xyz")
    try:
        numbers = tuple(float(part) for part in text.split(","))
    except ValueError:
        numbers = ()
    if len(numbers) != 3 or not all(map(math.isfinite, numbers)) or not any(numbers):
        raise CaperError(f"{option}: {text!r} is neither x, y, z, -x, ... nor three numbers")
    return numbers


def _states(text: str | None) -> dict[str, float]:
    """A number, or NAME=NUMBER,...; "" stands for all joints."""
    states: dict[str, float] = {}
    for item in text.split(",") if text is not None else ():
        name, _, number = item.rpartition("=")
        try:
            states[name.strip()] = float(number)
        except ValueError:
            states[name] = math.nan
    if not all(map(math.isfinite, states.values())) or ("" in states and len(states) > 1):
        raise CaperError(f"--rest: {text!r} is neither a number nor JOINT=NUMBER,...")
    return states


def _scale(text: str | None) -> float | None:
    """A factor, 1 by default; None for "mean"."""
    if text == "mean":
        return None
    try:
        scale = float(text or "1")
    except ValueError:
        scale = math.nan
    if not 0 < scale < math.inf:
        raise CaperError(f"--scale: {text!r} is neither a number above 0 nor mean")
    return scale


def import_options(given: Generate) -> ImportOptions:
    """How the files are to be understood.

    Raises:
      CaperError: an option that cannot be read.
    """
    import numpy as np

    from caper_jax.data.urdf import ImportOptions

    up, front = _direction("--up", given.up), _direction("--front", given.front)
    return ImportOptions(
        up=None if up is None else np.array(up),
        front=None if front is None else np.array(front),
        rest=_states(given.rest),
        parts=None if given.parts is None else tuple(given.parts.split(",")),
        scale=_scale(given.scale),
    )


def write_urdf_frames(options: Generate, path: Path) -> None:
    """Imports the objects, draws the check pictures and writes the frames.

    Args:
      options: those of ``caper generate``.
      path: of the files, see ``find_models``.

    Raises:
      CaperError: nothing to import, or an object (the only one) that cannot be.
    """
    import numpy as np

    from caper_jax import __version__, categories
    from caper_jax.data import hdf5
    from caper_jax.progress import progress
    from caper_jax.synthetic.urdf_frames import render_frames
    from caper_jax.visualization.model_check import write_model_check

    category = categories.get(options.category)
    hdf5.check_writable(options.out, options.overwrite)
    points, grid = options.points or POINTS, options.grid or GRID
    objects = _import_all(path, category, import_options(options))
    check = options.out.with_name(f"{options.out.stem}_check")
    for item in objects:
        write_model_check(check / f"{item.name}.png", item)
        (check / f"{item.name}.txt").write_text("\n".join(item.notes) + "\n", encoding="utf-8")
        report = json.dumps(item.report(), indent=1) + "\n"
        (check / f"{item.name}.json").write_text(report, encoding="utf-8")
    if len(objects) == 1:
        print("\n".join(objects[0].notes))
    with progress("rendering", total=options.num_frames) as bar:
        batch = render_frames(
            objects,
            options.num_frames,
            noise=options.noise,
            num_points=points,
            grid=grid,
            split=options.split,
            seed=options.seed,
            report=bar.update,
        )
    hdf5.write(
        options.out,
        category=category,
        split=options.split,
        **vars(batch),
        names=[
            f"{category.name}_{objects[which].name}_{index:06d}"
            for index, which in enumerate(np.asarray(batch.instance))
        ],
        attributes={
            "generator": __version__,
            "source": "urdf",
            "noise": options.noise,
            "seed": options.seed,
            "instances": len(objects),
            "grid": grid,
        },
        overwrite=options.overwrite,
    )
    print(
        f"written: {options.out} ({options.num_frames} frames of {points} points, "
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
