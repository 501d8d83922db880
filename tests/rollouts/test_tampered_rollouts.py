"""Tampering with a converted run: each way is found, and told by name.

``edited``: the file is changed and nothing else. ``forged``: afterwards its own hashes,
its certificate and the ledger are made to fit, as somebody would who knows the format.
"""

from __future__ import annotations

import json
from contextlib import suppress

import numpy as np
import pytest
import tamper
from tamper import BOX, alone, change, put

from flashdex.errors import RunError
from flashdex.rollouts.rollout import MADE_BY, PROVENANCE


def result_as_reference(data):
    for name in ("object_pos", "object_quat", "fingertips", "joints"):
        data[f"ref_{name}"] = data[name]


def turned(data):
    data["object_quat"] = data["object_quat"] * np.array([1, 1, 1, -1.0])


def thrown(data):
    """The object flies along the recording by itself, the hand stays where it is."""
    velocity = data["qvel0"].copy()
    adr = data["object_qvel_adr"][0]
    velocity[adr : adr + 3] = [0.02, 0.0, 0.6]
    data["qvel0"] = velocity
    data["ctrl"] = np.repeat(data["ctrl"][:1], len(data["ctrl"]), 0)
    tamper.simulate(data)


def assisted(data):
    data["wrench"] = data["wrench"].copy()
    data["wrench"][:, 0, 2] = 1.0


def shorter(data):
    tamper.cut(data, 1)
    data["num_ref_frames"] = np.asarray(len(data["ctrl"]))


def faster(data):
    data["fps"], data["grace"] = np.asarray(120.0), np.asarray(30)


def other_controls(data):
    data["ctrl"] = data["ctrl"] + 0.01
    tamper.simulate(data)


# what is changed in the arrays, and the field that a finding has to name
ROLLOUTS = {
    "controls, a little": (change("ctrl", at=(10, 7), by=1e-4), "ctrl"),
    "controls, states to fit": (other_controls, "ctrl"),
    "joint states": (change("qpos", at=(20, 8), by=1e-4), "qpos"),
    "velocities": (change("qvel", at=20, by=1e-3), "qvel"),
    "object position": (change("object_pos", by=1e-3), "object_pos"),
    "object orientation": (turned, "object_quat"),
    "object on its reference": (
        put("object_pos", lambda d: d["ref_object_pos"]),
        "object_pos",
    ),
    "fingertips": (change("fingertips", by=1e-3), "fingertips"),
    "joints": (change("joints", by=1e-3), "joints"),
    "actions": (change("actions", at=(5, 1, 2), by=0.05), "ctrl"),
    "reference is the result": (result_as_reference, "ref_object_pos"),
    "reference a little": (change("ref_object_pos", by=1e-4), "ref_object_pos"),
    "reference orientation": (
        put("ref_object_quat", lambda d: d["object_quat"]),
        "ref_object_quat",
    ),
    "reference fingertips": (change("ref_fingertips", by=1e-3), "ref_fingertips"),
    "reference joints": (change("ref_joints", by=1e-3), "ref_joints"),
    "last frame cut": (lambda d: tamper.cut(d, 1), "frames"),
    "cut with its reference": (shorter, "frames"),
    "grace loosened": (put("grace", 30), "grace"),
    "criterion loosened": (put("criterion", "sr_mt_obj_x2"), "criterion"),
    "criterion of another family": (put("criterion", "sr_spider"), "criterion"),
    "control rate": (faster, "fps"),
    "substeps": (put("decimation", 3), "decimation"),
    "hand that takes no part": (put("hand_active", [True, True]), "hand_active"),
    "object of the other hand": (put("hand_object", [0, 0]), "hand_object"),
    "first object pose": (change("qpos0", at=-5, by=0.004), "qpos0"),
    "first joints": (change("qpos0", at=20, by=0.01), "qpos0"),
    "flying object, idle hand": (thrown, "qvel0"),
    "assist": (assisted, "wrench"),
    "seed": (put("seed", 99), "seed"),
    "hand renamed": (put("hand", "sharpa_wave"), "hand"),
    "motion renamed": (put("motion", "left_ball"), "motion"),
    "links renamed": (
        put(
            "joint_bodies",
            lambda d: str(d["joint_bodies"]).replace("index", "mid", 1),
        ),
        "joint_bodies",
    ),
}


@pytest.mark.parametrize("how", ["edited", "forged"])
@pytest.mark.parametrize("kind", ROLLOUTS)
def test_a_rollout_that_is_changed_is_found_by_name(spoilt_run, check, kind, how):
    edit, named = ROLLOUTS[kind]
    path = spoilt_run / BOX
    data = tamper.load(path)
    edit(data)
    tamper.store(path, data)
    if how == "forged":
        with suppress(RunError):  # there are files that cannot even be written
            tamper.forge(spoilt_run, path, data)
    found = check(spoilt_run)
    assert any(text.startswith(BOX) and named in text for text in found), found


def vanish(data, value):
    data["qpos"] = data["qpos"].copy()
    data["qpos"][30, -7:] = value


NUMBERS = {
    "NaN position": change("qpos", at=(30, 3), by=np.nan),
    "NaN velocity": change("qvel", at=(30, 3), by=np.nan),
    "NaN object": change("object_pos", at=(30, 0, 2), by=np.nan),
    "NaN control": change("ctrl", at=(30, 3), by=np.nan),
    "NaN first state": change("qpos0", at=3, by=np.nan),
    "NaN reference": change("ref_object_quat", at=(3, 0), by=np.nan),
    "infinite velocity": change("qvel0", at=3, by=np.inf),
    "zero quaternions": put("object_quat", lambda d: 0 * d["object_quat"]),
    "zero reference": put("ref_object_quat", lambda d: 0 * d["object_quat"]),
    "zero first quaternion": change("qpos0", at=slice(-4, None), by=-1.0),
    "no frames": lambda d: tamper.cut(d, len(d["ctrl"])),
    "no rate": put("fps", np.nan),
    "negative rate": put("fps", -60.0),
    "no substeps": put("decimation", 0),
    "a billion substeps": put("decimation", 10**9),
}


@pytest.mark.parametrize("kind", NUMBERS)
def test_numbers_that_are_none_are_found_before_anything_is_simulated(
    spoilt_run, check, monkeypatch, kind
):
    from flashdex.rollouts import checks

    monkeypatch.setattr(checks, "compile_mjcf", None)
    path = spoilt_run / BOX
    data = tamper.load(path)
    NUMBERS[kind](data)
    tamper.store(path, data)
    assert any(BOX in text for text in check(spoilt_run))
    # alone, too
    assert alone(path)


SETTINGS = {
    "text": {"timestep": "fast"},
    "nothing": {"timestep": None},
    "NaN": {"timestep": float("nan")},
    "infinite": {"impratio": float("inf")},
    "huge": {"iterations": 10**18},
    "unknown": {"magic": 1},
    "unknown gains": {"gains": "iron"},
    "a list": [],
    "other friction": {"object_friction": 3.0},
    "other substeps": {"decimation": 5},
}


@pytest.mark.parametrize("kind", SETTINGS)
def test_physics_settings_that_are_none_are_told_of_a_file_alone(spoilt_run, kind):
    path = spoilt_run / BOX
    data = tamper.load(path)
    said = json.loads(str(data["provenance"]))
    new = SETTINGS[kind]
    said["physics"] = said["physics"] | new if isinstance(new, dict) else new
    data["provenance"] = np.asarray(json.dumps(said))
    tamper.store(path, data)
    assert alone(path)


def without(part, name, *, more=lambda data: None):
    def run(data):
        said = json.loads(str(data[part]))
        del said[name]
        data[part] = np.asarray(json.dumps(said))
        more(data)

    return run


def hidden_geom(data):
    """What a file without its settings could not be compared with."""
    geom = '<geom type="box" size=".1 .1 .005" pos="0 0 .03" rgba="0 0 0 0"/>'
    tamper.replace_xml(data, '<body name="object0">', geom + '<body name="object0">')
    tamper.simulate(data)


DROPPED = {name: without("provenance", name) for name in PROVENANCE}
DROPPED |= {name: without("versions", name) for name in MADE_BY}
DROPPED["settings, geom"] = without("provenance", "physics", more=hidden_geom)
DROPPED["a setting"] = lambda data: data.update(
    provenance=np.asarray(str(data["provenance"]).replace('"impratio": 10.0, ', ""))
)


@pytest.mark.parametrize("kind", DROPPED)
def test_a_file_that_says_less_is_found_alone_and_in_its_run(spoilt_run, check, kind):
    path = spoilt_run / BOX
    data = tamper.load(path)
    before = str(data["provenance"]) + str(data["versions"])
    DROPPED[kind](data)
    assert str(data["provenance"]) + str(data["versions"]) != before
    data["model_sha256"] = np.asarray(tamper.rollout_of(data).model_sha256)
    tamper.store(path, data)
    assert alone(path)
    assert any(text.startswith(BOX) for text in check(spoilt_run))


FIELDS = {
    **{f"no {n}": lambda d, n=n: d.pop(n) for n in ("model_sha256", "wrist_bodies")},
    "address as a float": put("object_qpos_adr", lambda d: d["object_qpos_adr"] * 1.0),
    "address beyond": put("object_qpos_adr", lambda d: d["object_qpos_adr"] + 900),
    "address of a hand": put("object_qpos_adr", lambda d: d["object_qpos_adr"] * 0),
    "slot beyond": put("hand_object", [99, 0]),
    "links as numbers": put("joint_bodies", "[[1], [2]]"),
    "links of one hand": put("joint_bodies", "[[]]"),
    "links as an object": put("joint_bodies", "{}"),
    "wrists as numbers": put("wrist_bodies", "[1, 2]"),
    "versions as a list": put("versions", "[]"),
    "deep JSON": put("provenance", "[" * 100_000),
    "text as a rate": put("fps", "fast"),
    "numbers as a name": put("motion", 3),
    "objects": put("motion", lambda d: np.array([{}], dtype=object)),
    "complex numbers": put("qpos", lambda d: d["qpos"] * 1j),
    "several seeds": put("seed", [1, 2]),
    "no objects": lambda d: [
        d.update({k: d[k][:, :0]}) for k in d if "object_" in k and d[k].ndim == 3
    ],
    "foreign key": put("evil", 1),
    "schema": put("schema", 7),
    "schema as text": put("schema", "one"),
    "name that is a path": put("motion", "../evil"),
    "name with a newline": put("motion", "a\nb"),
}


@pytest.mark.parametrize("kind", FIELDS)
def test_fields_that_are_none_end_in_findings(spoilt_run, check, kind):
    path = spoilt_run / BOX
    data = tamper.load(path)
    FIELDS[kind](data)
    np.savez(path, allow_pickle=True, **data)
    assert check(spoilt_run)
    assert check(spoilt_run, library=False)
    assert alone(path)


@pytest.mark.parametrize("seed", range(12))
def test_a_random_number_of_a_rollout_that_is_changed_is_found(spoilt_run, check, seed):
    rng = np.random.default_rng(seed)
    path = spoilt_run / BOX
    data = tamper.load(path)
    names = [n for n, v in data.items() if v.dtype.kind == "f" and v.size > 1]
    name = names[rng.integers(len(names))]
    value = data[name].copy()
    at = tuple(rng.integers(n) for n in value.shape)
    size = value.dtype.type(rng.choice([0.0, 1e-4, 0.3]))
    value[at] = np.nextafter(value[at] + size, value.dtype.type(9))  # or the last bit
    data[name] = value
    tamper.store(path, data)
    assert check(spoilt_run, library=bool(seed % 2))


@pytest.mark.parametrize("seed", range(12))
def test_a_random_number_that_is_forged_is_found(spoilt_run, check, seed):
    rng = np.random.default_rng([1, seed])
    path = spoilt_run / BOX
    data = tamper.load(path)
    names = [n for n, v in data.items() if v.dtype.kind == "f" and v.size > 1]
    # of an action beyond its range only the range counts; no wrench is a number, too
    name = [n for n in names if n not in ("actions", "wrench")][seed % (len(names) - 2)]
    value = data[name].copy()
    at = tuple(rng.integers(n) for n in value.shape)
    value[at] += 1e-3 * rng.choice([-1, 1])
    data[name] = value
    tamper.forge(spoilt_run, path, data)
    found = check(spoilt_run)
    assert any(text.startswith(BOX) for text in found), (name, at)
