"""Tests run on the CPU, seen by JAX as eight devices; float64 only inside ``jax.enable_x64``.

Arrays are held to the shapes and dtypes that the package's annotations say (jaxtyping).
"""

from __future__ import annotations

import os
from pathlib import Path

# Before anything imports jax: a GPU would be slower here, and round differently.
os.environ["JAX_PLATFORMS"] = "cpu"
# Commands that tests run leave the cache of whoever runs the tests alone.
os.environ["CAPER_CACHE"] = "off"

import _helpers.typechecker
import jax
import pytest
from jax.experimental.compilation_cache import compilation_cache
from jaxtyping import install_import_hook

jax.config.update("jax_num_cpu_devices", 8)
install_import_hook("caper_jax", f"{_helpers.typechecker.__name__}.check")


@pytest.fixture(scope="session", autouse=True)
def compiled_once(tmp_path_factory: pytest.TempPathFactory) -> None:
    """What one test has compiled, the others of this process find."""
    jax.config.update("jax_compilation_cache_dir", str(tmp_path_factory.mktemp("compiled")))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.5)
    compilation_cache.reset_cache()  # looks at the folder when first used, only


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """Folder of real sample data beside the repository; the test is skipped where absent."""
    folder = Path(__file__).resolve().parents[2] / "shared" / "data"
    if not folder.is_dir():
        pytest.skip(f"no sample data at {folder}")
    return folder
