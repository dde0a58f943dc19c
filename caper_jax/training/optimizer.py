"""Optimizers and the flat-and-anneal schedule (Ranger, as used to train HS-Pose).

Ranger is RAdam (Liu et al. 2020) on centralized gradients (Yong et al. 2020) inside Lookahead
(Zhang et al. 2019). No optimizer's state depends on the learning rate, which is why the builders
below take the rate of *this* step, possibly a traced scalar: one compiled step serves a run bounded
by steps and a run bounded by minutes, and vmap trains with many rates side by side.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax

from caper_jax.config import OptimizerName, TrainingConfig
from caper_jax.errors import unknown_name

PyTree = Any
ScalarLike = jax.typing.ArrayLike  # of shape []; may be traced

_FLAT_UNTIL = 0.72  # progress at which the cosine begins
_WARMUP_START = 0.001  # first factor of the linear warm-up


def flat_and_anneal(
    progress: np.ndarray | float, step: np.ndarray | int, warmup: int
) -> np.ndarray | np.floating:
    """Learning-rate factor: linear warm-up, flat to 72 % of the run, cosine to 0.

    On the host, in float64: it must not wait for the device. Of many steps at once, for a scan.

    Args:
      progress: [...] fraction of the run that is done, in [0, 1].
      step: [...] number of steps done so far.
      warmup: steps of the warm-up from 0.001 to 1; 0 for none.

    Returns:
      [...] factor in [0, 1] by which the base learning rate is multiplied.
    """
    ramp = _WARMUP_START + (1.0 - _WARMUP_START) * np.asarray(step) / max(warmup, 1)
    fall = np.clip((np.asarray(progress) - _FLAT_UNTIL) / (1.0 - _FLAT_UNTIL), 0.0, 1.0)
    return np.where(np.asarray(step) < warmup, ramp, 1.0) * 0.5 * (1.0 + np.cos(np.pi * fall))


def centralize_gradients() -> optax.GradientTransformation:
    """Subtract from every kernel's gradient its mean over all axes but the last.

    The last axis of a Flax kernel is its output, so each output unit's weights keep a zero-mean
    gradient; vectors and scalars (biases, norm scales) pass unchanged. ``optax.centralize`` keeps
    the *first* axis instead, the output axis of PyTorch kernels.
    """

    def centralize(gradient: jax.Array) -> jax.Array:
        if gradient.ndim < 2:
            return gradient
        return gradient - jnp.mean(gradient, axis=tuple(range(gradient.ndim - 1)), keepdims=True)

    return optax.stateless(lambda updates, params: jax.tree.map(centralize, updates))


def ranger(
    learning_rate: ScalarLike,
    *,
    clip_norm: ScalarLike = 5.0,
    b1: float = 0.95,
    b2: float = 0.999,
    eps: float = 1e-5,
    threshold: float = 5.0,
    weight_decay: ScalarLike = 0.0,
    sync_period: int = 6,
    slow_step_size: float = 0.5,
) -> optax.GradientTransformation:
    """Ranger: global-norm clipping, gradient centralization, RAdam, Lookahead.

    Works on ``optax.LookaheadParams``: gradients are taken at ``fast``, ``slow`` is what to
    evaluate and to ship. ``eps`` is added to the bias-corrected root of the second moment.

    Args:
      learning_rate: rate of this step; may be traced, the state does not depend on it.
      clip_norm: bound on the global norm of the gradient, before centralization.
      b1: decay of the first moment.
      b2: decay of the second moment.
      eps: added to the denominator.
      threshold: length of the approximated moving average from which RAdam rectifies; below it
        the step is plain momentum.
      weight_decay: decoupled weight decay.
      sync_period: fast steps between two synchronizations (k).
      slow_step_size: step of the slow weights towards the fast ones (alpha).
    """
    fast = optax.chain(
        optax.clip_by_global_norm(clip_norm),
        centralize_gradients(),
        optax.scale_by_radam(b1=b1, b2=b2, eps=eps, threshold=threshold),
        optax.add_decayed_weights(weight_decay),
        optax.scale_by_learning_rate(learning_rate),
    )
    return optax.lookahead(fast, sync_period=sync_period, slow_step_size=slow_step_size)


def adamw(
    learning_rate: ScalarLike,
    *,
    clip_norm: ScalarLike = 5.0,
    b1: float = 0.9,
    b2: float = 0.999,
    eps: float = 1e-8,
    weight_decay: ScalarLike = 0.0,
) -> optax.GradientTransformation:
    """AdamW behind global-norm clipping; ``weight_decay`` spares vectors (biases, norm scales)."""
    return optax.chain(
        optax.clip_by_global_norm(clip_norm),
        optax.scale_by_adam(b1=b1, b2=b2, eps=eps),
        optax.add_decayed_weights(
            weight_decay, mask=lambda params: jax.tree.map(lambda p: jnp.ndim(p) > 1, params)
        ),
        optax.scale_by_learning_rate(learning_rate),
    )


OPTIMIZERS = {"ranger": ranger, "adamw": adamw}


@dataclass(frozen=True)
class Optimizer:
    """One interface to Ranger and AdamW: initialize, then update with the factor of the step.

    A pytree of its numbers, which may be traced; bounds are checked where a configuration is read.

    Attributes:
      name: "ranger" or "adamw".
      learning_rate: base rate, multiplied by the schedule's factor.
      clip_norm: bound on the global norm of the gradient.
      weight_decay: decoupled weight decay.
    """

    name: OptimizerName = "ranger"
    learning_rate: ScalarLike = 1e-4
    clip_norm: ScalarLike = 5.0
    weight_decay: ScalarLike = 0.0

    @classmethod
    def of(cls, config: TrainingConfig) -> Optimizer:
        """The optimizer that a run's settings describe."""
        return cls(config.optimizer, config.learning_rate, config.clip_norm, config.weight_decay)

    def _transformation(self, factor: ScalarLike) -> optax.GradientTransformation:
        if self.name not in OPTIMIZERS:
            raise unknown_name("optimizer", self.name, OPTIMIZERS)
        return OPTIMIZERS[self.name](
            self.learning_rate * factor, clip_norm=self.clip_norm, weight_decay=self.weight_decay
        )

    def init(self, params: PyTree) -> tuple[PyTree, PyTree]:
        """Wrap the parameters as this optimizer keeps them, and make its state.

        Args:
          params: the network's parameters.

        Raises:
          CaperError: unknown name.

        Returns:
          (params, optimizer_state); with Ranger the parameters are a ``LookaheadParams`` whose
          slow half is a copy, because one buffer under two leaves cannot be donated twice.
        """
        if self.name == "ranger":
            params = optax.LookaheadParams(fast=params, slow=jax.tree.map(jnp.copy, params))
        return params, self._transformation(1.0).init(params)

    def update(
        self, gradients: PyTree, state: PyTree, params: PyTree, factor: ScalarLike
    ) -> tuple[PyTree, PyTree]:
        """One step.

        Args:
          gradients: of the loss at ``training_weights(params)``, same structure.
          state: optimizer state.
          params: as returned by `init`.
          factor: the schedule's factor of this step; may be traced.

        Returns:
          (new params, new optimizer state).
        """
        updates, state = self._transformation(factor).update(gradients, state, params)
        return optax.apply_updates(params, updates), state


jax.tree_util.register_dataclass(
    Optimizer,
    data_fields=["learning_rate", "clip_norm", "weight_decay"],
    meta_fields=["name"],
)


def training_weights(params: PyTree) -> PyTree:
    """The weights at which the loss is differentiated (the fast ones under Lookahead)."""
    return params.fast if isinstance(params, optax.LookaheadParams) else params


def evaluation_weights(params: PyTree) -> PyTree:
    """The weights to evaluate and to export (the slow ones under Lookahead)."""
    return params.slow if isinstance(params, optax.LookaheadParams) else params
