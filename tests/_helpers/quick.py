"""Programs that run once: compiling without optimization takes half the time."""

from __future__ import annotations

from functools import partial

import jax

quick_jit = partial(jax.jit, compiler_options={"xla_backend_optimization_level": 0})
