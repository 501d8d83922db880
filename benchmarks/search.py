"""A round of the search: controls, rollouts, costs, beside MuJoCo C on one core.

`physics=warp` tries the samples in MuJoCo Warp; where they lead to is compared, too.
Both play in turn in one process.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from statistics import median
from typing import Any

import numpy as np
import torch
from torch.utils.benchmark import timer

from benchmarks.common import output
from benchmarks.common.ceilings import memory_gb
from benchmarks.common.library import describe_scene
from flashdex.envs.physics.make import engine_device
from flashdex.envs.physics.state_map import StateMap
from flashdex.envs.scene.scene import SceneLayout, rebuild_scene
from flashdex.recipe import SearchRecipe, expect_kind
from flashdex.search.costs import ErrorLimits, cost
from flashdex.search.problem import Problem
from flashdex.search.simulate import MujocoC, Warp, make_simulator
from flashdex.training.build import RunBuilder

FEW = 16  # sequences that MuJoCo C plays
SIZE = 0.3  # of the actions, standard deviation


def main(words: Sequence[str] = ()) -> dict[str, Any]:
    """Measure, and print one JSON object; it is returned."""
    parser = output.make_parser("search", __doc__)
    output.add_recipe_options(parser)
    add = parser.add_argument
    add("--samples", type=int, default=64, help="sequences of actions (%(default)s)")
    add("--worlds", type=int, default=1, help="that each is tried in (%(default)s)")
    add("--horizon", type=int, default=36, help="control steps (%(default)s)")
    add("--seconds", type=float, default=10.0, help="how long")
    args = parser.parse_intermixed_args(words)
    composed = output.compose_bench(args, changes=["task=search"])
    asked = expect_kind(composed, SearchRecipe, where="search")
    recipe = asked.in_action_space()
    builder = RunBuilder.from_recipe(recipe, device=torch.device("cpu"))
    one = Round(recipe, builder, args.samples, args.worlds, args.horizon)
    result = {
        "benchmark": "search",
        "recipe": recipe.name,
        "engine": recipe.search.engine,
        "samples": args.samples,
        "worlds": args.worlds,
        "horizon": one.steps,
        "decimation": recipe.physics.decimation,
        **describe_scene(builder.library),
        **one.measure(args.seconds),
        "memory_gb": memory_gb(engine_device(asked.physics)),
    }
    return output.emit(result, out=args.out)


class Round:
    """One round of a window at the beginning of a recipe's first motion."""

    def __init__(
        self,
        recipe: SearchRecipe,
        builder: RunBuilder,
        samples: int,
        worlds: int,
        horizon: int,
    ) -> None:
        library, hands, physics = builder.library, builder.hands, recipe.physics
        layout = SceneLayout.of(library)
        scene = rebuild_scene(library, 0, hands, physics, layout, nodes=0)
        self.problem = Problem(
            *(builder.bank, hands, StateMap(library, hands, scene), scene, 0),
            env=recipe.env,
            decimation=physics.decimation,
        )
        self.search = recipe.search
        self.limits = ErrorLimits.of(recipe.train.criterion)
        self.truth = MujocoC(self.problem.model, physics.decimation)
        self.play = make_simulator(recipe.search.engine, physics) or self.truth
        self.steps = min(horizon, self.problem.steps)
        self.worlds = self.problem.worlds(worlds)
        hand = (len(self.problem.active), self.problem.num_joints)
        rng = np.random.default_rng(0)
        self.knots = SIZE * rng.normal(size=(samples, self.steps, *hand))

    def turn(self) -> dict[str, float]:
        """One round: ms of its parts, of ``truth``, and mm ``gap`` to MuJoCo C."""
        problem, knots, ms = self.problem, self.knots, {}

        def timed(name: str, call: Callable[..., Any], *given: Any) -> Any:
            begin = timer()
            found = call(*given)
            ms[name] = 1e3 * (timer() - begin)
            return found

        ctrl = timed("controls", problem.controls, problem.spread(knots), 0)
        found = timed("rollout", self.play, self.worlds, ctrl, 0)
        trial = problem.trial(*found)
        noise = np.full(knots.shape[2:], SIZE)
        given = (trial, knots, noise, problem, self.search, 0, self.limits)
        timed("cost", cost, *given)
        states, _ = timed("truth", self.truth, self.worlds, ctrl[:FEW], 0)
        pos = 1 + problem.adr[:, None] + np.arange(3)
        gap = np.abs(found[0][:FEW, :, -1, pos] - states[:, :, -1, pos])
        return {**ms, "gap": 1e3 * float(np.median(gap))}

    def measure(self, seconds: float) -> dict[str, Any]:
        """Rates over turns of so many seconds, after two that are not counted."""
        begin = timer()
        self.turn()
        first_s = timer() - begin  # compiles
        self.turn()  # records
        begin, turns = timer(), [self.turn()]
        while timer() - begin < seconds:
            turns.append(self.turn())
        ms = {name: median(turn[name] for turn in turns) for name in turns[0]}
        gap, samples = ms.pop("gap"), len(self.knots)
        one = ms.pop("truth") / min(FEW, samples)
        return {
            "samples_per_s": round(1e3 * samples / sum(ms.values()), 1),
            "rollout_samples_per_s": round(1e3 * samples / ms["rollout"], 1),
            "cpu_samples_per_s": round(1e3 / one, 1),
            "ratio": round(samples * one / ms["rollout"], 3),
            "ms_by_part": {name: round(value, 2) for name, value in ms.items()},
            "gap_mm": round(gap, 6),
            "first_s": round(first_s, 2),
            "turns": len(turns),
            "overflow": self.play.overflow if isinstance(self.play, Warp) else {},
        }


if __name__ == "__main__":
    output.run(main)
