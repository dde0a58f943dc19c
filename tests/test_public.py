"""The public surface: every name in ``__all__`` is there, and importing it costs nothing."""

from __future__ import annotations

import subprocess
import sys

import pytest

import caper_jax


@pytest.mark.parametrize("name", caper_jax.__all__)
def test_every_public_name_is_there(name):
    assert getattr(caper_jax, name) is not None
    assert name in dir(caper_jax)


def test_the_import_loads_nothing_else():
    """The promise is 0.1 s beyond JAX and Flax; nothing is far below, on any machine."""
    code = "import caper_jax, sys; print([m for m in sys.modules if m in ('jax', 'numpy', 'flax')])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_what_is_not_public_is_named():
    with pytest.raises(AttributeError, match="attribute lod"):
        caper_jax.lod  # noqa: B018
