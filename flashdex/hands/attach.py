"""Put a hand into a MuJoCo scene: six wrist joints, servos, gravity compensation."""

from __future__ import annotations

import mujoco
import numpy as np

from flashdex.hands.gains import NUM_WRIST_JOINTS, Gains, GainsPreset
from flashdex.hands.spec import HandError, HandSpec, load_hand
from flashdex.keys import Side

# Five virtual links carry the wrist joints; the sixth joint sits on the base itself.
VIRTUAL_MASS = 0.1  # kg
VIRTUAL_INERTIA = 0.01  # kg m2


def add_hand(
    scene: mujoco.MjSpec,
    hand: HandSpec | str,
    side: Side | None = None,
    *,
    gains: GainsPreset = "paper",
    gravcomp: float = 1.0,
) -> HandSpec:
    """Attach a hand at the world's origin, with its six wrist joints and servos.

    All names in the scene carry the prefix ``left_`` or ``right_``: joints and
    actuators ``hand.joint_names`` (an actuator has the name of its joint), bodies
    ``hand.link_names``, sites ``left_palm`` (base frame), ``left_tip_<finger>``
    (vendor frame), ``left_pad_<finger>`` (tracking point), ``left_center_<finger>``
    (end sphere). Joints and actuators stand in the order of ``hand.joint_names``.
    Controls are position targets, m and rad.

    Args:
        scene: receives the hand; compile it afterwards.
        hand: a spec, or the name of a built-in hand.
        side: needed with a name; with a spec it must agree.
        gains: servo preset.
        gravcomp: share of gravity that is compensated on the hand's bodies, 0 to 1.

    Returns:
        The spec of the hand that was added.

    Raises:
        HandError: no side given, contradicting sides, or an unknown preset.

    Example:
        >>> scene = mujoco.MjSpec()
        >>> hand = add_hand(scene, "xhand", "right")
        >>> model = scene.compile()
        >>> model.nv, model.nu
        (18, 18)
    """
    spec = _resolve(hand, side)
    if gains not in spec.gains:
        raise HandError(
            f"gains: '{gains}' is not a preset of {spec.name}. "
            f"Known: {', '.join(sorted(spec.gains))}."
        )
    wrist = _attach_base(scene, spec)
    for body in [wrist, *wrist.find_all(mujoco.mjtObj.mjOBJ_BODY)]:
        body.gravcomp = gravcomp
    _set_gains(scene, spec, spec.gains[gains])
    return spec


def _resolve(hand: HandSpec | str, side: Side | None) -> HandSpec:
    if isinstance(hand, HandSpec):
        if side not in (None, hand.side):
            raise HandError(
                f"side: '{side}' contradicts the spec, which is a {hand.side} hand. "
                "Leave it out, or pass the other spec."
            )
        return hand
    sides = load_hand(hand)
    if side not in sides:
        raise HandError(f"side: {side!r} is no side of '{hand}'. Give left or right.")
    return sides[side]


def _attach_base(scene: mujoco.MjSpec, spec: HandSpec) -> mujoco.MjsBody:
    # returns the first virtual link, root of everything that belongs to the hand
    parent, links = scene.worldbody, []
    for i in range(NUM_WRIST_JOINTS - 1):
        parent = parent.add_body(
            name=f"{spec.prefix}wrist_link{i}",
            ipos=[0.0, 0.0, 0.0],
            mass=VIRTUAL_MASS,
            inertia=[VIRTUAL_INERTIA] * 3,
            explicitinertial=True,
        )
        links.append(parent)
    base = mujoco.MjSpec.from_string(spec.mjcf).worldbody.first_body()
    links.append(parent.add_frame().attach_body(base, spec.prefix, ""))
    slide, hinge = mujoco.mjtJoint.mjJNT_SLIDE, mujoco.mjtJoint.mjJNT_HINGE
    for i, link in enumerate(links):
        # the compiler reads hinge ranges in the unit of the scene, degrees unless told
        degrees = i >= 3 and scene.compiler.degree
        limits = spec.joint_range[i]
        link.add_joint(
            name=spec.joint_names[i],
            type=hinge if i >= 3 else slide,
            axis=spec.joint_axis[i],
            range=np.rad2deg(limits) if degrees else limits,
            limited=mujoco.mjtLimited.mjLIMITED_TRUE,
        )
    return links[0]


def _set_gains(scene: mujoco.MjSpec, spec: HandSpec, gains: Gains) -> None:
    for i, name in enumerate(spec.joint_names):
        joint = scene.joint(name)
        joint.armature = gains.armature[i]
        # linear, then quadratic and cubic terms of the speed
        joint.damping = np.array([gains.damping[i], 0.0, 0.0])
        joint.frictionloss = gains.frictionloss[i]
        limit = gains.force_limit[i]
        actuator = scene.add_actuator(
            name=name,
            target=name,
            trntype=mujoco.mjtTrn.mjTRN_JOINT,
            ctrlrange=spec.joint_range[i],
            ctrllimited=mujoco.mjtLimited.mjLIMITED_TRUE,
            forcerange=np.array([-limit, limit]),
            forcelimited=mujoco.mjtLimited.mjLIMITED_TRUE,
        )
        actuator.set_to_position(kp=gains.kp[i], kv=gains.kv[i])
