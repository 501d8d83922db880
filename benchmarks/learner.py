"""``python -m benchmarks.learner``: the FlashSAC update against its plainest form.

Both hold the same weights and see the same batch and noise; they take turns in one
process, so that what else runs on the machine slows both alike. An actor step comes
with every second update, so every figure is the mean of two updates. The rate of plain
matrix products is measured in the same run; an update's share of it is what its own
products would take at that rate, over what it took.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import dataclass, fields
from statistics import median
from typing import Any

import torch
from tensordict import TensorDict
from torch import Tensor, nn

from benchmarks.common.ceilings import (
    count_products,
    float32_products,
    matmul_ceilings,
    replay_seconds,
    total_flops,
)
from benchmarks.common.clock import memory_gb, now, reset_peak_memory
from benchmarks.common.learner_recipe import measure_recipe
from benchmarks.common.output import add_output_options, emit
from benchmarks.common.plain_flashsac import (
    PlainActor,
    PlainBatch,
    PlainCritics,
    PlainEncoder,
    PlainLearner,
    PlainTrunk,
)
from flashdex.errors import FlashdexError
from flashdex.modules.actor import FlashActor
from flashdex.modules.critic import EnsembleCritic
from flashdex.modules.future import FutureEncoder
from flashdex.modules.trunk import FlashTrunk
from flashdex.objectives.flashsac import FlashSACLoss
from flashdex.objectives.stepper import FlashSACStepper
from flashdex.system.allocator import keep_freed_memory

GAMMA, N_STEPS, FRAMES = 0.98, 3, 10


@dataclass(frozen=True)
class LearnerSize:
    """Shapes of one measurement.

    Attributes:
        observation: width D of the observation, the window's latent excluded.
        action: actions A of one group.
        groups: actor-critic groups G.
        batch: transitions B.
        critic: width of the critics.
        actor: width of the actors.
        future: features C of a frame of the future window; 0 leaves the encoder out.
        latent: output of the future encoder.
        channels: convolutions of the future encoder.
        threads: torch threads; None is the process's.
        rounds: pairs of updates measured when nothing else is asked for.
    """

    observation: int
    action: int
    groups: int
    batch: int
    critic: int
    actor: int
    future: int = 0
    latent: int = 128
    channels: tuple[int, int, int] = (128, 64, 32)
    threads: int | None = None
    rounds: int = 10


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


def make_loss(size: LearnerSize) -> FlashSACLoss:
    """The library's networks and objective, fresh."""

    def encoder(ensemble: int) -> FutureEncoder | None:
        if not size.future:
            return None
        return FutureEncoder(
            size.future,
            num_frames=FRAMES,
            latent_dim=size.latent,
            widths=size.channels,
            ensemble=ensemble,
        )

    count = size.groups
    actor = FlashActor(
        size.observation,
        size.action,
        num_groups=count,
        width=size.actor,
        future_encoder=encoder(count),
    )
    critic = EnsembleCritic(
        size.observation,
        size.action,
        num_groups=count,
        width=size.critic,
        future_encoder=encoder(1),
    )
    return FlashSACLoss(
        actor,
        critic,
        groups=[f"group{g}" for g in range(count)],
        gamma=GAMMA,
        n_steps=N_STEPS,
    )


def make_plain(
    size: LearnerSize, loss: FlashSACLoss, *, device: torch.device | str = "cpu"
) -> PlainLearner:
    """The plain learner with the weights of ``loss``.

    Args:
        size: shapes.
        loss: the library's learner.
        device: where its tensors are made.
    """
    with torch.device(device):
        return _make_plain(size, loss)


def _make_plain(size: LearnerSize, loss: FlashSACLoss) -> PlainLearner:
    latent = size.latent if size.future else 0
    inputs = size.observation + latent

    def encoder() -> PlainEncoder | None:
        if not size.future:
            return None
        return PlainEncoder(size.future, FRAMES, size.latent, size.channels)

    actors = [
        PlainActor(inputs, size.action, size.actor, encoder())
        for _ in range(size.groups)
    ]
    joint = inputs + size.groups * size.action
    critics = PlainCritics(joint, size.critic, size.groups, encoder())
    for member, actor in enumerate(actors):
        _copy_actor(loss.actor_network, member, actor, size.action)
    _copy_critics(loss.qvalue_network, critics)
    return PlainLearner(actors, critics, action_dim=size.action)


@torch.no_grad()
def _copy_actor(
    source: FlashActor, member: int, actor: PlainActor, action: int
) -> None:
    _copy_trunk(source.trunk, member, actor.trunk)
    weight, bias = source.head.weight[member], source.head_bias[member]
    for head, rows in ((actor.mean_head, slice(action)), (actor.std_head, action)):
        part = rows if isinstance(rows, slice) else slice(rows, None)
        head.weight.copy_(weight[part])
        head.bias.copy_(bias[part])
    if actor.encoder is not None and source.future_encoder is not None:
        _copy_encoder(source.future_encoder, member, actor.encoder)


@torch.no_grad()
def _copy_critics(source: EnsembleCritic, critics: PlainCritics) -> None:
    for member, trunk in enumerate(critics.trunks):
        assert isinstance(trunk, PlainTrunk)
        _copy_trunk(source.trunk, member, trunk)
    for member, head in enumerate(critics.heads):
        assert isinstance(head, nn.Linear)
        head.weight.copy_(source.head.weight[member])
        head.bias.copy_(source.head_bias[member])
    if critics.encoder is not None and source.future_encoder is not None:
        _copy_encoder(source.future_encoder, 0, critics.encoder)


def _copy_trunk(source: FlashTrunk, member: int, trunk: PlainTrunk) -> None:
    """Both list their parameters in data-flow order, gamma and beta before a map."""
    for mine, other in zip(trunk.parameters(), source.parameters(), strict=True):
        mine.copy_(other[member])


def _copy_encoder(source: FutureEncoder, member: int, encoder: PlainEncoder) -> None:
    layers = (encoder.conv1, encoder.conv2, encoder.conv3, encoder.read_out)
    for layer, weight, bias in zip(layers, source.weights, source.biases, strict=True):
        layer.weight.copy_(weight[member].view_as(layer.weight))
        assert layer.bias is not None
        layer.bias.copy_(bias[member])


def make_batch(size: LearnerSize, *, seed: int = 0) -> tuple[TensorDict, PlainBatch]:
    """The same random transitions in the layouts of both learners."""
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> Tensor:
        return torch.randn(shape, generator=generator)

    rows = size.batch
    now, after = normal(rows, size.observation), normal(rows, size.observation)
    terminated = normal(rows, 1) > 2
    actions = [normal(rows, size.action).tanh() for _ in range(size.groups)]
    rewards = [0.3 * normal(rows, 1) for _ in range(size.groups)]
    td = TensorDict({"observation": now}, [rows])
    td.set("next", TensorDict({"observation": after, "terminated": terminated}, [rows]))
    futures: list[Tensor | None] = [None, None]
    if size.future:
        futures = [normal(rows, size.future, FRAMES) for _ in range(2)]
        td.set("future", futures[0]).set(("next", "future"), futures[1])
    for g, (action, reward) in enumerate(zip(actions, rewards, strict=True)):
        td.set((f"group{g}", "action"), action)
        td.set(("next", f"group{g}", "reward"), reward)
    plain = PlainBatch(
        observation=now,
        next_observation=after,
        future=futures[0],
        next_future=futures[1],
        action=torch.cat(actions, -1),
        reward=[reward.squeeze(-1) for reward in rewards],
        discount=torch.full((rows,), GAMMA**N_STEPS),
        terminated=terminated.squeeze(-1).to(now.dtype),
    )
    return td, plain


def move_batch(batch: PlainBatch, device: torch.device) -> PlainBatch:
    """The batch on another device."""

    def move(value: Tensor | list[Tensor] | None) -> Tensor | list[Tensor] | None:
        if isinstance(value, list):
            return [v.to(device) for v in value]
        return None if value is None else value.to(device)

    values = {f.name: move(getattr(batch, f.name)) for f in fields(batch)}
    return PlainBatch(**values)  # pyright: ignore[reportArgumentType]


BURN_IN = 2  # pairs of updates that are not counted
HOST = torch.device("cpu")
Update = Callable[[], object]


def measure(
    size: LearnerSize,
    *,
    rounds: int,
    compile: bool = False,
    autocast: bool = False,
    device: torch.device = HOST,
) -> dict[str, Any]:
    """Let the learners take turns.

    Args:
        size: shapes.
        rounds: pairs of updates of each.
        compile: also measure both learners compiled.
        autocast: also measure the library's with products in bfloat16.
        device: where everything lives.

    Returns:
        Milliseconds per update, their ratios to the plain learner (medians over
        rounds), split, share of the products, GFLOP/s and their ceilings.
    """
    torch.manual_seed(0)
    arms, stepper = _make_arms(size, compile=compile, autocast=autocast, device=device)
    for update in arms.values():
        _seconds_of_pair(update, device, BURN_IN)
    times: dict[str, list[float]] = {name: [] for name in arms}
    for _ in range(rounds):
        for name, update in arms.items():
            times[name].append(_seconds_of_pair(update, device))
    out: dict[str, Any] = {
        "rounds": rounds,
        "baseline_ms_per_update": _ms(times["baseline"]),
    }
    if compile:
        plain = times.pop("baseline_compiled")
        out["baseline_ms_per_update_compiled"] = _ms(plain)
        out["ratio_of_compiled"] = _ratio(times["compiled"], plain)
    for name in times.keys() - {"baseline"}:
        out[f"ms_per_update_{name}"] = _ms(times[name])
        out[f"ratio_to_baseline_{name}"] = _ratio(times[name], times["baseline"])
    out["ratio_to_baseline"] = out["ratio_to_baseline_eager"]
    whole = median(times["eager"])
    out["split"] = _split(stepper, size, whole=whole, rounds=rounds, device=device)
    out |= _products(arms["eager"], whole, repeat=rounds, device=device)
    return out | _shares(times, out["gflop_per_update"], device)


def _make_arms(
    size: LearnerSize, *, compile: bool, autocast: bool, device: torch.device
) -> tuple[dict[str, Update], FlashSACStepper]:
    loss = make_loss(size).to(device)
    td, plain_batch = make_batch(size)
    td, plain_batch = td.to(device), move_batch(plain_batch, device)
    shape = (size.groups, size.batch, size.action)
    noise = {
        name: torch.randn(shape, device=device)
        for name in ("actor_noise", "target_noise")
    }
    plain = make_plain(size, loss, device=device)
    stepper = FlashSACStepper(loss)
    arms: dict[str, Update] = {
        "baseline": lambda: plain.update(plain_batch, **noise),
        "eager": lambda: stepper.update(td, **noise),
    }
    if autocast:
        rounded = FlashSACStepper(make_loss(size).to(device), autocast=True)
        arms["autocast"] = lambda: rounded.update(td, **noise)
    if compile:
        fast = FlashSACStepper(make_loss(size).to(device), compile=True)
        arms["compiled"] = lambda: fast.update(td, **noise)
        plain_fast = make_plain(size, loss, device=device)
        plain_fast.compile()
        arms["baseline_compiled"] = lambda: plain_fast.update(plain_batch, **noise)
    if compile and autocast:
        both = FlashSACStepper(make_loss(size).to(device), compile=True, autocast=True)
        arms["compiled_autocast"] = lambda: both.update(td, **noise)
    return arms, stepper


def _seconds_of_pair(update: Update, device: torch.device, pairs: int = 1) -> float:
    """Seconds per update over pairs of updates, each with one actor step."""
    # on a GPU enough of them that the end of each pair is not waited for
    pairs = pairs if device.type == "cpu" else 4 * pairs
    start = now(device)
    for _ in range(2 * pairs):
        update()
    return (now(device) - start) / (2 * pairs)


def _ratio(ours: list[float], theirs: list[float]) -> float:
    """Median over rounds, so that both saw the same machine."""
    return round(median(a / b for a, b in zip(ours, theirs, strict=True)), 3)


def _ms(seconds: list[float]) -> float:
    return round(1e3 * median(seconds), 3)


def _split(
    stepper: FlashSACStepper,
    size: LearnerSize,
    *,
    whole: float,
    rounds: int,
    device: torch.device,
) -> dict[str, float]:
    """Milliseconds of one update: reading, actor, critic, and what steps weights."""
    loss, td = stepper.loss, make_batch(size)[0].to(device)
    noise = torch.randn(size.groups, size.batch, size.action, device=device)
    batch = loss.read(td)

    def differentiate(value: Tensor) -> None:
        value.backward()
        for parameter in loss.parameters():
            parameter.grad = None

    calls: dict[str, Update] = {
        "read": lambda: loss.read(td),
        "actor": lambda: differentiate(loss.actor_objective(batch, noise)[0]),
        "critic": lambda: differentiate(loss.qvalue_objective(batch, noise)[0]),
    }
    times: dict[str, list[float]] = {name: [] for name in calls}
    for _ in range(rounds):
        for name, call in calls.items():
            start = now(device)
            call()
            times[name].append(now(device) - start)
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


NORMAL_SIZES = ("quickstart", "b512", "b2048")


def main(words: list[str] | None = None) -> list[dict[str, Any]]:
    """Measure, and print one JSON object a size, one a line.

    Args:
        words: ``--sizes NAME ...``, ``--rounds N``, ``--threads N``, ``--compile``,
            ``--autocast``, ``--device D``, ``--precision P``, ``--out FILE``.

    Returns:
        The printed objects.
    """
    args = _parse(words or [])
    keep_freed_memory()  # as training does; both learners gain
    device = _device(args.device)
    sizes = args.sizes or (["paper"] if device.type == "cuda" else NORMAL_SIZES)
    before = torch.get_num_threads()
    results = []
    for name in sizes:
        torch.set_num_threads(args.threads or SIZES[name].threads or before)
        with float32_products(args.precision):
            results.append(emit(_one_size(name, args, device), out=args.out))
    torch.set_num_threads(before)
    return results


def _device(name: str) -> torch.device:
    is_there = torch.cuda.is_available()
    if name == "cuda" and not is_there:
        raise FlashdexError(
            "--device cuda, but torch sees no GPU ('flashdex doctor' "
            "says why). Use --device cpu or auto."
        )
    return torch.device("cuda" if is_there and name != "cpu" else "cpu")


def _one_size(
    name: str, args: argparse.Namespace, device: torch.device
) -> dict[str, Any]:
    size = SIZES[name]
    rounds = args.rounds or size.rounds
    reset_peak_memory(device)
    result = {
        "benchmark": "learner",
        "size": name,
        "device": str(device),
        "precision": args.precision,
        "observation": size.observation,
        "action": size.action,
        "groups": size.groups,
        "batch": size.batch,
        "critic": size.critic,
        "actor": size.actor,
        **measure(
            size,
            rounds=rounds,
            compile=args.compile,
            autocast=args.autocast,
            device=device,
        ),
        "memory_gb": memory_gb(device),
        "torch_threads": torch.get_num_threads(),
        "torch": torch.__version__,
    }
    if name == "quickstart" and device.type == "cpu":
        # the same sizes inside the recipe, with replay and observations
        result["recipe"] = measure_recipe(name, args.overrides, updates=2 * rounds)
    return result


def _parse(words: list[str]) -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.learner")
    parser.add_argument(
        "--sizes",
        nargs="+",
        choices=SIZES,
        help=f"what to measure ({', '.join(NORMAL_SIZES)}; paper on a GPU)",
    )
    parser.add_argument("--rounds", type=int, help="pairs of updates")
    parser.add_argument("--threads", type=int, help="torch threads")
    parser.add_argument(
        "--compile", action="store_true", help="also both compiled; minutes a size"
    )
    parser.add_argument(
        "--autocast", action="store_true", help="also with products in bfloat16"
    )
    parser.add_argument(
        "--device", choices=["auto", "cpu", "cuda"], default="auto", help="where"
    )
    parser.add_argument(
        "--precision",
        choices=["highest", "high"],
        default="highest",
        help="of float32 products; high is TF32 on a GPU",
    )
    add_output_options(parser)
    parser.add_argument(
        "--set",
        dest="overrides",
        nargs="*",
        default=[],
        metavar="key=value",
        help="changes of the quickstart recipe",
    )
    return parser.parse_args(words)
