"""A reward and an observation of one's own, registered in a script.

    python examples/03_own_reward_and_observation.py [key=value ...]

A term is a function whose keyword-only arguments are its options; a recipe then names
it like those that ship. In a package of your own it needs no registering: a recipe
names it by `_target_`, and the command allows the package (docs/extend.md).
"""

import sys

import torch

import flashdex
from flashdex import keys
from flashdex.envs.mdp import number, observation, reward


@reward(weight=0.1, needs_object=True, gate="imitation")
def steady_object(step, *, scale: float = number(1.0, above=0, high=1000)):
    """Objects that hardly turn, exp(-scale |w|).

    Args:
        scale: Steepness, s/rad.
    """
    return torch.exp(-scale * step.own_vel[..., 3:].norm(dim=-1))


@observation(needs_object=True)
def object_height(td):
    """Height of each hand's object, world, m."""
    return td[keys.OWN, "pos"][..., 2:]


mine = ["+env.rewards.steady_object.scale=0.5", "+env.transforms.object_height={}"]
recipe = flashdex.compose("quickstart", ["env.num_envs=4", *mine, *sys.argv[1:]])
plain = flashdex.compose("quickstart", ["env.num_envs=4", *sys.argv[1:]])
env, without = flashdex.make_env(recipe, seed=0), flashdex.make_env(plain, seed=0)

widths = [e.observation_spec["observation"].shape[-1] for e in (without, env)]
print(f"observation: {widths[0]} numbers, with the height {widths[1]}")
rollout = env.rollout(8, break_when_any_done=False)
for side in ("left", "right"):
    value = rollout["next", side, "reward_terms", "steady_object"].mean().item()
    print(f"{side}: steady_object {value:.3f}")
