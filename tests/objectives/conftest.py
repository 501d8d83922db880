"""Builders shared by the tests of the objectives."""

import pytest
import torch
from tensordict import TensorDict

from flashdex.modules.actor import FlashActor
from flashdex.modules.critic import EnsembleCritic
from flashdex.modules.future import FutureEncoder
from flashdex.objectives.flashsac import FlashSACLoss

OBS, ACT, CHANNELS = 5, 2, 4


@pytest.fixture(autouse=True)
def same_draws():
    """Weights and noise do not depend on which tests ran before."""
    torch.manual_seed(0)


@pytest.fixture
def make_loss():
    def make(
        groups=("left", "right"), *, future=False, critic_action="joint", **kwargs
    ):
        num = 1 if groups is None else len(groups)

        def encoder(ensemble):
            if not future:
                return None
            return FutureEncoder(CHANNELS, latent_dim=3, ensemble=ensemble)

        actor = FlashActor(
            OBS, ACT, num_groups=num, width=8, head="unit", future_encoder=encoder(num)
        )
        critic = EnsembleCritic(
            OBS,
            ACT,
            num_groups=num,
            width=8,
            critic_action=critic_action,
            future_encoder=encoder(1),
        )
        return FlashSACLoss(actor, critic, groups=groups, **kwargs)

    return make


@pytest.fixture
def make_batch():
    def make(groups=("left", "right"), *, size=16, seed=0):
        generator = torch.Generator().manual_seed(seed)

        def normal(*shape):
            return torch.randn(shape, generator=generator)

        td = TensorDict(
            {
                "observation": normal(size, OBS),
                "future": normal(size, CHANNELS, 10),
                "next": {
                    "observation": normal(size, OBS),
                    "future": normal(size, CHANNELS, 10),
                    "terminated": normal(size, 1) > 1,
                },
            },
            [size],
        )
        for group in [()] if groups is None else [(g,) for g in groups]:
            td.set((*group, "action"), normal(size, ACT).tanh())
            td.set(("next", *group, "reward"), normal(size, 1))
        return td

    return make
