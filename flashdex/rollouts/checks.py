"""What a stored rollout says, against what can be recomputed: each difference by name.

Nothing of the file is trusted but its first state, its actions and its controls, and
these only where no library is at hand.
"""

from __future__ import annotations

import json
import math
from dataclasses import fields
from typing import Any

import mujoco
import numpy as np

from flashdex.envs.physics.config import PhysicsConfig
from flashdex.errors import FlashdexError
from flashdex.hands.spec import load_hand
from flashdex.metrics.criteria_table import resolve_criterion
from flashdex.recipe.check import build_config
from flashdex.rollouts.build import grace_steps, link_names
from flashdex.rollouts.certificate import DEVIATION_M, DEVIATION_RAD
from flashdex.rollouts.findings import Finding, Notes, differences, is_date, short
from flashdex.rollouts.models import compare_models, implausible, rebuild_around
from flashdex.rollouts.resimulation import (
    Simulation,
    load_simulation,
    object_poses,
    simulate,
    tracked_points,
)
from flashdex.rollouts.rollout import (
    MADE_BY,
    OF_SEARCH,
    PROVENANCE,
    Rollout,
    bindings_of,
    is_search_part,
)
from flashdex.rollouts.safety import state_deviation
from flashdex.rollouts.truth import Truth, settings_of
from flashdex.system.machine import versions
from flashdex.system.mjcf import compile_mjcf

NO_LIBRARY = "its library is not at hand"
SAME = 1e-6  # m, rad, m/s, rad/s; of numbers that one machine computes twice
ALIKE = 1e-4  # of float32 numbers that another engine computed
POINTS = 1e-5  # m; stored points come from float32 kinematics
UNIT = 1e-4  # of the length of a quaternion
IMPACTS = 0.05  # share of steps that another engine may resolve differently
# of numbers that stand where a scene has others
_UNFIT = (ValueError, KeyError, TypeError, IndexError, OverflowError)
MAX_SUBSTEPS = 1_000_000  # of a file that says itself how many; an hour at 60 Hz
# of the file alone: no library says them, hashes bind them
_UNBOUND = {"provenance", "versions", "errors", "env_steps", "model_xml"}
_STATES = {"qpos", "qvel"}  # simulated anew, see ``_states``


class RolloutCheck(Notes):
    """All that is found in one rollout; ``run`` it once.

    Args:
        rollout: as loaded.
        file: its name, for the findings.
        truth: recipe that it was made by, and its library; None when they are not at
            hand.
        is_miss: it need not pass, nor last as long as its motion.
    """

    def __init__(
        self,
        rollout: Rollout,
        file: str,
        truth: Truth | None,
        *,
        is_miss: bool = False,
    ) -> None:
        super().__init__(file)
        self.rollout, self.truth, self.is_miss = rollout, truth, is_miss
        self.is_sound = False  # its numbers mean something
        self.model: mujoco.MjModel | None = None  # to be simulated; None: it may not
        self._provenance = json.loads(rollout.provenance)
        self._versions = json.loads(rollout.versions)

    def run(self) -> list[Finding]:
        """Check everything that the findings before leave a meaning."""
        self._plain()
        self.is_sound = not self.findings
        if not self.is_sound:
            return self.findings
        self._bound()
        simulation = self._simulation()
        if simulation is not None and self.model is not None:
            # of the run's own solver effort, which a certificate raises
            self._states(self.model)
            self._derived(simulation)
        self._scores()
        self._truth()
        return self.findings

    def _simulation(self) -> Simulation | None:
        """What may be simulated, or None: it must not be, or cannot."""
        try:
            self._model()
            if self.model is not None:
                return load_simulation(self.rollout, self.model)
        except FlashdexError as error:
            self.fault("model", str(error))
            self.model = None
        return None

    def _plain(self) -> None:
        """Numbers that are none, rotations that are none, sizes without meaning."""
        r = self.rollout
        for name in _array_names(r):
            value = np.asarray(getattr(r, name))
            if not np.isfinite(value).all():
                at = np.argwhere(~np.isfinite(value))[0].tolist()
                self.fault(name, f"is not finite at {at}")
        if r.num_frames == 0:
            self.fault("frames", "there are none")
        elif r.num_frames * r.decimation > MAX_SUBSTEPS:
            self.fault("frames", f"{r.num_frames} of them are no motion")
        elif r.grace != grace_steps(r.fps):
            self.fault("grace", f"is {r.grace}, expected {grace_steps(r.fps)}")
        is_cut = r.num_frames < r.reference_length
        if is_cut and self.truth is None and not self.is_miss:
            self.fault("frames", f"{r.num_frames} of {r.reference_length} are left")
        try:
            resolve_criterion(r.criterion)
        except FlashdexError as error:
            self.fault("criterion", str(error))
        if not self.findings:
            self._quaternions()

    def _quaternions(self) -> None:
        r = self.rollout
        present = np.flatnonzero(np.asarray(r.object_qpos_adr) >= 0)
        found = [
            ("object_quat", r.object_quat[:, present]),
            ("ref_object_quat", r.ref_object_quat[:, present]),
        ]
        for adr in np.asarray(r.object_qpos_adr)[present].tolist():
            found.append(("qpos0", r.qpos0[adr + 3 : adr + 7]))
            found.append(("qpos", r.qpos[:, adr + 3 : adr + 7]))
        for name, quat in found:
            length = np.linalg.norm(quat, axis=-1)
            if quat.shape[-1] != 4 or (np.abs(length - 1) > UNIT).any():
                self.fault(name, "holds a quaternion that is no rotation")

    def _bound(self) -> None:
        """Hashes and limits that the file itself carries, and that it has them all."""
        r, said, made_by = self.rollout, self._provenance, self._versions
        if not is_search_part(said.get(OF_SEARCH, {"rung": 0, "attempt_s": 0})):
            self.fault("provenance", f"{short(said[OF_SEARCH])} is of no search")
        for name in PROVENANCE.keys() ^ (said.keys() - {OF_SEARCH}):
            self.fault("provenance", f"{'holds' if name in said else 'lacks'} {name!a}")
        for name in PROVENANCE.keys() & said.keys():
            if type(said[name]) is not PROVENANCE[name]:
                self.fault("provenance", f"has {short(said[name])} as '{name}'")
        if "date" in said and not is_date(said["date"]):
            self.fault("provenance", f"{short(said['date'])} is no date")
        for name in MADE_BY:
            if type(made_by.get(name)) is not str:
                self.fault("versions", f"has {short(made_by.get(name))} as '{name}'")
        for name, value in bindings_of(r).items():
            if name in said:
                for text in differences(said[name], value, at=name, tolerance=0.0):
                    self.fault(name, text)
        wrench = r.wrench
        if wrench is not None and np.abs(wrench).max(initial=0.0) > 0:
            self.fault("wrench", f"is up to {np.abs(wrench).max():.3g}, expected none")

    def _model(self) -> None:
        """The stored model against one built anew; sets what may be simulated."""
        r = self.rollout
        where = f"{self.file}: model_xml"
        truth = self.truth
        if truth is None or r.motion not in truth.bank.names:
            self.model = compile_mjcf(r.model_xml, where=where)
            self._model_alone(self.model)
            return
        scene = truth.scene(r.motion, nodes=0)
        if r.model_xml == scene.xml:
            self.model = scene.model
            return
        # of a collection of several scenes, padded to the largest
        stored = self.model = compile_mjcf(r.model_xml, where=where)
        scene = truth.scene(r.motion, nodes=stored.nbvh)
        if r.model_xml != scene.xml:
            exact = self._versions.get("mujoco") == mujoco.__version__
            self._compare(stored, scene.model, exact=exact)
        bodies = load_simulation(r, scene.model).object_body
        for name, text in implausible(scene.model, bodies).items():
            self.skip(f"model {name}", f"{text}, by recipe and library themselves")

    def _model_alone(self, model: mujoco.MjModel) -> None:
        """Without library: everything but shapes, masses and supports."""
        r = self.rollout
        settings, hands = self._settings(), None
        try:
            hands = load_hand(r.hand)
        except FlashdexError:
            self.fault(
                "hand", f"'{r.hand}' is not known here; install the package of it"
            )
        bodies = load_simulation(r, model).object_body
        for name, text in implausible(model, bodies).items():
            self.fault(f"model {name}", text)
        if settings is None or hands is None:
            return
        try:
            slots = np.asarray(r.hand_object).tolist()
            around = rebuild_around(r.model_xml, model, hands, settings, slots)
        except (*_UNFIT, mujoco.FatalError) as error:
            self.fault("model", f"is no scene of this hand ({error})")
            return
        if r.joint_bodies != link_names(hands):
            self.fault("joint_bodies", "are not the links of this hand")
        self._compare(model, around, exact=False)
        self.skip("model", f"shapes, masses and supports of objects: {NO_LIBRARY}")

    def _settings(self) -> PhysicsConfig | None:
        """Physics settings that the file names; None, and a fault, where it cannot."""
        stored = self._provenance.get("physics")
        names = {field.name for field in fields(PhysicsConfig)}
        if not isinstance(stored, dict) or stored.keys() != names:
            self.fault("physics", "are not all of the settings, or more")
            return None
        problems: list[str] = []
        settings = build_config(PhysicsConfig, stored, "physics", problems)
        if problems:
            self.fault("physics", f"are no settings ({problems[0]})")
            return None
        step = settings.timestep * settings.decimation * self.rollout.fps
        if settings.decimation != self.rollout.decimation or not abs(step - 1) < 1e-3:
            self.fault("physics", f"{step:.3g} control steps in one")
        return settings

    def _compare(
        self, stored: mujoco.MjModel, expected: mujoco.MjModel, *, exact: bool
    ) -> None:
        for name, text in compare_models(stored, expected, exact=exact).items():
            self.fault(f"model {name}", text)

    def _states(self, model: mujoco.MjModel) -> None:
        """The states that follow from the first one and the controls."""
        r = self.rollout
        run = simulate(model, r)
        worst = {n: np.abs(v - getattr(r, n)).max(axis=1) for n, v in run.items()}
        if all((error <= SAME).all() for error in worst.values()):
            return
        here = versions()
        same = all(
            self._versions.get(k) == here[k] for k in ("mujoco", "engine")
        ) and _machine(self._versions) == _machine(here)
        if same:
            for name, error in worst.items():
                beyond = np.flatnonzero(~(error <= SAME))
                if len(beyond):
                    self.fault(
                        name,
                        f"leaves what the controls lead to at frame {beyond[0]}, by up "
                        f"to {error.max():.3g}",
                    )
            return
        self._single_steps(model)

    def _single_steps(self, model: mujoco.MjModel) -> None:
        """Of another engine or machine: does each state follow from the one before?"""
        r = self.rollout
        run = simulate(model, r, single=True)
        shift, turn = state_deviation(model, run["qpos"], r.qpos)
        beyond = ~((shift <= DEVIATION_M) & (turn <= DEVIATION_RAD))
        if beyond.mean() > IMPACTS:
            self.fault(
                "qpos",
                f"{beyond.mean():.0%} of the states do not follow from the one before, "
                f"first at frame {int(np.flatnonzero(beyond)[0])}",
            )
        made = f"{self._versions.get('engine')} on {_machine(self._versions)}"
        self.skip(
            "qpos, qvel", f"to the last digit: made by {made}, checked step by step"
        )

    def _derived(self, simulation: Simulation) -> None:
        """Points and poses that follow from the stored positions."""
        r = self.rollout
        active = np.flatnonzero(r.hand_active)
        slots = np.flatnonzero(np.asarray(r.object_qpos_adr) >= 0)
        points = tracked_points(simulation, r.qpos)
        for name, value in (points | object_poses(simulation, r.qpos)).items():
            stored = getattr(r, name)
            rows = slots if name.startswith("object") else active
            if stored is None:
                continue
            if value is None:
                self.skip(name, "the model lacks some of its points")
                continue
            error = np.abs(value[:, rows] - stored[:, rows]).max(initial=0.0)
            if not error <= POINTS:
                self.fault(name, f"is up to {error:.3g} off the stored positions")

    def _scores(self) -> None:
        r = self.rollout
        verdict = r.score()[resolve_criterion(r.criterion)]
        if verdict.is_passed == self.is_miss:
            word = f"not passed: {verdict.reason}" if verdict.reason else "passed"
            self.fault("criterion", f"{verdict.name} is {word}")
        expected = {k: round(v, 6) for k, v in verdict.values.items()}
        for text in differences(json.loads(r.errors), expected, tolerance=2e-6):
            self.fault("errors", text)

    def _truth(self) -> None:
        """Field by field against the rollout that recipe and library give."""
        r, truth = self.rollout, self.truth
        if truth is None:
            self.skip("roles, reference, first state, actions, criterion", NO_LIBRARY)
            return
        if r.motion not in truth.bank.names:
            self.fault("motion", f"'{r.motion}' is none of the run's")
            return
        steps = truth.num_steps(r.motion)
        if r.num_frames > steps or (r.num_frames < steps and not self.is_miss):
            self.fault("frames", f"{r.num_frames}, expected {steps}")
            return
        if r.actions.shape != (r.num_frames, 2, truth.bank.num_joints):
            self.fault("actions", f"have shape {r.actions.shape}")
            return
        nodes = 0 if self.model is None else self.model.nbvh
        model = truth.scene(r.motion, nodes=nodes).model
        if (r.qpos.shape[1], r.qvel.shape[1]) != (model.nq, model.nv):
            self.fault("qpos", f"{r.qpos.shape[1]} columns, expected {model.nq}")
            return
        self._fields(truth.remake(r, nodes=nodes))
        expected = json.loads(json.dumps(settings_of(truth.recipe)))
        for text in differences(self._provenance.get("physics"), expected, at="is"):
            self.fault("physics", f"{text}, by the recipe of the run")
        engine = truth.recipe.physics.engine
        if self._versions.get("engine") != engine:
            self.fault("versions", f"engine is another than the recipe's, {engine}")

    def _fields(self, expected: Rollout) -> None:
        is_own = self._versions.get("engine") == "cpu"
        skipped = _UNBOUND | _STATES | {"model_sha256"}
        for name in (f.name for f in fields(Rollout)):
            a, b = getattr(self.rollout, name), getattr(expected, name)
            if name in skipped:
                continue
            if isinstance(a, np.ndarray) and isinstance(b, np.ndarray):
                error = _distance(a, b)
                if not error <= (SAME if is_own else ALIKE):
                    self.fault(name, f"is up to {error:.3g} off what the library gives")
            elif (a is None) != (b is None) or a != b:
                self.fault(name, f"is {short(a)}, expected {short(b)}")


def _array_names(rollout: Rollout) -> list[str]:
    names = (f.name for f in fields(Rollout))
    return [n for n in names if isinstance(getattr(rollout, n), np.ndarray)]


def _distance(a: np.ndarray, b: np.ndarray) -> float:
    if a.shape != b.shape:
        return math.inf
    return float(np.abs(a.astype(float) - b.astype(float)).max(initial=0.0))


def _machine(made_by: dict[str, Any]) -> str:
    """Kind of processor: ``x86_64`` of ``NVIDIA H200, x86_64, 16 CPU cores``."""
    words = str(made_by.get("hardware", "")).split(", ")
    return words[-2] if len(words) > 1 else ""
