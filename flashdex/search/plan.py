"""One pass over a motion: annealed sampling of knots, a receding horizon."""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import NDArray

from flashdex.hands.gains import NUM_WRIST_JOINTS
from flashdex.hands.spec import HandSpec
from flashdex.keys import SIDES
from flashdex.search.config import Rung, SearchConfig
from flashdex.search.costs import ErrorLimits, cost, shares
from flashdex.search.problem import Problem, Worlds

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Plan:
    """Actions of a motion, and how far they were decided."""

    actions: NDArray[np.float32]  # (S', 2, J); S' < S where it was given up
    is_whole: bool


def closing_directions(hand: HandSpec) -> Array:
    """How much each joint takes part when all fingers close, (J,) in [-1, 1].

    By how fast a joint brings the fingertips that it moves towards the middle of all
    five, in the middle of the joint ranges; the fastest counts 1. The wrist's are 0.
    """
    model = mujoco.MjModel.from_xml_string(hand.mjcf)
    data = mujoco.MjData(model)
    data.qpos[:] = model.jnt_range.mean(-1)
    mujoco.mj_forward(model, data)
    sites = [i for i in range(model.nsite) if model.site(i).name.startswith("pad_")]
    middle = data.site_xpos[sites].mean(0)
    speed, jacobian = np.zeros(model.nv), np.empty((3, model.nv))
    for site in sites:
        mujoco.mj_jacSite(model, data, jacobian, None, site)
        to = middle - data.site_xpos[site]
        speed += to / np.linalg.norm(to) @ jacobian
    return np.r_[np.zeros(NUM_WRIST_JOINTS), speed / np.abs(speed).max()]


class Planner:
    """Plans one motion by one rung of the ladder.

    Args:
        problem: of the motion.
        config: noise, weights and lengths.
        rung: what a pass may cost.
        limits: of the criterion.
        grace: first steps that are not scored.
        seed: of the noise, any sequence of numbers.
        start: actions of the first steps to draw around, (S', 2, J), S' <= S; None is
            playback, as are the steps after them.
    """

    def __init__(
        self,
        problem: Problem,
        config: SearchConfig,
        rung: Rung,
        *,
        limits: ErrorLimits,
        grace: int,
        seed: list[int],
        start: NDArray[np.float32] | None = None,
    ) -> None:
        self.problem, self.config, self.rung = problem, config, rung
        self.limits, self.grace = limits, grace
        self._rng = np.random.default_rng(seed)
        count = problem.steps // config.knot + 2
        steps = np.arange(problem.steps) / config.knot
        # of each step, linear between knots: (S, Q)
        self._basis = np.maximum(0, 1 - np.abs(steps[:, None] - np.arange(count)))
        hands, joints = len(problem.active), problem.num_joints
        self._knots = np.zeros((count, hands, joints))
        if start is not None:
            self._fit(start[:, problem.active].reshape(len(start), -1))
        fingers = joints - NUM_WRIST_JOINTS
        c = config
        one = np.r_[
            np.repeat(c.wrist_pos_noise / c.wrist_pos_bound, 3),
            np.repeat(c.wrist_rot_noise / c.wrist_rot_bound, 3),
            np.repeat(c.finger_noise / c.finger_bound, fingers),
        ]
        self._noise = np.tile(one * rung.spread, (hands, 1))
        specs = [problem.hands[SIDES[i]] for i in problem.active]
        size = rung.spread * c.squeeze_noise / c.finger_bound
        self._closing = size * np.stack([closing_directions(spec) for spec in specs])

    def _fit(self, actions: NDArray[np.float32]) -> None:
        """Set the knots that come nearest to actions of the first steps, (S', A J)."""
        basis = self._basis[: len(actions)]
        used = basis.any(0)
        found, *_ = np.linalg.lstsq(basis[:, used], actions, rcond=None)
        shape = (-1, *self._knots.shape[1:])
        self._knots[used] = found.reshape(shape).clip(-1, 1)

    def _draw(self, count: int, knots: int) -> Array:
        """Noise of knots, (N, Q, A, J): partly constant, and hands that close."""
        share, normal = self.config.constant_share, self._rng.normal
        rest = np.sqrt(1 - share**2)
        shape = self._noise.shape

        def mixed(*width: int) -> Array:
            held = normal(size=(count, 1, *width))
            return share * held + rest * normal(size=(count, knots, *width))

        own = mixed(*shape) * self._noise
        return own + mixed(shape[0], 1) * self._closing

    def _window(self, worlds: Worlds, first: int, stop: int) -> NDArray[np.float32]:
        """Anneal the knots of steps ``first`` to ``stop``; the best actions there."""
        problem, config, rung = self.problem, self.config, self.rung
        used = np.flatnonzero(self._basis[first:stop].any(0))
        basis = self._basis[first:stop, used]
        best = middle = self._knots[used]
        lowest = np.inf
        for turn in range(rung.rounds):
            noise = self._draw(rung.samples, len(used)) * config.anneal**turn
            tried = middle + noise
            tried[0], tried[1] = middle, best
            tried = tried.clip(-1, 1)
            actions = problem.spread(np.einsum("hq,nqaj->nhaj", basis, tried))
            trial = problem.simulate(worlds, actions, first)
            costs = cost(trial, tried, self._noise, problem, config, first, self.limits)
            order = np.argsort(costs, kind="stable")
            middle = tried[order[: config.elite]].mean(0)
            if costs[order[0]] < lowest:
                best, lowest = tried[order[0]], costs[order[0]]
        self._knots[used] = best
        return problem.spread(np.einsum("hq,qaj->haj", basis, best))

    def run(self) -> Plan:
        """One pass; it is given up once the errors so far are beyond the limits."""
        problem, stride = self.problem, self.config.stride
        worlds, first = problem.worlds(self.rung.worlds), 0
        total = np.zeros((2, len(problem.slots)))
        done: list[NDArray[np.float32]] = []
        while first < problem.steps:
            stop = min(problem.steps, first + self.rung.horizon)
            actions = self._window(worlds, first, stop)[:stride]
            trial = problem.simulate(worlds, actions[None], first)
            done.append(actions)
            found = shares(trial, problem, first, self.limits)
            scored = slice(max(0, self.grace - first), None)
            for i, errors in enumerate((found.pos, found.rot)):
                total[i] += errors[0, 0, scored].sum(0)
            worlds = worlds.after(trial.states[0, :, -1])
            first += len(actions)
            if total.max() > problem.steps - self.grace:
                break
        return Plan(np.concatenate(done), first >= problem.steps)
