"""Foreign models: what reads files, multiplies or never ends is refused unopened."""

import os

import mujoco
import pytest

from flashdex.errors import FlashdexError
from flashdex.hands.spec import load_hand
from flashdex.system import mjcf
from flashdex.system.mjcf import ModelError, check_mjcf, compile_mjcf

BOX = '<body name="b"><freejoint/><geom type="box" size=".1 .1 .1"/></body>'


def model(body=BOX, top="", option='timestep="0.002"'):
    """A text with one free box, more elements, and attributes of ``option``."""
    return f"<mujoco>{top}<option {option}/><worldbody>{body}</worldbody></mujoco>"


def deep(levels):
    return "<body>" * levels + "</body>" * levels


HOSTILE = {
    # other files
    "include": model(top='<include file="/etc/passwd"/>'),
    "include_in_body": model('<body><include file="/etc/passwd"/></body>'),
    "mesh_file": model(top='<asset><mesh name="m" file="/etc/passwd"/></asset>'),
    "mesh_file_empty": model(top='<asset><mesh name="m" file=""/></asset>'),
    "texture_file": model(
        top='<asset><texture type="2d" name="t" file="/etc/passwd"/></asset>'
    ),
    "texture_side": model(
        top='<asset><texture type="cube" name="t" fileright="/etc/passwd"/></asset>'
    ),
    "meshdir": model(top='<compiler meshdir="/etc"/>'),
    "assetdir": model(top='<compiler assetdir="/etc"/>'),
    "skin": model(top='<asset><skin name="s" file="/etc/passwd"/></asset>'),
    "model_asset": model(top='<asset><model name="m" file="/etc/passwd"/></asset>'),
    "attach": model('<attach model="m" body="b" prefix="p"/>'),
    "hfield_file": model(
        top='<asset><hfield name="h" file="/etc/passwd" size="1 1 1 1"/></asset>'
    ),
    "entity_file": '<!DOCTYPE m [<!ENTITY x SYSTEM "/etc/passwd">]>' + model(),
    # code
    "plugin": model(top='<extension><plugin plugin="mujoco.sdf"/></extension>'),
    "plugin_attribute": model('<geom type="box" size="1 1 1" plugin="x"/>'),
    # bombs
    "replicate": model(f'<replicate count="1000000">{BOX}</replicate>'),
    "composite": model('<composite type="cable" count="1000000 1 1"/>'),
    "flexcomp": model('<flexcomp type="grid" count="999 999 999" name="f"/>'),
    "hfield": model(
        top='<asset><hfield name="h" nrow="99999" ncol="99999" size="1 1 1 1"/></asset>'
    ),
    "mesh_builtin": model(
        top='<asset><mesh name="m" builtin="sphere" params="9"/></asset>'
    ),
    "texture_size": model(
        top='<asset><texture name="t" type="2d" builtin="flat" width="99999" '
        'height="99999"/></asset>'
    ),
    "billion_laughs": '<!DOCTYPE m [<!ENTITY a "aa">]>' + model(),
    "numeric": model(top='<custom><numeric name="n" size="999999999"/></custom>'),
    "memory": model(top='<size memory="1T"/>'),
    "memory_wraps": model(top='<size memory="99999999999999E"/>'),
    "memory_no_number": model(top='<size memory="lots"/>'),
    "nstack": model(top='<size nstack="1e15"/>'),
    "nuser": model(top='<size nuser_body="100000000"/>'),
    "nuserdata": model(top='<size nuserdata="100000000"/>'),
    "depth": model(deep(10_000)),
    "elements": model('<geom size="1"/>' * 20_001),
    # numbers
    "timestep_nan": model(option='timestep="nan"'),
    "timestep_nan_of_c": model(option='timestep="nan(7)"'),
    "timestep_negative": model(option='timestep="-0.002"'),
    "timestep_zero": model(option='timestep="0"'),
    "timestep_infinite": model(option='timestep="1e999"'),
    "timestep_hex": model(option='timestep="0x1p99"'),
    "timestep_word": model(option='timestep="soon"'),
    "iterations": model(option='iterations="1000000000"'),
    "ls_iterations": model(option='ls_iterations="1000000000"'),
    "noslip_iterations": model(option='noslip_iterations="1000000000"'),
    "ccd_iterations": model(option='ccd_iterations="1000000000"'),
    "gravity_nan": model(option='gravity="0 0 nan"'),
    "position_nan": model('<body pos="0 nan 0"><geom size="1"/></body>'),
    "size_infinite": model('<geom size="inf"/>'),
    # no MJCF
    "urdf": '<robot name="r"><link name="l"/></robot>',
    "text": "not a model",
    "empty": "",
    "nul": model() + "\0<include/>",
    "cdata": model("<![CDATA[<include file='x'/>]]>"),
    "instruction": "<?run it?>" + model(),
    "surrogate": model('<body name="\udcff"/>') + "<",
}


@pytest.mark.parametrize("text", HOSTILE.values(), ids=HOSTILE)
def test_hostile_model_is_refused_unopened(text, monkeypatch):
    def never(*_):
        raise AssertionError("MuJoCo was given a text that is not allowed")

    monkeypatch.setattr(mujoco.MjModel, "from_xml_string", never)
    with pytest.raises(ModelError, match=r"^clip\.npz: ") as caught:
        compile_mjcf(text, where="clip.npz")
    assert isinstance(caught.value, FlashdexError)
    assert len(str(caught.value)) < 400


def test_large_text_is_refused_before_it_is_parsed(monkeypatch):
    monkeypatch.setattr(mjcf, "MAX_BYTES", 100)
    with pytest.raises(ModelError, match="MiB of text"):
        check_mjcf(model(), where="clip")


def test_pipe_that_a_model_names_is_not_waited_for(tmp_path):
    os.mkfifo(tmp_path / "pipe.xml")
    with pytest.raises(ModelError, match="include"):
        check_mjcf(model(top=f'<include file="{tmp_path}/pipe.xml"/>'), where="clip")


@pytest.mark.parametrize(
    ("text", "told"),
    [
        pytest.param(model('<body><joint/></body><geom size="1"/>'), "mass", id="mass"),
        pytest.param(model('<geom type="mesh" mesh="m"/>'), "mesh", id="no_mesh"),
    ],
)
def test_what_mujoco_refuses_is_one_message(text, told):
    with pytest.raises(ModelError, match=rf"clip: the model cannot be used: .*{told}"):
        compile_mjcf(text, where="clip")


LONG = model('<body><joint/><geom size="1"/></body>', '<size memory="2M"/>')
HISTORY = (
    '<actuator><motor joint="j" nsample="2000000000" delay="1"/></actuator></mujoco>'
)


@pytest.mark.parametrize(
    ("text", "limits", "told"),
    [
        pytest.param(LONG, {"MAX_MEMORY": 64 << 20}, "ended|memory", id="memory"),
        pytest.param(
            LONG, {"MAX_SECONDS": 1, "TRIAL_STEPS": 10**9}, "1 s", id="endless_steps"
        ),
        pytest.param(
            model('<body><joint name="j"/><geom size="1"/></body>').replace(
                "</mujoco>", HISTORY
            ),
            {},
            "cannot be used",
            id="history_of_gigabytes",
        ),
    ],
)
def test_model_that_takes_too_much_dies_apart(text, limits, told, monkeypatch):
    for name, value in limits.items():
        monkeypatch.setattr(mjcf, name, value)
    with pytest.raises(ModelError, match=told):
        compile_mjcf(text, where="clip")


def test_good_model_is_the_same_as_without_trial():
    text = load_hand("xhand")["left"].mjcf
    ours, plain = compile_mjcf(text, where="x"), mujoco.MjModel.from_xml_string(text)
    assert (ours.body_mass == plain.body_mass).all()
    assert ours.names == plain.names


def test_scenes_of_ours_pass(make_physics):
    for scene in make_physics(3).scenes:
        check_mjcf(scene.xml, where="scene")


def test_given_files_may_be_named_and_no_others():
    corners = "\n".join(
        f"v {x} {y} {z}" for x in (0, 1) for y in (0, 1) for z in (0, 1)
    )
    faces = "\nf 1 2 3\nf 1 5 2\nf 1 3 5\nf 8 7 6\n"
    text = model(
        '<geom type="mesh" mesh="m"/>',
        '<asset><mesh name="m" file="a.obj" inertia="convex"/></asset>',
    )
    given = {"a.obj": (corners + faces).encode()}
    assert compile_mjcf(text, where="x", assets=given).nmesh == 1
    with pytest.raises(ModelError, match=r"b\.obj.*outside of the model"):
        compile_mjcf(text.replace("a.obj", "b.obj"), where="x", assets=given)
