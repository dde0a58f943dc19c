"""Depth-sensor noise on a regular grid of rays (one frame; vmap over batches).

One parametric model covers the presets: axial noise that grows with the square of the distance
and with incidence (Nguyen, Izadi and Lovell, 3DIMPVT 2012), disparity rounded to fractions of a
pixel (Barron and Malik, CVPR 2013), stereo noise z^2 * subpixel / (f B), loss of pixels at depth
jumps and at grazing incidence, mixed pixels at jumps, and isotropic point noise.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from caper_jax.errors import unknown_name


@flax.struct.dataclass
class Sensor:
    """Coefficients of the noise model, meters; arrays or floats.

    Attributes:
      floor: axial standard deviation at ``origin``.
      origin: distance from which on the axial noise grows.
      quadratic: added axial standard deviation per (z - origin)^2.
      incidence: weight of the grazing-angle term.
      focal_baseline: focal length [px] times baseline [m] of the disparity; 0 turns rounding off.
      disparity_step: disparity resolution, px.
      isotropic: standard deviation of noise added to x, y and z alike.
      jump_loss: probability to lose a pixel at a depth jump over 3 %.
      grazing_loss: probability to lose a pixel seen under less than 12 deg.
      mixing: probability that a pixel at a jump lies between the two surfaces.
    """

    floor: float | Float[Any, "*batch"]
    origin: float | Float[Any, "*batch"]
    quadratic: float | Float[Any, "*batch"]
    incidence: float | Float[Any, "*batch"]
    focal_baseline: float | Float[Any, "*batch"]
    disparity_step: float | Float[Any, "*batch"]
    isotropic: float | Float[Any, "*batch"]
    jump_loss: float | Float[Any, "*batch"]
    grazing_loss: float | Float[Any, "*batch"]
    mixing: float | Float[Any, "*batch"]


PRESETS: dict[str, Sensor] = {
    "none": Sensor(0.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0),
    "gauss3mm": Sensor(0.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.003, 0.0, 0.0, 0.0),
    "kinect": Sensor(0.0012, 0.4, 0.0019, 1.0, 570.0 * 0.075, 0.125, 0.0, 0.35, 0.6, 0.05),
    # D435: baseline 50 mm; noise z^2 * 0.08 px / (f B) with f = 640 px at 848 px width.
    "realsense": Sensor(0.0, 0.0, 0.0025, 0.5, 640.0 * 0.05, 1 / 32, 0.0, 0.3, 0.5, 0.15),
}
CAMERAS = ("kinect", "realsense")  # the presets that stand for what is sold


def sensor_mix(names: tuple[str, ...]) -> Sensor:
    """The presets of ``names`` stacked on a leading axis, one drawn per frame by ``draw_sensor``.

    Raises:
      CaperError: unknown preset.
    """
    for name in names:
        if name not in PRESETS:
            raise unknown_name("noise preset", name, PRESETS)
    return jax.tree.map(lambda *v: np.array(v, np.float32), *(PRESETS[name] for name in names))


def draw_sensor(key: PRNGKeyArray, mix: Sensor) -> Sensor:
    """One sensor of the mix, uniformly."""
    index = jax.random.randint(key, (), 0, jnp.shape(mix.floor)[0])
    return jax.tree.map(lambda values: jnp.asarray(values)[index], mix)


@flax.struct.dataclass
class SurfaceMap:
    """What the noise depends on, per pixel [...].

    Attributes:
      depth: meters.
      cosine: of the incidence angle, clipped to 0.17 (80 deg).
      jump: bool, a neighbor is missing or over 3 % nearer or farther.
      reach: meters from this surface to the farthest neighboring one behind it, 0 if none.
    """

    depth: Float[Any, "*pixels"]
    cosine: Float[Any, "*pixels"]
    jump: Bool[Any, "*pixels"]
    reach: Float[Any, "*pixels"]


def _shifted(image, fill):
    """The right, left, lower and upper neighbors of each pixel, four [H, W] arrays."""
    padded = jnp.pad(image, 1, constant_values=fill)
    return padded[1:-1, 2:], padded[1:-1, :-2], padded[2:, 1:-1], padded[:-2, 1:-1]


def surface_map(
    depth: Float[Any, "H W"],
    hit: Bool[Any, "H W"],
    rays: Sequence[Float[Any, "H W"]],
) -> SurfaceMap:
    """Incidence and depth jumps from finite differences of a clean depth image.

    Args:
      depth: [H, W] meters; arbitrary where ``hit`` is False.
      hit: [H, W] bool.
      rays: (x [H, W], y [H, W]) directions (x, y, 1).
    """
    x, y = rays
    depth = jnp.where(hit, depth, 0.0)
    right, left, down, up = _shifted(depth, 0.0)
    jump, reach = jnp.zeros_like(hit), jnp.zeros_like(depth)
    for other in (right, left, down, up):
        jump |= (other == 0.0) | (jnp.abs(other - depth) > 0.03 * depth)
        reach = jnp.maximum(reach, other - depth)
    # The plane of a planar patch is linear in inverse depth: 1/z = a x + b y + c, with normal
    # (a, b, c); the ray (x, y, 1) meets it at cosine (1/z) / (|normal| |ray|).
    # Across a jump there is no patch: take it as facing the axis there.
    inverse = 1.0 / jnp.maximum(depth, 1e-6)

    def along(other):
        smooth = jnp.abs(other - depth) <= 0.03 * depth
        return jnp.where(smooth, 1.0 / jnp.maximum(other, 1e-6), inverse)

    side, below = along(right), along(down)
    step_x = x[0, 1] - x[0, 0]
    step_y = y[1, 0] - y[0, 0]
    a = (side - inverse) / jnp.maximum(step_x, 1e-9)
    b = (below - inverse) / jnp.maximum(step_y, 1e-9)
    c = inverse - a * x - b * y
    norm = jax.lax.rsqrt((a * a + b * b + c * c) * (x * x + y * y + 1.0))
    return SurfaceMap(depth, jnp.clip(inverse * norm, 0.17, 1.0), jump, reach)


def valid_pixels(
    key: PRNGKeyArray, sensor: Sensor, surface: SurfaceMap, hit: Bool[Any, "*pixels"]
) -> Bool[Array, "*pixels"]:
    """[...] bool: the hits for which the sensor returns a depth."""
    uniform = jax.random.uniform(key, hit.shape)
    lost = surface.jump & (uniform < sensor.jump_loss)
    lost |= (surface.cosine < 0.2) & (uniform < sensor.grazing_loss)
    return hit & ~lost


def measure(
    key: PRNGKeyArray,
    sensor: Sensor,
    surface: SurfaceMap,
    rays: Sequence[Float[Any, "*pixels"]],
) -> Float[Array, "*pixels 3"]:
    """Measured points [..., 3], meters, camera frame, for pixels of any shape [...]."""
    normal_key, uniform_key = jax.random.split(key)
    x, y = rays
    depth = surface.depth
    angle = jnp.arccos(surface.cosine)
    grazing = (angle / (jnp.pi / 2 - angle)) ** 2 * 1e-4 / jnp.sqrt(jnp.maximum(depth, 0.1))
    axial = sensor.floor + sensor.quadratic * (depth - sensor.origin) ** 2
    sigma = axial + sensor.incidence * grazing
    normal = jax.random.normal(normal_key, (4, *depth.shape))
    z = depth + sigma * normal[0]
    # Mixed pixels lie part of the way to the surface behind.
    uniform = jax.random.uniform(uniform_key, (2, *depth.shape))
    mixed = (uniform[0] < sensor.mixing) & surface.jump
    z = jnp.where(mixed, z + uniform[1] * surface.reach, z)
    focal_baseline = jnp.maximum(sensor.focal_baseline, 1e-6)
    steps = jnp.round(focal_baseline / jnp.maximum(z, 0.05) / sensor.disparity_step)
    rounded = focal_baseline / (jnp.maximum(steps, 1.0) * sensor.disparity_step)
    z = jnp.where(sensor.focal_baseline > 0, rounded, z)
    points = jnp.stack([x * z, y * z, z], -1)
    return points + sensor.isotropic * jnp.moveaxis(normal[1:], 0, -1)
