"""Signals that end a run: once is a clean end, Ctrl-C twice is at once."""

from __future__ import annotations

import logging
import signal
from types import FrameType, TracebackType
from typing import Any

_LOG = logging.getLogger(__name__)


class StopSignals:
    """Notes Ctrl-C, SIGTERM and a closed terminal, for the loop to act on.

    A second Ctrl-C raises KeyboardInterrupt where it falls. A second SIGTERM does
    nothing: schedulers repeat it, and it must not cost the checkpoint being written.

    Attributes:
        requested: whether to stop.

    Example:
        >>> with StopSignals() as stop:
        ...     stop.requested
        False
    """

    def __init__(self) -> None:
        self.requested = False
        self._before: dict[int, Any] = {}

    def __enter__(self) -> StopSignals:
        names = [signal.SIGINT, signal.SIGTERM]
        hangup = getattr(signal, "SIGHUP", None)
        # nohup ignores it, and is taken at its word
        if hangup is not None and signal.getsignal(hangup) != signal.SIG_IGN:
            names.append(hangup)
        self._before = {n: signal.signal(n, self._note) for n in names}
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        for name, handler in self._before.items():
            signal.signal(name, handler)

    def _note(self, number: int, frame: FrameType | None) -> None:
        if self.requested and number == signal.SIGINT:
            raise KeyboardInterrupt
        if not self.requested:
            _LOG.info("stopping after this step; Ctrl-C again stops at once")
        self.requested = True
