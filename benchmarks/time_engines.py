"""Time engines on one hand and one box: first step (compilation included) and later.

Prints one JSON line an engine. ``python -m benchmarks.time_engines cpu brax``.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from pathlib import Path

import torch

from flashdex.envs.physics.config import PhysicsConfig
from flashdex.envs.physics.make import make_physics
from flashdex.envs.reference import ReferenceBank
from flashdex.hands.spec import load_hand
from tests.envs.reduced import reduced_library


def time_engine(engine: str, num_envs: int, steps: int) -> dict[str, float | str]:
    """Step all worlds along the reference; seconds and milliseconds."""
    hands = load_hand("xhand")
    with tempfile.TemporaryDirectory() as folder:
        library = reduced_library(Path(folder) / "library", hands)
        config = PhysicsConfig(engine=engine, num_threads=1)  # type: ignore[arg-type]
        start = time.perf_counter()
        physics = make_physics(library, hands, config, num_envs)
        motion = torch.zeros(num_envs, dtype=torch.long)
        ref = ReferenceBank(library, hands).at(motion, motion + 5)
        pose = torch.cat([ref["object_pos"], ref["object_quat"]], -1)
        still = torch.zeros(num_envs, 2, 6)
        mask = torch.ones(num_envs, dtype=torch.bool)
        state = [ref["joint_pos"], ref["joint_vel"], pose, still]
        device = [x.to(physics.device) for x in (mask, motion, *state)]
        physics.reset(*device)
        physics.step(device[2])
        physics.state()["bad"].cpu()
        first = time.perf_counter() - start
        start = time.perf_counter()
        for _ in range(steps):
            physics.step(device[2])
        physics.state()["bad"].cpu()
        each = (time.perf_counter() - start) / steps
    return {
        "engine": engine,
        "num_envs": num_envs,
        "first_step_s": round(first, 1),
        "step_ms": round(each * 1e3, 3),
        "env_steps_per_s": round(num_envs / each, 1),
    }


def main() -> None:
    """Read the arguments and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("engines", nargs="+")
    parser.add_argument("--num-envs", type=int, default=4)
    parser.add_argument("--steps", type=int, default=50)
    args = parser.parse_args()
    for engine in args.engines:
        print(json.dumps(time_engine(engine, args.num_envs, args.steps)), flush=True)


if __name__ == "__main__":
    main()
