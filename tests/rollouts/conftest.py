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


@pytest.fixture(scope="session")
def proofs():
    """Certificates by the content of the rollout; they are deterministic, see there."""
    return {}


@pytest.fixture
def check(truth, proofs, monkeypatch):
    """Faults of a run by what they name; the run must not hold."""
    from flashdex.rollouts import verify
    from flashdex.rollouts.certificate import certify

    def remembered(rollout, *, model):
        key = rollout.content_sha256
        if key not in proofs:
            proofs[key] = certify(rollout, model=model)
        return proofs[key]

    monkeypatch.setattr(verify, "certify", remembered)

    def run(run_dir, *, library=True):
        verified = verify.verify_run(run_dir, truth if library else None)
        assert not verified.holds
        return [str(f) for f in verified.findings if f.is_fault]

    return run
