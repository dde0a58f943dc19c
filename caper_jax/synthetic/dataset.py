"""Generated frames as a dataset, drawn when they are asked for."""

from __future__ import annotations

import threading
from collections.abc import Sequence

import jax

from caper_jax.data.types import Batch, Frame
from caper_jax.errors import CaperError
from caper_jax.synthetic.camera import gravity
from caper_jax.synthetic.frames import FRAMES_AT_A_TIME, Generator
from caper_jax.synthetic.instances import split_key

_KEPT = 8  # draws in memory


class GeneratedDataset:
    """The first frames of a seed: those that ``caper generate`` writes, without a file.

    Attributes:
      category, split: of the generator.
      format: "generated".
      mask_source: "simulated".
      names: category, split and number.
    """

    format = "generated"
    mask_source = "simulated"
    checked = True  # its truth is what was drawn

    def __init__(self, generator: Generator, frames: int, seed: int = 0) -> None:
        """Draws nothing yet.

        Args:
          generator: of its split and instances.
          frames: how many.
          seed: of the frames.

        Raises:
          CaperError: no frames.
        """
        if frames < 1:
            raise CaperError(f"nothing to generate: {frames} frames")
        self.category = generator.category
        self.split = generator.split
        title = f"{self.category.name}_{self.split}"
        self.names: Sequence[str] = [f"{title}_{index:06d}" for index in range(frames)]
        self._generator = generator
        self._key = split_key(generator.split, seed)
        self._draws: dict[int, Batch] = {}
        self._lock = threading.Lock()

    def videos(self) -> dict[str, list[int]]:
        """None: frames are single."""
        return {}

    def __len__(self) -> int:
        return len(self.names)

    def __getitem__(self, index: int, /) -> Frame:
        if not 0 <= index < len(self):
            raise IndexError(f"frame {index} of {len(self)}")
        start = index - index % FRAMES_AT_A_TIME
        with self._lock:  # threads that want frames of one draw wait for it
            if start not in self._draws:
                key = jax.random.fold_in(self._key, start)
                drawn = self._generator.batch(key, FRAMES_AT_A_TIME)
                kept = list(self._draws.items())[1 - _KEPT :]
                self._draws = {**dict(kept), start: jax.device_get(drawn)}
            batch = self._draws[start]
        row = jax.tree.map(lambda array: array[index - start], batch)
        return Frame(
            name=self.names[index],
            points=row.points,
            labels=row.labels,
            truth=row.pose,
            visible=row.visible,
            visibility=row.visibility,
            instance=str(row.instance),
            gravity=gravity(row.pose, self.category.viewpoint),
        )
