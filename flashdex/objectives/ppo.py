"""One PPO learner: TorchRL's clipped loss and advantage estimate, with minibatches."""

from __future__ import annotations

from collections import defaultdict
from typing import Any, cast

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule
from torch import Tensor
from torchrl.modules import IndependentNormal, ProbabilisticActor
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value import GAE

from flashdex.modules.gaussian_policy import GaussianPolicy, ValueNet
from flashdex.objectives.stepper import check_moments

# A wide observation leaves room for small steps only: rates near 1e-5 are usual.
LR_FACTOR, LR_RANGE = 1.5, (1e-6, 1e-2)
METRICS = ("loss_policy", "loss_value", "entropy", "kl", "ratio_clipped")
METRICS += ("explained_variance", "gradient_norm")


def bootstrap_rows(done: Tensor) -> Tensor:
    """Rows (N, T) whose next state is not the next row: ends and the last step."""
    rows = done.clone()
    rows[:, -1] = True
    return rows


def steered_rate(rate: Tensor, kl: Tensor, target: float) -> Tensor:
    """Learning rate / 1.5 above twice the target divergence, x 1.5 below half of it."""
    low = torch.where(kl < 0.5 * target, rate * LR_FACTOR, rate)
    return torch.where(kl > 2.0 * target, rate / LR_FACTOR, low).clamp(*LR_RANGE)


def sampled_kl(out: TensorDictBase) -> Tensor:
    """``E[r - 1 - log r]`` from the output of the clipped loss, r = new / old.

    The divergence of old from new: never negative, and of far smaller variance than
    ``E[-log r]``.
    """
    return (out["mean_ratio"] - 1.0 + out["kl_approx"]).detach()


def _standardised(x: Tensor) -> Tensor:
    """``(x - mean) / std`` over all rows; no rows stay no rows."""
    centred = x - x.mean()
    return centred / (centred.square().mean().sqrt() + 1e-8)


class _ClipLoss(ClipPPOLoss):
    """TorchRL's loss without its look at the entropy, which waits for the device."""

    def _get_entropy(
        self, dist: torch.distributions.Distribution, adv_shape: torch.Size
    ) -> Tensor:
        return dist.entropy().unsqueeze(-1)


class PPO:
    """Owns policy, value and optimiser, and learns from whole rollouts.

    Rollouts are TensorDicts of batch (N, T): ``observation`` (D), ``future`` (C, K) if
    the networks have an encoder, ``action`` (A) before any clipping, ``mask`` (1) bool
    of the rows that count, and under ``next`` ``reward``, ``done``, ``terminated`` (1).

    Args:
        policy: Gaussian policy, on the device of everything else.
        value: state value.
        gamma: discount.
        gae_lambda: decay of the advantage estimate.
        clip: of the probability ratio.
        value_clip: of the value's step away from that of the rollout; None is free.
        value_coef: weight of the value loss.
        entropy_coef: weight of the entropy.
        lr: first learning rate.
        target_kl: divergence that the learning rate is steered to; None is constant.
        max_grad_norm: of all parameters together.
        epochs: passes over a rollout.
        minibatches: gradient steps a pass.
        generator: source of actions and minibatches; None is the global one.
    """

    def __init__(
        self,
        policy: GaussianPolicy,
        value: ValueNet,
        *,
        gamma: float,
        gae_lambda: float = 0.95,
        clip: float = 0.2,
        value_clip: float | None = None,
        value_coef: float = 1.0,
        entropy_coef: float = 0.0,
        lr: float = 1e-3,
        target_kl: float | None = None,
        max_grad_norm: float = 1.0,
        epochs: int = 5,
        minibatches: int = 4,
        generator: torch.Generator | None = None,
    ) -> None:
        self.policy, self.value, self.lr = policy, value, lr
        self.target_kl, self.max_grad_norm = target_kl, max_grad_norm
        self.epochs, self.minibatches = epochs, minibatches
        self.generator = generator
        self.in_keys: list[Any] = ["observation"]
        if policy.body.encoder is not None:
            self.in_keys.append("future")
        self.gae = GAE(gamma=gamma, lmbda=gae_lambda, value_network=None)
        self.loss = self._make_loss(
            clip_epsilon=clip,
            clip_value=value_clip,
            critic_coeff=value_coef,
            entropy_coeff=entropy_coef,
        )
        self.parameters = [*policy.parameters(), *value.parameters()]
        # As a tensor the rate is steered without waiting for the device.
        rate = torch.tensor(lr, device=policy.log_std.device)
        self.optimizer = torch.optim.Adam(self.parameters, lr=rate, fused=True)

    def _make_loss(self, **options: Any) -> _ClipLoss:
        actor = ProbabilisticActor(
            TensorDictModule(self.policy, self.in_keys, ["loc", "scale"]),
            in_keys=["loc", "scale"],
            distribution_class=IndependentNormal,
        )
        critic = TensorDictModule(self.value, self.in_keys, ["state_value"])
        options |= {"loss_critic_type": "l2", "functional": False}
        loss = _ClipLoss(actor, critic, **options)
        loss.set_keys(action="action", sample_log_prob="log_prob")
        if options["clip_value"] is not None:
            # as a buffer it would be read on the host at every step
            del loss.clip_value
            loss.clip_value = options["clip_value"]
        return loss

    def _inputs(self, td: TensorDictBase) -> list[Tensor]:
        return [td[key] for key in self.in_keys]

    @torch.no_grad()
    def act(self, td: TensorDictBase, *, explore: bool) -> Tensor:
        """Actions (B, A): a sample, or the mean; neither is clipped."""
        mean, std = self.policy(*self._inputs(td))
        if not explore:
            return mean
        noise = torch.randn(mean.shape, generator=self.generator, device=mean.device)
        return mean + std * noise

    @torch.no_grad()
    def estimate(self, rollout: TensorDictBase, tail: TensorDictBase) -> TensorDictBase:
        """Add values, advantages, value targets and log-probabilities to a rollout.

        A row that ends an episode without termination bootstraps from the state it
        ended in; a terminated one from nothing.

        Args:
            rollout: batch (N, T).
            tail: inputs of the states after the rows of `bootstrap_rows`, in row-major
                order, batch (E,).
        """
        size, flat = rollout.batch_size, rollout.reshape(-1)
        value = self.value(*self._inputs(flat)).unflatten(0, size)
        after = torch.cat([value[:, 1:], value[:, -1:]], 1)
        ends = bootstrap_rows(rollout["next", "done"].squeeze(-1))
        after[ends] = self.value(*self._inputs(tail))
        rollout.set("state_value", value).set(("next", "state_value"), after)
        mean, std = self.policy(*self._inputs(flat))
        log_prob = IndependentNormal(mean, std).log_prob(flat["action"])
        rollout.set("log_prob", log_prob.unflatten(0, size))
        return self.gae(rollout)

    def learn(self, rollout: TensorDictBase, tail: TensorDictBase) -> TensorDict:
        """Learn from a rollout of the present policy; see `estimate` for the arguments.

        Returns:
            Metrics, means over the gradient steps; 0 where no row counts.
        """
        rollout = self.estimate(rollout, tail)
        rows = cast(TensorDict, rollout[rollout["mask"].squeeze(-1)])
        rows.set("advantage", _standardised(rows.get("advantage")))
        zero = torch.zeros((), device=self.rate.device)
        sums: dict[str, Tensor] = defaultdict(lambda: zero)
        steps = 0
        for _ in range(self.epochs if len(rows) else 0):
            options = {"generator": self.generator, "device": zero.device}
            order = torch.randperm(len(rows), **options)
            for chosen in order.chunk(self.minibatches):
                for name, metric in self._step(rows[chosen], steps == 0).items():
                    sums[name] = sums[name] + metric.detach().mean()
                steps += 1
        report = TensorDict({k: sums[k] / max(steps, 1) for k in METRICS}, [])
        report.set("std", self.policy.log_std.detach().exp().mean())
        return report.set("learning_rate", self.rate.clone())

    @property
    def rate(self) -> Tensor:
        """Learning rate of the coming step."""
        return self.optimizer.param_groups[0]["lr"]

    def _step(self, batch: TensorDictBase, is_first: bool) -> dict[str, Tensor]:
        out = self.loss(batch)
        kl = sampled_kl(out)
        if self.target_kl is not None and not is_first:
            # The first step has a divergence of exactly 0, which says nothing.
            self.rate.copy_(steered_rate(self.rate, kl, self.target_kl))
        total = out["loss_objective"] + out["loss_critic"] + out["loss_entropy"]
        total.backward()
        norm = torch.nn.utils.clip_grad_norm_(self.parameters, self.max_grad_norm)
        self.optimizer.step()
        self.optimizer.zero_grad(set_to_none=True)
        return {
            "loss_policy": out["loss_objective"],
            "loss_value": out["loss_critic"],
            "entropy": out["entropy"],
            "kl": kl,
            "ratio_clipped": out["clip_fraction"],
            "explained_variance": out["explained_variance"],
            "gradient_norm": norm,
        }

    def state_dict(self) -> dict[str, Any]:
        """Networks and optimiser; the generator belongs to the caller."""
        return {
            "policy": self.policy.state_dict(),
            "value": self.value.state_dict(),
            "optimizer": self.optimizer.state_dict(),
            "lr": self.lr,
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore ``state_dict``.

        The steered rate goes on, unless this learner was given another first rate than
        the one of the state: then it starts again from there.
        """
        self.policy.load_state_dict(state["policy"])
        self.value.load_state_dict(state["value"])
        self.optimizer.load_state_dict(state["optimizer"])
        check_moments(self.optimizer)
        # Adam leaves the rate on the device it was stored from.
        group = self.optimizer.param_groups[0]
        group["lr"] = group["lr"].to(self.policy.log_std.device)
        if state["lr"] != self.lr:
            group["lr"] = torch.full_like(self.rate, self.lr)
