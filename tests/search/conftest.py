"""Problems of the synthetic library."""

import pytest

from flashdex.envs.config import EnvConfig
from flashdex.envs.physics.config import PhysicsConfig
from flashdex.envs.physics.state_map import StateMap
from flashdex.envs.scene.scene import SceneLayout, rebuild_scene
from flashdex.search.problem import Problem


@pytest.fixture(scope="session")
def action_space():
    """Fields of EnvConfig: what a search stores its actions in."""
    return {
        "finger_mode": "residual",
        "finger_scale": 0.5,
        "wrist_pos_scale": 0.03,
        "wrist_rot_scale": 0.2,
        "wrist_lowpass_hz": 0.0,
    }


@pytest.fixture(scope="session")
def make_problem(library, hands, bank, action_space):
    """The problem of a motion of the synthetic library, by name."""
    physics = PhysicsConfig(num_threads=1)

    def make(name):
        row = bank.names.index(name)
        layout = SceneLayout.of(library)
        scene = rebuild_scene(library, row, hands, physics, layout, nodes=0)
        states = StateMap(library, hands, scene)
        return Problem(
            *(bank, hands, states, scene, row),
            env=EnvConfig(**action_space),
            decimation=physics.decimation,
        )

    return make
