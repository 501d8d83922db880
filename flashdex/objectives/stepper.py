"""One FlashSAC update: actor, temperature, critic, target, in this order."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from flashdex.modules.layers import project_, restore_generator
from flashdex.modules.product import bfloat16_products
from flashdex.objectives.batch import FlashBatch, nested
from flashdex.objectives.flashsac import FlashSACLoss
from flashdex.objectives.optim import ScheduledAdam, TargetAverage
from flashdex.objectives.terms import Metrics

ACTOR_METRICS = ("loss_actor", "entropy", "q_value", "loss_alpha", "alpha")


class FlashSACStepper:
    """Owns the optimisers of a `FlashSACLoss` and performs updates.

    Every optimiser advances its own cosine once per own step, so that actor and
    temperature, which step every ``actor_period`` updates, end at mid-cosine.

    Args:
        loss: the objective, already on its device.
        lr: first learning rate.
        lr_end: last learning rate.
        total_updates: critic updates of the run; None keeps ``lr``.
        actor_lr_scale: factor on the actor's learning rates.
        actor_period: updates between two actor steps.
        actor_delay: critic updates before the first actor step.
        tau: rate of the target average.
        generator: source of the policy noise; None is the global one.
        compile: compile the two objectives.
        autocast: large matrix products in bfloat16, everything else in float32.

    Example:
        >>> stepper = FlashSACStepper(loss, total_updates=10_000)
        >>> metrics = stepper.update(buffer.sample())
    """

    def __init__(
        self,
        loss: FlashSACLoss,
        *,
        lr: float = 3e-4,
        lr_end: float = 1.5e-4,
        total_updates: int | None = None,
        actor_lr_scale: float = 1.0,
        actor_period: int = 2,
        actor_delay: int = 0,
        tau: float = 0.01,
        generator: torch.Generator | None = None,
        compile: bool = False,
        autocast: bool = False,
    ) -> None:
        self.loss = loss
        self.autocast = autocast
        self.actor_period, self.actor_delay = actor_period, actor_delay
        self.generator = generator
        self.updates = 0
        rates = {"peak": lr, "end": lr_end, "total": total_updates}
        scale = actor_lr_scale
        actor_rates = {**rates, "peak": scale * lr, "end": scale * lr_end}
        self.actor_optimizer = ScheduledAdam(
            loss.actor_network.parameters(), **actor_rates
        )
        self.alpha_optimizer = ScheduledAdam([loss.log_alpha], **rates)
        self.critic_optimizer = ScheduledAdam(loss.qvalue_network.parameters(), **rates)
        self.target_average = TargetAverage(
            loss.qvalue_network, loss.target_qvalue_network, tau=tau
        )
        self._actor_objective = loss.actor_objective
        self._qvalue_objective = loss.qvalue_objective
        if compile:
            self._actor_objective = torch.compile(loss.actor_objective)
            self._qvalue_objective = torch.compile(loss.qvalue_objective)
        zeros = torch.zeros(len(loss.groups), device=loss.log_alpha.device)
        self._zero = zeros[0]
        self._actor_metrics: Metrics = dict.fromkeys(ACTOR_METRICS, zeros)

    def update(
        self,
        tensordict: TensorDictBase,
        *,
        actor_noise: Tensor | None = None,
        target_noise: Tensor | None = None,
    ) -> TensorDict:
        """Perform one update.

        Args:
            tensordict: sampled batch of B transitions.
            actor_noise: standard normal draws of the actor loss, (G, B, A).
            target_noise: those of the next action in the target, (G, B, A).

        Returns:
            Detached metrics with the same keys every time: ``(group, name)``, and the
            learning rate at the root. Between actor steps the last actor values are
            repeated.
        """
        batch = self.loss.read(tensordict)
        waited = self.updates >= self.actor_delay
        rate = self.critic_optimizer.rate
        with bfloat16_products(self.autocast):
            if waited and self.updates % self.actor_period == 0:
                self._actor_step(batch, self._draw(batch, actor_noise))
            noise = self._draw(batch, target_noise)
            qvalue, critic_metrics = self._qvalue_objective(batch, noise)
            self.critic_optimizer.step(qvalue)
        project_(self.loss.qvalue_network)
        self.target_average.step()
        self.updates += 1
        return self._report(critic_metrics, rate)

    def _actor_step(self, batch: FlashBatch, noise: Tensor) -> None:
        loss, metrics = self._actor_objective(batch, noise)
        self.actor_optimizer.step(loss)
        project_(self.loss.actor_network)
        alpha_loss, alpha_metrics = self.loss.alpha_loss(
            metrics.pop("log_prob"), batch.weight
        )
        self.alpha_optimizer.step(alpha_loss)
        self._actor_metrics = {**metrics, **alpha_metrics}

    def _draw(self, batch: FlashBatch, noise: Tensor | None) -> Tensor:
        if noise is not None:
            return noise
        shape = (
            len(self.loss.groups),
            batch.size,
            self.loss.actor_network.action_dim,
        )
        return torch.randn(
            shape,
            generator=self.generator,
            dtype=batch.action.dtype,
            device=batch.action.device,
        )

    def _report(self, critic_metrics: Metrics, rate: float) -> TensorDict:
        report = TensorDict({}, [])
        for name, values in {**self._actor_metrics, **critic_metrics}.items():
            for group, value in zip(self.loss.groups, values.unbind(0), strict=True):
                report.set(nested(group, name), value)
        return report.set("learning_rate", torch.full_like(self._zero, rate))

    def state_dict(self) -> dict[str, Any]:
        """Everything an exact resume needs, the environments excepted."""
        state = {
            "loss": self.loss.state_dict(),
            "actor_optimizer": self.actor_optimizer.state_dict(),
            "alpha_optimizer": self.alpha_optimizer.state_dict(),
            "critic_optimizer": self.critic_optimizer.state_dict(),
            "updates": self.updates,
            "actor_metrics": dict(self._actor_metrics),
        }
        if self.generator is not None:
            state["generator"] = self.generator.get_state()
        return state

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore `state_dict`; the learner then continues bit-equal on the CPU."""
        self.loss.load_state_dict(state["loss"])
        self.actor_optimizer.load_state_dict(state["actor_optimizer"])
        self.alpha_optimizer.load_state_dict(state["alpha_optimizer"])
        self.critic_optimizer.load_state_dict(state["critic_optimizer"])
        self.updates = state["updates"]
        metrics = state["actor_metrics"].items()
        self._actor_metrics = {k: v.to(self._zero.device) for k, v in metrics}
        if self.generator is not None and "generator" in state:
            restore_generator(self.generator, state["generator"])
