"""What a stored rollout has to be: made again from library, recipe and its actions."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import torch
from torch import Tensor

from flashdex import keys
from flashdex.envs.mdp.actions import joint_target, lowpass, lowpass_alpha
from flashdex.envs.mdp.resets import first_state
from flashdex.envs.physics.state_map import StateMap
from flashdex.envs.reference import ReferenceBank, stack_hands
from flashdex.envs.scene.scene import Scene, SceneLayout, rebuild_scene
from flashdex.hands.gains import NUM_WRIST_JOINTS
from flashdex.hands.spec import HandSpec
from flashdex.motions.library import MotionLibrary
from flashdex.recipe import Recipe
from flashdex.rollouts.build import RolloutBuilder
from flashdex.rollouts.recorder import Episode
from flashdex.rollouts.rollout import Rollout


class _Scenes(Mapping[int, Scene]):
    """Scenes of single motions, built when they are asked for."""

    def __init__(self, truth: Truth) -> None:
        self._truth = truth
        self._found: dict[tuple[int, int], Scene] = {}
        self.nodes = 0  # bounding volumes of the scene that is asked for next

    def __getitem__(self, motion: int) -> Scene:
        key = (motion, self.nodes)
        if key not in self._found:
            truth = self._truth
            self._found[key] = rebuild_scene(
                truth.library,
                motion,
                truth.hands,
                truth.recipe.physics,
                truth.layout,
                nodes=self.nodes,
            )
        return self._found[key]

    def __iter__(self) -> Iterator[int]:
        return iter(range(self._truth.library.num_motions))

    def __len__(self) -> int:
        return self._truth.library.num_motions


@dataclass(frozen=True)
class Truth:
    """Recipe, library and hands of a run: nothing of what its rollouts say.

    The library holds the motions that the recipe selects; ``bank`` is on the CPU.
    """

    recipe: Recipe
    library: MotionLibrary
    hands: dict[keys.Side, HandSpec]
    bank: ReferenceBank

    @cached_property
    def layout(self) -> SceneLayout:
        """What all scenes of the run have in common."""
        return SceneLayout.of(self.library)

    @cached_property
    def _scenes(self) -> _Scenes:
        return _Scenes(self)

    def scene(self, motion: str, *, nodes: int) -> Scene:
        """Scene of a motion; ``nodes``: bounding volumes, see ``rebuild_scene``."""
        self._scenes.nodes = nodes
        return self._scenes[self.bank.names.index(motion)]

    @cached_property
    def _joint_range(self) -> Tensor:
        return stack_hands(self.hands, "joint_range")

    @property
    def step_dt(self) -> float:
        """Control step, s."""
        return self.recipe.physics.timestep * self.recipe.physics.decimation

    def num_steps(self, motion: str) -> int:
        """Control steps of a whole attempt."""
        length = int(self.bank.length[self.bank.names.index(motion)])
        return min(length - 1, round(self.recipe.env.max_seconds / self.step_dt))

    def remake(self, stored: Rollout, *, nodes: int) -> Rollout:
        """The rollout that a run would have stored, had it been in these states.

        First state, controls, reference and all that is derived come from library and
        recipe; of ``stored`` are the actions, and the states that they led to.
        """
        row = self.bank.names.index(stored.motion)
        scene = self.scene(stored.motion, nodes=nodes)
        states = StateMap(self.library, self.hands, scene)
        start = first_state(self.bank, row, self._joint_range)
        qpos0, qvel0, _ = states.write(torch.tensor([row]), **start)
        actions = torch.as_tensor(stored.actions)
        steps = len(actions)
        targets = self._targets(row, actions)
        ctrl = states.controls(torch.full((steps,), row), targets)
        episode = Episode(
            env=0,
            env_steps=stored.env_steps,
            steps={
                "qpos": stored.qpos,
                "qvel": stored.qvel,
                "ctrl": ctrl.numpy(),
                "wrench": np.zeros((steps, self.bank.num_slots, 6)),
                "action": stored.actions,
            },
            qpos0=qpos0[0].numpy(),
            qvel0=qvel0[0].numpy(),
            motion=row,
            frame=steps,
            causes={},
        )
        return self._builder(stored).build(episode)

    def _builder(self, stored: Rollout) -> RolloutBuilder:
        recipe = self.recipe
        return RolloutBuilder(
            self.bank,
            self.hands,
            self._scenes,
            decimation=recipe.physics.decimation,
            criterion=recipe.train.criterion,
            seed=recipe.seed,
            made_by=json.loads(stored.versions),
            provenance=json.loads(stored.provenance),
            motion_hash=self.library.motion_hash,
        )

    def _targets(self, row: int, actions: Tensor) -> Tensor:
        """Joint targets of an attempt's actions, (T, 2, J)."""
        env, steps = self.recipe.env, len(actions)
        frames = torch.arange(steps) + 1
        ref = self.bank.at(torch.full((steps,), row), frames, ("joint_target",))
        actions = torch.nan_to_num(actions).clamp(-1.0, 1.0)
        wrist, before = [], torch.zeros(1, 2, NUM_WRIST_JOINTS)
        alpha = lowpass_alpha(env.wrist_lowpass_hz, self.step_dt)
        for step in range(steps):
            raw = actions[step : step + 1, :, :NUM_WRIST_JOINTS]
            before = lowpass(before, raw, torch.tensor([step == 0]), alpha=alpha)
            wrist.append(before)
        scale = [env.wrist_pos_scale] * 3 + [env.wrist_rot_scale] * 3
        return joint_target(
            torch.cat(wrist),
            actions[..., NUM_WRIST_JOINTS:],
            ref["joint_target"],
            self._joint_range,
            wrist_scale=torch.tensor(scale),
            finger_scale=env.finger_scale if env.finger_mode == "residual" else None,
        )


def settings_of(recipe: Recipe) -> dict[str, Any]:
    """Physics settings as a rollout stores them: what its scene was built by."""
    return dataclasses.asdict(recipe.physics)
