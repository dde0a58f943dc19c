"""The two presets: `paper` as published, `fast` for CPUs."""

from __future__ import annotations

from caper_jax.errors import unknown_name
from caper_jax.networks.caper import NetworkConfig
from caper_jax.networks.heads import HeadConfig

PRESETS: dict[str, NetworkConfig] = {
    # As published: stage I, then stage II. Correcting stage I's pose is ours.
    "paper": NetworkConfig(encoder="hs", corrections=0),
    "fast": NetworkConfig(
        encoder="fast",
        root_heads=HeadConfig(widths=(256, 256, 256), dropout=0.0, pool_first=True),
        pooled_heads=HeadConfig(widths=(256, 256, 256), dropout=0.0, pool_first=True),
        point_heads=HeadConfig(widths=(64, 64, 64), dropout=0.0),
        turn_width=64,
        sides_width=256,
        point_stride=4,
    ),
}


def preset(name: str) -> NetworkConfig:
    """The network sizes of a preset.

    Raises:
      CaperError: unknown name.
    """
    if name not in PRESETS:
        raise unknown_name("preset", name, PRESETS)
    return PRESETS[name]
