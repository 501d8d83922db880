"""What a pickle costs, told from its steps before a machine takes them.

The pickle machine allocates whatever a length or a place in its memo says, tens of
gigabytes for ten bytes of file, and compares keys for hours; torch's own, too.
"""

from __future__ import annotations

import io
import pickle
import pickletools
from typing import IO, Any

from flashdex.system.archives import open_archive

# bytes that a step of the pickle machine takes at least, and an item of a set or table
STEP, HASHED = 32, 48
STEPS = {
    **dict.fromkeys(("REDUCE", "NEWOBJ", "NEWOBJ_EX", "OBJ", "INST"), 200),
    **dict.fromkeys(("EMPTY_SET", "FROZENSET"), 216),
    **dict.fromkeys(("EMPTY_DICT", "DICT", "EMPTY_LIST", "LIST", "TUPLE"), 64),
    **dict.fromkeys(("MARK", "PUT", "BINPUT", "LONG_BINPUT", "MEMOIZE", "GET"), 8),
    **dict.fromkeys(("BINGET", "LONG_BINGET", "DUP", "POP", "APPEND", "APPENDS"), 8),
}
MAX_STEPS = 20_000_000  # of the pickle machine, some seconds
MAX_INT = 2**64  # of a number that is no magic
MAX_TREE = 256 << 20  # bytes of the pickle of a torch file, which holds no numbers
MAX_HASHED = 200_000_000  # parts of keys, some seconds
MAGIC = 0x1950A86A20F9469CFC6C  # the one larger number: an old torch file begins so
TUPLES = ("TUPLE", "TUPLE1", "TUPLE2", "TUPLE3")
HASHING = ("SETITEM", "SETITEMS", "DICT", "ADDITEMS", "FROZENSET")
# of each step: items it takes, whether all down to a mark as well, items it leaves
STACK = {
    code.name: (
        [*code.stack_before, pickletools.markobject].index(pickletools.markobject),
        pickletools.markobject in code.stack_before,
        len(code.stack_after),
    )
    for code in pickletools.opcodes
}


def check_tensors(file: IO[bytes], *, limit: int) -> None:
    """Check a file of ``torch.save`` that may unpack to ``limit`` bytes; then rewind.

    Raises:
        ValueError, pickle.UnpicklingError: it would grow, or take hours to load.
        Exception: it is damaged.
    """
    file.seek(0)
    is_archive = file.read(4) == b"PK\3\4"  # as torch tells them apart
    file.seek(0)
    if is_archive:
        with open_archive(file, limit=limit) as archive:
            for part in archive.infolist():
                if part.filename.endswith(".pkl") and part.file_size > MAX_TREE:
                    raise ValueError(f"'{part.filename}' is too large")
                if part.filename.endswith(".pkl"):
                    check_steps(io.BytesIO(archive.read(part)))
    else:  # magic, version, system, content, storages
        for _ in range(5):
            check_steps(file)
    file.seek(0)


def check_steps(file: IO[bytes], *, room: int | None = None) -> None:
    """Read one pickle over, from its start to its end, without building anything.

    Args:
        file: at the start of the pickle; at its end afterwards.
        room: bytes that it may become, as many as it likes when None.

    Raises:
        pickle.UnpicklingError: it takes too long, or its memo is not in order.
        ValueError: it becomes more than ``room``.
        Exception: it is damaged; pickletools raises nearly any.
    """
    puts, cost = 0, _Forecast(room)
    for number, (code, part, _) in enumerate(pickletools.genops(file)):
        cost.add(code.name, part, puts)
        if number > MAX_STEPS:
            raise pickle.UnpicklingError(f"more than {MAX_STEPS:,} steps")
        if code.name in ("PUT", "BINPUT", "LONG_BINPUT"):
            if not isinstance(part, int) or part > puts:
                raise pickle.UnpicklingError("the memo of the pickle is not in order")
            puts += 1
        elif code.name == "MEMOIZE":
            puts += 1
        elif isinstance(part, int) and abs(part) > MAX_INT and part != MAGIC:
            # keys of one hash, and text of it, take time that grows with the square
            raise pickle.UnpicklingError("a number of more than 64 bits")


def check_room(size: int, room: int) -> None:
    """Refuse what becomes larger than it may, both in bytes.

    Raises:
        ValueError: it does.
    """
    if size > room:
        raise ValueError("it becomes far more than the file holds")


class _Forecast:
    """What a pickle will take, followed without building it: memory, and hashing.

    A tuple has no hash of its own: it is taken of all its parts, each time anew. Tuples
    of the same tuples double it with every level, a hundred bytes of file never end.
    """

    def __init__(self, room: int | None) -> None:
        self.room, self.taken, self.hashed = room, 0, 0  # bytes twice; parts of keys
        self._stack: list[int] = []  # parts of each item; 0 is a mark
        self._memo: dict[int, int] = {}

    def add(self, name: str, part: Any, place: int) -> None:
        """Take in one step; ``place`` of the memo is the next that is free."""
        stack = self._stack
        self.taken += STEPS.get(name, STEP)
        if name in ("PUT", "BINPUT", "LONG_BINPUT", "MEMOIZE"):
            self._memo[place if name == "MEMOIZE" else part] = stack[-1] if stack else 1
        elif name in ("GET", "BINGET", "LONG_BINGET"):
            stack.append(self._memo.get(part, 1))
        elif name in ("MARK", "DUP"):
            stack.append(0 if name == "MARK" or not stack else stack[-1])
        else:
            self._apply(name, *STACK[name])
        if self.room is not None:
            check_room(self.taken, self.room)

    def _apply(self, name: str, alone: int, to_mark: bool, left: int) -> None:
        stack, parts, depth = self._stack, 0, len(self._stack)
        while to_mark and stack and (item := stack.pop()):
            parts += item
        if alone:
            parts += sum(stack[-alone:])
            del stack[-alone:]
        if name in HASHING:
            self.taken += HASHED * (depth - len(stack))
            self.hashed += parts
            if self.hashed > MAX_HASHED:
                raise pickle.UnpicklingError("keys that would take hours to compare")
        if left:
            stack += [1 + parts if name in TUPLES else 1] * left
