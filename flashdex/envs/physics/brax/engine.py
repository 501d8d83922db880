"""brax on MJX: physics in JAX, for TPUs, JAX users and checks across engines.

``brax.io.mjcf`` builds the system and ``brax.mjx.pipeline`` takes each substep, with
brax's rotations for the wrench. What the pipeline adds to ``mjx.step`` (link poses in
brax's form) is never read, so that the compiler drops it. brax's own ``init`` is left
out: it would compile the forward pass a second time. What this engine cannot do is in
docs/engines.md.

torch and JAX exchange arrays by DLPack on one device. JAX never writes into an array
that it was given or has returned (nothing is donated), and torch never sees the state
itself: ``brax_share`` copies what goes in, and what comes out is copied here.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from tensordict import TensorDict
from torch import Tensor

from flashdex import keys
from flashdex.envs.physics.base import Physics, RawState
from flashdex.envs.scene.scene import Scene
from flashdex.envs.scene.wrench import ObjectWrench
from flashdex.errors import FlashdexError, MissingExtraError
from flashdex.hands.spec import HandSpec
from flashdex.motions.library import MotionLibrary

if TYPE_CHECKING:
    from flashdex.envs.physics.brax.wrench import WrenchInputs
    from flashdex.envs.physics.config import PhysicsConfig


def brax_device() -> torch.device:
    """Where JAX keeps the states.

    Raises:
        MissingExtraError: brax is not installed.
    """
    try:
        import flashdex.envs.physics.brax.step  # noqa: F401, all that brax needs
        from flashdex.envs.physics.brax.step import set_up
    except ModuleNotFoundError as error:
        raise MissingExtraError(error.name or "brax", extra="brax") from error
    return set_up()


class BraxPhysics(Physics):
    """brax's MJX pipeline on all worlds at once; see ``Physics``.

    The first step compiles for about a minute with one hand, longer with more; the
    program is kept in ``~/.cache/flashdex/jax`` (or ``JAX_COMPILATION_CACHE_DIR``).

    Raises:
        MissingExtraError: brax is not installed.
        FlashdexError: motions of the collection use different objects.
    """

    def __init__(
        self,
        library: MotionLibrary,
        hands: dict[keys.Side, HandSpec],
        physics: PhysicsConfig,
        num_envs: int,
        scenes: list[Scene] | None = None,
    ) -> None:
        refuse_unlike_objects(library)
        super().__init__(library, hands, physics, num_envs, brax_device(), scenes)
        import flashdex.envs.physics.brax.step as code
        from flashdex.envs.physics.brax.model import build_model
        from flashdex.envs.physics.brax.wrench import wrench_inputs

        self._code, self._wrench_inputs = code, wrench_inputs
        self.model = build_model(self.scenes)
        sides = [keys.SIDES.index(s) for s in self.scenes[0].layout.sides]
        own_slot = code.to_jax(self.map.own_slot[:, sides])
        self._advance = code.make_advance(self.model, own_slot)
        slots = self.map.num_slots
        self._worlds = code.empty_worlds(self.model, num_envs, slots)
        self._no_wrench = self._inputs(_no_wrench(num_envs, slots, self.device))

    def _place(self, mask: Tensor, *state: Tensor) -> None:
        code = self._code
        chosen = code.to_jax(mask)
        written = self.map.write(self._motion, *state)
        flat = [code.to_jax(x) for x in (*written, self._motion)]
        placed = code.place(self._worlds, chosen, *flat)
        # Contacts at the new state: a substep whose motion is thrown away, and none
        # where no world is reset.
        probe = self._advance(placed, self._no_wrench, chosen.any().astype("int32"))
        self._worlds = code.adopt_forward(chosen, placed, probe)

    def step(self, target: Tensor, wrench: ObjectWrench | None = None) -> None:
        """Advance one control step; see ``Physics.step``."""
        ctrl = self._code.to_jax(self.map.controls(self._motion, target))
        act = self._no_wrench if wrench is None else self._inputs(wrench)
        substeps = self._code.to_jax(torch.tensor(self.decimation))
        self._worlds = self._advance(self._worlds._replace(ctrl=ctrl), act, substeps)

    def state(self) -> TensorDict:
        """Current state in the layout of ``flashdex.keys``; see ``Physics.state``."""
        now, view = self._worlds, self._code.to_torch
        flat = (view(now.qpos), view(now.qvel), view(now.contact))
        return self._state(*flat, view(now.bad).clone())

    def raw(self) -> RawState:
        """Copies of the state, float32; see ``Physics.raw``."""
        now = self._worlds
        parts = (now.qpos, now.qvel, now.ctrl, now.wrench)
        return RawState(*[self._code.to_torch(x).clone() for x in parts])

    def take_overflow(self) -> dict[str, int]:
        """Worlds that may have lost contacts since the last call; see ``Physics``.

        MJX keeps the deepest contacts, as many as ``brax_model`` gives it room for. A
        world counts when every place was taken, so that one more would have been lost.
        """
        full = self._worlds.full
        self._worlds = self._worlds._replace(full=full & False)
        worlds = int(full.sum())
        return {"contacts": worlds} if worlds else {}

    def _inputs(self, wrench: ObjectWrench) -> WrenchInputs:
        return self._wrench_inputs(wrench, self._code.to_jax)


def refuse_unlike_objects(library: MotionLibrary) -> None:
    """Check that all motions use the same objects in the same slots.

    Raises:
        FlashdexError: names the first motion that differs from the first one.
    """
    rows = library.motions["object_index"]
    unlike = (rows != rows[:1]).any(-1).nonzero().flatten().tolist()
    if unlike:
        first, other = library.names[0], library.names[unlike[0]]
        raise FlashdexError(
            f"physics=brax: motion '{other}' has other objects than '{first}'. This "
            "engine compiles one set of meshes for all worlds, so all motions of a "
            "collection must use the same objects in the same slots. Use physics=warp "
            "or physics=cpu, or select motions of the same objects."
        )


def _no_wrench(num_envs: int, slots: int, device: torch.device) -> ObjectWrench:
    """A wrench that acts on nothing."""
    zero = torch.zeros(num_envs, slots, device=device)
    return ObjectWrench(
        ref_pose=zero[..., None].expand(-1, -1, 7),
        ref_vel=zero[..., None].expand(-1, -1, 6),
        mass=zero,
        inertia=zero[..., None, None].expand(-1, -1, 3, 3),
        present=zero.bool(),
        hold=zero[:, 0],
        kp=zero[:, 0],
        kv=zero[:, 0],
        hold_stiffness=0.0,
        torque_ratio=0.0,
        force_limit=0.0,
        torque_limit=0.0,
    )
