"""A run directory: a rollout stepped by MuJoCo C, and lines as training writes them."""

import math
import re

import pytest
import yaml
from pushed_box import make_rollout

from flashdex.cli.main import main
from flashdex.rollouts.certificate import certify
from flashdex.system.jsonl import write_lines, write_object
from flashdex.system.run_files import write_recipe

EVIL = '<script>alert("x")</script> & co'


@pytest.fixture(scope="session")
def rollout():
    return make_rollout(frames=36, criterion="sr_mt_obj", beside=0.005)


@pytest.fixture(scope="session")
def certificate(rollout):
    return certify(rollout)


def attempt(motion, env_steps, *, wall_s=60.0, converted=False, errors=None, why=()):
    return {
        "motion": motion,
        "converted": converted,
        "certified": None,
        "criterion": "sr_mt_obj",
        "errors": errors or {},
        "passed": [],
        "completed": bool(errors),
        "why": [{"cause": cause, "hand": hand} for cause, hand in why],
        "frame": 17,
        "env_steps": env_steps,
        "wall_s": wall_s,
        "seed": 3,
        "engine": "cpu",
        "trivial": [],
    }


@pytest.fixture
def empty_run(tmp_path):
    """A run that has just begun: a recipe and versions, nothing else."""
    run = tmp_path / "run"
    run.mkdir()
    recipe = {
        "name": "tiny",
        "seed": 3,
        "hand": "finger",
        "total_env_steps": 50_000,
        "ablation": "none",
        "physics": {"engine": "cpu"},
        "train": {"criterion": "sr_mt_obj", "render_conversions": False},
    }
    write_recipe(run, yaml.safe_dump(recipe))
    versions = {"flashdex": "0.1.0", "mujoco": "4.0", "hardware": "8 cores, no GPU"}
    write_object({"run": "0" * 32, **versions}, run, "versions.json")
    return run


@pytest.fixture
def run_dir(empty_run, rollout, certificate):
    """Three motions: one converted and proven, one never completed, one off."""
    run = empty_run
    rollout.save(run / "rollouts" / "push.npz")
    certificate.save(run / "rollouts" / "push.certificate.json")
    converted = attempt(
        "push", 12_345, wall_s=90.0, converted=True, errors={"object_pos": 0.005}
    )
    converted["errors"]["object_rot"] = math.radians(2.0)
    converted |= {
        "passed": ["sr_mt_obj", "sr_mt_obj_left"],
        "rollout": "rollouts/push.npz",
        "certified": True,
        "verdict": "robust",
        "lift_ratio": None,
        "path_ratio": 0.98,
        "hands": ["left"],
        "frame": 36,
    }
    dropped = [("object_dropped", "right")]
    lines = [
        attempt("push", 2_000, why=[("fingertip_off", "left")]),
        attempt(EVIL, 3_000, why=dropped),
        attempt(EVIL, 4_000, why=dropped),
        attempt(EVIL, 5_000, why=[("early_reset", "right")]),
        attempt("turn", 6_000, errors={"object_pos": 0.09, "object_rot": 0.1}),
        converted,
        attempt("turn", 14_000, errors={"object_pos": 0.0412, "object_rot": 0.2}),
    ]
    lines[-1]["wall_s"] = 90.0
    for line in lines:
        if line["motion"] == "turn":
            line["why"] = [{"cause": "object_pos", "hand": "left"}]
    write_lines(run / "conversions.jsonl", lines)
    metrics = [
        {
            "env_steps": float(step),
            "hours": step / 400_000,
            "convert/cumulative": float(step > 12_345),
            "convert/rate": float(step > 12_345) / 5,
            "reward/left/wrist_pos": step / 20_000,
            "reward/right/wrist_pos": 0.5,
            "loss/left/loss_actor": -0.1,
            "episode/completed": 0.4,
            "perf/env_steps_per_s": 100.0,
        }
        for step in (1_000, 8_000, 16_000)
    ]
    write_lines(run / "metrics.jsonl", metrics)
    scored = {
        "passed": [],
        "state": "failed",
        "errors": {"object_pos": 0.0071, "object_rot": math.radians(4)},
    }
    failed = {
        "passed": [],
        "state": "failed",
        "errors": {"object_pos": 0.0632, "object_rot": math.radians(11)},
    }
    baselines = {
        "do_nothing": {"push": failed, EVIL: failed, "turn": failed},
        "kinematic_playback": {"push": scored, EVIL: failed, "turn": failed},
    }
    write_object(baselines, run, "baselines.json")
    return run


@pytest.fixture
def call(capsys):
    """Run the command; return exit code, stdout, stderr."""

    def run(*argv):
        code = main([str(word) for word in argv])
        captured = capsys.readouterr()
        return code, captured.out, captured.err

    return run


@pytest.fixture
def table_rows():
    """Cells of the report's table, by row and heading, without markup."""

    def parse(text):
        body = re.search(r"<tbody>(.*?)</tbody>", text, re.DOTALL).group(1)
        rows = []
        for row in re.findall(r"<tr>(.*?)</tr>", body, re.DOTALL):
            cells = re.findall(r'<td data-label="(.*?)">(.*?)</td>', row, re.DOTALL)
            rows.append({h: re.sub(r"<[^>]*>", "", c).strip() for h, c in cells})
        return rows

    return parse
