"""Progress of a run: a bar on a terminal, a line now and then without one."""

from __future__ import annotations

import logging
import time

from tqdm import tqdm

_LOG = logging.getLogger(__name__)
PLAIN_LOG_S = 30.0  # s between progress lines where there is no terminal


class Progress:
    """Shows env steps and conversions.

    Args:
        name: of the recipe.
        total: env steps of the run.
        done: of them, those of earlier sessions.
    """

    def __init__(self, name: str, *, total: int, done: int) -> None:
        self.total = total
        # Without a terminal tqdm would fill the log with carriage returns.
        self._bar = tqdm(
            total=total,
            initial=done,
            unit="step",
            unit_scale=True,
            desc=name,
            disable=None,
            dynamic_ncols=True,
        )
        self._last_line = time.monotonic()

    def update(self, steps: int) -> None:
        """Advance the bar."""
        self._bar.update(steps)

    def show(self, note: str, *, env_steps: int, wall_s: float) -> None:
        """Show a note beside the bar, or log a line if the last one is old enough.

        Args:
            note: what was achieved.
            env_steps: of the run.
            wall_s: seconds of the run.
        """
        self._bar.set_postfix_str(note)
        now = time.monotonic()
        if self._bar.disable and now - self._last_line >= PLAIN_LOG_S:
            self._last_line = now
            _LOG.info(
                "%d of %d env steps, %s, %.0f s", env_steps, self.total, note, wall_s
            )

    def close(self) -> None:
        """Leave the bar as it is."""
        self._bar.close()
