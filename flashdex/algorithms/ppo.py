"""PPO on the tracking environment: one learner a hand, rollouts of compact states."""

from __future__ import annotations

from functools import lru_cache
from typing import Any, cast

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn

from flashdex import keys
from flashdex.algorithms.base import Learner, TaskSpec, register, snapshot
from flashdex.algorithms.config import AlgoConfig
from flashdex.algorithms.footprint import (
    Footprint,
    Networks,
    run_backward,
    tensor_bytes,
)
from flashdex.algorithms.inputs import HandRows, make_encoder
from flashdex.errors import RunError
from flashdex.modules.gaussian_policy import GaussianPolicy, RunningNorm, ValueNet
from flashdex.modules.layers import restore_generator
from flashdex.objectives.ppo import PPO, bootstrap_rows
from flashdex.objectives.reward_normalizer import RewardNormalizer

CHUNK = 4096  # rows assembled at once


class PPOInputs:
    """Observation and future window with running statistics of both."""

    def __init__(self, rows: HandRows, device: torch.device) -> None:
        self.rows, self.transforms = rows, rows.transforms
        widths = {keys.OBSERVATION: rows.observation_dim}
        if rows.future_shape is not None:
            widths[keys.FUTURE] = rows.future_shape[0]
        self.keys = list(widths)
        norms = {key: RunningNorm(width) for key, width in widths.items()}
        self.norms = nn.ModuleDict(norms).to(device)

    @property
    def fitted(self) -> bool:
        """Whether the statistics have seen any row."""
        return bool(self.norm(keys.OBSERVATION).count > 0)

    def norm(self, key: str) -> RunningNorm:
        """Statistics of one input."""
        norm = self.norms[key]
        assert isinstance(norm, RunningNorm)
        return norm

    def raw(self, state: TensorDictBase) -> TensorDict:
        """Inputs of compact states (B,), and the mask of the groups, (B, G).

        A row that is not finite has its mask off.
        """
        parts = []
        for chunk in state.split(CHUNK):
            seen = self.rows.assemble(chunk)
            row: dict[str, Tensor] = {key: seen[key] for key in self.keys}
            mask = self.rows.groups.mask(seen[keys.GROUP_MASK])
            for value in row.values():
                mask = mask & value.flatten(1).isfinite().all(-1, keepdim=True)
            row[keys.GROUP_MASK] = mask
            parts.append(TensorDict(row, chunk.batch_size))
        return cast(TensorDict, torch.cat(parts))

    @torch.no_grad()
    def scaled(self, raw: TensorDictBase) -> TensorDict:
        """Normalised inputs, (B,)."""
        # NaN would outlive a mask or a termination: 0 x NaN is NaN.
        values = {k: torch.nan_to_num(self.norm(k)(raw[k])) for k in self.keys}
        return TensorDict(values, raw.batch_size)

    def __call__(self, state: TensorDictBase) -> TensorDict:
        """Normalised inputs of compact states, (B,)."""
        return self.scaled(self.raw(state))

    def track(self, raw: TensorDictBase) -> None:
        """Merge rows into the statistics; those without any group are left out."""
        used = raw[keys.GROUP_MASK].any(-1)
        for key in self.keys:
            self.norm(key).update(raw[key][used])


STEP = ("action", "reward", "finite", "terminated", "done")


@register("ppo")
class PPOLearner(Learner):
    """The paper's PPO baseline.

    Each group of hands is a PPO learner of its own on the common observation. Attempt
    worlds act deterministically and are not learnt from: their actions are not samples
    of the policy. Nor are steps of a motion that a hand takes no part in.

    Rewards are scaled as FlashSAC's are, by the running spread of the discounted
    return, but over other worlds: here attempt worlds are left out of the statistics,
    there they count, so that the two learners see about the same numbers, not the same.
    """

    def __init__(self, config: AlgoConfig, spec: TaskSpec) -> None:
        self.config, self.device = config, spec.device
        self.generator = torch.Generator(self.device).manual_seed(spec.seed)
        torch.manual_seed(spec.seed)
        rows = HandRows(config, spec)
        self.bank, self.groups = rows.bank, rows.groups
        self.inputs = PPOInputs(rows, self.device)
        self.agents = {
            name: make_ppo(config, rows, self.generator) for name in self.groups.names
        }
        self.normalizer = RewardNormalizer(
            spec.example.batch_size[0],
            len(self.groups.names),
            gamma=config.gamma,
            bound=config.v_max,
        ).to(self.device)
        # looked up once: which worlds attempt never changes
        self._train_rows = (
            (~spec.example[keys.ATTEMPT].squeeze(-1)).nonzero().squeeze(-1)
        )
        self._dropped = torch.zeros((), dtype=torch.int64, device=self.device)
        self._updates = 0
        self._rollout: list[TensorDict] = []

    @torch.no_grad()
    def act(self, state: TensorDictBase, *, explore: bool = True) -> Tensor:
        """See ``Learner.act``.

        Samples are not clipped, so that their log-probability is that of the Gaussian;
        the environment clips.
        """
        inputs = self.inputs(state)
        mean = self._join(inputs, explore=False).clamp(-1.0, 1.0)
        if not explore:
            return mean
        noisy = self._join(inputs, explore=True)
        return torch.where(state[keys.ATTEMPT].unsqueeze(-1), mean, noisy)

    def _join(self, inputs: TensorDict, *, explore: bool) -> Tensor:
        actions = TensorDict({}, inputs.batch_size)
        for name, agent in self.agents.items():
            actions.set((name, keys.ACTION), agent.act(inputs, explore=explore))
        return self.groups.join(actions)

    def process_step(
        self,
        state: TensorDictBase,
        action: Tensor,
        reward: Tensor,
        next_state: TensorDictBase,
        terminated: Tensor,
        done: Tensor,
    ) -> None:
        """Update the reward statistics and append the training worlds to the rollout.

        Steps whose reward is not finite are counted and not learnt from.
        """
        train = ~state[keys.ATTEMPT]
        active = self.bank.hand_active[state[keys.MOTION].squeeze(-1)]
        reward = self.groups.rewards(reward)
        finite = reward.isfinite()
        self._dropped += (~finite & train).any(-1).sum()
        reward = torch.where(finite, reward, 0.0)
        counts = self.groups.mask(active) & train & finite
        self.normalizer.update(reward, done, counts)
        step = TensorDict(
            {
                "state": state.select(*keys.STATE),
                "next_state": next_state.select(*keys.STATE),
                "action": action,
                "finite": finite,
                "reward": reward,
                "terminated": terminated,
                "done": done,
            },
            [len(action)],
        )
        self._rollout.append(cast(TensorDict, step[self._train_rows]))

    def num_updates(self) -> int:
        """1 once the rollout is full; the first one only sets the input statistics."""
        if len(self._rollout) < self.config.ppo.horizon:
            return 0
        if self.inputs.fitted:
            return 1
        rollout = self._stacked().reshape(-1)
        self.inputs.track(self.inputs.raw(rollout.get("state")))
        self._rollout.clear()
        return 0

    def _stacked(self) -> TensorDict:
        return cast(TensorDict, TensorDict.stack(self._rollout, 1))  # (N, T)

    def batches(self) -> tuple[dict[str, TensorDict], TensorDict, TensorDict]:
        """What the groups learn from in the present rollout.

        Returns:
            rows of each group, (N, T), and their tail, both as
            `flashdex.objectives.ppo.PPO` wants them; the raw inputs, (N T,).
        """
        rollout = self._stacked()
        size = rollout.batch_size
        steps: dict[str, Tensor] = {key: rollout[key] for key in STEP}
        raw = self.inputs.raw(rollout.get("state").reshape(-1))
        inputs: Any = self.inputs.scaled(raw).unflatten(0, size)
        # Elsewhere the next state is the state of the next row.
        ends = bootstrap_rows(steps["done"].squeeze(-1))
        tail = self.inputs(rollout.get("next_state")[ends])
        joint = steps["action"].flatten(-2).flatten(0, 1)
        actions = self.groups.actions(joint)
        active: Any = raw[keys.GROUP_MASK]
        mask = active.unflatten(0, size) & steps["finite"]
        reward = steps["reward"] / self.normalizer.denominator()
        found = {}
        for i, name in enumerate(self.groups.names):
            one = slice(i, i + 1)
            after = {"reward": reward[..., one]}
            after.update({key: steps[key] for key in ("terminated", "done")})
            values: dict[str, Any] = dict(inputs.items())
            values["action"] = actions[i].unflatten(0, size)
            values["mask"] = mask[..., one]
            found[name] = TensorDict({**values, "next": TensorDict(after, size)}, size)
        return found, tail, raw

    def update(self) -> TensorDict:
        """Learn from the rollout, all epochs, and drop it; returns the metrics."""
        batches, tail, raw = self.batches()
        self._rollout.clear()
        report = TensorDict({}, [])
        for name, agent in self.agents.items():
            report.set(name, agent.learn(batches[name], tail))
        self.inputs.track(raw)  # only now: the rollout was collected with the old ones
        self._updates += 1
        return report

    @property
    def num_dropped(self) -> int:
        """Steps whose reward was not finite; waits for the device."""
        return int(self._dropped)

    @property
    def updates(self) -> int:
        """Rollouts learnt from so far."""
        return self._updates

    @property
    def num_rows(self) -> int:
        """Rows of the open rollout."""
        return sum(len(step) for step in self._rollout)

    def forget_episodes(self) -> None:
        """Drop the open rollout and the running returns."""
        self._rollout.clear()
        self.normalizer.clear_returns()

    def state_dict(self) -> dict[str, Any]:
        """A copy of all but the open rollout."""
        state = {
            "agents": {name: a.state_dict() for name, a in self.agents.items()},
            "inputs": self.inputs.norms.state_dict(),
            "normalizer": self.normalizer.state_dict(),
            "generator": self.generator.get_state(),
            "updates": self._updates,
            "dropped": self.num_dropped,
        }
        return snapshot(state)

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore ``state_dict``; the rollout begins anew.

        Raises:
            RunError: the state is that of another algorithm or of other groups.
        """
        if set(state.get("agents", ())) != set(self.agents):
            raise RunError(
                "the checkpoint is not one of PPO with the groups "
                f"{', '.join(self.agents)}: an override changed algo.kind or "
                "algo.groups. Resume without it, or start a new run."
            )
        state = snapshot(state)  # Adam keeps the very tensors it is given
        for name, agent in self.agents.items():
            agent.load_state_dict(state["agents"][name])
        self.inputs.norms.load_state_dict(state["inputs"])
        self.normalizer.load_state_dict(state["normalizer"])
        restore_generator(self.generator, state["generator"])
        self._updates = state["updates"]
        self._dropped.fill_(state["dropped"])
        self._rollout.clear()

    def rehearse(self, config: AlgoConfig, state: TensorDictBase) -> Footprint:
        """See ``Learner.rehearse``; an observation is kept.

        It lies there raw, scaled, and as a copy for each group.
        """
        row: Any = self.inputs(state)[:1].to("meta")
        agents = [nn.ModuleList([a.policy, a.value]) for a in self.agents.values()]
        policy, value = one = agents[0].to("meta")

        def update(size: int) -> tuple[int, float]:
            rows = row.expand(size).clone()
            seen = (rows[keys.OBSERVATION], rows.get(keys.FUTURE, None))

            def compute() -> Tensor:
                mean, std = policy(*seen)
                return (mean / std).sum() + value(*seen).sum()

            peak, flops = run_backward(compute, one)
            return peak + tensor_bytes(seen), flops

        each = (2 + len(agents)) * tensor_bytes(list(row.values()))
        networks = Networks.of(nn.ModuleList(agents))
        return Footprint(networks, each, lru_cache(update))

    @classmethod
    def gentler(cls, config: AlgoConfig) -> str:
        """See ``Learner.gentler``."""
        return f"algo.ppo.lr={config.ppo.lr / 2:g}"

    @classmethod
    def row_count(cls, config: AlgoConfig, num_envs: int) -> int:
        """Rows of a rollout."""
        return num_envs * config.ppo.horizon

    @classmethod
    def batch_rows(cls, config: AlgoConfig, num_envs: int) -> int:
        """Rows of a minibatch."""
        return -(-cls.row_count(config, num_envs) // config.ppo.minibatches)


def make_ppo(config: AlgoConfig, rows: HandRows, generator: torch.Generator) -> PPO:
    """Networks, loss and optimiser of one group."""
    ppo, width, shape = config.ppo, rows.observation_dim, rows.future_shape
    policy = GaussianPolicy(
        width,
        rows.action_dim,
        hidden=ppo.hidden,
        init_std=ppo.init_std,
        encoder=make_encoder(config, shape, 1),
    )
    value = ValueNet(width, hidden=ppo.hidden, encoder=make_encoder(config, shape, 1))
    device = generator.device
    return PPO(
        policy.to(device),
        value.to(device),
        gamma=config.gamma,
        gae_lambda=ppo.gae_lambda,
        clip=ppo.clip,
        value_clip=ppo.value_clip,
        value_coef=ppo.value_coef,
        entropy_coef=ppo.entropy_coef,
        lr=ppo.lr,
        target_kl=ppo.target_kl,
        max_grad_norm=ppo.max_grad_norm,
        epochs=ppo.epochs,
        minibatches=ppo.minibatches,
        generator=generator,
    )
