"""What the files of a run say of one another, after all hashes were made to fit."""

import json

import mujoco
import numpy as np
import pytest
import tamper
from tamper import BOX, PROOF

from flashdex.metrics.tally import UNMOVED
from flashdex.rollouts.certificate import certify
from flashdex.rollouts.ledger import CONVERSIONS
from flashdex.rollouts.rollout import Rollout
from flashdex.rollouts.verify import verify_run
from flashdex.system.jsonl import read_lines, read_object, write_lines, write_object


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


def overridden(run, change, *, physics=()):
    """A rollout that says it was made by an earlier recipe of its run."""
    edit(
        "sessions.jsonl",
        lambda lines: [*lines, lines[0] | {"overrides": ["train.certify=true"]}],
    )(run)
    data = tamper.load(run / BOX)
    change(data)
    tamper.simulate(data)
    said = json.loads(str(data["provenance"])) | {"recipe_sha256": "0" * 64}
    said["physics"] |= dict(physics)
    data["provenance"] = np.asarray(json.dumps(said))
    tamper.forge(run, run / BOX, data)
    rollout = Rollout.load(run / BOX)
    model = mujoco.MjModel.from_xml_string(rollout.model_xml)
    certify(rollout, model=model).save(run / PROOF)
    tamper.reseal(run, run / BOX, run / PROOF)


def test_a_recipe_that_changed_excuses_no_other_object(spoilt_run, truth):
    overridden(spoilt_run, lambda data: None)
    assert verify_run(spoilt_run, truth).holds
    lighter = ('mass="0.12"', 'mass="0.02"')
    overridden(spoilt_run, lambda data: tamper.replace_xml(data, *lighter))
    found = [str(f) for f in verify_run(spoilt_run, truth).findings if f.is_fault]
    assert any("body_mass" in text for text in found)


@pytest.mark.parametrize("value", [float("nan"), -1.0, "x", 1e300])
def test_settings_of_a_former_recipe_are_settings(spoilt_run, truth, value):
    overridden(spoilt_run, lambda data: None, physics={"friction": value})
    found = [str(f) for f in verify_run(spoilt_run, truth).findings if f.is_fault]
    assert any("are no settings" in text for text in found)
