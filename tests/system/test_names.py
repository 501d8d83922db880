"""One name type for all that comes from outside, and the file that may carry it."""

import pytest

from flashdex.errors import FlashdexError
from flashdex.system.names import (
    NAME_BYTES,
    STEM,
    check_name,
    check_names,
    file_stem,
    plain_name,
)

BAD = {
    "parent": "../evil",
    "here": ".",
    "up": "..",
    "absolute": "/etc/passwd",
    "folder": "a/b",
    "windows": "a\\b",
    "empty": "",
    "spaces": "   ",
    "nul": "a\0b",
    "newline": "a\nb",
    "escape": "a\x1b[31mb",
    "turned": "a\u202eb",
    "line separator": "a\u2028b",
    "surrogate": "a\udc80b",
    "long": "a" * (NAME_BYTES + 1),
    "long in bytes": "\u00e4" * (NAME_BYTES // 2 + 1),
    "number": 3,
    "none": None,
    "list": ["a"],
    "bytes": b"a",
}
GOOD = [
    "lift",
    "taco (brush, bowl)_07",
    "p\u00e4ck aus",
    "\u63b4\u3080",
    "a" * NAME_BYTES,
]
GOOD += ["[x] 'y' \"z\" <b>", ".hidden", "-rf", "con", "nul.npz", "x: y|z?*"]


@pytest.mark.parametrize("name", BAD.values(), ids=BAD.keys())
def test_what_is_no_name_is_refused_in_one_printable_line(name):
    with pytest.raises(FlashdexError) as caught:
        check_name(name, what="motion", where="library/manifest.json")
    text = str(caught.value)
    assert text.isascii()
    assert text.isprintable()
    assert text.startswith("library/manifest.json: ")
    assert len(text) < 400


@pytest.mark.parametrize("name", GOOD)
def test_a_name_of_any_script_has_a_plain_short_stem_of_its_own(name):
    assert check_name(name, what="motion") == name
    stem = file_stem(name)
    assert STEM.fullmatch(stem)
    assert len(stem) <= 96
    assert stem.split(".")[0].lower() not in {"con", "nul"}
    assert not stem.startswith((".", "-"))


def test_stems_tell_names_apart():
    others = ["a b", "a_b", "a  b", "a\u00a0b", "A b", "a b.", "a" * 200, "a" * 201]
    assert len({file_stem(name) for name in others}) == len(others)


def test_two_names_that_would_share_a_file_are_refused():
    assert check_names(["a", "b", "a b"], what="motion") == ["a", "b", "a b"]
    taken = file_stem("a b")  # a name that is the stem of another
    for pair in (["lift", "lift"], ["Lift", "lift"], ["a b", taken]):
        with pytest.raises(FlashdexError, match="would be the same"):
            check_names(pair, what="motion")


@pytest.mark.parametrize(
    "found",
    ["../evil", "", "..", " ", "a/b\\c", "a\0b\n", "half \ud800", "é" * 300, "\x1b[2J"],
    ids=ascii,
)
def test_any_text_has_a_name_near_it(found):
    name = plain_name(found)
    assert check_name(name, what="motion") == name
    assert plain_name(name) == name


def test_a_name_is_its_own_nearest():
    assert plain_name("päck aus (2)") == "päck aus (2)"
