"""Certificate of a conversion: the stored controls, re-simulated open loop in MuJoCo C.

A conversion is a claim of the training physics. The certificate replays it from the
stored first state, as it is and under small perturbations, and says what held.
"""

from __future__ import annotations

import json
import math
import platform
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from flashdex.envs.scene.perturbation import PERTURBATION, Perturbation
from flashdex.metrics.criteria import resolve_criterion
from flashdex.metrics.criteria_table import CertificateVerdict, Verdict
from flashdex.rollouts.findings import Finding, at, differences, short
from flashdex.rollouts.resimulation import (
    Replay,
    Simulation,
    load_simulation,
    model_hash,
    perturb,
    resimulate,
)
from flashdex.rollouts.rollout import Rollout
from flashdex.rollouts.safety import (
    SafetyMonitor,
    assist_sources,
    joint_limit_violations,
    state_deviation,
)
from flashdex.system.files import write_atomic

CERTIFICATE_SCHEMA = 2  # 1 did not name its rollout
PROVEN = ("certified", "robust")  # verdicts of a conversion that holds
ROBUST_SHARE = 0.75  # 6 of 8 perturbed runs
# mm; the scored object positions and the stored states are copies of one another
MISMATCH_MM = 1e-3
# where a certificate was made: numbers of another processor differ in the last digits
ELSEWHERE = ("identity.certified_by", "provenance.certified_on")
BRIEF = ("state", "reason", "failing_frame", "values")  # of a perturbed verdict
DEVIATION_M, DEVIATION_RAD = 1e-3, math.radians(1.0)


@dataclass(frozen=True)
class Certificate:
    """The proof, or its failure, as plain data."""

    # certified (nominal run passes), robust (and 6 of 8 perturbed ones), failed or
    # not_measured
    verdict: CertificateVerdict
    reason: str  # why not, or empty
    identity: dict[str, Any]  # schema, motion, criterion, engines and versions
    model: dict[str, Any]  # hashes, timestep, solver settings of the re-simulation
    inputs: dict[str, Any]  # sizes of the sequence, stored and applied wrenches
    nominal: dict[str, dict[str, Any]]  # criterion -> verdict of the nominal run
    deviation: dict[str, Any]  # of the nominal run from the stored states
    perturbed: dict[str, Any]  # seed, sizes, runs, share that passed by criterion
    safety: dict[str, Any]  # penetration mm, force N, joint limits, warnings, NaN
    provenance: dict[str, Any]  # seed, env steps, hashes, hardware

    @property
    def survived(self) -> float:
        """Share of the perturbed replays that pass by the rollout's criterion."""
        return self.perturbed["pass_fraction"].get(self.identity["criterion"]) or 0.0

    def counted(self, rollout: Rollout) -> Certificate:
        """The proof of the same rollout, whose cost is known only now."""
        identity = {**self.identity, "rollout_sha256": rollout.content_sha256}
        said = {**json.loads(rollout.provenance), "env_steps": rollout.env_steps}
        provenance = {**self.provenance, **said}
        return replace(self, identity=identity, provenance=provenance)

    def to_json(self) -> str:
        """JSON text; numbers that are not finite become null."""
        text = json.dumps(asdict(self))
        finite = json.loads(text, parse_constant=lambda _: None)
        return json.dumps(finite, indent=1, allow_nan=False)

    def save(self, path: str | Path) -> Path:
        """Write the JSON in one piece, usually ``<motion>.certificate.json``."""
        path = Path(path)
        write_atomic(path, self.to_json() + "\n")
        return path


def certify(
    rollout: Rollout,
    *,
    num_perturbations: int = 8,
    seed: int = 0,
    sizes: Perturbation = PERTURBATION,
    model: mujoco.MjModel | None = None,
) -> Certificate:
    """Replay a rollout nominally and perturbed, and score it by its own criterion.

    A ``model`` that is given was compiled from the text in the rollout by somebody who
    trusts that text; it is checked, tried and compiled otherwise.

    The same file gives the same certificate on the same versions and processor type.

    Example:
        >>> certify(Rollout.load("rollouts/lift.npz")).verdict  # doctest: +SKIP
        'robust'
    """
    criterion = resolve_criterion(rollout.criterion)
    sim = load_simulation(rollout, model)
    monitor = SafetyMonitor(sim.model, sim.object_body)
    nominal = resimulate(sim, monitor=monitor)
    runs = [
        resimulate(perturb(sim, sizes, seed=seed, index=index)).verdicts
        for index in range(num_perturbations)
    ]
    wrench = rollout.wrench
    stored_wrench = None if wrench is None else float(np.abs(wrench).max())
    assists = assist_sources(sim.model, sim.object_body)
    deviation = _deviation(sim, nominal)
    verdict, reason = _decide(
        nominal.verdicts[criterion],
        [run[criterion] for run in runs],
        is_assisted=bool(assists) or (stored_wrench or nominal.wrench_max) > 0,
        mismatch_mm=deviation["stored_mismatch_mm"],
    )
    return Certificate(
        verdict=verdict,
        reason=reason,
        identity=_identity(rollout, criterion),
        model=_model_part(sim),
        inputs={
            "num_frames": rollout.num_frames,
            "reference_length": rollout.reference_length,
            "decimation": rollout.decimation,
            "stored_wrench_max": stored_wrench,
            "applied_wrench_max": nominal.wrench_max,
            "assist_sources": assists,
        },
        nominal={name: v.to_dict() for name, v in nominal.verdicts.items()},
        deviation=deviation,
        perturbed=_perturbed_part(runs, seed, sizes),
        safety={
            **monitor.to_dict(),
            "joint_limits": joint_limit_violations(sim.model, nominal.qpos),
            "warnings": nominal.warnings,
            "nan_count": nominal.nan_count,
        },
        provenance={
            **json.loads(rollout.provenance),
            "seed": rollout.seed,
            "env_steps": rollout.env_steps,
            "certified_on": f"{platform.system()} {platform.machine()}",
        },
    )


def _decide(
    nominal: Verdict,
    runs: list[Verdict],
    *,
    is_assisted: bool,
    mismatch_mm: float = 0.0,
) -> tuple[CertificateVerdict, str]:
    if nominal.state == "not_measured":
        return "not_measured", nominal.reason
    if mismatch_mm > MISMATCH_MM:
        return "failed", "stored_states"
    if is_assisted:
        return "failed", "assist"
    if not nominal.is_passed:
        return "failed", nominal.reason
    passed = sum(run.is_passed for run in runs)
    is_robust = bool(runs) and passed >= math.ceil(ROBUST_SHARE * len(runs))
    return ("robust" if is_robust else "certified"), ""


def _identity(rollout: Rollout, criterion: str) -> dict[str, Any]:
    return {
        "schema": CERTIFICATE_SCHEMA,
        "motion": rollout.motion,
        "rollout_sha256": rollout.content_sha256,
        "hand": rollout.hand,
        "criterion": criterion,
        "grace": rollout.grace,
        "fps": rollout.fps,
        "produced_by": json.loads(rollout.versions),
        "certified_by": {"engine": "mujoco", "mujoco": mujoco.__version__},
    }


def _model_part(sim: Simulation) -> dict[str, Any]:
    option = sim.model.opt
    return {
        "xml_sha256": sim.rollout.model_sha256,
        "compiled_sha256": model_hash(sim.model),
        "timestep": option.timestep,
        "integrator": mujoco.mjtIntegrator(option.integrator).name,
        "solver": mujoco.mjtSolver(option.solver).name,
        "cone": mujoco.mjtCone(option.cone).name,
        "impratio": option.impratio,
        "iterations": option.iterations,
        "ls_iterations": option.ls_iterations,
        "tolerance": option.tolerance,
    }


def _deviation(sim: Simulation, nominal: Replay) -> dict[str, Any]:
    rollout = sim.rollout
    shift, turn = state_deviation(sim.model, nominal.qpos, rollout.qpos)
    # not <= : NaN counts as beyond
    beyond = np.flatnonzero(~((shift <= DEVIATION_M) & (turn <= DEVIATION_RAD)))
    stored = [
        np.abs(rollout.object_pos[:, slot] - rollout.qpos[:, adr : adr + 3]).max()
        for slot, adr in enumerate(sim.object_adr)
        if adr >= 0
    ]
    return {
        "first_frame_beyond": int(beyond[0]) if len(beyond) else -1,
        "end_mm": float(shift[-1]) * 1e3,
        "end_deg": math.degrees(turn[-1]),
        "max_mm": float(shift.max()) * 1e3,
        "max_deg": math.degrees(turn.max()),
        # object_pos was scored in training, qpos is its state: they must be one
        "stored_mismatch_mm": float(max(stored, default=0.0)) * 1e3,
    }


def _perturbed_part(
    runs: list[dict[str, Verdict]], seed: int, sizes: Perturbation
) -> dict[str, Any]:
    counts = {
        name: {
            state: sum(run[name].state == state for run in runs)
            for state in ("passed", "failed", "not_measured")
        }
        for name in (runs[0] if runs else ())
    }
    return {
        "num_runs": len(runs),
        "seed": seed,
        "sizes": asdict(sizes),
        "counts": counts,
        "pass_fraction": {
            name: count["passed"] / measured if measured else None
            for name, count in counts.items()
            for measured in [count["passed"] + count["failed"]]
        },
        "runs": [
            {name: {k: getattr(v, k) for k in BRIEF} for name, v in run.items()}
            for run in runs
        ],
    }


def compare_certificates(
    stored: dict[str, Any], new: dict[str, Any], file: str
) -> list[Finding]:
    """Every number of a stored certificate that is not that of a new one."""
    found: list[Finding] = []
    here = [at(new, *name.split(".")) for name in ELSEWHERE]
    there = [at(stored, *name.split(".")) for name in ELSEWHERE]
    if here != there:
        text = f"certified elsewhere ({short(there)}): its numbers may differ a little"
        found.append(Finding(file, "numbers", text, is_fault=False))
        stored, new = _same_anywhere(stored), _same_anywhere(new)
    return found + [
        Finding(file, text.split(" ")[0], text) for text in differences(stored, new)
    ]


def _same_anywhere(certificate: dict[str, Any]) -> dict[str, Any]:
    """What does not depend on where a certificate was made."""
    names = ("verdict", "identity", "inputs", "provenance")
    return {
        name: {k: v for k, v in part.items() if f"{name}.{k}" not in ELSEWHERE}
        if isinstance(part := certificate.get(name), dict)
        else part
        for name in names
    }
