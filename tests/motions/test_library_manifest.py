"""Manifests of libraries that no writer writes: refused, whatever they ask for."""

import pytest
from mutations import snapshot
from synthetic import edit_manifest

from flashdex.errors import LibraryError
from flashdex.motions.library import MotionLibrary
from flashdex.motions.library_format import ARRAYS


def set_entry(key, value, manifest):
    manifest["arrays"]["frames/tip_dist"][key] = value


LONG = "x" * 256
NO_NAMES = ["../evil", "/evil", "", " ", "..", "a/b", "a\\b", "a\0b", "a\nb", LONG]
NO_NAMES += [None, 3, ["a"], "\x1b[2J", "half \ud800"]
MANIFESTS = {
    **{
        f"{part}-{i}": lambda m, p=part, n=name: m[p][0].update(name=n)
        for part in ("motions", "objects")
        for i, name in enumerate(NO_NAMES)
    },
    "twins": lambda m: m["motions"][1].update(name=m["motions"][0]["name"]),
    "twins-but-for-case": lambda m: m["motions"][1].update(name="RIGHT_BOX"),
    "hand-path": lambda m: m.update(hand="../../hands/evil"),
    "hand-number": lambda m: m.update(hand=3),
    "hand-missing": lambda m: m.pop("hand"),
    **{
        f"fps-{value}": lambda m, v=value: m.update(fps=v)
        for value in (0, -60, float("nan"), float("inf"), 1e9, "60", None, True, [60])
    },
    "fps-missing": lambda m: m.pop("fps"),
    "schema-text": lambda m: m.update(schema="2"),
    "schema-float": lambda m: m.update(schema=2.0),
    "schema-future": lambda m: m.update(schema=3),
    "units": lambda m: m["units"].update(length="mm"),
    "up": lambda m: m.update(up="y"),
    "quat-order": lambda m: m.update(quat="xyzw"),
    "hand-order": lambda m: m["hands"].reverse(),
    "data-outside": lambda m: m.update(data=".."),
    "data-absolute": lambda m: m.update(data="/tmp"),
    "data-missing": lambda m: m.pop("data"),
    "data-elsewhere": lambda m: m.update(data="data-" + "0" * 16),
    "no-motions": lambda m: m.update(motions=[]),
    "motions-less": lambda m: m["motions"].pop(),
    "motions-more": lambda m: m["motions"].append(m["motions"][0] | {"name": "n"}),
    "motions-mapping": lambda m: m.update(motions={}),
    "motion-text": lambda m: m["motions"].__setitem__(0, "right_box"),
    "motion-hash": lambda m: m["motions"][0].update(content_sha256="0" * 64),
    "motion-hash-missing": lambda m: m["motions"][0].pop("content_sha256"),
    "motions-exchanged": lambda m: m["motions"].reverse(),
    "objects-less": lambda m: m["objects"].pop(),
    "objects-exchanged": lambda m: m["objects"].reverse(),
    "parts-none": lambda m: m["objects"][0].update(parts=[]),
    "parts-text": lambda m: m["objects"][0].update(parts="meshes/box/visual.obj"),
    "parts-twice": lambda m: m["objects"][0]["parts"].append("meshes/box/visual.obj"),
    "part-outside": lambda m: m["objects"][0].update(parts=["../../evil.obj"]),
    "part-unlisted": lambda m: m["objects"][0].update(parts=["meshes/box/a.obj"]),
    "visual-absolute": lambda m: m["objects"][0].update(visual="/etc/passwd"),
    "visual-missing": lambda m: m["objects"][0].pop("visual"),
    "watertight-text": lambda m: m["objects"][0].update(watertight="yes"),
    "mesh-outside": lambda m: m["meshes"].update({"meshes/../../evil.obj": "0" * 64}),
    "mesh-other-kind": lambda m: m["meshes"].update({"meshes/box/a.gltf": "0" * 64}),
    "mesh-hash": lambda m: m["meshes"].update({"meshes/box/visual.obj": "0" * 64}),
    "mesh-hash-none": lambda m: m["meshes"].update({"meshes/box/visual.obj": None}),
    "meshes-list": lambda m: m.update(meshes=list(m["meshes"])),
    "versions-list": lambda m: m.update(versions=["torch"]),
    "inputs-number": lambda m: m.update(inputs=3),
    "arrays-list": lambda m: m.update(arrays=[]),
    "array-outside": lambda m: m["arrays"].update({"../evil": {}}),
    "array-unknown": lambda m: m["arrays"].update(
        {"frames/more": m["arrays"]["frames/tip_dist"]}
    ),
    **{
        f"missing-{name.replace('/', '-')}": lambda m, n=name: m["arrays"].pop(n)
        for name in ARRAYS
        if not name.startswith("quality/")
    },
    **{
        f"array-{word}": lambda m, w=word, v=value: m["arrays"][
            "frames/tip_dist"
        ].update({w.split("-")[0]: v})
        for word, value in {
            "dtype-object": "object",
            "dtype-double": "float64",
            "dtype-none": None,
            "shape-bomb": [2**40, 2, 5],
            "shape-overflow": [2**62, 2**62, 4],
            "shape-negative": [-1, 2, 5],
            "shape-float": [123.0, 2, 5],
            "shape-bool": [True, 2, 5],
            "shape-less": [122, 2, 5],
            "shape-flat": [1230],
            "shape-text": "123",
            "shape-deep": [[123], 2, 5],
            "shape-empty": [0, 2, 5],
            "sha256-other": "0" * 64,
            "sha256-short": "0",
            "sha256-none": None,
            "more-key": 1,
        }.items()
    },
    "array-text": lambda m: m["arrays"].update({"frames/tip_dist": "float32"}),
}


@pytest.mark.parametrize("case", MANIFESTS)
def test_manifests_that_no_writer_writes_are_refused(copy, case):
    edit_manifest(copy, MANIFESTS[case])
    before = snapshot(copy)
    with pytest.raises(LibraryError) as caught:
        MotionLibrary.load(copy)
    assert str(copy) in str(caught.value)
    assert "prepare" in str(caught.value).lower()
    assert str(caught.value).isascii()
    assert snapshot(copy) == before


TEXTS = {
    "empty": b"",
    "binary": bytes(range(256)),
    "cut": b'{"schema": 2, "mot',
    "scalar": b"2",
    "list": b"[]",
    "null": b"null",
    "latin-1": '{"schema": 2, "é": 1}'.encode("latin-1"),
    "bom": b"\xef\xbb\xbf{}",
    "deep": b"[" * 100_000,
    "long-number": b'{"schema": ' + b"9" * 10_000 + b"}",
    "zeros": b"\0" * 4096,
}


@pytest.mark.parametrize("case", TEXTS)
def test_manifests_that_are_no_json_object_are_refused(copy, case):
    (copy / "manifest.json").write_bytes(TEXTS[case])
    with pytest.raises(LibraryError, match=r"manifest\.json|schema"):
        MotionLibrary.load(copy)


def test_a_manifest_has_a_limit(copy, monkeypatch):
    monkeypatch.setattr("flashdex.motions.library_format.MAX_MANIFEST", 1000)
    with pytest.raises(LibraryError, match="over 0 MiB"):
        MotionLibrary.load(copy)
