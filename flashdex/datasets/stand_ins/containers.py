"""Stand-ins for what Python itself puts into pickles."""

from __future__ import annotations

from typing import Any

from flashdex.datasets.stand_ins.base import StandIn, Value


class ObjectType(StandIn):
    """``object``, the base that old pickles name."""


class Reconstructor(StandIn):
    """``copyreg._reconstructor``: makes an empty object of an old pickle."""

    def __new__(cls, *args: Any) -> StandIn:
        """An empty object of the class that is asked for, if that is a stand-in."""
        kind, base, state = args
        if not issubclass(kind, StandIn) or base is not ObjectType or state is not None:
            raise ValueError("an old-style object that is not plain")
        return StandIn.__new__(kind)


class MutableSet(StandIn):
    """``set``, called on a list."""

    def value(self, plain: Value) -> set:
        """The elements."""
        return set(plain(self.args[0])) if self.args else set()


class FrozenSet(StandIn):
    """``frozenset``, called on a list."""

    def value(self, plain: Value) -> frozenset:
        """The elements."""
        return frozenset(plain(self.args[0])) if self.args else frozenset()


class Ordered(StandIn):
    """``collections.OrderedDict``: made of pairs, or filled afterwards."""

    def __setitem__(self, key: Any, item: Any) -> None:
        if self.state is None:
            self.state = []
        self.state.append([key, item])

    def value(self, plain: Value) -> dict:
        """A dict in the same order."""
        pairs = list(plain(self.args[0])) if self.args else []
        for key, item in self.state or []:
            pairs.append((plain(key), plain(item)))
        return dict(pairs)


class Encoded(StandIn):
    """``_codecs.encode``: how protocol 2 keeps bytes, as a latin-1 text."""

    def value(self, plain: Value) -> bytes:
        """The bytes."""
        text, codec = self.args
        if codec not in ("latin1", "latin-1"):
            raise ValueError(f"bytes in the encoding {codec!r}")
        return plain(text).encode("latin1")


class NoBytes(StandIn):
    """``bytes`` as protocol 2 calls it: without arguments."""

    def value(self, plain: Value) -> bytes:
        """No bytes."""
        if self.args:
            raise ValueError("bytes made of something")
        return b""
