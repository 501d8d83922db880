"""Jobs: what is done is not done again, and one bad recording costs only itself."""

import json
import os
import signal
from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from flashdex import datasets
from flashdex.datasets import list_recordings, register
from flashdex.datasets.procedural.reader import procedural
from flashdex.datasets.source import Recording, Source, SourceOptions
from flashdex.errors import DemoError, UnknownSourceError
from flashdex.motions.align import align
from flashdex.motions.checks.aligned import check_left_out
from flashdex.motions.contact.roles import find_roles
from flashdex.motions.pipeline import workers as pool
from flashdex.motions.pipeline.motion import MotionSettings
from flashdex.motions.pipeline.prepare import Order, hash_inputs, run_order
from flashdex.motions.pipeline.stage import listening
from flashdex.motions.pipeline.workers import Job, run_job, run_jobs
from flashdex.motions.repair.repair import repair
from flashdex.objects.asset import ObjectSettings

SMALL = ObjectSettings(sdf_resolution=24)


@pytest.fixture
def settings(tmp_path):
    cache = tmp_path / "cache"
    return MotionSettings(control_hz=15.0, objects=SMALL, attempts=1, cache_dir=cache)


def too_short(name):
    """A recording that is read and rejected in no time."""
    demo = procedural(0, kinds=["pick_box_right"])[0]
    return [demo.cut(0, 40, name=name)]


def never():
    raise AssertionError("the recording was read again")


def die(code):
    os.kill(os.getpid(), code)


def stop():
    raise KeyboardInterrupt


def wrong_key():
    return {}["no such key"]


def test_what_killed_writers_left_in_the_cache_goes_after_a_day(settings, tmp_path):
    folder = tmp_path / "cache" / "motions"
    folder.mkdir(parents=True)
    for name in (".a.npz.12.tmp", ".b.npz.12.tmp", "a.npz", "a.tmp"):
        (folder / name).touch()
        os.utime(folder / name, (0, 0))
    (folder / ".b.npz.12.tmp").touch()  # somebody writes it now
    with pytest.raises(UnknownSourceError):
        run_order(Order("none such", settings=settings), tmp_path / "out")
    assert sorted(os.listdir(folder)) == [".b.npz.12.tmp", "a.npz", "a.tmp"]


@pytest.fixture
def recording(tmp_path):
    file = tmp_path / "clip.bin"
    file.write_bytes(b"content")
    return Recording(name="clip", read=partial(too_short, "clip"), files=(file,))


def statuses(outcomes):
    return [row["reason"].split(":")[0] for o in outcomes for row in o.rows]


def test_prepared_motion_comes_from_the_disk_as_it_was(settings):
    listed = list_recordings(
        "procedural", SourceOptions(path="pick_box_right", limit=1)
    )
    first = run_job(Job(listed[0], settings))
    again = run_job(Job(replace(listed[0], read=never), settings))
    assert again.rows == first.rows
    assert first.rows[0]["status"] != "rejected"
    root = settings.cache_dir
    (stored,), (made,) = again.load(root), first.load(root)
    fresh = run_job(Job(listed[0], replace(settings, cache_dir=root / "other")))
    (computed,) = fresh.load(root / "other")
    for key, value in computed.record.frames.items():
        np.testing.assert_array_equal(stored.record.frames[key], value)
    assert stored.record.quality["contact"].any()
    assert stored.record.info == made.record.info
    assert stored.record.objects[0].name == computed.record.objects[0].name


def test_no_more_is_prepared_than_is_asked_for(settings, tmp_path, monkeypatch):
    (box,) = procedural(0, kinds=["pick_box_right"])
    reads = {
        "short": partial(too_short, "short"),
        "one": partial(list, [replace(box, name="one")]),
        "two": partial(list, [replace(box, name="two")]),
        "three": never,
    }
    listed = [Recording(name=name, read=read) for name, read in reads.items()]
    monkeypatch.setattr(datasets, "REGISTERED", {})
    register(Source(name="pile", list=lambda _: listed, about="", needs=()))
    order = Order("pile", settings=settings, enough=2)
    library = run_order(order, tmp_path / "two", progress=False)
    assert list(library.names) == ["one", "two"]
    options = SourceOptions(select=("two", "*"))
    order = replace(order, options=options, enough=1)
    library = run_order(order, tmp_path / "one", progress=False)
    assert list(library.names) == ["two"]


def test_changed_content_settings_or_lost_object_is_prepared_again(settings, recording):
    run_job(Job(recording, settings))
    unread = replace(recording, read=never)
    assert statuses([run_job(Job(unread, settings))]) == ["R_SHORT"]
    other = replace(settings, control_hz=30.0)
    assert statuses([run_job(Job(unread, other))]) == ["E_READ"]
    recording.files[0].write_bytes(b"another content")
    assert statuses([run_job(Job(unread, settings))]) == ["E_READ"]


def test_damaged_cache_file_is_replaced(settings, recording):
    first = run_job(Job(recording, settings))
    first.file.write_bytes(b"PK no archive")
    again = run_job(Job(recording, settings))
    assert again.rows == first.rows
    assert again.file.read_bytes() != b"PK no archive"


def test_cache_that_cannot_be_written_costs_nothing(settings, recording, tmp_path):
    (tmp_path / "file").write_text("no folder")
    settings = replace(settings, cache_dir=tmp_path / "file")
    outcome = run_job(Job(recording, settings))
    assert outcome.file is None or not outcome.file.is_file()
    assert len(outcome.load(tmp_path)) == 1


def test_bad_recordings_become_rows_and_the_others_go_on(settings, recording):
    refused = Recording(name="refused", read=partial(DemoError.__init__))
    odd = Recording(name="odd", read=wrong_key)
    gone = Recording(name="gone", read=never, files=(recording.files[0] / "no",))
    jobs = [Job(r, settings) for r in (refused, odd, gone, recording)]
    outcomes = run_jobs(jobs, workers=1, progress=False)
    assert statuses(outcomes) == ["E_READ", "E_READ", "E_FILE", "R_SHORT"]
    assert "KeyError" in outcomes[1].rows[0]["reason"]


def test_interrupted_work_goes_on_where_it_was(settings, recording):
    stopped = Recording(name="second", read=stop)
    jobs = [Job(recording, settings), Job(stopped, settings)]
    with pytest.raises(KeyboardInterrupt):
        run_jobs(jobs, workers=1, progress=False)
    second = replace(stopped, read=partial(too_short, "second"))
    jobs = [Job(replace(recording, read=never), settings), Job(second, settings)]
    outcomes = run_jobs(jobs, workers=1, progress=False)
    assert statuses(outcomes) == ["R_SHORT", "R_SHORT"]


def test_worker_that_dies_costs_its_recording_only(settings, recording):
    killed = Recording(name="killer", read=partial(die, signal.SIGKILL))
    others = [
        replace(recording, name=f"clip{i}", read=partial(too_short, f"clip{i}"))
        for i in range(3)
    ]
    jobs = [Job(r, settings) for r in (others[0], killed, *others[1:])]
    outcomes = run_jobs(jobs, workers=2, progress=False)
    assert statuses(outcomes) == ["R_SHORT", "E_CRASH", "R_SHORT", "R_SHORT"]
    assert [o.rows[0]["motion"] for o in outcomes] == [
        *("clip0", "killer", "clip1", "clip2")
    ]


def test_two_workers_write_the_library_of_one(tmp_path):
    made = []
    for workers in (1, 2):
        order = Order(
            "procedural",
            SourceOptions(path="pick_box_right,pick_cylinder_left"),
            MotionSettings(
                control_hz=15.0, objects=SMALL, cache_dir=tmp_path / f"cache{workers}"
            ),
        )
        out = tmp_path / f"library{workers}"
        made.append(run_order(order, out, workers=workers, progress=False))
    one, two = made
    assert one.names == two.names
    assert (one.frames == two.frames).all()
    assert (one.objects == two.objects).all()
    assert one.manifest["inputs"] == two.manifest["inputs"]


def test_slow_playback_halves_the_speed(tmp_path):
    lengths, speeds = [], []
    for speed in (1.0, 0.5):
        settings = MotionSettings(
            control_hz=15.0, objects=SMALL, cache_dir=tmp_path / "cache", speed=speed
        )
        order = Order("procedural", SourceOptions(path="pick_box_right"), settings)
        library = run_order(order, tmp_path / f"{speed}")
        lengths.append(int(library.motions["length"][0]))
        speeds.append(library.frames["object_linvel"].norm(dim=-1).mean())
    assert lengths[1] == pytest.approx(2 * lengths[0], abs=2)
    assert float(speeds[1] / speeds[0]) == pytest.approx(0.5, rel=0.1)


def test_copies_are_reported_and_left_out(tmp_path, monkeypatch, settings):
    for name in ("a", "b"):
        (tmp_path / name).write_bytes(b"same")
    names = ("a", "b", "box")
    listed = [
        Recording(name=n, read=partial(too_short, n), files=(tmp_path / n,))
        for n in names[:2]
    ]
    listed += list_recordings("procedural", SourceOptions(path="pick_box_right"))
    monkeypatch.setattr("flashdex.datasets.REGISTERED", {})
    made = {"list": lambda options: listed, "about": "test", "needs": ()}
    register(Source(name="copies", **made))
    order = Order("copies", SourceOptions(), settings)
    library = run_order(order, tmp_path / "library")
    report = (library.path / "report.csv").read_text()
    assert "I_DUP: the same content as 'a'" in report
    assert library.manifest["quality"]["rejected"] == 2


def test_inputs_hash_follows_content_not_place(tmp_path, monkeypatch, settings):
    file = tmp_path / "a"
    file.write_bytes(b"one")
    listed = [Recording(name="a", read=never, files=(file,))]
    monkeypatch.setattr("flashdex.datasets.REGISTERED", {})
    made = {"list": lambda options: listed, "about": "test", "needs": ()}
    register(Source(name="hashed", **made))
    order = Order("hashed", SourceOptions(), settings)
    first = hash_inputs(order)
    assert hash_inputs(replace(order, settings=replace(settings, speed=0.5))) != first
    file.write_bytes(b"two")
    assert hash_inputs(order) != first
    file.write_bytes(b"one")
    assert hash_inputs(order) == first


def test_motions_travel_with_the_answer_where_disks_differ(settings, recording):
    outcome = run_job(Job(recording, settings), carry=True)
    elsewhere = replace(outcome, file=settings.cache_dir / "not" / "here.npz")
    assert [item.row for item in elsewhere.load(settings.cache_dir)] == outcome.rows


def test_bad_motion_costs_none_of_the_others(settings):
    good = procedural(0, kinds=["pick_box_right"])[0].cut(0, 40, name="short")
    bad = replace(good, name="bad", keypoints={"right": good.keypoints["right"][:5]})
    outcome = run_job(Job(Recording(name="both", read=lambda: [good, bad]), settings))
    assert [row["motion"] for row in outcome.rows] == ["short", "bad"]
    assert statuses([outcome]) == ["R_SHORT", "E_DEMO"]


def test_pieces_around_gaps_share_the_table_of_the_recording():
    demo = procedural(0, kinds=["pick_box_right"])[0]
    box = demo.objects[0]
    top = int(box.pose[:, 2].argmax())
    index = np.repeat([0, 0, top, top, 0], [80, 20, 80, 20, 80])
    gaps = np.repeat([False, True, False, True, False], [80, 20, 80, 20, 80])

    def play(track):
        return np.where(gaps.reshape(-1, *[1] * (track.ndim - 1)), np.nan, track[index])

    held = replace(
        demo,
        keypoints={s: play(k) for s, k in demo.keypoints.items()},
        palm={s: play(p) for s, p in demo.palm.items()},
        objects=[replace(box, pose=play(box.pose))],
        support_z=None,
    )
    pieces, _ = repair(held)
    assert [p.num_frames for p in pieces] == [80, 80, 80]
    assert pieces[1].objects[0].pose[:, 2].min() > box.pose[0, 2] + 0.05
    assert [p.support_z for p in pieces] == pytest.approx([0.0] * 3, abs=2e-3)


def test_objects_without_a_slot_are_chosen_by_touch_and_told():
    demo = procedural(0, kinds=["pick_box_right"])[0]
    box = demo.objects[0]
    still = np.tile(box.pose[0], (demo.num_frames, 1))
    still[:, 0] += 0.4
    shaken = still.copy()
    shaken[:, 1] += 0.1 * np.sin(np.linspace(0, 6, demo.num_frames))
    others = [
        replace(box, name="still", pose=still),
        replace(box, name="shaken", pose=shaken),
    ]
    demo = replace(demo, objects=[*others, box], hand_object={})
    aligned = find_roles(align(demo, control_hz=15.0))
    assert aligned.object_names == ["shaken", "box"]
    assert aligned.hand_object.tolist() == [-1, 1]
    assert list(aligned.left_out) == ["still"]
    moving = replace(demo, objects=[others[1], replace(others[1], name="b"), box])
    aligned = find_roles(align(moving, control_hz=15.0))
    assert aligned.object_names[-1] == "box"
    codes = [f.code for f in check_left_out(aligned)]
    assert codes == ["W_OBJECTS"]


def test_stages_inside_one_recording_are_told(settings, monkeypatch, caplog):
    """A new mesh takes a minute: without a terminal each stage can be a line."""
    monkeypatch.setattr(pool, "LINE_SECONDS", -1.0)
    options = SourceOptions(path="pick_box_right", limit=1)
    (listed,) = list_recordings("procedural", options)
    heard = []
    with listening(heard.append), caplog.at_level("INFO"):
        run_jobs([Job(listed, settings)], workers=1)
    name = listed.name
    wanted = ["reading", "mesh of box", "contact", "joints of xhand"]
    assert heard == [f"{name}: {stage}" for stage in wanted]
    assert "prepared 0 of 1 recordings; pick_box_right: mesh of box" in caplog.text
    assert "prepared 1 of 1 recordings; 1 kept" in caplog.text
    heard.clear()
    run_jobs([Job(listed, settings)], workers=1)
    assert not heard  # nobody listens, and it comes from the cache


def change_entries(file, change):
    """Change what a file of the cache says of its motions."""
    with np.load(file) as stored:
        arrays = dict(stored)
    entries = json.loads(str(arrays["entries"]))
    change(entries)
    arrays["entries"] = np.array(json.dumps(entries))
    np.savez_compressed(file, **arrays)


HARM = {
    "pickle": lambda f: np.savez(f, entries=np.array([print], dtype=object)),
    "torn": lambda f: f.write_bytes(f.read_bytes()[:-100]),
    "bomb": lambda f: np.savez_compressed(f, entries=np.zeros(1 << 24)),
    "no_entries": lambda f: np.savez(f, other=np.zeros(3)),
    "numbers": lambda f: np.savez(f, entries=np.zeros(3)),
    "deep": lambda f: np.savez(f, entries=np.array("[" * 10**5)),
    "other_list": lambda f: change_entries(f, lambda e: e.append(1)),
    "no_row": lambda f: change_entries(f, lambda e: e[0].pop("row")),
    "record_of_another_kind": lambda f: change_entries(
        f, lambda e: e[0].update(record={"objects": [], "evil": 1})
    ),
    "object_elsewhere": lambda f: change_entries(
        f, lambda e: e[0].update(record={"objects": [["a", "../../evil"]]})
    ),
    "row_of_another_kind": lambda f: change_entries(f, lambda e: e[0].update(row=[])),
}


@pytest.mark.parametrize("harm", HARM.values(), ids=HARM)
def test_harmful_cache_file_is_made_again(settings, recording, harm):
    first = run_job(Job(recording, settings))
    harm(first.file)
    again = run_job(Job(recording, settings))
    assert again.rows == first.rows
    assert run_job(Job(replace(recording, read=never), settings)).rows == first.rows


def test_link_planted_in_the_cache_is_replaced_not_followed(
    settings, recording, tmp_path
):
    file = run_job(Job(recording, settings)).file
    mine = tmp_path / "mine.txt"
    mine.write_text("mine")
    file.unlink()
    file.symlink_to(mine)
    temporary = file.with_name(f".{file.name}.{os.getpid()}.tmp")
    temporary.symlink_to(mine)
    run_job(Job(recording, settings))
    assert mine.read_text() == "mine"
    assert file.is_file()
    assert not file.is_symlink()


def test_pipe_planted_in_the_cache_is_not_waited_for(settings, recording):
    first = run_job(Job(recording, settings))
    first.file.unlink()
    os.mkfifo(first.file)
    assert run_job(Job(recording, settings)).rows == first.rows
    assert first.file.is_file()
