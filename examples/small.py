"""What ``--quick`` trains: networks that compile in seconds and learn next to nothing."""

from dataclasses import replace

import caper_jax as caper


def small(config: caper.RunConfig, steps: int) -> caper.RunConfig:
    """The run with narrow networks, few points and shapes, and so many steps."""
    network = config.network
    narrow = replace(network.root_heads, widths=(8, 8, 8))
    network = replace(
        network,
        fast=replace(network.fast, centers=16, scales=(0.3,), width=8, blocks=1, last=8),
        root_heads=narrow,
        pooled_heads=narrow,
        point_heads=replace(network.point_heads, widths=(8, 8, 8)),
        rotation_classifier=replace(network.rotation_classifier, width=0),
        refiner=replace(network.refiner, width=0),
        num_points=64,
    )
    training = replace(config.training, steps=steps, minutes=None, batch_size=4, log_steps=1)
    return replace(
        config,
        network=network,
        data=caper.GeneratorConfig(instances=8, grid=32, num_points=64),
        training=training,
        calibration_frames=0,
    )
