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
from flashdex.search.costs import Costs, ErrorLimits, cost, shares
from flashdex.search.problem import Problem, Worlds

Array = NDArray[np.float64]
# strides gone back from the one in which an object is lost, and one more each time that
# it gets no further
BACK = 2
EFFORT = 2.0  # factor of samples there, and of the noise squared


@dataclass(frozen=True)
class Plan:
    """Actions of a motion, and how far they were decided."""

    actions: NDArray[np.float32]  # (S', 2, J); S' < S where it was given up
    is_whole: bool


@dataclass(frozen=True)
class _Mark:
    """How far a pass has come, to go back to."""

    worlds: Worlds
    total: Array  # errors of position and rotation so far, in limits, (2, O)
    done: list[NDArray[np.float32]]  # strides of actions
    knots: Array

    @property
    def step(self) -> int:
        """The control step that comes next."""
        return sum(len(actions) for actions in self.done)

    def rank(self) -> tuple[int, float]:
        """Of what is beyond the limits, or nearly: farther on first, then nearer."""
        return self.step, -float(self.total.max())


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

    def _window(
        self, worlds: Worlds, first: int, stop: int, effort: float
    ) -> NDArray[np.float32]:
        """Anneal the knots of steps ``first`` to ``stop``; the best actions there."""
        problem, config, rung = self.problem, self.config, self.rung
        used = np.flatnonzero(self._basis[first:stop].any(0))
        basis = self._basis[first:stop, used]
        best = middle = self._knots[used]
        lowest = np.inf
        for turn in range(rung.rounds):
            noise = self._draw(round(rung.samples * effort), len(used))
            noise *= config.anneal**turn * effort**0.5
            tried = middle + noise
            tried[0], tried[1] = middle, best
            tried = tried.clip(-1, 1)
            actions = problem.spread(np.einsum("hq,nqaj->nhaj", basis, tried))
            costs = self._costs(worlds, actions, tried, first)
            order = np.argsort(costs.total, kind="stable")
            middle = tried[order[: config.elite]].mean(0)
            if costs.total[order[0]] < lowest:
                best, lowest = tried[order[0]], costs.total[order[0]]
            if costs.error[order[0]] < config.enough:
                break
        self._knots[used] = best
        return problem.spread(np.einsum("hq,qaj->haj", basis, best))

    def _costs(
        self, worlds: Worlds, actions: NDArray[np.float32], knots: Array, first: int
    ) -> Costs:
        """Costs of N sequences; only those that do well nominally are perturbed."""

        def found(worlds: Worlds, some: NDArray[np.intp]) -> Costs:
            trial = self.problem.simulate(worlds, actions[some], first)
            given = (knots[some], self._noise, self.problem, self.config)
            return cost(trial, *given, first, self.limits)

        nominal = found(worlds.only(slice(1)), np.arange(len(actions)))
        rest = len(worlds.models) - 1
        if not rest:
            return nominal
        most = max(self.config.elite, len(actions) // 4)
        best = np.argsort(nominal.total, kind="stable")[:most]
        perturbed = found(worlds.only(slice(1, None)), best)
        out = Costs(np.full(len(actions), np.inf), np.full(len(actions), np.inf))
        for name in ("total", "error"):
            one, others = getattr(nominal, name)[best], getattr(perturbed, name)
            getattr(out, name)[best] = (one + rest * others) / (1 + rest)
        return out

    def run(self) -> Plan:
        """One pass; it is given up once the errors so far are beyond the limits.

        Where an object is lost, the pass goes back some strides and tries harder there,
        as often as the rung allows.
        """
        problem, rung = self.problem, self.rung
        at = _Mark(
            problem.worlds(rung.worlds),
            np.zeros((2, len(problem.slots))),
            [],
            self._knots.copy(),
        )
        marks, retries, depth, until = [at], rung.retries, 0, 0
        left: list[_Mark] = []  # where it went back, but might have gone on
        over: list[_Mark] = []  # where it was beyond the limits
        while at.step < problem.steps:
            at, error = self._advance(at, EFFORT if at.step < until else 1.0)
            is_over = at.total.max() > problem.steps - self.grace
            if (is_over or error > self.config.lost) and retries:
                (over if is_over else left).append(at)
                # deeper each time that it gets no further
                depth = depth + 1 if at.step <= until else 1
                retries, until = retries - 1, max(until, at.step)
                marks = marks[: max(1, len(marks) - BACK - depth)]
                at = marks[-1]
                self._knots = at.knots.copy()
            elif is_over and left:
                over.append(at)
                at, left = max(left, key=_Mark.rank), []
                self._knots = at.knots.copy()
            elif is_over:
                at = max([*over, at], key=_Mark.rank)
                break
            else:
                marks.append(at)
        return Plan(np.concatenate(at.done), at.step >= problem.steps)

    def _advance(self, at: _Mark, effort: float) -> tuple[_Mark, float]:
        """Decide the next stride and play it; the mean error in it, in limits.

        ``effort`` is a factor of the samples, and of their noise squared.
        """
        problem, first = self.problem, at.step
        stop = min(problem.steps, first + self.rung.horizon)
        actions = self._window(at.worlds, first, stop, effort)[: self.config.stride]
        trial = problem.simulate(at.worlds, actions[None], first)
        pose = trial.object_pos, trial.object_quat
        found = shares(*pose, problem, first, self.limits)
        scored = slice(max(0, self.grace - first), None)
        total = at.total + np.stack(
            [errors[0, 0, scored].sum(0) for errors in (found.pos, found.rot)]
        )
        worlds = at.worlds.after(trial.states[0, :, -1])
        error = float(found.worst.mean())
        return _Mark(worlds, total, [*at.done, actions], self._knots.copy()), error
