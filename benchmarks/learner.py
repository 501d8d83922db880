"""The FlashSAC update against its plainest form.

Both hold the same weights and see the same batch and noise; they take turns in one
process, so that what else runs on the machine slows both alike. An actor step comes
with every second update, so every figure is the mean of two updates. The rate of plain
matrix products is measured in the same run; an update's share of it is what its own
products would take at that rate, over what it took.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from statistics import median
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torch.utils.benchmark import timer

from benchmarks.common import output
from benchmarks.common.ceilings import (
    count_products,
    float32_products,
    matmul_ceilings,
    memory_gb,
    replay_seconds,
    reset_peak_memory,
    total_flops,
)
from benchmarks.common.plain_flashsac import PlainLearner, read_batch
from flashdex import keys
from flashdex.algorithms.flashsac import FlashSACLearner
from flashdex.algorithms.inputs import HandRows
from flashdex.envs.tracking import TrackingEnv
from flashdex.errors import FlashdexError
from flashdex.modules.actor import FlashActor
from flashdex.modules.critic import EnsembleCritic
from flashdex.modules.future import FutureEncoder
from flashdex.objectives.flashsac import FlashSACLoss
from flashdex.objectives.stepper import FlashSACStepper
from flashdex.system.allocator import keep_freed_memory
from flashdex.training.build import RunBuilder

GAMMA, N_STEPS, FRAMES = 0.98, 3, 10
BURN_IN = 2  # pairs of updates that are not counted
ROWS_PER_BATCH = 8  # replay rows collected for the recipe's updates, in batches
HOST = torch.device("cpu")
Update = Callable[[], object]


@dataclass(frozen=True)
class LearnerSize:
    """Shapes of one measurement."""

    observation: int  # width D, the window's latent excluded
    action: int  # of one group
    groups: int
    batch: int
    critic: int  # width
    actor: int
    future: int = 0  # features of a frame of the window; 0 leaves the encoder out
    latent: int = 128
    channels: tuple[int, int, int] = (128, 64, 32)
    threads: int | None = None  # None: the process's
    rounds: int = 10  # pairs of updates when nothing else is asked for


SIZES = {
    "b512": LearnerSize(300, 36, 1, 512, 256, 128),
    "b2048": LearnerSize(300, 36, 1, 2048, 256, 128, rounds=5),
    # recipes/quickstart.yaml
    "quickstart": LearnerSize(
        582, 18, 2, 128, 64, 64, 78, 32, (32, 32, 16), threads=1, rounds=40
    ),
    # only to try the commands
    "tiny": LearnerSize(60, 18, 2, 64, 32, 16, 78, 16, (16, 16, 8), threads=1),
    # the paper's recipe: minutes an update on a CPU
    "paper": LearnerSize(2308, 18, 2, 4096, 1024, 128, 78, rounds=1),
}
NORMAL_SIZES = ("quickstart", "b512", "b2048")


def make_loss(size: LearnerSize) -> FlashSACLoss:
    """The library's networks and objective, fresh."""
    window = {"num_frames": FRAMES, "latent_dim": size.latent, "widths": size.channels}

    def options(width: int, ensemble: int) -> dict[str, Any]:
        encoder = None
        if size.future:
            encoder = FutureEncoder(size.future, ensemble=ensemble, **window)
        return {"num_groups": count, "width": width, "future_encoder": encoder}

    count, shape = size.groups, (size.observation, size.action)
    actor = FlashActor(*shape, **options(size.actor, count))
    critic = EnsembleCritic(*shape, **options(size.critic, 1))
    groups = [f"group{g}" for g in range(count)]
    return FlashSACLoss(actor, critic, groups=groups, gamma=GAMMA, n_steps=N_STEPS)


def make_batch(size: LearnerSize, *, seed: int = 0) -> TensorDict:
    """Random transitions."""
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> Tensor:
        return torch.randn(size.batch, *shape, generator=generator)

    now, after = normal(size.observation), normal(size.observation)
    td = TensorDict({"observation": now}, [size.batch])
    ended = normal(1) > 2
    td.set("next", TensorDict({"observation": after, "terminated": ended}, [len(td)]))
    for g in range(size.groups):
        td.set((f"group{g}", "action"), normal(size.action).tanh())
    for g in range(size.groups):
        td.set(("next", f"group{g}", "reward"), 0.3 * normal(1))
    if size.future:
        td.set("future", normal(size.future, FRAMES))
        td.set(("next", "future"), normal(size.future, FRAMES))
    return td


def measure(
    size: LearnerSize,
    *,
    rounds: int,
    compile: bool = False,
    autocast: bool = False,
    device: torch.device = HOST,
) -> dict[str, Any]:
    """Let the learners take turns, some rounds of pairs of updates.

    Returns:
        Milliseconds per update, their ratios to the plain learner (medians over
        rounds), split, share of the products, GFLOP/s and their ceilings.
    """
    torch.manual_seed(0)
    stepper, td = FlashSACStepper(make_loss(size).to(device)), make_batch(size)
    td = td.to(device)
    arms = _make_arms(stepper, td, size, compile=compile, autocast=autocast)
    # on a GPU enough updates that the end of each turn is not waited for
    turn = 2 if device.type == "cpu" else 8
    _seconds(arms, rounds=1, repeat=BURN_IN * turn)
    times = _seconds(arms, rounds=rounds, repeat=turn)
    plain = times["baseline"]
    out: dict[str, Any] = {"rounds": rounds, "baseline_ms_per_update": _ms(plain)}
    if compile:
        fast = times.pop("baseline_compiled")
        out["baseline_ms_per_update_compiled"] = _ms(fast)
        out["ratio_of_compiled"] = _ratio(times["compiled"], fast)
    for name in times.keys() - {"baseline"}:
        out[f"ms_per_update_{name}"] = _ms(times[name])
        out[f"ratio_to_baseline_{name}"] = _ratio(times[name], plain)
    out["ratio_to_baseline"] = out["ratio_to_baseline_eager"]
    whole = median(times["eager"])
    out["split"] = _split(stepper, td, whole=whole, rounds=rounds)
    out |= _products(arms["eager"], whole, repeat=rounds, device=device)
    return out | _shares(times, out["gflop_per_update"], device)


def _make_arms(
    stepper: FlashSACStepper, td: TensorDict, size: LearnerSize, **options: bool
) -> dict[str, Update]:
    """The updates that take turns, all on the same batch and noise."""
    device, batch = td["observation"].device, read_batch(td, stepper.loss)
    shape = (size.groups, size.batch, size.action)
    noise: dict[str, Tensor] = {
        name: torch.randn(shape, device=device)
        for name in ("actor_noise", "target_noise")
    }

    def ours(**chosen: bool) -> Update:
        other = FlashSACStepper(make_loss(size).to(device), **chosen)
        return lambda: other.update(td, **noise)

    plain = PlainLearner(stepper.loss)
    arms: dict[str, Update] = {
        "baseline": lambda: plain.update(batch, **noise),
        "eager": lambda: stepper.update(td, **noise),
    }
    if options["autocast"]:
        arms["autocast"] = ours(autocast=True)
    if options["compile"]:
        arms["compiled"] = ours(compile=True)
        fast = PlainLearner(stepper.loss)
        fast.compile_networks()
        arms["baseline_compiled"] = lambda: fast.update(batch, **noise)
    if all(options.values()):
        arms["compiled_autocast"] = ours(compile=True, autocast=True)
    return arms


def _seconds(
    calls: Mapping[str, Update], *, rounds: int, repeat: int = 1
) -> dict[str, list[float]]:
    """Seconds of each call in every round, in which they take turns."""
    times: dict[str, list[float]] = {name: [] for name in calls}
    for _ in range(rounds):
        for name, call in calls.items():
            start = timer()
            for _ in range(repeat):
                call()
            times[name].append((timer() - start) / repeat)
    return times


def _ratio(ours: list[float], theirs: list[float]) -> float:
    """Median over rounds, so that both saw the same machine."""
    return round(median(a / b for a, b in zip(ours, theirs, strict=True)), 3)


def _ms(seconds: list[float]) -> float:
    return round(1e3 * median(seconds), 3)


def _split(
    stepper: FlashSACStepper, td: TensorDict, *, whole: float, rounds: int
) -> dict[str, float]:
    """Milliseconds of one update: reading, actor, critic, and what steps weights."""
    loss = stepper.loss
    batch = loss.read(td)
    shape = (len(loss.groups), batch.size, loss.actor_network.action_dim)
    noise = torch.randn(shape, device=batch.action.device)

    def differentiate(value: Tensor) -> None:
        value.backward()
        loss.zero_grad()

    calls: dict[str, Update] = {
        "read": lambda: loss.read(td),
        "actor": lambda: differentiate(loss.actor_objective(batch, noise)[0]),
        "critic": lambda: differentiate(loss.qvalue_objective(batch, noise)[0]),
    }
    times = _seconds(calls, rounds=rounds)
    split = {name: _ms(values) for name, values in times.items()}
    split["actor"] = round(split["actor"] / stepper.actor_period, 3)
    # what is left: optimisers, projections, target average, report
    split["step"] = round(max(0.0, 1e3 * whole - sum(split.values())), 3)
    return split


def _products(
    update: Update, whole: float, *, repeat: int, device: torch.device
) -> dict[str, float]:
    """Speed of the matrix products; the share is what they would take by themselves."""
    counts = count_products(lambda: (update(), update()))
    seconds = replay_seconds(counts, repeat=repeat, device=device) / 2
    gflop = total_flops(counts) / 2 / 1e9
    return {
        "gflop_per_update": round(gflop, 3),
        "matmul_share": round(seconds / whole, 3),
        "gflops": round(gflop / whole, 1),
        "ceiling_gflops": round(gflop / seconds, 1),
        "ceiling_ms_per_update": round(1e3 * seconds, 3),
    }


def _shares(
    times: dict[str, list[float]], gflop: float, device: torch.device
) -> dict[str, Any]:
    """Updates a second, and the share of the plain products' rate that they use."""
    rates = matmul_ceilings(device, seconds=0.5 if device.type == "cuda" else 0.2)
    is_tf32 = torch.get_float32_matmul_precision() != "highest"
    full = "tf32" if device.type == "cuda" and is_tf32 else "float32"
    out: dict[str, Any] = {"ceiling_gflops_by_format": rates}
    for name, seconds in times.items():
        rate = 1 / median(seconds)
        used = rates["bfloat16" if name.endswith("autocast") else full]
        out[f"updates_per_s_{name}"] = round(rate, 3)
        out[f"share_of_ceiling_{name}"] = round(gflop * rate / used, 4)
    return out


def measure_recipe(
    name: str, overrides: Sequence[str], *, updates: int
) -> dict[str, float | int]:
    """Build a recipe, collect rows by random actions and measure its updates.

    Milliseconds an update (medians): ``sample`` draws and unpacks replay rows,
    ``assemble`` makes the observations of both window ends, ``learn`` is the update
    itself, ``whole`` everything; and the width it was measured at.
    """
    recipe = output.compose_tracking(name, ["algo.actor_delay=0", *overrides])
    bench = RunBuilder.from_recipe(recipe)
    env = bench.make_env()
    learner = bench.make_learner(env)
    assert isinstance(learner, FlashSACLearner)
    _collect(env, learner, rows=ROWS_PER_BATCH * recipe.algo.batch_size)
    assert isinstance(learner.rows, HandRows)
    rows, codec, buffer = learner.rows, learner.rows.codec, learner.buffer
    state, _ = codec.unpack(buffer.draw())
    calls: dict[str, Update] = {
        "sample": lambda: codec.unpack(buffer.draw()),
        "assemble": lambda: rows.assemble_rows(state),
        "whole": learner.update,
    }
    _seconds(calls, rounds=2 * BURN_IN)
    times = _seconds(calls, rounds=updates)
    parts = zip(times["whole"], times["sample"], times["assemble"], strict=True)
    times["learn"] = [whole - sample - shown for whole, sample, shown in parts]
    # even and odd updates differ by the actor step
    split = {
        phase: round(500 * (median(values[::2]) + median(values[1::2])), 3)
        for phase, values in times.items()
    }
    with torch.no_grad():
        width = learner.sample()[0][keys.OBSERVATION].shape[-1]
    return {**split, "observation": width}


@torch.no_grad()
def _collect(env: TrackingEnv, learner: FlashSACLearner, *, rows: int) -> None:
    generator = torch.Generator().manual_seed(0)
    shape = (env.num_envs, 2, env.bank.num_joints)
    td: TensorDictBase = env.reset()
    while learner.num_rows < rows:
        action = 2 * torch.rand(shape, generator=generator) - 1
        env.put_action(td, action)
        td, following = env.step_and_maybe_reset(td)
        after = td.get("next")
        reward = torch.cat([after[keys.reward(s)] for s in keys.SIDES], -1)
        ended = after[keys.TERMINATED], after[keys.DONE]
        learner.process_step(td, action, reward, after, *ended)
        td = following


def main(words: Sequence[str] = ()) -> list[dict[str, Any]]:
    """Measure, and print one JSON object a size, one a line; they are returned."""
    args = _parse(words)
    keep_freed_memory()  # as training does; both learners gain
    is_there = torch.cuda.is_available()
    if args.device == "cuda" and not is_there:
        raise FlashdexError(
            "--device cuda, but torch sees no GPU ('flashdex doctor' "
            "says why). Use --device cpu or auto."
        )
    device = torch.device("cuda" if is_there and args.device != "cpu" else "cpu")
    sizes = args.sizes or (["paper"] if device.type == "cuda" else NORMAL_SIZES)
    before = torch.get_num_threads()
    results = []
    for name in sizes:
        torch.set_num_threads(args.threads or SIZES[name].threads or before)
        with float32_products(args.precision):
            results.append(output.emit(_one_size(name, args, device), out=args.out))
    torch.set_num_threads(before)
    return results


def _one_size(
    name: str, args: argparse.Namespace, device: torch.device
) -> dict[str, Any]:
    size = SIZES[name]
    rounds = args.rounds or size.rounds
    reset_peak_memory(device)
    options = {"compile": args.compile, "autocast": args.autocast}
    names = ("observation", "action", "groups", "batch", "critic", "actor")
    result = {
        "benchmark": "learner",
        "size": name,
        "device": str(device),
        "precision": args.precision,
        **{field: getattr(size, field) for field in names},
        **measure(size, rounds=rounds, device=device, **options),
        "memory_gb": memory_gb(device),
        "torch": torch.__version__,
    }
    if name == "quickstart" and device.type == "cpu":
        # the same sizes inside the recipe, with replay and observations
        result["recipe"] = measure_recipe(name, args.overrides, updates=2 * rounds)
    return result


def _parse(words: Sequence[str]) -> argparse.Namespace:
    parser = output.make_parser("learner", __doc__)
    add = parser.add_argument
    normal = ", ".join(NORMAL_SIZES)
    add("--sizes", nargs="+", choices=SIZES, help=f"({normal}; paper on a GPU)")
    add("--rounds", type=int, help="pairs of updates")
    add("--threads", type=int, help="torch threads")
    add("--compile", action="store_true", help="also both compiled; minutes a size")
    add("--autocast", action="store_true", help="also with products in bfloat16")
    add("--device", choices=["auto", "cpu", "cuda"], default="auto", help="where")
    about = "of float32 products; high is TF32 on a GPU"
    add("--precision", choices=["highest", "high"], default="highest", help=about)
    add("--set", dest="overrides", nargs="*", default=[], metavar="key=value")
    return parser.parse_args(words)


if __name__ == "__main__":
    output.run(main)
