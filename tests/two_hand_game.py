"""A one-step game of two hands whose equilibria are known in closed form.

With the state s in [-1, 1]^2 and one action a hand, x = (left, right) in [-1, 1]^2,

    r_left  = 2 - (x_left - p_left + .5 x_right)^2 - (x_right - .3)^2
    r_right = 2 - (x_right - p_right - .8 x_left)^2 - (x_left - .6)^2

with ``p = .2 s + (-.5, .5)``. The first term is a hand's own task, which the other hand
shifts; the second is what the other hand's action costs it, and a hand that looks after
itself cannot change that. Write ``M = [[1, .5], [-.8, 1]]`` and ``q = (.6, .3)``:

* Nash equilibrium, each hand best against the other: ``M x = p``.
* Team optimum, maximum of the sum: ``(M^T M + I) x = M^T p + q``.
* Blind optimum, each hand best against a uniform other: ``x = p``.

They lie 0.31 to 0.36 apart (root mean square) and inside |x| < 0.75. Every step
terminates, so that Q is the reward itself.

Which of them a learner finds follows from what its critic reads and where its actor's
gradient goes; see `VARIANTS`.
"""

from __future__ import annotations

import torch
from tensordict import TensorDict

from flashdex.modules.actor import FlashActor
from flashdex.modules.critic import EnsembleCritic
from flashdex.objectives.flashsac import FlashSACLoss
from flashdex.objectives.stepper import FlashSACStepper

SIDES = ("left", "right")
CENTRE = torch.tensor([-0.5, 0.5])
SLOPE = 0.2
COUPLING = torch.tensor([[1.0, 0.5], [-0.8, 1.0]])
WISH = torch.tensor([0.6, 0.3])

VARIANTS = {
    # joint critics, own-action gate: each hand climbs its own reward -> Nash
    "gated": {},
    # joint critics, no gate: both hands climb the sum of both values -> team
    "ungated": {"gate": False},
    # one tower and one critic on the summed reward -> team
    "unified": {"unified": True},
    # own-action critics average over the replayed other hand; uniform: E = 0 -> blind
    "own": {"own": True},
    # the same, but the replayed other hand is the present policy -> Nash
    "own on policy": {"own": True, "on_policy": True},
}


def aims(state):
    """``p = .2 s + (-.5, .5)``, (B, 2)."""
    return SLOPE * state + CENTRE


def rewards(state, action):
    """Rewards of left and right, (B, 2), of actions (B, 2)."""
    task = (action @ COUPLING.T - aims(state)).square()
    burden = (action - WISH).square().flip(-1)
    return 2.0 - task - burden


def nash(state):
    """Equilibrium in which neither hand gains by moving alone, (B, 2)."""
    return aims(state) @ torch.linalg.inv(COUPLING).T


def team(state):
    """Actions of the largest summed reward, (B, 2)."""
    normal = COUPLING.T @ COUPLING + torch.eye(2)
    return (aims(state) @ COUPLING + WISH) @ torch.linalg.inv(normal)


def blind(state):
    """Best own action against a uniform action of the other hand, (B, 2)."""
    return aims(state)


OPTIMA = {"nash": nash, "team": team, "blind": blind}


def _make_stepper(updates, generator, *, unified, own, gate):
    """Small networks; temperature 1e-4 that can only fall; actor starts late."""
    num = 1 if unified else 2
    sizes = {"num_groups": num, "width": 32, "num_blocks": 1}
    actor = FlashActor(2, 2 // num, init_std=0.1, **sizes)
    # deterministic rewards: few atoms, whose neighbours share the mass, fit fastest
    kind = "own" if own else "joint"
    critic = EnsembleCritic(2, 2 // num, num_atoms=21, critic_action=kind, **sizes)
    loss = FlashSACLoss(
        actor,
        critic,
        groups=None if unified else SIDES,
        alpha_init=1e-4,
        target_sigma=0.007,  # the smallest std of the head: never too little entropy
        own_action_gate=gate,
    )
    return FlashSACStepper(
        loss,
        lr=3e-3,
        lr_end=1e-4,
        total_updates=updates,
        actor_lr_scale=0.3,
        actor_delay=updates // 3,
        generator=generator,
    )


def _rows(state, action, unified):
    size = len(state)
    following = {
        "observation": state.flip(0),
        "terminated": torch.ones(size, 1, dtype=torch.bool),
    }
    td = TensorDict({"observation": state, "next": following}, [size])
    reward = rewards(state, action)
    if unified:
        td["action"] = action
        # half of the sum: stays on the support, same optimum
        td["next", "reward"] = reward.mean(-1, keepdim=True)
        return td
    for h, side in enumerate(SIDES):
        td[side, "action"] = action[:, h : h + 1]
        td["next", side, "reward"] = reward[:, h : h + 1]
    return td


@torch.no_grad()
def _act(actor, state):
    mean, _ = actor(state, mode="eval")
    return torch.cat([*mean.tanh()], -1)


def train(variant, *, seed, updates=400, batch_size=128):
    """Train on fresh rows in every update.

    Behaviour is uniform in [-1, 1]^2, or the policy's action +- 0.4 for ``on_policy``.

    Args:
        variant: key of `VARIANTS`.
        seed: of networks, states and actions.
        updates: critic updates; the actor joins after a third.
        batch_size: rows an update.

    Returns:
        Root mean square distance of the deterministic policy to each of `OPTIMA`.
    """
    options = {"unified": False, "own": False, "gate": True, **VARIANTS[variant]}
    on_policy = options.pop("on_policy", False)
    generator = torch.Generator().manual_seed(seed)
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        stepper = _make_stepper(updates, generator, **options)
    actor = stepper.loss.actor_network

    def uniform(size):
        return 2 * torch.rand(size, 2, generator=generator) - 1

    for _ in range(updates):
        state, action = uniform(batch_size), uniform(batch_size)
        if on_policy:
            action = (_act(actor, state) + 0.4 * action).clamp(-1, 1)
        stepper.update(_rows(state, action, options["unified"]))
    state = uniform(1000)
    action = _act(actor, state)
    return {
        name: (action - optimum(state)).square().mean().sqrt().item()
        for name, optimum in OPTIMA.items()
    }
