"""Ways to tamper with a run: edits, and edits after which all hashes fit again."""

from __future__ import annotations

import json
from dataclasses import fields

import mujoco
import numpy as np

from flashdex.errors import RunError
from flashdex.metrics.criteria_table import resolve_criterion
from flashdex.rollouts.certificate import certify
from flashdex.rollouts.ledger import CONVERSIONS
from flashdex.rollouts.rollout import Rollout, bindings_of
from flashdex.rollouts.verify import verify_file
from flashdex.system.arrays import hash_content
from flashdex.system.jsonl import read_lines, write_lines

BOX = "rollouts/right_box.npz"
PROOF = "rollouts/right_box.certificate.json"
LONG = ("ctrl", "qpos", "qvel", "object_pos", "object_quat", "fingertips", "joints")
LONG += tuple(f"ref_{n}" for n in ("object_pos", "object_quat", "fingertips", "joints"))
LONG += ("actions", "wrench")


def load(path):
    with np.load(path) as file:
        return {key: file[key] for key in file.files}


def store(path, data):
    np.savez_compressed(path, **data)


def rollout_of(data):
    """A rollout of raw arrays, whatever its hashes say."""
    values = {}
    for field in fields(Rollout):
        if field.name in data:
            value = data[field.name]
            values[field.name] = value.item() if value.shape == () else value
    values["model_sha256"] = ""
    return Rollout(**values)


def forge(run, path, data):
    """Store tampered arrays, and make everything that is bound to them fit again."""
    rollout = rollout_of(data)
    said = json.loads(rollout.provenance)
    rollout.provenance = json.dumps(said | bindings_of(rollout))
    verdict = rollout.score()[resolve_criterion(rollout.criterion)]
    errors = {k: round(v, 6) for k, v in verdict.values.items()}
    rollout.errors = json.dumps(errors)
    np.savez_compressed(
        path,
        schema=1,
        **{
            f.name: value
            for f in fields(Rollout)
            if (value := getattr(rollout, f.name)) is not None
        },
    )
    certificate = path.with_name(path.stem + ".certificate.json")
    model = mujoco.MjModel.from_xml_string(rollout.model_xml)
    certify(rollout, model=model, num_perturbations=1).save(certificate)
    reseal(
        run, path, certificate, rollout.summary(resolve_criterion(rollout.criterion))
    )


def reseal(run, path, certificate, summary=None):
    """Write the ledger anew, with the hashes of the files as they are now."""
    lines = read_lines(run / CONVERSIONS)
    verdict = json.loads(certificate.read_text())["verdict"]
    for line in lines:
        if line.get("rollout") == f"rollouts/{path.name}":
            line |= summary or {}
            line["certified"] = verdict in ("certified", "robust")
            line["verdict"] = verdict
            line["rollout_sha256"] = hash_content(path)
            line["certificate_sha256"] = hash_content(certificate)
    write_lines(run / CONVERSIONS, lines)


def simulate(data):
    """Make the states of tampered controls, model or first state follow from them."""
    model = mujoco.MjModel.from_xml_string(str(data["model_xml"]))
    state = mujoco.MjData(model)
    state.qpos[:], state.qvel[:] = data["qpos0"], data["qvel0"]
    for t, row in enumerate(data["ctrl"]):
        state.ctrl[:] = row
        mujoco.mj_step(model, state, nstep=int(data["decimation"]))
        data["qpos"][t], data["qvel"][t] = state.qpos, state.qvel
    for slot, adr in enumerate(data["object_qpos_adr"].tolist()):
        if adr >= 0:
            data["object_pos"][:, slot] = data["qpos"][:, adr : adr + 3]
            data["object_quat"][:, slot] = data["qpos"][:, adr + 3 : adr + 7]


def cut(data, count):
    for name in LONG:
        if name in data:
            data[name] = data[name][:-count]


def replace_xml(data, old, new, *, count=1):
    text = str(data["model_xml"])
    assert old in text, old
    data["model_xml"] = np.asarray(text.replace(old, new, count))


def alone(path):
    """Faults of a file without its run."""
    try:
        return [str(f) for f in verify_file(path) if f.is_fault]
    except RunError as error:
        return [str(error)]


def change(name, *, at=slice(None), by):
    def run(data):
        data[name] = data[name].copy()
        data[name][at] += by

    return run


def put(name, value):
    def run(data):
        data[name] = np.asarray(value(data) if callable(value) else value)

    return run
