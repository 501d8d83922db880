"""Both learners take turns on one batch: times, products, shares of the ceiling."""

from __future__ import annotations

from collections.abc import Callable
from statistics import median
from typing import Any

import torch
from torch import Tensor

from flashdex.bench.ceilings import matmul_ceilings
from flashdex.bench.clock import now
from flashdex.bench.learner_sizes import (
    LearnerSize,
    make_batch,
    make_loss,
    make_plain,
    move_batch,
)
from flashdex.bench.products import count_products, replay_seconds, total_flops
from flashdex.objectives.stepper import FlashSACStepper

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
