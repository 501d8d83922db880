"""Verified runs: certificates, lines and files that do not fit each other."""

from __future__ import annotations

import json
import shutil

import numpy as np
import pytest
import tamper
from tamper import BOX, PROOF

from flashdex.errors import RunError
from flashdex.rollouts.findings import differences
from flashdex.rollouts.ledger import CONVERSIONS
from flashdex.rollouts.verify import verify_run
from flashdex.system.jsonl import read_lines, write_lines


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
    "passed is nothing": of_stored("passed", None),
    "trivial is nothing": of_stored("trivial", None),
    "lift is text": of_stored("lift_ratio", "high"),
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
        assert any(
            "is that of" in str(finding) for finding in one.findings if finding.is_fault
        )


def test_a_link_in_the_place_of_a_file_is_refused(spoilt_run, tmp_path):
    other = tmp_path / "elsewhere.npz"
    shutil.move(spoilt_run / BOX, other)
    (spoilt_run / BOX).symlink_to(other)
    with pytest.raises(RunError, match="is a link"):
        verify_run(spoilt_run)


@pytest.mark.parametrize("name", ["recipe.yaml", "metrics.csv", "films"])
def test_a_link_to_nothing_under_any_name_is_refused(spoilt_run, tmp_path, name):
    (spoilt_run / name).unlink(missing_ok=True)
    (spoilt_run / name).symlink_to(tmp_path / "nothing")
    with pytest.raises(RunError, match=name):
        verify_run(spoilt_run)


def test_a_library_that_was_changed_is_told(spoilt_run, truth, monkeypatch):
    monkeypatch.setattr(truth.library, "content_hash", "0" * 64)
    found = [str(f) for f in verify_run(spoilt_run, truth).findings]
    assert any(
        "library_sha256" in text and "made from another" in text for text in found
    )


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
