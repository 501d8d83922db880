"""Tampering with a converted run: each way is found, and told by name.

``edited``: the file is changed and nothing else. ``forged``: afterwards its own hashes,
its certificate and the ledger are made to fit, as somebody would who knows the format.
"""

from __future__ import annotations

import json
import shutil
from contextlib import suppress

import numpy as np
import pytest
import tamper

from flashdex.errors import RunError
from flashdex.rollouts.certificate import certify
from flashdex.rollouts.findings import differences
from flashdex.rollouts.ledger import CONVERSIONS
from flashdex.rollouts.verify import verify_file, verify_run
from flashdex.system.jsonl import read_lines, write_lines

BOX = "rollouts/right_box.npz"
PROOF = "rollouts/right_box.certificate.json"


@pytest.fixture(scope="session")
def proofs():
    """Certificates by the content of the rollout; they are deterministic, see there."""
    return {}


@pytest.fixture
def check(truth, proofs, monkeypatch):
    """Faults of a run by what they name; the run must not hold."""
    from flashdex.rollouts import verify

    def remembered(rollout, *, model):
        key = rollout.content_sha256
        if key not in proofs:
            proofs[key] = certify(rollout, model=model)
        return proofs[key]

    monkeypatch.setattr(verify, "certify", remembered)

    def run(run_dir, *, library=True):
        verified = verify_run(run_dir, truth if library else None)
        assert not verified.holds
        return [str(f) for f in verified.findings if f.is_fault]

    return run


def test_an_untouched_run_holds_and_everything_is_checked(converted_run, truth):
    verified = verify_run(converted_run, truth)
    assert verified.holds
    assert verified.findings == []
    assert [one.found for one in verified.rollouts] == ["robust"]


def test_without_its_library_a_run_holds_and_says_what_was_not_checked(converted_run):
    verified = verify_run(converted_run)
    assert verified.holds
    told = {finding.what for finding in verified.findings}
    assert told == {"model", "roles, reference, first state, actions, criterion"}


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


def xml(old, new):
    return lambda data: tamper.replace_xml(data, old, new)


def third_hand(data):
    body = (
        '<body name="third" pos="0 0 -.05"><joint type="slide"/>'
        '<geom size=".1 .1 .01" type="box" mass="1"/></body></worldbody>'
    )
    tamper.replace_xml(data, "</worldbody>", body)
    for name in ("qpos0", "qvel0", "qpos", "qvel"):
        pad = np.zeros((*data[name].shape[:-1], 1))
        data[name] = np.concatenate([data[name], pad], -1)


def drive(data):
    motor = '<general name="lift" joint="object0" gear="0 0 1 0 0 0"/></actuator>'
    tamper.replace_xml(data, "</actuator>", motor)
    data["ctrl"] = np.concatenate([data["ctrl"], 0.5 + 0 * data["ctrl"][:, :1]], 1)


WORLD = '<body name="object0">'
SPRING = (
    "<tendon><spatial stiffness='5'><site site='above'/><site site='mid'/></spatial>"
    "</tendon><actuator>"
)
SITES = f'<site name="above" pos="0 0 .5"/>{WORLD}<site name="mid" size=".001"/>'


def spring(data):
    tamper.replace_xml(data, WORLD, SITES)
    tamper.replace_xml(data, "<actuator>", SPRING)


# how the model is changed, and what a finding has to name
MODELS = {
    "gravity off": (xml("<option ", '<option gravity="0 0 0" '), "gravity"),
    "gravity up": (xml("<option ", '<option gravity="0 0 9.81" '), "gravity"),
    "gravity sideways": (xml("<option ", '<option gravity="9.81 0 0" '), "gravity"),
    "gravity disabled": (xml("<flag ", '<flag gravity="disable" '), "disableflags"),
    "no contacts": (xml("<flag ", '<flag contact="disable" '), "disableflags"),
    "thick air": (xml("<option ", '<option viscosity="5" '), "viscosity"),
    "wind": (xml("<option ", '<option wind="0 0 5" density="9" '), "wind"),
    "time step": (xml('timestep="0.00416667"', 'timestep="0.004"'), "timestep"),
    "solver": (xml('iterations="20"', 'iterations="30"'), "iterations"),
    "friction direction": (xml('impratio="10"', 'impratio="100"'), "impratio"),
    "hidden platform": (
        xml(
            WORLD,
            '<geom type="box" size=".1 .1 .005" pos="0 0 .03" rgba="0 0 0 0"/>' + WORLD,
        ),
        "geom elements",
    ),
    "third hand": (third_hand, "body elements"),
    "actuator on the object": (drive, "actuator elements"),
    "weld to the world": (
        xml("<actuator>", '<equality><weld body1="object0"/></equality><actuator>'),
        "eq elements",
    ),
    "weld to the hand": (
        xml(
            "<actuator>",
            '<equality><weld body1="object0" body2="right_hand_link"/></equality>'
            "<actuator>",
        ),
        "eq elements",
    ),
    "spring on the object": (spring, "tendon elements"),
    "weightless object": (xml(WORLD, '<body name="object0" gravcomp="1">'), "gravcomp"),
    "friction of the object": (xml('friction="2 ', 'friction="1000 '), "friction"),
    "friction of the table": (
        xml('friction="1 0.05', 'friction="900 0.05'),
        "friction",
    ),
    "no contact with the table": (xml('conaffinity="3"', 'conaffinity="0"'), "conaff"),
    "no contact with the object": (
        xml('contype="2" conaffinity="3"', 'contype="0" conaffinity="0"'),
        "contype",
    ),
    "soft contact": (xml("condim=", 'solref="1 1" condim='), "solref"),
    "glue": (xml("condim=", 'margin=".05" gap=".04" condim='), "geom_"),
    "tiny mass": (xml('mass="0.12"', 'mass="1e-5"'), "mass"),
    "heavy object": (xml('mass="0.12"', 'mass="500"'), "mass"),
    "huge inertia": (xml("6.1e-05 5.33007e-05", "0.9 0.9"), "inertia"),
    "strong hand": (xml("gainprm=", 'gear="3" gainprm='), "gear"),
    "stiff servo": (xml('gainprm="1000"', 'gainprm="90000"'), "gainprm"),
    "no force limit": (xml('forcerange="-100 100"', 'forcerange="-9e9 9e9"'), "force"),
    "joint range": (xml('range="-5 5"', 'range="-9 9"'), "range"),
    "damped joint": (xml('damping="1"', 'damping="40"'), "damping"),
    "heavy link": (xml('mass="0.1"', 'mass="7"'), "mass"),
    "excluded contact": (
        xml(
            "<contact>",
            '<contact><exclude body1="right_hand_link" body2="object0"/>',
        ),
        "exclude",
    ),
    "contact pair": (
        xml(
            "<contact>",
            '<contact><pair geom1="object0_part0" geom2="support0" margin=".01"/>',
        ),
        "pair",
    ),
    "mocap body": (
        xml(WORLD, '<body mocap="true" name="m"><geom size=".1"/></body>' + WORLD),
        "body elements",
    ),
    "higher table": (xml('pos="0 0 -0.01"', 'pos="0 0 0.005"'), "geom_pos"),
    "smaller table": (xml('size="0.8 0.01"', 'size="0.1 0.01"'), "geom_"),
    "turned object": (
        xml('quat="1 0 0 0" type="mesh"', 'euler=".4 0 0" type="mesh"'),
        "geom_quat",
    ),
    "shape of the object": (
        xml('<mesh name="object0_part0"', '<mesh name="object0_part0" scale="2 2 2"'),
        "mesh",
    ),
}
# what no check without the library can see: the object's own shape, mass and support
OF_LIBRARY = {
    *("heavy object", "higher table", "smaller table", "turned object"),
    *("shape of the object",),
}


@pytest.mark.parametrize("kind", MODELS)
def test_a_model_that_is_not_the_scene_is_found_by_name(spoilt_run, check, kind):
    edit, named = MODELS[kind]
    path = spoilt_run / BOX
    data = tamper.load(path)
    edit(data)
    tamper.simulate(data)
    tamper.forge(spoilt_run, path, data)
    found = check(spoilt_run)
    assert any(text.startswith(f"{BOX}: model") and named in text for text in found)
    assert any("model" in text for text in alone(path)) or kind in OF_LIBRARY


HOSTILE = {
    "reads a file": '<include file="/etc/passwd"/>',
    "mesh of a file": '<asset><mesh name="x" file="/etc/passwd"/></asset>',
    "bomb": '<replicate count="100000000"><site/></replicate>',
    "plugin": '<extension><plugin plugin="mujoco.pid"/></extension>',
}


@pytest.mark.parametrize("kind", HOSTILE)
def test_a_hostile_model_is_not_compiled(spoilt_run, check, kind):
    path = spoilt_run / BOX
    data = tamper.load(path)
    tamper.replace_xml(data, "<worldbody>", HOSTILE[kind] + "<worldbody>")
    rollout = tamper.rollout_of(data)
    data["model_sha256"] = np.asarray(rollout.model_sha256)
    tamper.store(path, data)
    for found in (check(spoilt_run), alone(path)):
        assert any("model_xml: <" in text for text in found), found


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


FIELDS = {
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


def walk(value, at=()):
    """Paths of all leaves of a JSON value."""
    if isinstance(value, dict) and value:
        return [p for k, v in value.items() for p in walk(v, (*at, k))]
    if isinstance(value, list) and value:
        return [p for i, v in enumerate(value) for p in walk(v, (*at, i))]
    return [at]


def other(value):
    """Another value of the same kind."""
    if isinstance(value, bool) or value is None:
        return not value
    if isinstance(value, (int, float)):
        return value + 1
    return f"{value}x" if isinstance(value, str) else ["x"]


def put_at(value, path, new):
    for key in path[:-1]:
        value = value[key]
    value[path[-1]] = new


PARTS = ("verdict", "reason", "identity", "model", "inputs", "nominal", "deviation")
PARTS += ("perturbed", "safety", "provenance")


@pytest.mark.parametrize("how", ["edited", "forged"])
@pytest.mark.parametrize("part", PARTS)
def test_a_certificate_that_is_edited_is_found(spoilt_run, check, part, how):
    path = spoilt_run / PROOF
    certificate = json.loads(path.read_text())
    rng = np.random.default_rng(PARTS.index(part))
    leaves = walk(certificate[part], (part,))
    skipped = ("certified_by", "certified_on")
    leaves = [leaf for leaf in leaves if not set(leaf) & set(skipped)]
    leaf = leaves[rng.integers(len(leaves))]
    old = certificate
    for key in leaf:
        old = old[key]
    put_at(certificate, leaf, other(old))
    path.write_text(json.dumps(certificate))
    if how == "forged":
        tamper.reseal(spoilt_run, spoilt_run / BOX, path)
    found = check(spoilt_run)
    assert any(str(leaf[0]) in text and PROOF in text for text in found), (leaf, found)


def edit_lines(edit):
    """Change the lines and seal them anew."""

    def run(run_dir):
        path = run_dir / CONVERSIONS
        lines = read_lines(path)
        write_lines(path, edit(lines) or lines)

    return run


def of_stored(key, value):
    def edit(lines):
        for line in lines:
            if line.get("rollout"):
                line[key] = value(line[key]) if callable(value) else value

    return edit_lines(edit)


def raw(edit):
    """Change the bytes of the ledger; seals are left as they are."""

    def run(run_dir):
        path = run_dir / CONVERSIONS
        lines = path.read_bytes().splitlines(keepends=True)
        path.write_bytes(b"".join(edit(lines)))

    return run


def elsewhere(run_dir):
    shutil.copy(run_dir / BOX, run_dir / "rollouts" / "other.npz")
    of_stored("rollout", "rollouts/other.npz")(run_dir)


LINES = {
    "edited": raw(lambda x: [x[0].replace(b'"seed": 0', b'"seed": 1'), *x[1:]]),
    "doubled": raw(lambda x: [x[0], *x]),
    "removed": raw(lambda x: x[1:]),
    "moved": raw(lambda x: x[::-1]),
    "last removed": raw(lambda x: x[:-1]),
    "all removed": raw(lambda x: []),
    "garbage": raw(lambda x: [*x, b"garbage\n"]),
    "no object": raw(lambda x: [*x, b"[]\n"]),
    "without seal": raw(lambda x: [*x, b'{"motion": "right_box"}\n']),
    "doubled, sealed": edit_lines(lambda x: [x[0], *x]),
    "removed, sealed": edit_lines(lambda x: x[1:]),
    "last removed, sealed": edit_lines(lambda x: x[:-1]),
    "motion": of_stored("motion", "left_ball"),
    "errors": of_stored("errors", {"object_pos": 1e-3, "object_rot": 1e-3}),
    "not converted": of_stored("converted", False),
    "not certified": of_stored("certified", False),
    "verdict": of_stored("verdict", "certified"),
    "criterion": of_stored("criterion", "sr_mt"),
    "no criterion": of_stored("criterion", "best"),
    "passed": of_stored("passed", []),
    "lift": of_stored("lift_ratio", 1.0),
    "path": of_stored("path_ratio", 1.0),
    "trivial": of_stored("trivial", []),
    "trivial by baselines": of_stored("trivial", lambda v: v[1:]),
    "hands": of_stored("hands", ["left", "right"]),
    "frame": of_stored("frame", 1000),
    "env steps": of_stored("env_steps", 1),
    "time": of_stored("wall_s", 1e3),
    "seed": of_stored("seed", 5),
    "certified without a rollout": edit_lines(
        lambda x: [{**x[0], "rollout": None, "rollout_sha256": None}, *x[1:]]
    ),
    "another motion, converted": edit_lines(
        lambda x: [*x[:-1], {**x[-1], "motion": "both", "rollout": None}]
    ),
    "passed is a number": of_stored("passed", 5),
    "trivial is a number": of_stored("trivial", 5),
    "rollout is a list": of_stored("rollout", [1]),
    "time is NaN": of_stored("wall_s", float("nan")),
    "name is no text": of_stored("motion", "\ud800"),
    "rollout elsewhere": elsewhere,
    "rollout outside": of_stored("rollout", "../evil.npz"),
    "rollout's hash": of_stored("rollout_sha256", "0" * 64),
    "certificate's hash": of_stored("certificate_sha256", "0" * 64),
    "no hashes": of_stored("certificate_sha256", None),
    "rollout deleted": lambda run: (run / BOX).unlink(),
    "certificate deleted": lambda run: (run / PROOF).unlink(),
    "both deleted": lambda run: [(run / name).unlink() for name in (BOX, PROOF)],
    "rollout of no line": lambda run: shutil.copy(run / BOX, run / "rollouts/b.npz"),
    "certificate of nothing": lambda run: (run / "rollouts/b.certificate.json").touch(),
    "certificate is no JSON": lambda run: (run / PROOF).write_text("{"),
    "certificate is deep": lambda run: (run / PROOF).write_text("[" * 100_000),
    "recipe": lambda run: (run / "recipe.yaml").write_text(
        (run / "recipe.yaml").read_text() + "# x\n"
    ),
    "metrics": lambda run: (run / "metrics.jsonl").write_text("garbage\n"),
    "rollout is empty": lambda run: (run / BOX).write_bytes(b""),
    "rollout is cut": lambda run: (run / BOX).write_bytes(
        (run / BOX).read_bytes()[:-100]
    ),
}


@pytest.mark.parametrize("kind", LINES)
def test_files_and_lines_that_do_not_fit_each_other_are_found(spoilt_run, check, kind):
    LINES[kind](spoilt_run)
    assert check(spoilt_run)


def test_rollouts_of_two_motions_that_are_swapped_are_found(converted_pair, tmp_path):
    run = shutil.copytree(converted_pair, tmp_path / "run")
    files = sorted((run / "rollouts").iterdir())
    (a, a2), (b, b2) = files[:2], files[2:4]
    for one, two in ((a, b), (a2, b2)):
        content = one.read_bytes()
        one.write_bytes(two.read_bytes())
        two.write_bytes(content)
    for path, proof in ((b2, b), (a2, a)):
        tamper.reseal(run, path, proof)
    verified = verify_run(run)
    assert not verified.holds
    for one in verified.rollouts:
        assert any("is that of" in str(finding) for finding in one.faults)


def test_a_link_in_the_place_of_a_file_is_refused(spoilt_run, tmp_path):
    other = tmp_path / "elsewhere.npz"
    shutil.move(spoilt_run / BOX, other)
    (spoilt_run / BOX).symlink_to(other)
    with pytest.raises(RunError, match="is a link"):
        verify_run(spoilt_run)


def test_a_library_that_was_changed_is_told(spoilt_run, truth, monkeypatch):
    monkeypatch.setattr(truth.library, "content_hash", "0" * 64)
    found = [str(f) for f in verify_run(spoilt_run, truth).findings]
    assert any("is another than it was made from" in text for text in found)


def test_a_run_of_an_older_version_holds_and_says_what_is_not_bound(spoilt_run):
    path, proof = spoilt_run / BOX, spoilt_run / PROOF
    data = tamper.load(path)
    said = json.loads(str(data["provenance"]))
    old = {k: said[k] for k in ("recipe_sha256", "library_sha256", "date")}
    data["provenance"] = np.asarray(json.dumps(old))
    tamper.store(path, data)
    certificate = json.loads(proof.read_text())
    certificate["identity"]["schema"] = 1
    del certificate["identity"]["rollout_sha256"]
    proof.write_text(json.dumps(certificate))
    lines = read_lines(spoilt_run / CONVERSIONS)
    new = ("rollout_sha256", "certificate_sha256", "lift_ratio", "path_ratio")
    text = [{k: v for k, v in line.items() if k not in new} for line in lines]
    (spoilt_run / CONVERSIONS).write_text(
        "".join(json.dumps(line) + "\n" for line in text)
    )
    verified = verify_run(spoilt_run)
    assert verified.holds
    assert any("older version" in str(finding) for finding in verified.findings)


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


@pytest.mark.parametrize("seed", range(12))
def test_random_bytes_that_are_changed_are_found(spoilt_run, check, seed):
    rng = np.random.default_rng([2, seed])
    name = [BOX, PROOF, CONVERSIONS][seed % 3]
    content = bytearray((spoilt_run / name).read_bytes())
    at = int(rng.integers(len(content)))
    content[at] ^= 1 << int(rng.integers(7))
    (spoilt_run / name).write_bytes(bytes(content))
    assert check(spoilt_run, library=False)


@pytest.mark.parametrize(
    ("stored", "expected", "text"),
    [
        ({"a": 1}, {"a": 1.0 + 1e-12}, []),
        ({"a": 1}, {"a": 2}, ["a is 1, expected 2"]),
        ({"a": [1, {"b": None}]}, {"a": [1, {"b": 0}]}, ["a[1].b is null, expected 0"]),
        ({}, {"a": 1}, ["a is missing"]),
        ({"a": 1}, {}, ["a is too much"]),
        ({"a": [1]}, {"a": [1, 2]}, ["a has 1 entries, expected 2"]),
        ({"a": True}, {"a": 1}, ["a is true, expected 1"]),
        ({"a": float("nan")}, {"a": 1.0}, ["a is NaN, expected 1.0"]),
    ],
)
def test_differences_of_json_are_named(stored, expected, text):
    assert differences(stored, expected) == text
