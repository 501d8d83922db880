"""Faults of single files, and what a command makes of them."""

from __future__ import annotations

import io
import logging
import os
import random
import shutil
from dataclasses import dataclass
from pathlib import Path

from flashdex.cli.main import main


def flip_bit(path, draw):
    content = bytearray(path.read_bytes())
    content[draw.randrange(len(content))] ^= 1 << draw.randrange(8)
    path.write_bytes(content)


def cut_off(path, draw):
    os.truncate(path, draw.randrange(1, path.stat().st_size))


def cut_in_a_hole(path, draw):
    """Length of the whole, content of a part: a file system that came up again."""
    size = path.stat().st_size
    cut_off(path, draw)
    os.truncate(path, size)


def empty(path, draw):
    path.write_bytes(b"")


def zero_tail(path, draw):
    path.write_bytes(path.read_bytes() + bytes(200))


def garbage_tail(path, draw):
    path.write_bytes(path.read_bytes() + draw.randbytes(200) + b"\n")


def random_bytes(path, draw):
    path.write_bytes(draw.randbytes(500))


def a_list(path, draw):
    path.write_bytes(path.read_bytes() + b"[1, 2]\n")


def a_bare_line(path, draw):
    path.write_bytes(path.read_bytes() + b"{}\n")


def blank_line(path, draw):
    path.write_bytes(path.read_bytes() + b"\n \n")


def other_encoding(path, draw):
    path.write_bytes('{"é": 1}\n'.encode("latin-1") + path.read_bytes())


def utf_16(path, draw):
    path.write_bytes(path.read_bytes().decode("utf-8", "replace").encode("utf-16"))


def deep(path, draw):
    path.write_bytes(b"[" * 100_000)


def words_for_numbers(path, draw):
    text = path.read_bytes()
    for digit in b"0123456789":
        text = text.replace(b": %c" % digit, b': "x')
    path.write_bytes(text)


def doubled(path, draw):
    path.write_bytes(2 * path.read_bytes())


def backwards(path, draw):
    path.write_bytes(b"".join(reversed(path.read_bytes().splitlines(keepends=True))))


def gone(path, draw):
    path.unlink()


CONTENT = (
    *(flip_bit, cut_off, cut_in_a_hole, empty, zero_tail, garbage_tail, random_bytes),
    *(a_list, a_bare_line, blank_line, other_encoding, utf_16, deep),
    *(words_for_numbers, doubled, backwards, gone),
)


def file_link(path, outside):
    target = outside / "target"
    # what a careless reader would take for the file itself
    target.write_bytes(path.read_bytes() if path.is_file() else b"precious")
    remove(path)
    path.symlink_to(target)


def dangling_link(path, outside):
    remove(path)
    path.symlink_to(outside / "not_there")


def folder_link(path, outside):
    folder = outside / "folder"
    if path.is_dir():
        shutil.copytree(path, folder)
    else:
        folder.mkdir()
    (folder / "precious.txt").write_text("precious")
    remove(path)
    path.symlink_to(folder, target_is_directory=True)


def pipe(path, outside):
    remove(path)
    os.mkfifo(path)


def folder(path, outside):
    is_folder = path.is_dir()
    remove(path)
    path.write_text("a file") if is_folder else path.mkdir()


PLANTED = (file_link, dangling_link, folder_link, pipe, folder)


def remove(path):
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)
    path.parent.mkdir(exist_ok=True, parents=True)


def fingerprint(folder):
    """Names and contents below a folder, links not followed."""
    return {
        str(p.relative_to(folder)): p.read_bytes()
        for p in sorted(Path(folder).rglob("*"))
        if p.is_file() and not p.is_symlink()
    }


@dataclass
class Outcome:
    code: int | None
    out: str
    told: str  # what stderr and the log said

    def is_one_message(self, verb):
        lines = self.told.splitlines()
        said = [line for line in lines if line.startswith(f"flashdex {verb}: ")]
        return self.code == 2 and len(said) == 1 and "Traceback" not in self.told


def command(capsys, caplog, *words):
    """Run the command in this process."""
    capsys.readouterr()
    caplog.clear()
    caplog.set_level(logging.WARNING)
    code = main([str(word) for word in words])
    out, err = capsys.readouterr()
    return Outcome(code, out, caplog.text + err)


def drawn(seed):
    return random.Random(seed)


class Disk:
    """Fails the n-th of the calls that change something below a folder.

    Args:
        monkeypatch: of the test.
        root: the folder.
    """

    CALLS = ("fsync", "replace", "ftruncate", "mkdir", "unlink", "open")

    def __init__(self, monkeypatch, root):
        self.root, self.count, self.code, self.fails = str(root), 0, 0, lambda n: False
        for name in self.CALLS:
            call = getattr(os, name)
            monkeypatch.setattr(os, name, self._wrap(name, call))
        monkeypatch.setattr(os, "fdopen", self._fdopen)

    def fail(self, fails, code):
        """From now on fail the calls with a number for which ``fails`` is true."""
        self.count, self.fails, self.code = 0, fails, code

    def step(self, target):
        if isinstance(target, int):
            target = os.readlink(f"/proc/self/fd/{target}")
        if not os.path.abspath(target).startswith(self.root):
            return
        self.count += 1
        if self.fails(self.count):
            raise OSError(self.code, os.strerror(self.code), str(target))

    def _wrap(self, name, call):
        def wrapped(target, *args, **kwargs):
            flags = args[0] if name == "open" and args else os.O_RDONLY
            writes = flags & (os.O_WRONLY | os.O_RDWR | os.O_CREAT)
            if name != "open" or writes:
                self.step(target)
            return call(target, *args, **kwargs)

        return wrapped

    def _fdopen(self, handle, mode="r", *args, **kwargs):
        if mode == "rb":
            return open(handle, mode, *args, **kwargs)
        disk = self

        class Raw(io.FileIO):
            def write(self, data):
                disk.step(handle)
                return super().write(data[:100_000])  # what a call may leave

        raw = Raw(handle, {"ab": "a", "r+b": "r+"}.get(mode, mode))
        kind = io.BufferedRandom if mode == "r+b" else io.BufferedWriter
        return kind(raw)
