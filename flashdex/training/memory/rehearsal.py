"""A run of two worlds: what it holds a row, a world and a frame, and in one update.

The run's own parts are built on the CPU for motions that are made up, step and are
remembered; an update of any size runs on torch's meta device, where tensors have shapes
and no memory. What is allocated is counted.
"""

from __future__ import annotations

import dataclasses
import logging
import weakref
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any, cast

import mujoco
import torch
from tensordict import TensorDictBase
from torch import Tensor, nn
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves
from torch.utils.flop_counter import FlopCounterMode

from flashdex import keys
from flashdex.algorithms.base import Learner
from flashdex.algorithms.config import AlgoConfig
from flashdex.algorithms.flashsac import make_actor, make_critic
from flashdex.envs.physics.cpu import CpuPhysics
from flashdex.envs.physics.warp.memory import WarpMemory, measure_warp
from flashdex.envs.reference import ReferenceBank
from flashdex.hands.spec import load_hand
from flashdex.modules.layers import warm_up_statistics
from flashdex.modules.product import bfloat16_products
from flashdex.objectives.batch import FlashBatch
from flashdex.objectives.flashsac import FlashSACLoss
from flashdex.recipe import Recipe
from flashdex.replay.codec import row_bytes
from flashdex.replay.disk import replay_of
from flashdex.rollouts.recorder import EpisodeRecorder
from flashdex.training.build import RunBuilder
from flashdex.training.memory.stand_in import Collection, StandIn

_WORLDS, _BATCH = 2, 32
_ADAM_STEP = 4  # bytes of Adam's own counter, one a parameter tensor


class PeakMeter(TorchDispatchMode):
    """Counts the bytes of tensors that are made inside and still alive.

    Attributes:
        now: bytes alive.
        peak: most bytes alive at once.

    Example:
        >>> with PeakMeter() as meter:
        ...     x = torch.zeros(100, device="meta")
        ...     y = x[:10]  # a view is not counted again
        >>> meter.peak
        400
    """

    def __init__(self) -> None:
        super().__init__()
        self.now = self.peak = 0
        self._alive: dict[int, int] = {}

    def __torch_dispatch__(
        self, func: Any, types: Any, args: Any = (), kwargs: Any = None
    ) -> Any:
        """Run one operator and count what it made."""
        out = func(*args, **(kwargs or {}))
        given = {t.untyped_storage()._cdata for t in _tensors((args, kwargs))}
        for storage in (made.untyped_storage() for made in _tensors(out)):
            key = storage._cdata
            if key not in given and key not in self._alive:
                self._alive[key] = storage.nbytes()
                self.now += storage.nbytes()
                weakref.finalize(storage, self._free, key)
        self.peak = max(self.peak, self.now)
        return out

    def _free(self, key: int) -> None:
        self.now -= self._alive.pop(key, 0)


def _tensors(tree: Any) -> list[Tensor]:
    return [leaf for leaf in tree_leaves(tree) if isinstance(leaf, Tensor)]


def tensor_bytes(tensors: Any) -> int:
    """Bytes of tensors, or of a tree of them."""
    return sum(t.numel() * t.element_size() for t in _tensors(tensors))


@dataclass(frozen=True)
class Networks:
    """Bytes that networks and their optimisers keep."""

    weights: int  # parameters and buffers, target network included
    gradients: int  # of what is trained
    moments: int  # both moments of Adam and its counters

    @classmethod
    def of(cls, network: nn.Module) -> Networks:
        """Count a module; parameters without gradient are not trained."""
        # LossModule lists the trained parameters only
        everything = [p for _, p in nn.Module.named_parameters(network)]
        trained = [p for p in everything if p.requires_grad]
        weights = tensor_bytes([everything, list(network.buffers())])
        gradients = tensor_bytes(trained)
        return cls(weights, gradients, 2 * gradients + _ADAM_STEP * len(trained))

    @property
    def total(self) -> int:
        """All of it."""
        return self.weights + self.gradients + self.moments


Update = Callable[[int], tuple[int, float]]
"""Rows -> most bytes of an update on them beside `Networks`, operations of products."""


def run_backward(compute: Callable[[], Tensor], network: nn.Module) -> tuple[int, int]:
    """Peak bytes of a loss and its backward pass, and the operations of its products.

    Gradients of the network are left out and cleared. Operators run one by one; a
    compiled update needs about as much.
    """
    with FlopCounterMode(display=False) as flops, PeakMeter() as meter:
        compute().backward()
    network.zero_grad(set_to_none=True)
    # all gradients are there at the end, and counted with the networks
    peak = meter.peak - Networks.of(network).gradients
    return peak, flops.get_total_flops()


def flashsac_update(
    loss: FlashSACLoss,
    batch: FlashBatch,
    noise: Tensor,
    *,
    lowered: bool = False,
    actor_period: int = 1,
) -> tuple[int, float]:
    """Most bytes of an update beside networks and batch, operations of its products.

    Args:
        loss: networks, on the device of the batch.
        batch: B transitions.
        noise: (G, B, A).
        lowered: large products in bfloat16.
        actor_period: updates an actor step; the operations are those on average.
    """
    with bfloat16_products(lowered):
        actor, actor_flops = run_backward(
            lambda: loss.actor_objective(batch, noise)[0], loss.actor_network
        )
        critic, critic_flops = run_backward(
            lambda: loss.qvalue_objective(batch, noise)[0], loss.qvalue_network
        )
    return max(actor, critic), actor_flops / actor_period + critic_flops


def ask_algorithm(
    recipe: Recipe, learner: Learner, state: TensorDictBase
) -> tuple[Networks, int, Update]:
    """Networks of the recipe, bytes of an observation, and the update."""
    ask = {"flashsac": _ask_flashsac, "ppo": _ask_ppo}
    return ask[recipe.algo.kind](recipe.algo, learner, state)


def _ask_flashsac(
    algo: AlgoConfig, learner: Any, state: TensorDictBase
) -> tuple[Networks, int, Update]:
    """An observation is counted while it is assembled: none is kept."""
    del state
    peaks = []
    for count in (1, 2):
        with PeakMeter() as meter:
            batch = learner.sample(count)[0]
        peaks.append(meter.peak)
    row, groups = batch[:1].to("meta"), learner.rows.groups
    width, future = row[keys.OBSERVATION].shape[-1], row.get(keys.FUTURE, None)
    window = None if future is None else tuple(future.shape[1:])
    number = len(groups.names)
    sizes = (width, groups.action_dim, number, window)
    with torch.device("meta"):
        actor, critic = make_actor(algo, *sizes), make_critic(algo, *sizes)
        if algo.norm_warmup:
            warm_up_statistics(actor)
            warm_up_statistics(critic)
        loss = FlashSACLoss(actor, critic, groups=groups.names)
    options: Any = {"lowered": algo.bfloat16, "actor_period": algo.actor_period}

    def update(size: int) -> tuple[int, float]:
        batch = loss.read(row.expand(size))
        noise = torch.randn(number, size, groups.action_dim, device="meta")
        peak, flops = flashsac_update(loss, batch, noise, **options)
        return peak + tensor_bytes([batch, noise]), flops

    slope = -(-(peaks[1] - peaks[0]) // (2 * _BATCH))  # a row has two ends
    return Networks.of(loss), slope, lru_cache(update)


def _ask_ppo(
    algo: AlgoConfig, learner: Any, state: TensorDictBase
) -> tuple[Networks, int, Update]:
    """An observation is kept: raw, scaled, and a copy for each group."""
    del algo
    row = learner.inputs(state)[:1].to("meta")
    agents = [nn.ModuleList([a.policy, a.value]) for a in learner.agents.values()]
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
    return Networks.of(nn.ModuleList(agents)), each, lru_cache(update)


class Rehearsal:
    """Two worlds of a recipe after some steps; products of its sizes make the plan.

    Args:
        recipe: validated recipe; buffer, batch and worlds play no role here.
        collection: sizes of its motions.
    """

    def __init__(self, recipe: Recipe, collection: Collection) -> None:
        self.recipe, self.collection = recipe, collection
        self.hands = load_hand(recipe.hand)
        joints = self.hands["left"].num_joints
        self.library = StandIn.of(collection, joints=joints, hand=recipe.hand)
        self.bank = ReferenceBank(self.library, self.hands)
        bench = RunBuilder(_small(recipe), self.library, self.hands, self.bank)
        env = bench.make_env()
        self._batch = cast(CpuPhysics, env.physics).batch
        self.model = env.physics.scenes[0].model
        learner, self._ring = bench.make_learner(env), EpisodeRecorder(env)
        td: Any = env.rand_step(env.reset())
        self._ring.record_start()
        after, action = td["next"], torch.zeros(_WORLDS, 2, joints)
        self._ring.record_step(action, after[keys.DONE], 0)
        flags, reward = (after[keys.TERMINATED], after[keys.DONE]), torch.zeros(2, 2)
        with _quiet(logging.getLogger("torchrl")):  # it tells of its buffer
            for _ in range(recipe.algo.n_step):
                learner.process_step(td, action, reward, after, flags[0], flags[1])
        ends = [list(end.select(*keys.STATE).values(True, True)) for end in (td, after)]
        self.step_bytes = tensor_bytes([ends, action, reward, flags]) // _WORLDS
        """One step of one world before packing: states, action, reward, flags."""
        buffer = replay_of(learner)
        self.row_bytes = 0 if buffer is None else row_bytes(cast(Any, buffer[:]))
        """A packed replay row; 0 where the algorithm keeps none."""
        found = ask_algorithm(recipe, learner, td)
        self.networks, self.input_bytes, self.update = found

    @cached_property
    def bank_bytes(self) -> tuple[int, int]:
        """Reference frames, and objects (points, distance grids, masses)."""
        return self.library.scale(list(self.bank.buffers()), self.collection)

    @cached_property
    def cpu(self) -> tuple[int, int]:
        """mujoco.batch: bytes a world, and a thread."""
        batch, data = self._batch, mujoco.MjData(self.model)
        derived = batch.bind("sensordata").nbytes + batch.warning.nbytes
        return batch.nstate * 8 + derived // _WORLDS, data.nbuffer + data.narena

    @cached_property
    def warp(self) -> WarpMemory:
        """mujoco_warp's arrays."""
        return measure_warp(self.library, self.hands, self.recipe.physics)

    @cached_property
    def attempt_bytes(self) -> int:
        """One step that is recorded of an attempt world."""
        halved = self.recipe.physics.engine != "cpu"  # only MuJoCo C has float64
        return sum(
            ring[0, 0].numel()
            * (4 if halved and ring.dtype == torch.float64 else ring.element_size())
            for ring in self._ring._rings.values()
        )


@contextmanager
def _quiet(logger: logging.Logger) -> Iterator[None]:
    level = logger.level
    logger.setLevel(logging.WARNING)
    yield
    logger.setLevel(level)


def _small(recipe: Recipe) -> Recipe:
    """Two worlds, one of which attempts, MuJoCo C and the narrowest networks."""
    change = dataclasses.replace
    return change(
        recipe,
        env=change(recipe.env, num_envs=_WORLDS, attempt_share=0.5, compile=False),
        physics=change(recipe.physics, engine="cpu", num_threads=1),
        algo=change(
            recipe.algo,
            device="cpu",
            compile=False,
            replay="device",
            buffer_size=_BATCH,
            batch_size=_BATCH,
            actor_width=8,
            critic_width=8,
        ),
    )
