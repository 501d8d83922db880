"""Tables for the terminal: the same facts as the page, within 100 columns."""

from flashdex.reports.run.terminal import (
    evaluation_table,
    run_table,
    score_table,
)
from flashdex.reports.text import align, short, shorten
from flashdex.system.jsonl import read_lines, write_lines


def row_of(text, name):
    heads = next(
        line for line in text.splitlines() if line.startswith("motion")
    ).split()
    line = next(line for line in text.splitlines() if line.startswith(name))
    cells = line.replace(f"{name} *", name).split()
    return dict(zip(heads, cells, strict=True))


def test_facts_of_a_run(run_dir, certificate):
    text = run_table(run_dir)
    assert (
        "1 of 5 converted by sr_mt_obj, 1 certified (1 robust, 1 strict), and 0 trivial"
        in text
    )
    assert "16,000 env steps in 2 min 24 s" in text
    row = row_of(text, "push")
    depth = certificate.safety["penetration_max_mm"]
    force = certificate.safety["force_peak"]
    assert certificate.nominal["sr_mt_obj_x0.5"]["state"] == "passed"
    worst = certificate.nominal["sr_mt_obj_frame"]["values"]["object_pos"]
    assert (
        f"mm: {depth:.1f} median, {depth:.1f} max; largest force, N: {force:.1f}"
        in text
    )
    assert row == {
        "motion": "push",
        "hand": "L",
        "tries": "2",
        "steps": "12.3k",
        "mm": "5.0",
        "deg": "2.0",
        "lift": "-",
        "worst": f"{1e3 * worst:.0f}",
        "half": "yes",
        "proof": "robust",
        "pert": f"{certificate.perturbed['pass_fraction']['sr_mt_obj']:.0%}",
        "pen": f"{depth:.1f}",
        "N": f"{certificate.safety['force_peak']:.0f}",
        "idle": "63/11",
        "playback": "7/4",
    }
    assert row_of(text, "turn")["mm"] == "41.2"
    assert "object_dropped right 67%; never completed, furthest frame 17" in text
    assert "limits of sr_mt_obj: object 30 mm, object 30 deg" in text


def test_no_line_is_longer_than_100(run_dir):
    path = run_dir / "conversions.jsonl"
    lines = read_lines(path)
    for line in lines:
        line["motion"] = line["motion"] * 9
        line["why"] = [{"cause": "c" * 80, "hand": "left"}] if line["why"] else []
    write_lines(path, lines)
    assert max(map(len, run_table(run_dir).splitlines())) <= 100


def test_runs_without_baselines_or_attempts(run_dir, empty_run):
    (run_dir / "baselines.json").unlink()
    text = run_table(run_dir)
    assert "playback" not in text
    assert row_of(text, "push")["proof"] == "robust"
    (run_dir / "conversions.jsonl").unlink()
    (run_dir / "metrics.jsonl").unlink()
    assert "no motion has been attempted yet" in run_table(empty_run)


def test_evaluation():
    row = {"motion": "lift", "sr_mt_obj": "passed", "sr_spider_raw": "not_measured"}
    row |= {"mope": 12.3, "more": 0.1, "lift_ratio": 0.5, "path_ratio": None}
    nothing = dict.fromkeys(("mope", "more", "lift_ratio", "path_ratio"))
    other = {**row, **nothing, "motion": "turn", "sr_mt_obj": "failed"}
    totals = {
        "env_steps": 1234,
        "mope": None,
        "more": None,
        "mope_all": 12.3,
        "more_all": 0.1,
        "mope_motions": 0,
        "mope_all_motions": 2,
        "sr_mt_obj": {"passed": 1, "failed": 1, "not_measured": 0},
        "sr_spider_raw": {"passed": 0, "failed": 0, "not_measured": 2},
    }
    lines = [
        line.split() for line in evaluation_table([row, other], totals).splitlines()
    ]
    assert ["lift", "yes", "n.m.", "12.3", "5.7", "0.50", "-"] in lines
    assert ["turn", "no", "n.m.", "-", "-", "-", "-"] in lines
    assert ["all", "2", "1/2", "0/0", "12.3", "5.7"] in lines
    text = evaluation_table([row, other], totals)
    assert "over all motions (2): 12.3 mm, 5.7 deg" in text
    assert "sr_spider_centred (0): - mm, - deg" in text


def test_scores_show_value_and_limit(rollout):
    text = score_table("push.npz", rollout.score())
    lines = {line.split()[0]: line for line in text.splitlines()}
    assert "passed" in lines["sr_mt_obj"]
    assert "object 5.0/30 mm, object 0.0/30 deg" in lines["sr_mt_obj"]
    assert "hand_absent" in lines["sr_mt_obj_right"]
    assert "not measured" in lines["sr_mt_obj_right"]
    assert "lift off by" in lines["sr_mt_obj_moved"]
    assert not [name for name in lines if name.startswith("completed")]


def test_columns_and_short_forms():
    assert align([["a", "10"], ["bcd", "2"]]) == ["a   10", "bcd  2"]
    assert [short(v) for v in (999, 12_345, 300e6)] == ["999", "12.3k", "300M"]
    assert shorten("abcdef", 6) == "abcdef"
    assert shorten("abcdefg", 6) == "abcd.."
