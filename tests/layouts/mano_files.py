"""Writes MANO model files of a made-up hand; nothing of the licensed files is in them.

The figure is a stick hand: rest wrist at x = +0.1 m (right), fingers along -x, palm
normal -y, thumb towards +z. Vertices stand in rings around its joints (so that the
regressor gives the joints) and along its bones. The left hand is the mirror image,
with the sign error that the released left hand has in ``shapedirs``.
"""

from __future__ import annotations

import pickle
import sys
import types
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import scipy.sparse as sp

PARENTS = [-1, 0, 1, 2, 0, 4, 5, 0, 7, 8, 0, 10, 11, 0, 13, 14]
NUM_VERTICES = 778
RING = 12  # vertices around each joint
TIPS = {"left": [745, 317, 445, 556, 673], "right": [745, 317, 444, 556, 673]}
LAST_JOINTS = [15, 3, 6, 12, 9]  # thumb to pinky
WRIST = np.array([0.1, 0.01, 0.01])
# right hand, from the wrist, m: ahead is -x, out of the palm -y, thumb side +z
KNUCKLES = {1: [-0.092, 0.004, 0.024], 4: [-0.09, 0.005, 0.001]}
KNUCKLES |= {10: [-0.084, 0.004, -0.021], 7: [-0.076, 0.0, -0.041]}
BONES = {1: [0.038, 0.023, 0.02], 4: [0.042, 0.026, 0.022]}
BONES |= {10: [0.039, 0.025, 0.021], 7: [0.03, 0.02, 0.018]}
SPREAD = {1: 0.1, 4: 0.02, 10: -0.06, 7: -0.16}  # rad, about y
THUMB = np.array([[-0.026, -0.008, 0.03], [-0.03, -0.012, 0.026]])
THUMB = np.vstack([THUMB, [[-0.026, -0.006, 0.014], [-0.022, -0.004, 0.01]]])
THUMB_AXIS = np.array([0.2, 0.9, 0.4]) / np.linalg.norm([0.2, 0.9, 0.4])
MIRROR = np.array([-1.0, 1.0, 1.0])
TURN_MIRROR = np.array([1.0, -1.0, -1.0])  # of rotation vectors


@dataclass(frozen=True)
class ManoHand:
    """The arrays of one side, as the file holds them (``shapedirs`` with the error)."""

    v_template: np.ndarray
    shapedirs: np.ndarray
    posedirs: np.ndarray
    regressor: np.ndarray
    weights: np.ndarray
    hands_mean: np.ndarray
    hands_components: np.ndarray


@lru_cache
def mano_hand(side, *, fix_left_shape=False):
    """The arrays of one side; the left shape can be had without its error."""
    template, joints, free = _figure(side)
    rng = np.random.default_rng(7)
    shapedirs = _shape_dirs(template * (MIRROR if side == "left" else 1.0), rng)
    if side == "left" and fix_left_shape:
        shapedirs = shapedirs * MIRROR[:, None]
    regressor = np.zeros((16, NUM_VERTICES))
    for joint in range(16):
        rows = free[joint * RING : (joint + 1) * RING]
        regressor[joint, rows] = 1.0 / RING
    mean, components = _finger_poses(rng)
    if side == "left":
        mean = (mean.reshape(15, 3) * TURN_MIRROR).ravel()
        components = (components.reshape(45, 15, 3) * TURN_MIRROR).reshape(45, 45)
    return ManoHand(
        v_template=template,
        shapedirs=shapedirs,
        posedirs=1e-4 * rng.standard_normal((NUM_VERTICES, 3, 135)),
        regressor=regressor,
        weights=_weights(template, joints),
        hands_mean=mean,
        hands_components=components,
    )


def write_mano(folder, *, npz=False, sides=("left", "right"), **changes):
    """Write MANO_LEFT and MANO_RIGHT as the released pickles are written.

    Args:
        folder: is made.
        npz: write ``.npz`` files with the same keys.
        sides: hands to write.
        changes: keys to replace in both files; None leaves a key out.
    """
    folder.mkdir(parents=True, exist_ok=True)
    for side in sides:
        hand = mano_hand(side)
        data = {
            "v_template": hand.v_template,
            "posedirs": hand.posedirs,
            "J": hand.regressor @ hand.v_template,
            "kintree_table": np.array([[2**32 - 1, *PARENTS[1:]], range(16)]),
            "weights": hand.weights,
            "f": np.tile([0, 1, 2], (1538, 1)).astype(np.uint32),
            "hands_mean": hand.hands_mean,
            "hands_components": hand.hands_components,
            "bs_style": "lbs",
            "bs_type": "lrotmin",
        }
        path = folder / f"MANO_{side.upper()}"
        if npz:
            data |= {"shapedirs": hand.shapedirs, "J_regressor": hand.regressor}
            data = {k: v for k, v in (data | changes).items() if v is not None}
            np.savez(path.with_suffix(".npz"), **data)
        else:
            path.with_suffix(".pkl").write_bytes(_pickle(data, hand, changes))


def _pickle(data, hand, changes):
    """A protocol 2 pickle with the module names of ten years ago."""
    chumpy, ch, reordering, csc = (
        types.ModuleType(name)
        for name in ("chumpy", "chumpy.ch", "chumpy.reordering", "scipy.sparse.csc")
    )
    ch.Ch = type("Ch", (), {"__module__": "chumpy.ch"})
    reordering.Select = type("Select", (), {"__module__": "chumpy.reordering"})
    csc.csc_matrix = type("csc_matrix", (), {"__module__": "scipy.sparse.csc"})
    modules = {m.__name__: m for m in (chumpy, ch, reordering, csc)}
    before = {name: sys.modules.get(name) for name in modules}
    sys.modules.update(modules)
    try:
        data["shapedirs"] = _select(ch.Ch(), reordering.Select(), hand.shapedirs)
        data["J_regressor"] = csc.csc_matrix()
        matrix = sp.csc_matrix(hand.regressor)
        data["J_regressor"].__dict__.update(
            format="csc",
            _shape=matrix.shape,
            maxprint=50,
            indices=matrix.indices,
            indptr=matrix.indptr,
            data=matrix.data,
        )
        data = {k: v for k, v in (data | changes).items() if v is not None}
        return pickle.dumps(data, protocol=2)
    finally:
        for name, module in before.items():
            if module is None:
                del sys.modules[name]
            else:
                sys.modules[name] = module


def _select(inner, select, shapedirs):
    """The first 10 of 20 shape directions, as chumpy keeps a slice."""
    rng = np.random.default_rng(11)
    rest = 1e-3 * rng.standard_normal((NUM_VERTICES, 3, 10))
    inner.__dict__["x"] = np.concatenate([shapedirs, rest], axis=-1)
    places = np.arange(NUM_VERTICES * 3 * 20).reshape(NUM_VERTICES, 3, 20)[..., :10]
    select.__dict__.update(
        a=inner, idxs=places.ravel(), preferred_shape=(NUM_VERTICES, 3, 10)
    )
    return select


def _figure(side):
    """Vertices, joints, and the vertex rows that are free of tips, in order."""
    joints, tips = _stick_hand()
    free = [i for i in range(NUM_VERTICES) if i not in TIPS[side]]
    template = np.zeros((NUM_VERTICES, 3))
    angle = 2 * np.pi * np.arange(RING) / RING
    circle = 0.006 * np.stack([0 * angle, np.cos(angle), np.sin(angle)], axis=-1)
    for joint in range(16):
        template[free[joint * RING : (joint + 1) * RING]] = joints[joint] + circle
    ends = np.array([*joints[1:], *tips])
    starts = np.array([*joints[PARENTS[1:]], *joints[LAST_JOINTS]])
    for place, row in enumerate(free[16 * RING :]):
        bone, part = place % 20, (place // 20 + 0.5) / 30
        radial = np.roll(circle[place % RING], place % 2)
        template[row] = starts[bone] + part * (ends[bone] - starts[bone]) + radial
    template[TIPS[side]] = tips
    if side == "left":
        return template * MIRROR, joints * MIRROR, free
    return template, joints, free


def _stick_hand():
    """Joints (16, 3) and tips (5, 3) of the right hand."""
    joints, tips = np.zeros((16, 3)), np.zeros((5, 3))
    joints[0] = WRIST
    for finger, first in enumerate((1, 4, 10, 7), start=1):
        along = [-np.cos(SPREAD[first]), 0.0, np.sin(SPREAD[first])]
        steps = np.outer(BONES[first], along)
        chain = np.cumsum([WRIST + KNUCKLES[first], *steps], axis=0)
        joints[first : first + 3], tips[finger] = chain[:3], chain[3]
    chain = WRIST + np.cumsum(THUMB, axis=0)
    joints[13:16], tips[0] = chain[:3], chain[3]
    return joints, tips


def _shape_dirs(right_template, rng):
    """Size, width and thickness first; the rest is small and random. Right hand."""
    dirs = 1e-3 * rng.standard_normal((NUM_VERTICES, 3, 10))
    dirs[:, 0, 0] += 0.04 * right_template[:, 0]
    dirs[:, 2, 1] += 0.04 * right_template[:, 2]
    dirs[:, 1, 2] += 0.04 * right_template[:, 1]
    return dirs


def _weights(template, joints):
    """Softmax of the distance to the bone that each joint moves."""
    ends = np.stack(
        [joints[PARENTS.index(j)] if j in PARENTS else joints[j] for j in range(16)]
    )
    middle = 0.5 * (joints + ends)
    gaps = np.linalg.norm(template[:, None] - middle, axis=-1)
    weights = np.exp(-gaps / 0.006)
    return weights / weights.sum(axis=1, keepdims=True)


def _finger_poses(rng):
    """Mean and components (right hand); the first 15 span the flexion of each joint."""
    flexion = np.zeros((15, 15, 3))
    for joint in range(15):
        flexion[joint, joint] = [0, 0, 1] if joint < 12 else THUMB_AXIS
    flexion = flexion.reshape(15, 45)
    mix = np.linalg.qr(rng.standard_normal((15, 15)))[0]
    others = rng.standard_normal((30, 45))
    others -= others @ flexion.T @ flexion
    others = np.linalg.qr(others.T)[0].T
    mean = 0.2 * flexion[:12].sum(axis=0) + 0.03 * rng.standard_normal(45)
    return mean, np.vstack([mix @ flexion, others])


def flexions(side):
    """Axis-angle per radian of flexion of each finger joint, (15, 45)."""
    rows = np.zeros((15, 15, 3))
    for joint in range(15):
        rows[joint, joint] = [0, 0, 1] if joint < 12 else THUMB_AXIS
    return (rows * (TURN_MIRROR if side == "left" else 1.0)).reshape(15, 45)
