"""The tracking environment: specs, a rollout that does nothing, a random one.

    python examples/01_env.py [key=value ...]

Zero actions with residual fingers follow the reference by its joint targets alone;
random ones shake around it. The environment emits the compact state and, per hand, the
raw value of each reward term; the transforms add what a policy reads.
"""

import sys

import torch
from torchrl.envs.utils import check_env_specs

import flashdex

recipe = flashdex.compose("quickstart", ["env.num_envs=4", *sys.argv[1:]])
env = flashdex.make_env(recipe, seed=0)
check_env_specs(env)
print("groups:", env.base_env.group_map)
print("observation:", tuple(env.observation_spec["observation"].shape))


def do_nothing(td):
    """Zero residuals."""
    return td.update(env.full_action_spec.zero())


for name, policy in (("zero", do_nothing), ("random", None)):
    torch.manual_seed(0)
    rollout = env.rollout(16, policy, break_when_any_done=False)
    for side in ("left", "right"):
        reward = rollout["next", side, "reward"].mean().item()
        terms = rollout["next", side, "reward_terms"]
        best = max(terms.keys(), key=lambda term: terms[term].mean().item())
        print(f"{name}, {side}: mean reward {reward:.4f}, largest term {best}")
