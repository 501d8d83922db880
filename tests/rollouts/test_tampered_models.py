"""Models that are not the scene of their motion, and those nobody may compile."""

from __future__ import annotations

import numpy as np
import pytest
import tamper
from tamper import BOX, alone


def xml(old, new):
    return lambda data: tamper.replace_xml(data, old, new)


def third_hand(data):
    body = (
        '<body name="third" pos="0 0 -.05"><joint type="slide"/>'
        '<geom size=".1 .1 .01" type="box" mass="1"/></body></worldbody>'
    )
    tamper.replace_xml(data, "</worldbody>", body)
    for name in ("qpos0", "qvel0", "qpos", "qvel"):
        pad = np.zeros((*data[name].shape[:-1], 1))
        data[name] = np.concatenate([data[name], pad], -1)


def drive(data):
    motor = '<general name="lift" joint="object0" gear="0 0 1 0 0 0"/></actuator>'
    tamper.replace_xml(data, "</actuator>", motor)
    data["ctrl"] = np.concatenate([data["ctrl"], 0.5 + 0 * data["ctrl"][:, :1]], 1)


WORLD = '<body name="object0">'
SPRING = (
    "<tendon><spatial stiffness='5'><site site='above'/><site site='mid'/></spatial>"
    "</tendon><actuator>"
)
SITES = f'<site name="above" pos="0 0 .5"/>{WORLD}<site name="mid" size=".001"/>'


def spring(data):
    tamper.replace_xml(data, WORLD, SITES)
    tamper.replace_xml(data, "<actuator>", SPRING)


# how the model is changed, and what a finding has to name
MODELS = {
    "gravity off": (xml("<option ", '<option gravity="0 0 0" '), "gravity"),
    "gravity up": (xml("<option ", '<option gravity="0 0 9.81" '), "gravity"),
    "gravity sideways": (xml("<option ", '<option gravity="9.81 0 0" '), "gravity"),
    "gravity disabled": (xml("<flag ", '<flag gravity="disable" '), "disableflags"),
    "no contacts": (xml("<flag ", '<flag contact="disable" '), "disableflags"),
    "thick air": (xml("<option ", '<option viscosity="5" '), "viscosity"),
    "wind": (xml("<option ", '<option wind="0 0 5" density="9" '), "wind"),
    "time step": (xml('timestep="0.00416667"', 'timestep="0.004"'), "timestep"),
    "solver": (xml('iterations="20"', 'iterations="30"'), "iterations"),
    "friction direction": (xml('impratio="10"', 'impratio="100"'), "impratio"),
    "hidden platform": (
        xml(
            WORLD,
            '<geom type="box" size=".1 .1 .005" pos="0 0 .03" rgba="0 0 0 0"/>' + WORLD,
        ),
        "geom elements",
    ),
    "third hand": (third_hand, "body elements"),
    "actuator on the object": (drive, "actuator elements"),
    "weld to the world": (
        xml("<actuator>", '<equality><weld body1="object0"/></equality><actuator>'),
        "eq elements",
    ),
    "weld to the hand": (
        xml(
            "<actuator>",
            '<equality><weld body1="object0" body2="right_hand_link"/></equality>'
            "<actuator>",
        ),
        "eq elements",
    ),
    "spring on the object": (spring, "tendon elements"),
    "weightless object": (xml(WORLD, '<body name="object0" gravcomp="1">'), "gravcomp"),
    "friction of the object": (xml('friction="2 ', 'friction="1000 '), "friction"),
    "friction of the table": (
        xml('friction="1 0.05', 'friction="900 0.05'),
        "friction",
    ),
    "no contact with the table": (xml('conaffinity="3"', 'conaffinity="0"'), "conaff"),
    "no contact with the object": (
        xml('contype="2" conaffinity="3"', 'contype="0" conaffinity="0"'),
        "contype",
    ),
    "soft contact": (xml("condim=", 'solref="1 1" condim='), "solref"),
    "glue": (xml("condim=", 'margin=".05" gap=".04" condim='), "geom_"),
    "tiny mass": (xml('mass="0.12"', 'mass="1e-5"'), "mass"),
    "heavy object": (xml('mass="0.12"', 'mass="500"'), "mass"),
    "huge inertia": (xml("6.1e-05 5.33007e-05", "0.9 0.9"), "inertia"),
    "strong hand": (xml("gainprm=", 'gear="3" gainprm='), "gear"),
    "stiff servo": (xml('gainprm="1000"', 'gainprm="90000"'), "gainprm"),
    "no force limit": (xml('forcerange="-100 100"', 'forcerange="-9e9 9e9"'), "force"),
    "joint range": (xml('range="-5 5"', 'range="-9 9"'), "range"),
    "damped joint": (xml('damping="1"', 'damping="40"'), "damping"),
    "heavy link": (xml('mass="0.1"', 'mass="7"'), "mass"),
    "excluded contact": (
        xml(
            "<contact>",
            '<contact><exclude body1="right_hand_link" body2="object0"/>',
        ),
        "exclude",
    ),
    "contact pair": (
        xml(
            "<contact>",
            '<contact><pair geom1="object0_part0" geom2="support0" margin=".01"/>',
        ),
        "pair",
    ),
    "mocap body": (
        xml(WORLD, '<body mocap="true" name="m"><geom size=".1"/></body>' + WORLD),
        "body elements",
    ),
    "higher table": (xml('pos="0 0 -0.01"', 'pos="0 0 0.005"'), "geom_pos"),
    "smaller table": (xml('size="0.8 0.01"', 'size="0.1 0.01"'), "geom_"),
    "turned object": (
        xml('quat="1 0 0 0" type="mesh"', 'euler=".4 0 0" type="mesh"'),
        "geom_quat",
    ),
    "shape of the object": (
        xml('<mesh name="object0_part0"', '<mesh name="object0_part0" scale="2 2 2"'),
        "mesh",
    ),
}
# what no check without the library can see: the object's own shape, mass and support
OF_LIBRARY = {
    *("heavy object", "higher table", "smaller table", "turned object"),
    *("shape of the object",),
}


@pytest.mark.parametrize("kind", MODELS)
def test_a_model_that_is_not_the_scene_is_found_by_name(spoilt_run, check, kind):
    edit, named = MODELS[kind]
    path = spoilt_run / BOX
    data = tamper.load(path)
    edit(data)
    tamper.simulate(data)
    tamper.forge(spoilt_run, path, data)
    found = check(spoilt_run)
    assert any(text.startswith(f"{BOX}: model") and named in text for text in found)
    assert any("model" in text for text in alone(path)) or kind in OF_LIBRARY


HOSTILE = {
    "reads a file": '<include file="/etc/passwd"/>',
    "mesh of a file": '<asset><mesh name="x" file="/etc/passwd"/></asset>',
    "bomb": '<replicate count="100000000"><site/></replicate>',
    "plugin": '<extension><plugin plugin="mujoco.pid"/></extension>',
}


@pytest.mark.parametrize("kind", HOSTILE)
def test_a_hostile_model_is_not_compiled(spoilt_run, check, kind):
    path = spoilt_run / BOX
    data = tamper.load(path)
    tamper.replace_xml(data, "<worldbody>", HOSTILE[kind] + "<worldbody>")
    rollout = tamper.rollout_of(data)
    data["model_sha256"] = np.asarray(rollout.model_sha256)
    tamper.store(path, data)
    for found in (check(spoilt_run), alone(path)):
        assert any("model_xml: <" in text for text in found), found
