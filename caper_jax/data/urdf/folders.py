"""Folders with URDF files, and what PartNet-Mobility keeps beside its own.

Read of PartNet-Mobility, all but the URDF optional: mobility.urdf, semantics.txt (lines ``link
joint name``), mobility_v2.json (a list of {id, name, ...} per link) and meta.json (model_cat).
"""

from __future__ import annotations

from pathlib import Path

from caper_jax.data.images import read_json
from caper_jax.errors import CaperError

PARTNET_URDF = "mobility.urdf"
# PartNet-Mobility's classes that hold a category; others in a folder of models are passed over.
PARTNET_CLASSES = {
    "laptop": ("Laptop",),
    "box": ("Box",),
    "stapler": ("Stapler",),
    "dishwasher": ("Dishwasher",),
    "drawer": ("StorageFurniture", "Table"),
    "cutter": ("Knife",),
    "eyeglasses": ("Eyeglasses",),
    "scissors": ("Scissors",),
}


def find_models(path: str | Path) -> list[Path]:
    """The URDF files meant by a path, sorted.

    Args:
      path: a URDF file, a folder with one (PartNet-Mobility's mobility.urdf goes before others),
        or a folder of such folders.

    Raises:
      CaperError: nothing there, no URDF, or several in one folder.
    """
    path = Path(path)
    if path.is_file():
        return [path]
    if not path.is_dir():
        raise CaperError(f"--urdf {path}: no such file or folder")
    own = _urdf_of(path)
    if own is not None:
        return [own]
    found = [_urdf_of(folder) for folder in sorted(path.iterdir()) if folder.is_dir()]
    models = [urdf for urdf in found if urdf is not None]
    if not models:
        raise CaperError(f"--urdf {path}: holds no .urdf file, and no folder in it does")
    return models


def _urdf_of(folder: Path) -> Path | None:
    """The one URDF of a folder, None when it has none."""
    if (folder / PARTNET_URDF).is_file():
        return folder / PARTNET_URDF
    files = sorted(folder.glob("*.urdf"))
    if len(files) > 1:
        names = ", ".join(file.name for file in files[:6])
        raise CaperError(f"{folder}: holds {len(files)} URDF files ({names}); name one of them")
    return files[0] if files else None


def partnet_labels(folder: Path) -> dict[str, str]:
    """What PartNet-Mobility calls its links, from semantics.txt or else mobility_v2.json."""
    semantics, mobility = folder / "semantics.txt", folder / "mobility_v2.json"
    if semantics.is_file():
        rows = [line.split() for line in semantics.read_text(encoding="utf-8").splitlines()]
        return {row[0]: row[2] for row in rows if len(row) >= 3}
    if not mobility.is_file():
        return {}
    content = read_json(mobility)
    nodes = content if isinstance(content, list) else []
    return {
        f"link_{node['id']}": str(node["name"])
        for node in nodes
        if isinstance(node, dict) and "id" in node and "name" in node
    }


def partnet_class(folder: Path) -> str:
    """The object's class in meta.json, "" where it says none."""
    path = folder / "meta.json"
    content = read_json(path) if path.is_file() else {}
    return str(content.get("model_cat", "")) if isinstance(content, dict) else ""
