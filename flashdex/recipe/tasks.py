"""The kinds of recipes: what can be trained, told apart by the key ``task``."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any, Literal, TypeVar

from flashdex.algorithms import find_algorithm, known_algorithms
from flashdex.algorithms.config import AlgoConfig
from flashdex.envs.config import GymConfig
from flashdex.envs.mdp.term import KINDS as TERM_KINDS
from flashdex.envs.mdp.term import default_mapping, registry, terms_of
from flashdex.errors import FlashdexError, nearest
from flashdex.hands import known_hands
from flashdex.recipe.run import LoopConfig
from flashdex.recipe.schema import Expectation, Recipe, RunRecipe
from flashdex.recipe.store import DEFAULT_TASK, GYM_TASK, SEARCH_TASK
from flashdex.search.config import SearchConfig


def find_conflicts(recipe: Recipe) -> list[str]:
    """Return one line for each thing that does not fit together."""
    checks = (_hand, _motions, _rate, _solver, _algo, _env, _expect)
    return [problem for check in checks for problem in check(recipe)]


def _hand(recipe: Recipe) -> list[str]:
    known = known_hands()
    if recipe.hand in known:
        return []
    close = nearest(recipe.hand, known)
    return [f"hand: '{recipe.hand}' is not a hand.{close} Known: {', '.join(known)}."]


def _motions(recipe: Recipe) -> list[str]:
    motions = recipe.motions
    if motions.library is None and motions.source is None:
        return [
            "motions: neither library nor source is given; set motions.library to a "
            "prepared folder or motions.source to procedural"
        ]
    if motions.library is not None:
        return []
    if motions.source not in ("procedural", "myodm") and motions.input is None:
        return [f"motions.input: missing; the source '{motions.source}' reads a folder"]
    return []


def _rate(recipe: Recipe) -> list[str]:
    physics, hz = recipe.physics, recipe.motions.control_hz
    step = physics.decimation * physics.timestep
    if abs(step * hz - 1) < 1e-3:
        return []
    return [
        f"physics.timestep: {physics.decimation} substeps of {physics.timestep:.6g} s "
        f"make {step:.6g} s, but motions.control_hz={hz:g} asks for {1 / hz:.6g} s; "
        f"set physics.timestep={1 / hz / physics.decimation:.8g}"
    ]


def _solver(recipe: Recipe) -> list[str]:
    physics = recipe.physics
    if physics.solver != "pgs" or physics.engine == "cpu":
        return []
    return [
        f"physics.solver: pgs is not available with physics.engine={physics.engine}; "
        "use newton or cg, or physics=cpu"
    ]


def _algo(recipe: Recipe) -> list[str]:
    return algo_conflicts(recipe, {"env.num_envs": recipe.env.num_envs})


def algo_conflicts(recipe: Recipe | GymRecipe, worlds: dict[str, int]) -> list[str]:
    """Return what does not fit between algorithm, task, budget and worlds.

    Args:
        recipe: of either kind.
        worlds: their number, by the recipe key that gives it.
    """
    algo, task = recipe.algo, recipe.task
    try:
        learner = find_algorithm(algo.kind)
    except FlashdexError as error:
        return [str(error)]
    if task not in learner.tasks:
        able = [name for name, a in known_algorithms().items() if task in a.tasks]
        return [
            f"algo.kind: '{algo.kind}' is not available with task: {task}; use "
            f"{' or '.join(able)}"
        ]
    return learner.conflicts(algo, recipe.total_env_steps, worlds)


def _env(recipe: Recipe) -> list[str]:
    env = recipe.env
    problems = []
    if env.attempt_share > 0 and round(env.attempt_share * env.num_envs) == 0:
        problems.append(
            f"env.attempt_share: {env.attempt_share} of {env.num_envs} worlds is none, "
            f"so nothing could ever be converted; give at least {1 / env.num_envs:.3g}"
        )
    if not any(options is not None for options in env.transforms.values()):
        problems.append("env.transforms: all are off; the policy would see nothing")
    if env.attempt_share >= 1:
        problems.append(
            "env.attempt_share: 1 leaves no world to explore; use less than 1"
        )
    gates = {term.gate for term, _ in terms_of("rewards", env.rewards).values()}
    for name, (term, _) in terms_of("terminations", env.terminations).items():
        if term.sums is not None and term.sums not in gates:
            known = [n for n, t in registry("rewards").items() if t.gate == term.sums]
            problems.append(
                f"env.terminations.{name}: it sums the object term, but the rewards "
                f"{' and '.join(known)} are all off; turn one on"
            )
    return problems


def _expect(recipe: Recipe) -> list[str]:
    return expect_conflicts(recipe.expect)


def expect_conflicts(entries: list[Expectation]) -> list[str]:
    """Return the promises that promise nothing."""
    return [
        f"expect[{i}]: give min, max or both"
        for i, entry in enumerate(entries)
        if entry.min is None and entry.max is None
    ]


# Keys of `algo` that speak of hands or of the future window.
HAND_ONLY = (
    "groups",
    "critic_action",
    "own_action_gate",
    "future_latent",
    "future_channels",
    "ppo",
)


@dataclass(frozen=True, kw_only=True)
class GymRecipe(RunRecipe):
    """One training run on a stock environment, complete.

    Example:
        >>> GymRecipe(name="tiny", total_env_steps=1000).gym.num_envs
        1
    """

    task: Literal["gym"] = "gym"
    """What is trained: a stock environment; must be given."""
    gym: GymConfig = dataclasses.field(default_factory=GymConfig)
    """Environment."""
    algo: AlgoConfig = dataclasses.field(default_factory=AlgoConfig)
    """Learner."""
    train: LoopConfig = dataclasses.field(default_factory=LoopConfig)
    """Loop."""

    @property
    def tags(self) -> list[str]:
        """Words that tell this run from others."""
        return [self.gym.env_id]

    @property
    def schedule_env_steps(self) -> int:
        """Env steps that the learning rate is laid out for."""
        return self.gym.schedule_env_steps or self.total_env_steps


def find_gym_conflicts(recipe: GymRecipe) -> list[str]:
    """Return one line for each thing that does not fit together."""
    return [
        *_environment(recipe),
        *_hand_keys(recipe.algo),
        *algo_conflicts(recipe, {"gym.num_envs": recipe.gym.num_envs}),
        *expect_conflicts(recipe.expect),
    ]


def _environment(recipe: GymRecipe) -> list[str]:
    gym = recipe.gym
    problems = []
    if not gym.env_id:
        problems.append("gym.env_id: missing; every recipe with task: gym must give it")
    if ":" in gym.env_id:
        problems.append(
            f"gym.env_id: '{gym.env_id}' names a module to import; recipes name "
            "registered environments only"
        )
    if recipe.schedule_env_steps < recipe.total_env_steps:
        problems.append(
            f"gym.schedule_env_steps: {gym.schedule_env_steps} ends before "
            f"total_env_steps={recipe.total_env_steps}"
        )
    return problems


def _hand_keys(algo: AlgoConfig) -> list[str]:
    plain = AlgoConfig()
    return [
        f"algo.{key}: has no effect with task: gym, which has neither hands nor a "
        "future window; leave it out"
        for key in HAND_ONLY
        if getattr(algo, key) != getattr(plain, key)
    ]


@dataclass(frozen=True, kw_only=True)
class SearchRecipe(Recipe):
    """One search for the actions of motions, complete; learner and loop play no role.

    Example:
        >>> SearchRecipe(name="tiny", total_env_steps=1000).search.stride
        8
    """

    task: Literal["search"] = "search"  # type: ignore[assignment]
    """What is done: actions are searched for; `flashdex search` sets it."""
    search: SearchConfig = dataclasses.field(default_factory=SearchConfig)
    """Search."""

    def in_action_space(self) -> SearchRecipe:
        """The recipe whose environment has the bounds of the search as its actions.

        So that stored actions mean what they mean in every run: residuals on targets
        that lead the servos. An engine that is only there for samples moves to
        ``search.engine``: states, scores and certificates are MuJoCo C's.
        """
        found, env, physics = self.search, self.env, self.physics
        if physics.engine == "warp":
            found = dataclasses.replace(found, engine="warp")
            physics = dataclasses.replace(physics, engine="cpu")
        env = dataclasses.replace(
            env,
            finger_mode="residual",
            wrist_pos_scale=found.wrist_pos_bound,
            wrist_rot_scale=found.wrist_rot_bound,
            finger_scale=found.finger_bound,
            wrist_lowpass_hz=0.0,
            feedforward="inverse",
        )
        return dataclasses.replace(self, env=env, physics=physics, search=found)


def find_search_conflicts(recipe: SearchRecipe) -> list[str]:
    """Return one line for each thing that does not fit together."""
    checks = (_hand, _motions, _rate, _solver, _ladders)
    return [problem for check in checks for problem in check(recipe)]


def _ladders(recipe: SearchRecipe) -> list[str]:
    found, problems = recipe.search, []
    if recipe.physics.engine == "brax":
        problems.append(
            "physics.engine: the search tries samples in MuJoCo C or MuJoCo Warp, not "
            "in 'brax'; use physics=cpu or physics=warp"
        )
    on_device = "warp" in (recipe.physics.engine, found.engine)
    if on_device and found.workers > 1:
        problems.append(
            f"search.workers: {found.workers} processes would share one GPU; with "
            "warp leave it out, one process tries all samples"
        )
    for name in ("ladder", "robust_ladder"):
        for i, rung in enumerate(getattr(found, name)):
            if rung.horizon < found.stride:
                problems.append(
                    f"search.{name}[{i}].horizon: {rung.horizon} steps are looked "
                    f"ahead, and search.stride={found.stride} decided; look further"
                )
    if not found.ladder:
        problems.append("search.ladder: empty; give at least one rung")
    return problems


R = TypeVar("R", bound=RunRecipe)


@dataclass(frozen=True)
class Kind:
    """One kind of recipe."""

    root: type[RunRecipe]
    """Its schema."""
    find_conflicts: Callable[[Any], list[str]]
    """Says what does not fit together in one."""
    make_base: Callable[[], dict[str, Any]]
    """What its files are merged onto: all named parts with no option set."""

    @property
    def keys(self) -> set[str]:
        """Those at the top of its recipes."""
        return {field.name for field in dataclasses.fields(self.root)}


KINDS: dict[str, Kind] = {
    DEFAULT_TASK: Kind(
        root=Recipe,
        find_conflicts=find_conflicts,
        make_base=lambda: {"env": {k: default_mapping(k) for k in TERM_KINDS}},
    ),
    SEARCH_TASK: Kind(
        root=SearchRecipe,
        find_conflicts=find_search_conflicts,
        make_base=lambda: {"env": {k: default_mapping(k) for k in TERM_KINDS}},
    ),
    GYM_TASK: Kind(root=GymRecipe, find_conflicts=find_gym_conflicts, make_base=dict),
}


def kind_of(data: Mapping[str, Any]) -> Kind:
    """Return the kind a mapping asks for; an unknown task counts as the default."""
    return KINDS.get(str(data.get("task")), KINDS[DEFAULT_TASK])


def split_foreign(
    data: Mapping[str, Any], problems: list[str]
) -> tuple[Kind, dict[str, Any]]:
    """Find the kind of a recipe and take out what belongs to another kind.

    Args:
        data: the composed recipe.
        problems: where an unknown task and foreign keys are noted.

    Returns:
        The kind, and the mapping without foreign keys and unknown tasks.
    """
    kept = dict(data)
    task = data.get("task", DEFAULT_TASK)
    if not isinstance(task, str) or task not in KINDS:
        problems.append(
            f"task: {task!r} is not a task.{nearest(str(task), KINDS)} "
            f"Allowed: {', '.join(KINDS)}."
        )
        kept.pop("task")
        task = DEFAULT_TASK
    own = KINDS[task].keys
    for key in data:
        homes = [name for name, kind in KINDS.items() if key in kind.keys]
        if key not in own and homes:
            problems.append(
                f"{key}: belongs to recipes with task: {homes[0]}, this one has "
                f"task: {task}; take it out"
            )
            kept.pop(key)
    return KINDS[task], kept


def mark_keys(data: Mapping[str, Any], keys: Iterable[str]) -> dict[str, Any]:
    """Add the keys that belong to another kind, or one without a value passes unseen.

    Args:
        data: the composed recipe.
        keys: those that the chosen options of groups write to.
    """
    own = kind_of(data).keys
    return {**{key: None for key in keys if key not in own}, **data}


def expect_kind(recipe: RunRecipe, root: type[R], *, where: str) -> R:
    """Return the recipe if it is of one kind.

    Args:
        recipe: any validated recipe.
        root: schema of the kind that is needed.
        where: who needs it, for the message.

    Raises:
        FlashdexError: it is of another kind.
    """
    if isinstance(recipe, root):
        return recipe
    wanted = next(name for name, kind in KINDS.items() if kind.root is root)
    raise FlashdexError(
        f"{where}: needs a recipe with task: {wanted}; '{recipe.name}' is of another "
        "kind. `flashdex ls` says what each recipe trains."
    )
