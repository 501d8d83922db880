"""Configuration of the physics: the engine and its numbers."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from flashdex.system.fields import number


@dataclass(frozen=True, kw_only=True)
class PhysicsConfig:
    """The physics engine and its numbers."""

    engine: Literal["cpu", "warp", "brax"] = "cpu"
    """cpu = MuJoCo C on all cores; warp = all worlds on one NVIDIA GPU; brax = MJX on
    JAX, for collections whose motions all use the same objects."""
    decimation: int = number(4, low=1, high=1000)
    """Physics substeps a control step; fewer is faster and less stable."""
    timestep: float = number(1 / 240, low=1e-5, high=0.1)
    """Physics step, s; timestep x decimation must be one control step."""
    gains: Literal["vendor", "paper"] = "vendor"
    """Servo gains; vendor = what the real motors can follow (1.1 and 0.4 N m on
    XHand), paper = 20/1.5 with 100 N m, slower and far stronger."""
    gravcomp: float = number(1.0, low=0, high=1)
    """Share of the hand's own weight that the arm compensates, as controllers do for a
    tool that they were told of; never an object's. 0 is the released code."""
    friction: float = number(1.0, low=0, high=100)
    """Sliding friction of hand geoms: rubber on plastic, wood, metal or glass."""
    object_friction: float = number(0.5, low=0, high=100)
    """Sliding friction of object geoms; the larger of a pair counts."""
    support_friction: float = number(0.5, low=0, high=100)
    """Sliding friction of supports; the larger of a pair counts."""
    torsional_friction: float = number(0.005, low=0, high=1)
    """Friction against spinning in place, of all geoms, m: torque over normal force,
    about 0.6 x sliding friction x radius of the patch that touches."""
    condim: Literal[3, 4, 6] = 4
    """Contact dimensions of objects: 3 = sliding, 4 adds torsion at the fingertip, 6
    rolling."""
    impratio: float = number(10.0, above=0, high=1e4)
    """Friction over normal constraint stiffness; larger slips less."""
    support_disks: bool = True
    """Rebuild tables and shelves as discs; off, objects have no support at all."""
    hand_support_contact: bool = True
    """Hands touch supports; off, they pass through tables as in a mocap overlay."""
    solver: Literal["newton", "cg", "pgs"] = "newton"
    """Constraint solver; warp and brax have no pgs."""
    iterations: int = number(20, low=1, high=10_000)
    """Solver iterations; certificates use more."""
    ls_iterations: int = number(50, low=1, high=10_000)
    """Line-search iterations."""
    num_threads: int = number(0, low=0, high=256)
    """Threads of the cpu engine; 0 = all cores."""
    nconmax: int | None = number(None, low=1, high=10_000)
    """Contacts a world, warp only; null = four for each geom that moves. All worlds
    share the room."""
    njmax: int | None = number(None, low=1, high=20_000)
    """Constraint rows a world, warp only; null = those of so many contacts and of all
    joint limits."""
