"""A hand-made rollout of a scene that MuJoCo C steps."""

import pytest
from pushed_box import SCENE, make_rollout, step_by_hand


@pytest.fixture
def rollout():
    return make_rollout()


@pytest.fixture
def build_rollout():
    return make_rollout


@pytest.fixture
def scene_xml():
    return SCENE


@pytest.fixture
def oracle():
    return step_by_hand
