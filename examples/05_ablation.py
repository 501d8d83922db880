"""An ablation in Python: take one observation block out, and see what is left.

    python examples/05_ablation.py [key=value ...]

In a recipe the same is one line, `~env.transforms.surface_distance`.
"""

import sys

from torchrl.envs import TransformedEnv

import flashdex
from flashdex import keys

recipe = flashdex.compose("quickstart", ["env.num_envs=4", *sys.argv[1:]])
env = flashdex.make_env(recipe, seed=0)
names = [name for name, options in recipe.env.transforms.items() if options is not None]
print("blocks:", ", ".join(names))

less = TransformedEnv(flashdex.make_env(recipe, seed=0).base_env)
for transform in env.transform:
    if (keys.BLOCKS, "surface_distance") not in transform.out_keys:
        less.append_transform(transform.clone())

for title, some in (("all", env), ("without surface_distance", less)):
    width = some.rollout(4)["observation"].shape[-1]
    print(f"{title}: {width} numbers")

same = flashdex.compose(
    "quickstart", ["~env.transforms.surface_distance", *sys.argv[1:]]
)
other = flashdex.make_env(same, num_envs=4)
print("by the recipe:", other.observation_spec["observation"].shape[-1], "numbers")
