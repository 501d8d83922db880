"""Record launches of warp kernels once and replay them: no Python between kernels."""

from __future__ import annotations

import logging
from collections.abc import Callable
from typing import Any

import torch

from flashdex.envs.physics.warp_model import require_warp

_log = logging.getLogger(__name__)


class Recorded:
    """A function of warp launches on fixed arrays, replayed from its second call on.

    The first call runs as it is, which compiles the kernels; the second records it, as
    a CUDA graph or as warp's list of launches on the CPU. Where that fails the function
    goes on as it is, with one warning.

    Args:
        launch: launches kernels; nothing else.
        device: of the arrays.
    """

    def __init__(self, launch: Callable[[], None], device: torch.device) -> None:
        self._launch = launch
        self._device = device
        self._name = str(require_warp()[0].device_from_torch(device))
        self._calls = 0
        self._graph: Any = None

    def __call__(self) -> None:
        """Run it after all work that torch has queued so far, before all later work."""
        wp = require_warp()[0]
        if self._calls == 1:
            self._graph = self._record()
        self._calls += 1
        stream = None  # the CPU has none
        if self._device.type == "cuda":
            stream = wp.stream_from_torch(torch.cuda.current_stream(self._device))
        if self._graph is not None:
            wp.capture_launch(self._graph, stream=stream)
            return
        with wp.ScopedDevice(self._name), wp.ScopedStream(stream):
            self._launch()

    def _record(self) -> Any:
        wp = require_warp()[0]
        # Torch's default stream cannot be recorded: this one only serves to record.
        own = wp.Stream(self._name) if self._device.type == "cuda" else None
        try:
            with (
                wp.ScopedDevice(self._name),
                wp.ScopedStream(own),
                wp.ScopedCapture(device=self._name, stream=own) as capture,
            ):
                self._launch()
        except Exception as error:
            _log.warning(
                "physics.engine=warp: the step could not be recorded and runs launch "
                "by launch, which is slower: %s",
                error,
            )
            return None
        return capture.graph
