"""When the virtual-object assist fades (method section 11)."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from flashdex.system.fields import number

if TYPE_CHECKING:
    from flashdex.envs.mdp.step import StepResult
    from flashdex.envs.mdp.term import Gate
    from flashdex.envs.tracking import TrackingEnv


class AssistSchedule:
    """Decides when the assist fades, epoch by epoch.

    The dial-back is evaluated before the gates and pops an explicit stack of levels,
    so that it can act; in the released code it stands behind a gate that excludes it.
    """

    def __init__(self, config: AssistConfig) -> None:
        self.config = config
        self.upper = (config.kp, config.kv)  # present gains
        self.lower = (config.kp, config.kv)  # lower end of the per-world draw
        self._levels: list[tuple[tuple[float, float], tuple[float, float]]] = []
        self._history: deque[tuple[float, float, float, float]] = deque(
            maxlen=config.window_epochs
        )
        self.epoch = 0
        self._changed_at = 0

    @property
    def active(self) -> bool:
        """Whether any wrench is left."""
        return self.config.enabled and self.upper[0] > 0

    def end_epoch(
        self, task: float, imitation: float, cloning: float, completion: float
    ) -> bool:
        """Record one epoch's means; return True when the gains changed.

        Args:
            task: weighted object term summed over hands, 0..1.
            imitation: weighted hand-tracking reward.
            cloning: behaviour-cloning reward.
            completion: share of episodes that ended without failure; 1 without ends.
        """
        self.epoch += 1
        self._history.append((task, imitation, cloning, completion))
        if not self.active:
            return False
        return self._dial_back() or self._decay()

    def _means(self) -> tuple[float, ...]:
        rows = list(self._history)
        return tuple(sum(r[i] for r in rows) / len(rows) for i in range(4))

    def _dial_back(self) -> bool:
        c = self.config
        waited = self.epoch - self._changed_at > c.dial_back_epochs
        if not (c.dial_back and self._levels and waited):
            return False
        if self._means()[3] >= c.dial_back_completion:
            return False
        upper, lower = self._levels.pop()
        factor = c.dial_back_factor
        self.upper = (upper[0] * factor, upper[1] * factor)
        self.lower = (lower[0] * factor, lower[1] * factor)
        self._restart()
        return True

    def _decay(self) -> bool:
        c = self.config
        if self.epoch < c.wait_epochs:
            return False
        if self._changed_at and self.epoch - self._changed_at < c.cooldown_epochs:
            return False
        task, imitation, cloning, completion = self._means()
        gates = (
            task >= c.task_gate
            and imitation >= c.imitation_gate
            and cloning >= c.bc_gate
            and completion >= c.completion_gate
        )
        if not gates:
            return False
        self._levels.append((self.upper, self.lower))
        self.upper = (self.upper[0] * c.decay, self.upper[1] * c.decay)
        self.lower = (self.upper[0] * c.lower_ratio, self.upper[1] * c.lower_ratio)
        if self.upper[0] < c.zero_below:
            self.upper = self.lower = (0.0, 0.0)
        elif self.lower[0] < c.lower_zero_below:
            self.lower = (0.0, 0.0)
        self._restart()
        return True

    def _restart(self) -> None:
        self._history.clear()
        self._changed_at = self.epoch

    def draw(self, num_envs: int, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        """Draw each world's gains uniformly between lower and upper, (N,) each."""
        device = generator.device
        share = torch.rand(num_envs, generator=generator, device=device)
        kp = self.lower[0] + share * (self.upper[0] - self.lower[0])
        kv = self.lower[1] + share * (self.upper[1] - self.lower[1])
        return kp, kv

    def state_dict(self) -> dict[str, Any]:
        """Everything that a resumed run needs."""
        return {
            "upper": self.upper,
            "lower": self.lower,
            "levels": list(self._levels),
            "history": list(self._history),
            "epoch": self.epoch,
            "changed_at": self._changed_at,
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore ``state_dict``."""
        self.upper, self.lower = tuple(state["upper"]), tuple(state["lower"])
        self._levels = [(tuple(u), tuple(v)) for u, v in state["levels"]]
        self._history.clear()
        self._history.extend(tuple(row) for row in state["history"])
        self.epoch, self._changed_at = state["epoch"], state["changed_at"]


class AssistEpoch:
    """Collects what decides whether the assist may fade.

    Only assisted worlds count: attempt worlds have no assist, so their failures say
    nothing about it. Hands without a part in the motion are left out. What a step adds
    stays on its device; the host waits for it once an epoch. ``gates`` are the rewards
    that count, in order, and what for.
    """

    def __init__(self, gates: Mapping[str, Gate]) -> None:
        self.gates = gates
        self._clear()

    def _clear(self) -> None:
        self._names: tuple[str, ...] = ()
        # sums of the terms, then entries, ends and failures
        self._totals: Tensor | None = None

    def step(
        self,
        env: TrackingEnv,
        result: StepResult,
        done: Tensor,
        terminated: Tensor,
        vector_steps: int,
    ) -> None:
        """Take in a vector step of ``env``; at the end of an epoch let its assist fade.

        ``vector_steps`` counts those of the run, this one included.
        """
        if env.assist is None:
            return
        self.add(result, ~env.attempt, done, terminated)
        ends = vector_steps % env.assist.config.epoch_steps == 0
        if ends and env.assist.end_epoch(**self.pop()):
            env.redraw_assist()

    def add(
        self, result: StepResult, assisted: Tensor, done: Tensor, terminated: Tensor
    ) -> None:
        """Take in a vector step; the worlds ``assisted`` count, (N,) bool."""
        counts = result.active & assisted.unsqueeze(-1)
        terms = torch.nan_to_num(torch.stack(list(result.reward_terms.values())))
        sums = torch.where(counts, terms, 0.0).sum((1, 2))
        numbers = [
            counts.sum(),
            (done.squeeze(-1) & assisted).sum(),
            (terminated.squeeze(-1) & assisted).sum(),
        ]
        total = torch.cat([sums.double(), torch.stack(numbers).double()])
        names = tuple(result.reward_terms)
        if self._totals is not None and names == self._names:
            total = total + self._totals.to(total.device)  # a checkpoint's: on the CPU
        self._names, self._totals = names, total

    def _read(self) -> tuple[dict[str, float], float, int, int]:
        """Sums of the terms, entries, ends and failures."""
        if self._totals is None:
            return {}, 0.0, 0, 0
        *sums, count, ended, failed = self._totals.tolist()
        return dict(zip(self._names, sums, strict=True)), count, int(ended), int(failed)

    def pop(self) -> dict[str, float]:
        """Means since the last call, each 0..1: arguments of ``end_epoch``."""
        sums, number, ended, failed = self._read()

        def found(gate: Gate) -> list[float]:
            return [sums[n] for n, g in self.gates.items() if g == gate and n in sums]

        def mean(values: list[float]) -> float:
            count = len(values) * number
            return sum(values) / count if count else 0.0

        task = next((value for value in found("task") if value), 0.0)
        out = {
            "task": mean([task]),
            "imitation": mean(found("imitation")),
            "cloning": mean(found("cloning")),
            "completion": 1.0 - failed / ended if ended else 1.0,
        }
        self._clear()
        return out

    def state_dict(self) -> dict[str, Any]:
        """Sums of the open epoch."""
        sums, count, ended, failed = self._read()
        return {"sums": sums, "count": count, "ended": ended, "failed": failed}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore ``state_dict``."""
        self._names = tuple(state["sums"])
        numbers = [state[name] for name in ("count", "ended", "failed")]
        values = [*state["sums"].values(), *numbers]
        self._totals = torch.tensor(values, dtype=torch.float64)


@dataclass(frozen=True, kw_only=True)
class AssistConfig:
    """PD wrench on the objects that fades while the policy learns.

    F = kp (x_ref - x) + kv (v_ref - v);
    tau = I_w [ratio kp rotvec(R_ref R^T) + sqrt(ratio) kv (w_ref - w)].
    An epoch is `epoch_steps` control steps of all worlds.
    """

    enabled: bool = False
    """Off by default; the released code has it on for 63 % of training."""
    kp: float = number(80.0, low=0, high=1e6)
    """Stiffness at the start, N/m."""
    kv: float = number(5.0, low=0, high=1e6)
    """Damping at the start, N s/m."""
    torque_ratio: float = number(96.0, low=0, high=1e6)
    """Angular over linear stiffness; its square root for the damping."""
    force_limit: float = number(50.0, low=0, high=1e6)
    """Clamp of each force component, N."""
    torque_limit: float = number(50.0, low=0, high=1e6)
    """Clamp of each torque component, N m."""
    epoch_steps: int = number(32, low=1, high=10**6)
    """Control steps an epoch."""
    window_epochs: int = number(30, low=1, high=10**6)
    """Epochs over which the gates are averaged; cleared at each decay."""
    wait_epochs: int = number(100, low=0, high=10**9)
    """Epochs before the first decay."""
    cooldown_epochs: int = number(40, low=0, high=10**9)
    """Epochs between two decays; shorter frees the object sooner."""
    decay: float = number(0.9, above=0, high=1)
    """Factor of the upper gain at each decay."""
    lower_ratio: float = number(0.8, low=0, high=1)
    """Lower end of the per-world draw over the upper one, after a decay."""
    zero_below: float = number(0.05, low=0, high=1e6)
    """All gains become zero once the upper kp is below this."""
    lower_zero_below: float = number(0.1, low=0, high=1e6)
    """The lower end becomes zero once it is below this."""
    task_gate: float = number(0.6, low=0, high=1)
    """Weighted object term, summed over hands, that a decay demands."""
    imitation_gate: float = number(0.01, low=0, high=1e6)
    """Imitation reward that a decay demands."""
    bc_gate: float = number(0.01, low=0, high=1e6)
    """Behaviour-cloning reward that a decay demands."""
    completion_gate: float = number(0.65, low=0, high=1)
    """Share of episodes without failure that a decay demands."""
    dial_back: bool = False
    """Return one gain level when completion falls; evaluated before the gates. The
    released code has the rule in an order that never acts."""
    dial_back_completion: float = number(0.5, low=0, high=1)
    """Completion below which a level is returned."""
    dial_back_epochs: int = number(500, low=0, high=10**9)
    """Epochs since the last decay before a level may be returned."""
    dial_back_factor: float = number(0.98, above=0, high=1)
    """Factor on the returned level."""
