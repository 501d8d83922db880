"""How much of a run hangs on one setting: its controls replayed under others.

    python -m benchmarks.transfer runs/myodm_xhand-search-s0 --out FILE

Every stored rollout is replayed open loop from its first state under each setting, and
the shares that pass the usual and the strict criteria are printed. Plans are blind: a
policy would react, and one planned in the harder world would plan otherwise. So a low
share says that a plan hangs on a setting, not that the motion cannot be done there.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from statistics import median
from typing import Any

import mujoco
import numpy as np

from benchmarks.common import output
from benchmarks.common.output import compose_tracking
from flashdex.errors import FlashdexError
from flashdex.recipe.store import known_groups
from flashdex.reports.text import align, plain
from flashdex.rollouts.resimulation import Simulation, load_simulation, resimulate
from flashdex.rollouts.rollout import Rollout
from flashdex.rollouts.safety import HAND, SUPPORT, SafetyMonitor, geom_kinds
from flashdex.system.files import own_files
from flashdex.system.run_files import ROLLOUTS

CRITERIA = ("sr_mt_obj", "sr_mt_obj_x0.5", "sr_mt_obj_frame", "sr_mt_obj_moved")
KINDS = {"friction": HAND, "object_friction": 0, "support_friction": SUPPORT}
# one change each of the world in which a rollout was made
SINGLE: dict[str, dict[str, Any]] = {
    "as it was made": {},
    "hand on object 2": {"hand_object": 2.0},
    "hand on object 1": {"hand_object": 1.0},
    "hand on object 0.8": {"hand_object": 0.8},
    "hand on object 0.5": {"hand_object": 0.5},
    "spin 0.05 m": {"torsional_friction": 0.05},
    "spin 0.005 m": {"torsional_friction": 0.005},
    "spin 0.001 m": {"torsional_friction": 0.001},
    "half the time step": {"substeps": 2},
    "solver cg": {"solver": "cg"},
    "solver pgs": {"solver": "pgs"},
    "hand not compensated": {"gravcomp": 0.0},
}


def worlds() -> dict[str, dict[str, Any]]:
    """Everything that the files of `recipes/world` set, as settings."""
    names = known_groups()["world"]
    found = {
        f"world={name}": compose_tracking("quickstart", [f"world={name}"]).physics
        for name in names
    }
    keys = (*KINDS, "torsional_friction", "solver", "gravcomp", "timestep")
    return {name: {k: getattr(p, k) for k in keys} for name, p in found.items()}


def change(sim: Simulation, setting: Mapping[str, Any]) -> Simulation:
    """The same controls in a model with other settings.

    Args:
        sim: stays as it is.
        setting: of `PhysicsConfig`; ``hand_object`` is the sliding friction of a pair
            of those, ``substeps`` how many take the place of one.
    """
    model, rollout = copy.deepcopy(sim.model), sim.rollout
    kinds = np.minimum(geom_kinds(model, sim.object_body), 0)  # every slot an object
    sliding = model.geom_friction[:, 0]
    for key, kind in KINDS.items():
        if key in setting:
            sliding[kinds == kind] = setting[key]
    if "hand_object" in setting:  # the larger of a pair counts
        sliding[kinds == HAND] = setting["hand_object"]
        of_object = kinds == 0
        sliding[of_object] = np.minimum(sliding[of_object], setting["hand_object"])
    if "torsional_friction" in setting:
        model.geom_friction[:, 1] = setting["torsional_friction"]
    if "solver" in setting:
        name = f"mjSOL_{setting['solver'].upper()}"
        model.opt.solver = mujoco.mjtSolver.__members__[name]
    if "gravcomp" in setting:
        driven = model.jnt_bodyid[model.actuator_trnid[:, 0]]
        in_hand = np.isin(model.body_rootid, model.body_rootid[driven])
        model.body_gravcomp[in_hand] = setting["gravcomp"]
    step = setting.get("timestep", model.opt.timestep / setting.get("substeps", 1))
    substeps = round(rollout.decimation * model.opt.timestep / step)
    model.opt.timestep *= rollout.decimation / substeps
    return replace(sim, model=model, rollout=replace(rollout, decimation=substeps))


def measure(run_dir: Path, settings: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
    """Shares of the stored rollouts of ``run_dir`` that pass, by setting."""
    files = own_files(run_dir, ROLLOUTS, "*.npz")
    if not files:
        raise FlashdexError(
            f"{run_dir}: holds no stored rollouts; give the folder of a run"
        )
    sims = [load_simulation(Rollout.load(path)) for path in files]
    rows = {}
    for name, setting in settings.items():
        replays = []
        for sim in sims:
            changed = change(sim, setting)
            monitor = SafetyMonitor(changed.model, changed.object_body)
            verdicts = resimulate(changed, monitor=monitor).verdicts
            replays.append((verdicts, monitor.to_dict()))
        rows[name] = {
            **{c: sum(v[c].is_passed for v, _ in replays) for c in CRITERIA},
            "force_n": round(median(s["force_peak"] for _, s in replays), 1),
            "penetration_mm": round(
                median(s["penetration_max_mm"] for _, s in replays), 2
            ),
            "passing": [
                sim.rollout.motion
                for sim, (verdicts, _) in zip(sims, replays, strict=True)
                if verdicts[CRITERIA[0]].is_passed
            ],
        }
    return {
        "benchmark": "transfer",
        "run": run_dir.name,
        "rollouts": len(sims),
        "rows": rows,
    }


def table(result: Mapping[str, Any]) -> str:
    """Counts for a terminal."""
    cells = [["setting", *CRITERIA, "N", "mm deep"]]
    for name, row in result["rows"].items():
        counts = [f"{row[c]}/{result['rollouts']}" for c in CRITERIA]
        peaks = plain(row["force_n"]), plain(row["penetration_mm"])
        cells.append([name, *counts, *peaks])
    return "\n".join(align(cells))


def main(words: Sequence[str] = ()) -> dict[str, Any]:
    """Replay, print the table and a JSON line; return what it says."""
    parser = output.make_parser("transfer", __doc__)
    parser.add_argument("run", type=Path, help="folder of a run")
    args = parser.parse_args(words)
    result = measure(args.run, {**SINGLE, **worlds()})
    print(table(result))
    return output.emit(result, out=args.out)


if __name__ == "__main__":
    output.run(main)
