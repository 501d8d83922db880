"""The sizes of the learner benchmark, and both learners built with equal weights."""

from __future__ import annotations

from dataclasses import dataclass, fields

import torch
from tensordict import TensorDict
from torch import Tensor, nn

from flashdex.bench.plain_learner import PlainBatch, PlainLearner
from flashdex.bench.plain_networks import (
    PlainActor,
    PlainCritics,
    PlainEncoder,
    PlainTrunk,
)
from flashdex.modules.actor import FlashActor
from flashdex.modules.critic import EnsembleCritic
from flashdex.modules.future import FutureEncoder
from flashdex.modules.trunk import FlashTrunk
from flashdex.objectives.flashsac import FlashSACLoss

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
