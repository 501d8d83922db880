"""What a run says of its library: another hand's, of an older version, not there."""

import dataclasses
import shutil

import pytest
from synthetic import forge_library, renew_velocities

from flashdex.envs.config import EnvConfig
from flashdex.envs.physics.config import PhysicsConfig
from flashdex.errors import LibraryError
from flashdex.motions.library import MotionLibrary
from flashdex.recipe import MotionsConfig, Recipe
from flashdex.training import build
from flashdex.training.build import RunBuilder, library_name, load_library
from flashdex.training.loaded import verify
from flashdex.training.memory.stand_in import find_library


@pytest.fixture
def copy(library, tmp_path):
    path = tmp_path / "lib"
    shutil.copytree(library.path, path)
    return path


def recipe_of(**motions):
    return dataclasses.replace(
        Recipe(name="tiny", total_env_steps=1),
        motions=MotionsConfig(**motions),
        env=EnvConfig(num_envs=1),
        physics=PhysicsConfig(num_threads=1),
    )


def without_a_joint(entries, arrays):
    for key in ("frames/joint_pos", "frames/joint_vel"):
        arrays[key] = arrays[key][..., :-1]


def bent_too_far(entries, arrays):
    arrays["frames/joint_pos"][60, 0, 8] = 9.0
    renew_velocities(arrays)


def without_objects(entries, arrays):
    arrays["motions/object_index"][:] = -1
    arrays["motions/hand_object"][:] = -1


def bent_by_an_idle_hand(entries, arrays):
    arrays["frames/joint_pos"][:40, 0, 8] = 9.0  # motion 0 is of the right hand
    renew_velocities(arrays)


@pytest.mark.parametrize(
    ("change", "text"),
    [
        (without_a_joint, "has 17 joints of 'xhand', the hand has 18"),
        (bent_too_far, "motion 'left_ball' bends 'left_.*' beyond its range"),
        (without_objects, "no motion has an object"),
    ],
)
def test_references_that_no_run_can_use_are_refused(copy, change, text):
    forge_library(copy, change)
    with pytest.raises(LibraryError, match=text):
        RunBuilder.from_recipe(recipe_of(library=str(copy)))


def test_what_an_idle_hand_does_is_not_asked(copy):
    forge_library(copy, bent_by_an_idle_hand)
    builder = RunBuilder.from_recipe(recipe_of(library=str(copy)))
    assert builder.bank.num_motions == 3


def test_a_library_that_is_not_there_is_told_where_it_was_looked_for(
    tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)  # as of a run that was moved, with its relative path
    with pytest.raises(LibraryError) as caught:
        load_library(recipe_of(library="libraries/mine"))
    assert f"in {tmp_path}/libraries/mine" in str(caught.value)
    assert "motions.library=DIR" in str(caught.value)


def test_an_automatic_library_of_an_older_version_is_prepared_again(
    library, tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    recipe = recipe_of(source="procedural", count=1)
    folder = tmp_path / "libraries" / library_name(recipe)
    folder.mkdir(parents=True)
    (folder / "manifest.json").write_text('{"schema": 1, "motions": []}')
    assert find_library(recipe) is None
    with pytest.raises(LibraryError, match="schema 1, this version reads 2"):
        find_library(recipe_of(library=str(folder)))
    made = []

    def prepare(order, path):
        made.append(path)
        return library

    monkeypatch.setattr(build, "run_order", prepare)
    assert load_library(recipe) is library
    assert [path.name for path in made] == [folder.name]


def test_a_selection_keeps_the_hashes_of_its_motions(library):
    whole = [library.motion_hash(row) for row in range(3)]
    assert len(set(whole)) == 3
    recipe = recipe_of(library=str(library.path), select=["both", "right_box"])
    part = build.select_motions(MotionLibrary.load(library.path), recipe)
    wanted = [library.row(name) for name in part.names]
    assert [part.motion_hash(i) for i in range(2)] == [whole[i] for i in wanted]
    assert part.content_hash == library.content_hash


def test_what_was_not_kept_does_not_count(library):
    def selected(**asked):
        recipe = recipe_of(library=str(library.path), **asked)
        return list(
            build.select_motions(MotionLibrary.load(library.path), recipe).names
        )

    asked = ["rejected", "both", "right_box"]
    assert selected(select=asked, count=1) == ["both"]
    for count in (None, 3):
        with pytest.raises(LibraryError, match="'rejected' matches none"):
            selected(select=asked, count=count)


def test_verify_tells_each_fault_of_a_library(copy):
    assert verify(copy).findings == []
    (mass,) = copy.glob("data-*/objects/mass.npy")
    content = bytearray(mass.read_bytes())
    content[-1] ^= 1
    mass.write_bytes(content)
    told = "\n".join(str(finding) for finding in verify(copy).findings)
    assert "objects/mass: was changed" in told
    assert verify(copy).files == []
