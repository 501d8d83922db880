"""One FlashSAC update: actor, temperature, critic, target, in this order."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn
from torch.optim.swa_utils import get_ema_multi_avg_fn

from flashdex.modules.layers import project_, restore_generator
from flashdex.modules.product import bfloat16_products
from flashdex.objectives.batch import FlashBatch, nested
from flashdex.objectives.flashsac import FlashSACLoss, Metrics

ACTOR_METRICS = ("loss_actor", "entropy", "q_value", "loss_alpha", "alpha")


def cosine_rate(step: int, total: int | None, *, peak: float, end: float) -> float:
    """``end + (peak - end) / 2 (1 + cos(pi step / total))``; constant without a total.

    Args:
        step: steps already taken by this optimiser.
        total: horizon, the number of critic updates of the run; None is constant.
        peak: first learning rate.
        end: last learning rate.
    """
    if total is None:
        return peak
    phase = math.pi * min(step, total) / total
    return end + 0.5 * (peak - end) * (1.0 + math.cos(phase))


class ScheduledAdam:
    """Adam (.9, .999, 1e-8, no decay) that advances its own cosine once a step.

    Args:
        parameters: what to train.
        peak: first learning rate.
        end: last learning rate.
        total: horizon of the cosine in critic updates; None keeps ``peak``.
    """

    def __init__(
        self,
        parameters: Iterable[nn.Parameter],
        *,
        peak: float = 3e-4,
        end: float = 1.5e-4,
        total: int | None = None,
    ) -> None:
        self.peak, self.end, self.total = peak, end, total
        self.steps = 0
        self.adam = torch.optim.Adam(list(parameters), lr=peak, fused=True)

    @property
    def rate(self) -> float:
        """Learning rate of the coming step."""
        return cosine_rate(self.steps, self.total, peak=self.peak, end=self.end)

    def step(self, loss: Tensor) -> None:
        """Differentiate ``loss``, step, clear the gradients, advance the schedule."""
        loss.backward()
        for group in self.adam.param_groups:
            group["lr"] = self.rate
        self.adam.step()
        self.adam.zero_grad(set_to_none=True)
        self.steps += 1

    def state_dict(self) -> dict[str, Any]:
        """Moments and schedule position."""
        return {"adam": self.adam.state_dict(), "steps": self.steps}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore `state_dict`."""
        self.adam.load_state_dict(state["adam"])
        check_moments(self.adam)
        self.steps = state["steps"]


def check_moments(optimizer: torch.optim.Optimizer) -> None:
    """Refuse moments of other shapes than their parameters, which torch takes as is.

    Raises:
        ValueError: one differs.
    """
    for parameter, moments in optimizer.state.items():
        for key in ("exp_avg", "exp_avg_sq"):
            if moments[key].shape != parameter.shape:
                raise ValueError(
                    f"{key} has shape {tuple(moments[key].shape)}, its parameter "
                    f"{tuple(parameter.shape)}"
                )


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

    _PARTS = ("loss", "actor_optimizer", "alpha_optimizer", "critic_optimizer")

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

        def adam(
            parameters: Iterable[nn.Parameter], scale: float = 1.0
        ) -> ScheduledAdam:
            ends = {"peak": scale * lr, "end": scale * lr_end}
            return ScheduledAdam(parameters, total=total_updates, **ends)

        self.actor_optimizer = adam(loss.actor_network.parameters(), actor_lr_scale)
        self.alpha_optimizer = adam([loss.log_alpha])
        self.critic_optimizer = adam(loss.qvalue_network.parameters())
        # parameters only: BatchNorm buffers of the target are its own
        self._online = [p.detach() for p in loss.qvalue_network.parameters()]
        self._target = [p.detach() for p in loss.target_qvalue_network.parameters()]
        self._average = get_ema_multi_avg_fn(1.0 - tau)
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
        self.average_target()
        self.updates += 1
        return self._report(critic_metrics, rate)

    @torch.no_grad()
    def average_target(self) -> None:
        """``theta_t <- theta_t + tau (theta - theta_t)`` on parameters only."""
        self._average(self._target, self._online, None)

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
        shape = (len(self.loss.groups), batch.size, self.loss.actor_network.action_dim)
        like = {"dtype": batch.action.dtype, "device": batch.action.device}
        return torch.randn(shape, generator=self.generator, **like)

    def _report(self, critic_metrics: Metrics, rate: float) -> TensorDict:
        report = TensorDict({}, [])
        for name, values in {**self._actor_metrics, **critic_metrics}.items():
            for group, value in zip(self.loss.groups, values.unbind(0), strict=True):
                report.set(nested(group, name), value)
        return report.set("learning_rate", torch.full_like(self._zero, rate))

    def state_dict(self) -> dict[str, Any]:
        """Everything an exact resume needs, the environments excepted."""
        state = {
            **{name: getattr(self, name).state_dict() for name in self._PARTS},
            "updates": self.updates,
            "actor_metrics": dict(self._actor_metrics),
        }
        if self.generator is not None:
            state["generator"] = self.generator.get_state()
        return state

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore `state_dict`; the learner then continues bit-equal on the CPU."""
        for name in self._PARTS:
            getattr(self, name).load_state_dict(state[name])
        self.updates = state["updates"]
        metrics = state["actor_metrics"].items()
        self._actor_metrics = {k: v.to(self._zero.device) for k, v in metrics}
        if self.generator is not None and "generator" in state:
            restore_generator(self.generator, state["generator"])
