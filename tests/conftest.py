"""Tests run on the CPU, seen by JAX as eight devices; float64 only inside ``jax.enable_x64``.

Arrays are held to the shapes and dtypes that the package's annotations say (jaxtyping).
"""

from __future__ import annotations

import os
from pathlib import Path

# Before anything imports jax: a GPU would be slower here, and round differently.
os.environ["JAX_PLATFORMS"] = "cpu"
# Most programs run once, and compile in half the time without what makes them run faster.
os.environ["XLA_FLAGS"] = (
    f"{os.environ.get('XLA_FLAGS', '')} "
    "--xla_backend_optimization_level=0 --xla_cpu_use_fusion_emitters=false"
)
# Commands that tests run leave the cache of whoever runs the tests alone.
os.environ["CAPER_CACHE"] = "off"

import _helpers.typechecker
import jax
import pytest
from jax.experimental.compilation_cache import compilation_cache
from jaxtyping import install_import_hook

jax.config.update("jax_num_cpu_devices", 8)
install_import_hook("caper_jax", f"{_helpers.typechecker.__name__}.check")


# Files that take longest come first, so that no worker is left alone with one at the end.
LONGEST = (
    "test_examples",
    "test_tracker",
    "test_estimator",
    "test_train",
    "test_train_many",
    "test_objective",
    "test_benchmarks",
    "test_step",
    "test_uncertainty",
    "test_refiner",
    "test_loop",
    "test_export",
)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    rank = {name: number for number, name in enumerate(LONGEST)}
    items.sort(key=lambda item: rank.get(item.path.stem, len(rank)))


@pytest.fixture(scope="session", autouse=True)
def compiled_once(tmp_path_factory: pytest.TempPathFactory) -> None:
    """What one test has compiled, the others find, also in other processes of this run."""
    folder = tmp_path_factory.getbasetemp()
    if "PYTEST_XDIST_WORKER" in os.environ:
        folder = folder.parent
    settings = {
        "jax_compilation_cache_dir": str(folder / "compiled"),
        "jax_compilation_cache_max_size": 2**32,  # with a limit it is locked while it is written
        "jax_persistent_cache_min_compile_time_secs": 0.3,
    }
    for name, value in settings.items():
        jax.config.update(name, value)
        os.environ[name.upper()] = str(value)  # of commands that tests run
    compilation_cache.reset_cache()  # looks at the folder when first used, only


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """Folder of real sample data beside the repository; the test is skipped where absent."""
    folder = Path(__file__).resolve().parents[2] / "shared" / "data"
    if not folder.is_dir():
        pytest.skip(f"no sample data at {folder}")
    return folder
