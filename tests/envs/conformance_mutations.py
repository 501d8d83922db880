"""Broken engines that the suite must catch: MuJoCo models with one number off.

An edited oracle stands for the engine that would compute so. Each is compared with the
real engines in the one scenario that shows it most, so that limits which have grown too
wide to notice it fail the test.
"""

from __future__ import annotations

from collections.abc import Callable

import mujoco

Edit = Callable[[mujoco.MjModel], None]


def scaled(field: str, factor: float, index: int | slice = slice(None)) -> Edit:
    """Multiply one field of the model."""

    def edit(model: mujoco.MjModel) -> None:
        getattr(model, field)[index] *= factor

    return edit


def gain(actuator: int, stiffness: float = 1.0, damping: float = 1.0) -> Edit:
    """Scale the gains of one servo; joints and servos have one order."""

    def edit(model: mujoco.MjModel) -> None:
        model.actuator_gainprm[actuator, 0] *= stiffness
        model.actuator_biasprm[actuator, 1] *= stiffness
        model.actuator_biasprm[actuator, 2] *= damping

    return edit


def box(field: str, factor: float, column: int | slice = slice(None)) -> Edit:
    """Scale a field of the box, the last body and geom."""

    def edit(model: mujoco.MjModel) -> None:
        rows = getattr(model, field)
        index = -1 if rows.ndim == 1 else (-1, column)
        rows[index] *= factor
        mujoco.mj_setConst(model, mujoco.MjData(model))

    return edit


def option(field: str, value: float) -> Edit:
    """Set one option."""

    def edit(model: mujoco.MjModel) -> None:
        setattr(model.opt, field, value)

    return edit


def _gravity(model: mujoco.MjModel) -> None:
    model.opt.gravity[2] *= 1.01


def _timestep(model: mujoco.MjModel) -> None:
    model.opt.timestep *= 1.01


def _hand_friction(model: mujoco.MjModel) -> None:
    model.geom_friction[:-1, 0] *= 0.5


def _torsion(model: mujoco.MjModel) -> None:
    model.geom_friction[:, 1] *= 0.5  # of a pair the larger counts


def _sliding_only(model: mujoco.MjModel) -> None:
    model.geom_condim[-1] = 3


def _no_self_contact(model: mujoco.MjModel) -> None:
    hand = model.geom_bodyid[-2]
    inside = (model.geom_bodyid > 0) & (model.geom_bodyid <= hand)
    model.geom_contype[inside] = 0  # box and disc still ask for the hand's geoms


MUTATIONS: dict[str, tuple[str, Edit]] = {
    "gravity 1 % more": ("fall", _gravity),
    "time step 1 % longer": ("fall", _timestep),
    "time step 1 % longer, spin": ("spin", _timestep),
    "mass centre at the origin": ("spin", box("body_ipos", 0.0)),
    "mass 10 % more": ("hold", box("body_mass", 1.1)),
    "inertia 10 % more": ("assist", box("body_inertia", 1.1)),
    "friction halved, gripped": ("grip", box("geom_friction", 0.5, 0)),
    "friction halved, sliding": ("slide", box("geom_friction", 0.5, 0)),
    "friction of the hand halved": ("rub", _hand_friction),
    "no torsional friction": ("grip", _sliding_only),
    "pyramidal friction cone": ("grip", option("cone", 0)),
    "impratio 1": ("grip", option("impratio", 1.0)),
    "contacts twice as slow": ("slide", scaled("geom_solref", 2.0)),
    "joint limits 10 % slower": ("limits", scaled("jnt_solref", 1.1)),
    "joint ranges 1 % wider": ("limits", scaled("jnt_range", 1.01)),
    "fingers pass each other": ("fist", _no_self_contact),
    "hand weighs 1 %": ("small_steps", scaled("body_gravcomp", 0.99)),
    "armature 5 % more": ("small_steps", scaled("dof_armature", 1.05)),
    "joint damping 5 % less": ("small_steps", scaled("dof_damping", 0.95)),
    "joint friction 10 % less": ("small_steps", scaled("dof_frictionloss", 0.9)),
    **{
        f"stiffness of servo {i} 5 % more": ("small_steps", gain(i, 1.05))
        for i in range(18)
    },
    **{
        f"damping of servo {i} 5 % more": ("small_steps", gain(i, damping=1.05))
        for i in range(18)
    },
    **{
        f"force of servo {i} 5 % less": (
            "large_steps",
            scaled("actuator_forcerange", 0.95, i),
        )
        for i in range(18)
    },
}
"""The scenario that must show it, and what is broken."""
FINE_MUTATIONS: dict[str, tuple[str, Edit]] = {
    "Euler integrator": ("spin", option("integrator", 0)),
    "mass 10 % more, gripped": ("grip", box("body_mass", 1.1)),
    "mass 10 % more, lying": ("cradle", box("body_mass", 1.1)),
    "friction halved, twirling": ("twirl", box("geom_friction", 0.5, 0)),
    "torsional friction halved": ("grip", _torsion),
    "contacts 10 % slower": ("slide", scaled("geom_solref", 1.1)),
    "random play, gravity 1 % more": ("random", _gravity),
}
"""What only engines with MuJoCo's own contacts and integrator can be held to."""
