"""Load the policy of a run, and roll it out in the environment it was trained in.

python examples/06_policy.py RUN [key=value ...]
"""

import sys

import flashdex
from flashdex.recipe import override_recipe

if len(sys.argv) < 2:
    sys.exit(__doc__)
run = flashdex.load_run(sys.argv[1])
recipe = override_recipe(run.recipe, sys.argv[2:])
env = flashdex.make_env(recipe, num_envs=4, seed=0, evaluation=True)
policy = flashdex.load_policy(run)
steps = env.base_env.max_episode_steps
rollout = env.rollout(steps, policy, auto_cast_to_device=True)
for side in ("left", "right"):
    total = rollout["next", side, "reward"].sum(1).mean().item()
    print(f"{side}: mean return {total:.3f} over {steps} steps")
