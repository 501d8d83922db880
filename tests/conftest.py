"""The synthetic library, and engines and environments on it, for env and training."""

from __future__ import annotations

import signal

import pytest

pytest_plugins = ["fixture_recordings", "fixture_runs"]


def pytest_configure():
    """Hear Ctrl-C, also where a shell started the tests in the background."""
    signal.signal(signal.SIGINT, signal.default_int_handler)


# Heavy imports stand inside the fixtures: tests that need none of them stay fast.


@pytest.fixture(scope="session")
def hands():
    """Both sides of the XHand."""
    from flashdex.hands.spec import load_hand

    return load_hand("xhand")


@pytest.fixture(scope="session")
def library(tmp_path_factory, hands):
    """Right hand and box; left hand and ball; both hands with both."""
    from synthetic import write_library

    return write_library(tmp_path_factory.mktemp("motions") / "library", hands)


@pytest.fixture(scope="session")
def bank(library, hands):
    """The library as tensors."""
    from flashdex.envs.reference import ReferenceBank

    return ReferenceBank(library, hands)


@pytest.fixture(scope="session")
def make_physics(library, hands):
    """Build the cpu engine: worlds, then fields of PhysicsConfig."""
    from flashdex.envs.physics.config import PhysicsConfig
    from flashdex.envs.physics.cpu import CpuPhysics

    def make(num_envs, **fields):
        config = PhysicsConfig(**{"num_threads": 1, **fields})
        return CpuPhysics(library, hands, config, num_envs)

    return make


@pytest.fixture(scope="session")
def make_env(make_physics, bank, hands):
    """Build a tracking env: worlds, seed, evaluation, then fields of EnvConfig."""
    from flashdex.envs.config import EnvConfig
    from flashdex.envs.tracking import TrackingEnv

    def make(num_envs=4, *, seed=0, evaluation=False, physics=None, **fields):
        engine = make_physics(num_envs, **(physics or {}))
        return TrackingEnv(
            engine,
            bank,
            hands,
            EnvConfig(num_envs=num_envs, **fields),
            step_dt=engine.step_dt,
            seed=seed,
            evaluation=evaluation,
        )

    return make


@pytest.fixture
def forget_terms(monkeypatch):
    """Terms that a test registers, and packages that it allows, are gone after it."""
    from flashdex.envs.mdp import term

    term.registry("rewards")  # those that ship are there before
    monkeypatch.setattr(term, "_TERMS", {k: dict(v) for k, v in term._TERMS.items()})
    monkeypatch.setattr(term, "_ALLOWED", set(term._ALLOWED))
