"""How far each engine may be from MuJoCo C: one table, with reasons.

Every figure is about twice the largest difference over four seeds of the script; what
was measured stands in docs/engines.md. ``conformance_mutations.py`` holds that the
figures still tell a broken engine from a sound one.

MJX integrates in another way than MuJoCo 4 (``step_like_mjx``). So brax is compared
twice: as it is, and with MuJoCo C integrated in MJX's way, which leaves only contact
and rounding, so that small faults cannot hide behind the known difference.
"""

from __future__ import annotations

from typing import Literal, NamedTuple

Column = Literal["cpu", "warp", "brax", "brax_own"]
Engine = Literal["cpu", "warp", "brax"]
ENGINES: tuple[Engine, ...] = ("cpu", "warp", "brax")
STEPS_OF = {"cpu": 200, "warp": 200, "brax": 90}
"""Control steps run; MJX needs about half a second for one of all worlds on a core."""


class Limit(NamedTuple):
    """Largest difference allowed.

    Attributes:
        cpu: of ``mujoco.batch``, float64: only what it reports is rounded to float32.
        warp: of mujoco_warp, float32 throughout.
        brax: of MJX, float32 throughout.
        brax_own: of MJX, from MuJoCo C that integrates as MJX does.
        unit: of the figures.
        why: where the difference comes from.
    """

    cpu: float
    warp: float
    brax: float
    brax_own: float
    unit: str
    why: str


_FREE = "rounding over 200 substeps; MJX integrates free bodies in another way"
_SERVO = "rounding; servos pull every joint back, so that nothing grows"
_FORCE = "as small_steps; MJX integrates saturated servos in another way"
_FIST = "as large_steps, and contact of the fingers with the thumb"
_PULL = "rounding; the pull brings the box back; MJX integrates spin in another way"
_LAND = "rounding and the solver's tolerance through impacts; MJX finds other contacts"
_SLIP = "rounding and tolerance while the box slips; MJX finds other contacts"
_GRIP = "contacts of capsules with box edges, which few micrometres move far"
_PART = "contact multiplies rounding until paths part; MJX finds other contacts"
_LATE = "paths have parted: only the statistics of four worlds are compared"
_HEAVY = "the mean over a second in which the box still moves a little, in C too"

LIMITS: dict[str, Limit] = {
    "fall.formula": Limit(
        *(1.1e-5, 2.5e-5, 2.5e-5, 2.5e-5, "m"),
        "the scene's text rounds the time step to six digits; then as fall.pose",
    ),
    "fall.pose": Limit(2.5e-7, 2.5e-5, 2.5e-5, 2.5e-5, "m", _FREE),
    "spin.momentum": Limit(
        *(0.006, 0.006, 0.006, 0.006, "of it"),
        "the integrators' own error with gyroscopic forces: MuJoCo C has the same",
    ),
    "spin.turn": Limit(2e-7, 5e-6, 0.03, 3e-6, "rad", _FREE),
    "spin.pos": Limit(3.5e-7, 4e-6, 2.6e-4, 3.5e-6, "m", _FREE),
    "limits.path": Limit(5e-7, 1.6e-5, 7e-5, 7e-5, "m, rad", _SERVO),
    "limits.rest": Limit(5e-7, 1.6e-5, 6e-6, 6e-6, "m, rad", _SERVO),
    "small_steps.max": Limit(1.2e-7, 8e-6, 1e-6, 1e-6, "m, rad", _SERVO),
    "small_steps.rms": Limit(7e-8, 3e-6, 4e-7, 4e-7, "m, rad", _SERVO),
    "large_steps.max": Limit(1.2e-7, 7e-6, 0.42, 4e-6, "m, rad", _FORCE),
    "large_steps.rms": Limit(7e-8, 2.5e-6, 0.1, 6e-7, "m, rad", _FORCE),
    "fist.max": Limit(1.2e-7, 1.7e-5, 0.32, 4.6e-3, "m, rad", _FIST),
    "fist.rms": Limit(7e-8, 6e-6, 0.08, 9e-4, "m, rad", _FIST),
    "grip.weight": Limit(0.005, 0.005, 0.008, 0.008, "of it", _HEAVY),
    "grip.force": Limit(1e-7, 0.17, 1.1, 1.1, "N", _GRIP),
    "grip.pos": Limit(1e-8, 8e-4, 3.6e-3, 3.6e-3, "m", _GRIP),
    "grip.turn": Limit(1.3e-7, 0.02, 0.24, 0.24, "rad", _GRIP),
    "grip.drift": Limit(1e-8, 8e-5, 5.5e-4, 5.5e-4, "m", _GRIP),
    "cradle.weight": Limit(2.5e-4, 2.5e-4, 1.1e-3, 1.1e-3, "of it", _HEAVY),
    "cradle.force": Limit(1e-8, 4e-3, 0.3, 0.3, "N", _LAND),
    "cradle.pos": Limit(6e-8, 4e-6, 1.7e-3, 1.7e-3, "m", _LAND),
    "cradle.turn": Limit(1.3e-7, 1.3e-4, 0.07, 0.07, "rad", _LAND),
    "cradle.drift": Limit(8e-8, 2e-6, 5e-4, 5e-4, "m", _LAND),
    "cradle.land_pos": Limit(6e-8, 3e-6, 2.2e-3, 2.2e-3, "m", _LAND),
    "cradle.land_turn": Limit(1.3e-7, 1.6e-4, 0.11, 0.11, "rad", _LAND),
    "slide.pos": Limit(2e-9, 1e-7, 1.6e-4, 1.6e-4, "m", _SLIP),
    "slide.turn": Limit(1.3e-7, 6e-7, 5e-3, 5e-3, "rad", _SLIP),
    "twirl.pos": Limit(2e-9, 1e-6, 5.5e-3, 5.5e-3, "m", _SLIP),
    "twirl.turn": Limit(1.3e-7, 3.5e-5, 0.2, 0.2, "rad", _SLIP),
    "rub.max": Limit(2.5e-7, 7e-6, 0.02, 0.02, "m, rad", _SLIP),
    "rub.rms": Limit(1.4e-7, 4e-6, 5.5e-3, 5.5e-3, "m, rad", _SLIP),
    "hold.pos": Limit(7e-8, 8e-7, 3e-6, 8e-7, "m", _PULL),
    "hold.turn": Limit(1.3e-7, 1.6e-6, 2e-4, 5e-7, "rad", _PULL),
    "assist.pos": Limit(4e-8, 1.6e-7, 2.3e-4, 1.6e-7, "m", _PULL),
    "assist.turn": Limit(1.3e-7, 5e-7, 2.3e-3, 5e-7, "rad", _PULL),
    "random.joints_early": Limit(2.5e-7, 4e-3, 0.6, 0.6, "m, rad", _PART),
    "random.object_early": Limit(4e-9, 2e-4, 0.045, 0.045, "m", _PART),
    "random.joints_middle": Limit(1.3e-7, 4e-4, 0.3, 0.27, "m, rad", _PART),
    "random.object_middle": Limit(2e-9, 6e-5, 0.014, 0.014, "m", _PART),
    "random.joints_late": Limit(1.3e-7, 0.15, 0.4, 0.4, "m, rad", _LATE),
    "random.push_late": Limit(2e-9, 0.35, 0.45, 0.6, "of it", _LATE),
    "random.height_late": Limit(1e-10, 0.005, 0.009, 0.012, "m", _LATE),
}
RESET_LIMITS: dict[str, Limit] = {
    "reset.state": Limit(
        *(0.0, 0.0, 0.0, 0.0, "m, rad, /s"), "what was written, in float32, unchanged"
    ),
    "reset.spin": Limit(
        *(7e-7, 7e-7, 7e-7, 7e-7, "rad/s"), "turned to body axes and back, in float32"
    ),
    "reset.force": Limit(
        *(4e-7, 2.5e-3, 7.0, 0.8, "N"),
        "the solver's tolerance; MJX finds other contacts",
    ),
    "reset.point": Limit(
        *(3e-8, 1e-6, 0.017, 0.017, "m"), "mean of the points, weighted by those forces"
    ),
}
