"""What can be wrong with a file, whatever it holds: bytes, kind, place, content.

Every edit takes the file and a generator; a payload that is run leaves ``MARK``.
"""

from __future__ import annotations

import io
import os
import pickle
import shutil
import zipfile
from pathlib import Path

import numpy as np
import torch

MARK = "payload_was_run"


class Payload:
    """Runs a command when it is unpickled by something careless."""

    def __init__(self, folder):
        self.command = f"touch '{folder / MARK}'"

    def __reduce__(self):
        return os.system, (self.command,)


def truncate(file, rng, share=0.5):
    data = file.read_bytes()
    file.write_bytes(data[: int(share * len(data))])


def keep_start(file, rng):
    truncate(file, rng, 16 / max(file.stat().st_size, 16))


def cut_end(file, rng):
    file.write_bytes(file.read_bytes()[:-3])


def extend(file, rng):
    file.write_bytes(file.read_bytes() + bytes(1000))


def repeat(file, rng):
    file.write_bytes(2 * file.read_bytes())


def zero(file, rng):
    data = bytearray(file.read_bytes())
    third = len(data) // 3
    data[third : 2 * third] = bytes(third)
    file.write_bytes(data)


def flip(file, rng):
    data = np.frombuffer(file.read_bytes(), np.uint8).copy()
    for place in rng.integers(0, len(data), 20):
        data[place] ^= np.uint8(1 << rng.integers(0, 8))
    file.write_bytes(data.tobytes())


def scramble_head(file, rng):
    data = bytearray(file.read_bytes())
    data[:200] = rng.integers(0, 256, len(data[:200]), dtype=np.uint8).tobytes()
    file.write_bytes(data)


def empty(file, rng):
    file.write_bytes(b"")


def noise(file, rng):
    file.write_bytes(rng.integers(0, 256, 3000, dtype=np.uint8).tobytes())


def delete(file, rng):
    file.unlink()


def folder(file, rng):
    file.unlink()
    file.mkdir()


def pointer(file, rng):
    text = "version https://git-lfs.github.com/spec/v1\noid sha256:4d7a\nsize 12345\n"
    file.write_text(text)


def pipe(file, rng):
    """A reader that opens it waits for ever."""
    file.unlink()
    os.mkfifo(file)


def link_outside(file, rng):
    file.unlink()
    file.symlink_to("/etc/hostname")


def link_to_itself(file, rng):
    file.unlink()
    file.symlink_to(file.name)


def link_to_endless(file, rng):
    file.unlink()
    file.symlink_to("/dev/zero")


def unreadable_text(file, rng):
    file.write_text("not what it should be\n" * 20)


def deep_json(file, rng):
    file.write_text("[" * 200_000)


def html(file, rng):
    """What a download without a login leaves."""
    file.write_text("<!DOCTYPE html><html><body>Please sign in</body></html>")


def hostile_pickle(file, rng):
    file.write_bytes(pickle.dumps({"hand_pose": Payload(file.parent)}))


def hostile_npy(file, rng):
    array = np.array([Payload(file.parent)], dtype=object)
    with file.open("wb") as stream:
        np.save(stream, array, allow_pickle=True)


def hostile_npz(file, rng):
    """The first entry, whatever it is called, becomes a pickle that runs something."""
    names = [file.stem]
    if zipfile.is_zipfile(file):
        with zipfile.ZipFile(file) as archive:
            names = [n.removesuffix(".npy") for n in archive.namelist()]
    payload = np.array(Payload(file.parent), dtype=object)
    with file.open("wb") as stream:
        np.savez(stream, **dict.fromkeys(names, payload))


def hostile_torch(file, rng):
    torch.save({"motion_filename": Payload(file.parent)}, file)


def huge_npy(file, rng):
    """A header that announces 10^15 numbers, and no numbers."""
    with file.open("wb") as stream:
        stream.write(_huge_header())


def huge_npz(file, rng):
    names = ["fps.npy", "robot.npy"]
    if zipfile.is_zipfile(file):
        with zipfile.ZipFile(file) as archive:
            names = archive.namelist()
    with zipfile.ZipFile(file, "w") as archive:
        for name in names:
            archive.writestr(name, _huge_header())


def bomb_npz(file, rng):
    """Zeros that unpack to half a gigabyte a piece."""
    names = ["a.npy"]
    if zipfile.is_zipfile(file):
        with zipfile.ZipFile(file) as archive:
            names = archive.namelist()[:1]
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
        for name in names:
            with archive.open(name, "w", force_zip64=True) as stream:
                stream.write(_huge_header((1 << 26,)))
                for _ in range(64):
                    stream.write(bytes(1 << 23))


def _huge_header(shape=(10**6, 10**6, 10**3)):
    stream = io.BytesIO()
    np.lib.format.write_array_header_1_0(
        stream, {"descr": "<f8", "fortran_order": False, "shape": shape}
    )
    return stream.getvalue()


def entity_xml(file, rng):
    file.write_text('<!DOCTYPE a [<!ENTITY b "bbbb">]><a>&b;</a>')


def nan_vertices(file, rng):
    file.write_text("v nan nan nan\nv 0 0 0\nv 0 1 0\nv 1 0 0\nf 1 2 3\nf 2 3 4\n")


def wild_faces(file, rng):
    file.write_text("v 0 0 0\nv 0 1 0\nv 1 0 0\nv 0 0 1\nf 1 2 99\nf -7 2 3\nf 0 1 2\n")


def other_text(file, rng):
    """Cells that are no numbers, a byte order mark, a column less, a NUL."""
    text = file.read_text()
    choice = rng.integers(0, 7)
    lines = text.splitlines()
    if choice == 0:
        lines = ["\ufeff" + lines[0], *lines[1:]]
    elif choice == 1:
        lines = [line.rpartition(",")[0] for line in lines]
    elif choice == 2:
        lines = [lines[0], *(line.replace("0", "x") for line in lines[1:])]
    elif choice == 3:
        lines[len(lines) // 2] = lines[len(lines) // 2].replace("1", "\x00")
    elif choice == 4:
        lines = lines[:1] + lines[:0:-1]
    elif choice == 5:
        lines = [line.replace("4", "9" * 500) for line in lines]
    else:
        lines = [line.replace(".", "e") for line in lines]
    file.write_text("\n".join(lines))


def remove_tree(file, rng):
    shutil.rmtree(file.parent)


ANY = (
    *(truncate, keep_start, cut_end, extend, repeat, zero, flip, scramble_head),
    *(empty, noise, delete, folder, pointer, pipe, link_outside, link_to_itself),
    *(link_to_endless, html, remove_tree),
)
BY_SUFFIX = {
    ".npz": (hostile_npz, huge_npz, hostile_pickle, bomb_npz),
    ".npy": (hostile_npy, huge_npy, hostile_pickle),
    ".pkl": (hostile_pickle, huge_npy, hostile_npz),
    ".pt": (hostile_torch, hostile_pickle, huge_npz),
    ".json": (deep_json, unreadable_text, other_text),
    ".jsonl": (deep_json, unreadable_text, other_text),
    ".csv": (deep_json, unreadable_text, other_text),
    ".xml": (entity_xml, unreadable_text, other_text),
    ".obj": (nan_vertices, wild_faces, unreadable_text),
    ".ply": (nan_vertices, unreadable_text),
    ".stl": (nan_vertices, unreadable_text),
    ".glb": (nan_vertices, unreadable_text),
}


def edits_of(name):
    """All edits that make sense for a file of this name."""
    return (*ANY, *BY_SUFFIX.get(Path(name).suffix, ()))
