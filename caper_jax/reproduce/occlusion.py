"""Table 8: errors by how much of a part is hidden."""

from __future__ import annotations

from typing import Any

import numpy as np

from caper_jax.errors import CaperError
from caper_jax.reproduce.options import Options
from caper_jax.reproduce.paper import OCCLUSION, PM_DIAGONAL_M
from caper_jax.reproduce.render import Report, Table, number
from caper_jax.reproduce.static import measure

CATEGORY = "drawer"  # the paper's
HEADER = (
    *("category", "occluded", "parts seen so", "rot paper [deg]", "ours"),
    *("trans paper [m]", "paper [%]", "ours [%]"),
)
_FRAMES = 1000


def run(name: str, options: Options) -> Report:
    """Means over all parts of all frames within each bin of occlusion.

    Args:
      name: "table8".
      options: see ``Options``; any category may be named.

    Raises:
      CaperError: no model or no data of a category, or data that do not say what is hidden.
    """
    rows: list[list[str]] = []
    facts, result = [], {}
    for category in options.category or (CATEGORY,):
        found = measure(category, options, _FRAMES)
        if "missing" in found:
            raise CaperError(f"{category}: there is {found['missing']}")
        if "by_occlusion" not in found:
            raise CaperError(f"{category}: the data do not say how much of a part is hidden")
        facts.append(f"{category}: {found['data']}, object masks {found['mask_source']}")
        result[category] = {"data": found["data"], "bins": pooled(found["by_occlusion"])}
        for content in result[category]["bins"]:
            low, high = content["occluded"]
            turn, shift = OCCLUSION[low, high] if category == CATEGORY else (None, None)
            ours = content["rotation_deg"], content["translation_relative"]
            rows.append(
                [
                    *(category, f"{100 * low:.0f}-{100 * high:.0f} %", str(content["count"])),
                    *(number(turn, 1), number(ours[0], 2), number(shift, 3)),
                    number(None if shift is None else 100 * shift / PM_DIAGONAL_M, 2),
                    number(None if ours[1] is None else 100 * ours[1], 2),
                ]
            )
    return Report(
        title="Table 8, self-occlusion (Sec 6.4)",
        tables=[Table("Mean errors of parts by the share that is hidden", HEADER, rows, 2)],
        facts=[
            "the paper measured on the drawers of ArtImage, ours were measured on:",
            *facts,
            "a part's occlusion: the share of its surface, as seen from the camera's side, that "
            "something hides; the paper calls 80-100 % highly occluded",
            f"the paper's meters are divided by an assumed diagonal: {PM_DIAGONAL_M:g} m",
        ],
        result={"categories": result},
    )


def pooled(bins: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Means over all parts in each bin, from their means and counts; None in an empty bin."""
    table = []
    for content in bins:
        parts = [part for part in content["parts"] if part["frames"]]
        count = np.array([part["frames"] for part in parts])
        means = {
            metric: float(np.average([part[metric]["mean"] for part in parts], weights=count))
            if parts
            else None
            for metric in ("rotation_deg", "translation_relative")
        }
        total = int(count.sum()) if parts else 0
        table.append({"occluded": tuple(content["occluded"]), "count": total, **means})
    return table
