"""A library small enough for engines that compile for minutes: one hand, one box.

The scene has half the joints of a full one and a single mesh of eight vertices, so that
every engine can run it in a test.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from flashdex import keys
from flashdex.hands.spec import HandSpec
from flashdex.motions.library import MotionLibrary
from flashdex.motions.library_writer import LibraryWriter, MotionRecord
from tests.synthetic import FPS, make_box, make_frames

FRAMES = 60
DISC = (0.0, 0.0, 0.0, 0.8, 0.02)  # m: x, y, top, radius, height


def reduced_library(
    folder: Path, hands: dict[keys.Side, HandSpec], disc: tuple[float, ...] = DISC
) -> MotionLibrary:
    """Write one motion of the right hand with a small box on a disc, and open it.

    Args:
        folder: where the library is written.
        hands: hand specs by side.
        disc: the support: x, y, top, radius, height, m.
    """
    writer = LibraryWriter(folder, hand="xhand", fps=FPS)
    active, owner, box = (False, True), (-1, 0), make_box()
    frames = make_frames(hands, FRAMES, active, owner, [box])
    discs = np.full((4, 5), np.nan)
    discs[0] = disc
    writer.add(MotionRecord("right_box", frames, active, owner, [box], discs))
    return MotionLibrary.load(writer.write())
