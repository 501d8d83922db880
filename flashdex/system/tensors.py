"""Files of tensors: sealed as a whole, checked before they are opened, plain data.

A file is an archive as ``torch.save`` writes it, with the SHA-256 of all bytes before
it as the archive's comment: ``torch.load`` reads it as ever. It is read by
``torch.load(weights_only=True)``, which builds tensors and plain containers and calls
nothing that the file names.
"""

from __future__ import annotations

import hashlib
import os
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any, BinaryIO

import torch
from tensordict import TensorDictBase
from torch import Tensor

from flashdex.errors import is_of_machine
from flashdex.system.archives import MAX_BYTES, RATIO_FROM, check_archive
from flashdex.system.files import open_own, open_plain, own_file
from flashdex.system.pickled import check_tensors

SEAL = re.compile(rb"sha256:([0-9a-f]{64})")
SEAL_BYTES = 71
MAX_PARTS, MAX_DEPTH = 1_000_000, 32
MAX_SHARED = 4  # tensors that may share their numbers, as targets of networks do
PLAIN = {
    *(torch.bool, torch.uint8, torch.int8, torch.int16, torch.int32, torch.int64),
    *(torch.float16, torch.bfloat16, torch.float32, torch.float64),
}
# Raw simulator states, which may hold anything once a world diverges.
RAW = frozenset({"nstep"})


def write_tensors(content: Any, root: Path, *parts: str) -> None:
    """Write a file of a run, complete and sealed or not at all; see ``open_own``.

    Raises:
        OSError: it cannot be written.
    """
    with open_own(root, *parts) as file:
        sink = _Sink(file)
        try:
            torch.save(content, sink)  # type: ignore[arg-type]
        except RuntimeError as error:
            # torch's writer makes a RuntimeError of its own of a failed write
            raise sink.fault or OSError(str(error).splitlines()[0]) from None
        _seal(file)


class _Sink:
    """A file that keeps the error of a failed write."""

    def __init__(self, file: BinaryIO) -> None:
        self.file, self.flush = file, file.flush
        self.fault: OSError | None = None

    def write(self, data: bytes) -> int:
        try:
            return self.file.write(data)
        except OSError as error:
            self.fault = error
            raise


def _seal(file: BinaryIO) -> None:
    # an archive ends with the length of its comment and the comment
    file.seek(-2, os.SEEK_END)
    file.write(SEAL_BYTES.to_bytes(2, "little"))
    file.seek(0)
    found = hashlib.file_digest(file, "sha256").hexdigest()  # type: ignore[arg-type]
    file.seek(0, os.SEEK_END)
    file.write(f"sha256:{found}".encode("ascii"))


def read_tensors(root: Path, *parts: str, sealed: bool = False) -> Any:
    """Read a file of ``write_tensors``, onto the CPU; those without seal by checksums.

    Args:
        root: folder of the run.
        parts: of the path below it.
        sealed: refuse one without a seal.

    Raises:
        OSError, MemoryError: the machine fails, see ``is_of_machine``.
        ValueError: it is damaged, no file of tensors, or holds more than those.
        RunError: a link or something else stands there.
    """
    path = own_file(root, *parts)
    try:
        with open_plain(path) as file:
            has_seal = _check_seal(file)
            if sealed and not has_seal:
                raise ValueError("its seal is missing: damaged, or of another version")
            file.seek(0)
            check_archive(file)
            check_tensors(file, limit=MAX_BYTES)
            content = torch.load(file, map_location="cpu", weights_only=True)
    # damaged bytes make torch raise nearly any exception
    except Exception as error:
        if isinstance(error, ValueError) or is_of_machine(error):
            raise
        words = str(error).strip() or type(error).__name__
        raise ValueError(words.splitlines()[0]) from error
    if isinstance(content, dict) and content.get("sealed") is True and not has_seal:
        raise ValueError("its seal is missing: it is damaged")
    _check_tensors(content, stored=path.stat().st_size)
    return content


def _check_tensors(content: Any, *, stored: int) -> None:
    tensors = [part for part in _parts(content) if isinstance(part, Tensor)]
    if any(t.is_nested or t.dtype not in PLAIN or t.is_meta for t in tensors) or any(
        t.layout != torch.strided for t in tensors
    ):
        raise ValueError("it holds a tensor that is not plain")
    # a view may claim more than the file holds, which comparing makes true
    size = sum(t.numel() * t.element_size() for t in tensors)
    if size > MAX_BYTES or size > RATIO_FROM + MAX_SHARED * stored:
        raise ValueError(f"its tensors claim {size >> 20} MiB")


def _check_seal(file: BinaryIO) -> bool:
    size = file.seek(0, os.SEEK_END)
    start = max(0, size - SEAL_BYTES)
    file.seek(start)
    found = SEAL.fullmatch(file.read())
    if found is None:
        return False
    file.seek(0)
    digest = hashlib.sha256()
    while start > 0 and (part := file.read(min(start, 1 << 20))):
        digest.update(part)
        start -= len(part)
    if digest.hexdigest().encode() != found.group(1):
        raise ValueError("it is damaged: its checksum differs")
    return True


def _parts(content: Any) -> list[Any]:
    """All parts of a content, shared ones as often as whoever goes over it meets them.

    Raises:
        ValueError: they are more than any file of a run has, or nested without end.
    """
    parts, level = [], [content]
    for _ in range(MAX_DEPTH):
        parts += level
        inner = []
        for part in level:
            inner += part.values() if isinstance(part, Mapping) else ()
            inner += part if isinstance(part, list | tuple) else ()
            if len(parts) + len(inner) > MAX_PARTS:
                raise ValueError(f"it has more than {MAX_PARTS} parts")
        level = inner
    if level:
        raise ValueError(f"it is nested more than {MAX_DEPTH} levels deep")
    return parts


def first_non_finite(state: Any, path: str = "") -> str:
    """Path of the first tensor or number that is not finite, empty when all are.

    Keys of raw simulator states are skipped.
    """
    if isinstance(state, Mapping | TensorDictBase):
        items = [(k, v) for k, v in state.items() if k not in RAW]
    elif isinstance(state, list | tuple):
        items = list(enumerate(state))
    elif isinstance(state, Tensor):
        bad = state.is_floating_point() and not bool(state.isfinite().all())
        return path if bad else ""
    else:
        bad = isinstance(state, float) and not -float("inf") < state < float("inf")
        return path if bad else ""
    found = (first_non_finite(v, f"{path}.{k}".lstrip(".")) for k, v in items)
    return next((f for f in found if f), "")
