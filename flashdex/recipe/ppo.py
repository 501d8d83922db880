"""Schema of the PPO baseline: what it has and FlashSAC has not."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

from flashdex.system.fields import number


@dataclass(frozen=True, kw_only=True)
class PPOConfig:
    """Read with `algo.kind=ppo` only.

    PPO also reads `groups`, `gamma`, `v_max` and the `future_` sizes of `algo`.
    """

    horizon: int = number(24, low=1)
    """Vector steps of a rollout; the training worlds times this are its rows."""
    epochs: int = number(5, low=1)
    """Passes over a rollout."""
    minibatches: int = number(4, low=1)
    """Gradient steps a pass."""
    lr: float = number(1e-3, above=0)
    """Learning rate at the start, and always without a target_kl."""
    target_kl: float | None = number(0.01, above=0)
    """Divergence from the policy of the rollout that the learning rate is steered to:
    above twice as much it falls by 1.5, below half of it rises; null = constant."""
    clip: float = number(0.2, above=0, high=1)
    """Probability ratios count between 1 - clip and 1 + clip."""
    gae_lambda: float = number(0.95, low=0, high=1)
    """Decay of the advantage estimate; 1 is the whole return, 0 one step."""
    value_coef: float = number(1.0, above=0)
    """Weight of the squared value error."""
    value_clip: float | None = number(0.2, above=0)
    """Farthest a value moves from that of the rollout, normalised rewards; null = any
    distance."""
    entropy_coef: float = number(0.0, low=0)
    """Weight of the entropy of the policy."""
    max_grad_norm: float = number(1.0, above=0)
    """Gradients of a hand's actor and value together are scaled down to this norm."""
    init_std: float = number(0.2, above=0)
    """Standard deviation of the actions at the start, the same in every state."""
    hidden: list[int] = dataclasses.field(default_factory=lambda: [512, 256, 128])
    """Widths of the hidden layers of actor and value."""
