"""Helpers of the hand tests, given as fixtures."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from flashdex.hands.attach import add_hand
from flashdex.keys import FINGERS, SIDES


@pytest.fixture
def make_model():
    """Compile a scene with the hands of the given sides, both if none is given."""
    return _make_model


@pytest.fixture
def sample_qpos():
    """Draw joint positions of one hand within its ranges, slides within a metre."""
    return _sample_qpos


@pytest.fixture
def sites():
    """World positions of one kind of fingertip site, (5, 3)."""
    return _sites


def _make_model(*sides, degree=True, contact=True, timestep=1 / 240, **kwargs):
    scene = mujoco.MjSpec()
    scene.compiler.degree = degree
    scene.option.timestep = timestep
    scene.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    if not contact:
        scene.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT
    for side in sides or SIDES:
        add_hand(scene, "xhand", side, **kwargs)
    return scene.compile()


def _sample_qpos(hand, rng):
    lower, upper = hand.joint_range.T.copy()
    lower[:3], upper[:3] = -1.0, 1.0
    return rng.uniform(lower, upper)


def _sites(model, data, side, kind):
    return np.array([data.site(f"{side}_{kind}_{f}").xpos for f in FINGERS])
