"""What the files of a run say of one another, after all hashes were made to fit."""

import hashlib
import json

import mujoco
import numpy as np
import pytest
import tamper
from tamper import BOX, PROOF

from flashdex.errors import RunError
from flashdex.metrics.tally import UNMOVED
from flashdex.recipe import dump_recipe, parse_recipe
from flashdex.recipe.reader import parse_yaml
from flashdex.rollouts.certificate import certify
from flashdex.rollouts.ledger import CONVERSIONS
from flashdex.rollouts.rollout import Rollout
from flashdex.rollouts.verify import verify_run
from flashdex.system.jsonl import read_lines, read_object, write_lines, write_object
from flashdex.system.run_files import read_recipe
from flashdex.training import baselines
from flashdex.training.baselines import check_baselines
from flashdex.training.build import RunBuilder
from flashdex.training.run_dir import load_run_recipe


def edit(name, change):
    def run(folder):
        lines = read_lines(folder / name)
        write_lines(folder / name, change(lines) or lines)

    return run


def of_every_line(**values):
    return edit(CONVERSIONS, lambda lines: [x | values for x in lines])


def without(*names):
    return edit(
        CONVERSIONS,
        lambda lines: [{k: v for k, v in x.items() if k not in names} for x in lines],
    )


def counters(**values):
    found = {f"convert/{k}": v for k, v in values.items()}
    return edit("metrics.jsonl", lambda lines: lines[-1].update(found))


def motions(**values):
    def run(folder):
        write_object({"motions": values}, folder, "motions.json")

    return run


def proof(**parts):
    """A certificate that says it was made elsewhere."""

    def run(folder):
        found = json.loads((folder / PROOF).read_text())
        found["provenance"]["certified_on"] = "Linux other"
        for part, values in parts.items():
            found[part] |= values
        (folder / PROOF).write_text(json.dumps(found))
        tamper.reseal(folder, folder / BOX, folder / PROOF)

    return run


def told_twice(folder):
    """The second line says that the object moved, and names no rollout."""
    moved = {"trivial": [], "lift_ratio": 1.0, "path_ratio": 1.0}
    edit(CONVERSIONS, lambda lines: lines[1].update(moved))(folder)


LIES = {
    "converted": counters(nontrivial=50.0),
    "cumulative": counters(cumulative=50.0),
    "certified": counters(certified=50.0),
    "robust": counters(robust=50.0),
    "per hour": counters(per_hour=9e9),
    "early curve": edit(
        "metrics.jsonl", lambda lines: lines[0].update({"convert/cumulative": 7.0})
    ),
    "seed": edit(CONVERSIONS, lambda lines: lines[-1].update(seed=5)),
    "engine": of_every_line(engine="warp"),
    "criterion": of_every_line(criterion="sr_mt_frame"),
    "passed": of_every_line(passed=["sr_mt_obj", "chord_sr"]),
    "trivial by baselines": edit(
        CONVERSIONS, lambda x: [y | {"trivial": ["do_nothing"]} for y in x]
    ),
    "errors of no pass": edit(CONVERSIONS, lambda x: x[-1]["errors"].clear()),
    "errors beyond": edit(
        CONVERSIONS, lambda x: x[-1]["errors"].update(object_pos=1.0)
    ),
    "no criterion": edit(CONVERSIONS, lambda x: x[-1]["passed"].append("best")),
    "negative": edit(CONVERSIONS, lambda x: x[-1].update(frame=-1)),
    "steps at the end": edit("sessions.jsonl", lambda x: x[-1].update(env_steps=9)),
    "hours that go back": edit("metrics.jsonl", lambda x: x[-1].update(hours=-1.0)),
    "no reason to end": edit("sessions.jsonl", lambda x: x[-1].update(why="x")),
    "end of nothing": edit("sessions.jsonl", lambda x: x[1:]),
    "a fourth baseline": lambda run: write_object(
        read_object(run, "baselines.json") | {"do_nothing2": {}}, run, "baselines.json"
    ),
    "record after the end": edit("metrics.jsonl", lambda x: [*x, x[-1]]),
    "other versions": lambda run: versions(torch="0")(run),
    "no versions": lambda run: versions(hardware=None)(run),
    "no trivial": without("trivial"),
    "old lines": without("trivial", "rollout_sha256", "certificate_sha256"),
    "moved later": told_twice,
    "ratios": edit(CONVERSIONS, lambda lines: lines[1]["trivial"].remove(UNMOVED)),
    "another motion's hash": motions(right_box="0" * 64),
    "another motion": motions(left_ball="0" * 64),
    "no motions": motions(),
    "more motions": lambda run: write_object(
        {"motions": read_object(run, "motions.json")["motions"] | {"x": "0"}},
        run,
        "motions.json",
    ),
    "no baselines": lambda run: (run / "baselines.json").unlink(),
    "empty baselines": lambda run: (run / "baselines.json").write_text("{}"),
    "no sessions": lambda run: (run / "sessions.jsonl").unlink(),
    "proof of another": proof(identity={"rollout_sha256": "0" * 64}),
    "proof by another criterion": proof(identity={"criterion": "sr_loose"}),
    "proof of other seeds": proof(provenance={"seed": 77}),
    "proof with help": proof(inputs={"assist_sources": ["weld"]}),
    "old proof": proof(identity={"schema": 1}),
}


@pytest.mark.parametrize("lie", LIES)
def test_a_lie_with_hashes_that_fit_is_named(spoilt_run, truth, lie):
    LIES[lie](spoilt_run)
    assert not verify_run(spoilt_run, truth).holds


def test_a_proof_made_elsewhere_holds(spoilt_run, truth):
    proof()(spoilt_run)
    assert verify_run(spoilt_run, truth).holds


FORMER = "algo.lr=0.0007"  # a value of the recipe that decides nothing of a rollout


def resumed(run, words, *, former=()):
    """A session more, that says it was resumed with these overrides.

    ``former``: words that make the recipe it says it was resumed from.
    """
    text, before = read_recipe(run), ""
    if former:
        before = dump_recipe(parse_recipe(text, former, where="test"))

    def add(lines):
        start = {k: v for k, v in lines[0].items() if k != "before"}
        more = {"overrides": list(words), "before": before}
        return [*lines, start | more | {"wall_s": lines[-1]["wall_s"]}]

    edit("sessions.jsonl", add)(run)
    return before or text


def now(run, key):
    """``key=value`` of the recipe as it is."""
    value = parse_yaml(read_recipe(run), where="test")
    for word in key.split("."):
        value = value[word]
    return f"{key}={json.dumps(value)}"


SESSIONS = {
    "criterion": "train.criterion=sr_mt_obj_x2",
    "motions": "motions.select=[left_ball]",
    "physics": "physics.friction=3.0",
    "learning rate": "algo.lr=0.0007",
    "no value": "algo",
    "unknown": "algo.magic=1",
}


@pytest.mark.parametrize("kind", SESSIONS)
def test_a_session_that_did_not_change_the_recipe_is_named(spoilt_run, truth, kind):
    resumed(spoilt_run, [SESSIONS[kind]])
    found = [str(f) for f in verify_run(spoilt_run, truth).findings if f.is_fault]
    assert any("overrides of start 2" in text for text in found)


EXCUSED = ("converted", "early curve", "criterion", "engine", "seed", "no baselines")
EXCUSED += ("trivial by baselines", "another motion's hash")


@pytest.mark.parametrize("how", ["the same value", "another value"])
@pytest.mark.parametrize("lie", EXCUSED)
def test_a_resume_with_other_values_excuses_no_lie(spoilt_run, truth, lie, how):
    former = [FORMER] if how == "another value" else []
    resumed(spoilt_run, [now(spoilt_run, "algo.lr")], former=former)
    LIES[lie](spoilt_run)
    found = [f for f in verify_run(spoilt_run, truth).findings if f.is_fault]
    assert [f for f in found if f.file != "sessions.jsonl"]


def test_what_other_motions_decide_is_told(spoilt_run):
    """Without a library nobody knows whose attempts an earlier recipe counted."""
    now_selected = now(spoilt_run, "motions.select")
    resumed(spoilt_run, [now_selected], former=["motions.select=null"])
    told = {f.what for f in verify_run(spoilt_run).ledger if not f.is_fault}
    assert "counts" in told


def overridden(run, change, *, physics=()):
    """A rollout that was made by an earlier recipe of its run."""
    before = resumed(run, [now(run, "algo.lr")], former=[FORMER])
    data = tamper.load(run / BOX)
    change(data)
    tamper.simulate(data)
    sha256 = hashlib.sha256(before.encode()).hexdigest()
    said = json.loads(str(data["provenance"])) | {"recipe_sha256": sha256}
    said["physics"] |= dict(physics)
    data["provenance"] = np.asarray(json.dumps(said))
    tamper.forge(run, run / BOX, data)
    rollout = Rollout.load(run / BOX)
    model = mujoco.MjModel.from_xml_string(rollout.model_xml)
    certify(rollout, model=model).save(run / PROOF)
    tamper.reseal(run, run / BOX, run / PROOF)


def lighter(data):
    tamper.replace_xml(data, 'mass="0.12"', 'mass="0.02"')


def test_a_recipe_that_changed_excuses_nothing(spoilt_run, truth):
    overridden(spoilt_run, lambda data: None)
    verified = verify_run(spoilt_run, truth)
    assert verified.holds
    assert verified.findings == []


@pytest.mark.parametrize(
    ("change", "physics", "named"),
    [
        (lighter, {}, "body_mass"),
        (tamper.put("criterion", "sr_mt_obj_x2"), {}, "criterion"),
        (tamper.change("ctrl", by=0.01), {}, "ctrl"),
        (lambda data: None, {"friction": float("nan")}, "physics"),
        (lambda data: None, {"friction": 3.0}, "physics"),
        (lambda data: None, {"friction": "x"}, "physics"),
    ],
)
def test_an_earlier_recipe_excuses_nothing(spoilt_run, truth, change, physics, named):
    overridden(spoilt_run, change, physics=physics)
    found = [str(f) for f in verify_run(spoilt_run, truth).findings if f.is_fault]
    assert any(text.startswith(BOX) and named in text for text in found)


def versions(**values):
    def run(folder):
        found = read_object(folder, "versions.json") | values
        found = {k: v for k, v in found.items() if v is not None}
        write_object(found, folder, "versions.json")

    return run


IDS = {
    "none": versions(run=None),
    "empty": versions(run=""),
    "a number": versions(run=7),
    "another": versions(run="0" * 32),
    "another session": edit("sessions.jsonl", lambda x: x[0].update(run="0" * 32)),
    "no versions": lambda run: (run / "versions.json").unlink(),
}


@pytest.mark.parametrize("kind", IDS)
def test_a_run_that_does_not_say_which_it_is_does_not_hold(spoilt_run, truth, kind):
    IDS[kind](spoilt_run)
    assert not verify_run(spoilt_run, truth).holds
    assert not verify_run(spoilt_run).holds
    with pytest.raises(RunError, match=r"versions\.json"):
        load_run_recipe(spoilt_run)


def test_baselines_are_computed_again(spoilt_run, truth):
    builder = RunBuilder(truth.recipe, truth.library, truth.hands, truth.bank)
    assert check_baselines(builder, spoilt_run, []) == []
    rows = read_object(spoilt_run, "baselines.json")
    row = rows["kinematic_playback"]["right_box"]
    row["passed"] = [name for name in row["passed"] if name != "sr_mt_obj"] + ["x"]
    # as somebody seals it who knows the format
    (made_of,) = baselines._inputs(builder).values()
    rows["kinematic_playback"]["right_box"] = baselines._sealed(row, made_of)
    write_object(rows, spoilt_run, "baselines.json")
    (*_, found) = check_baselines(builder, spoilt_run, [])
    assert "kinematic_playback.right_box" in str(found)
    assert found.is_fault
