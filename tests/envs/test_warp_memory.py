"""The warp engine's bytes, against the engine itself."""

from __future__ import annotations

import dataclasses

import pytest

pytest.importorskip("mujoco_warp")


def array_bytes(owner):
    import warp as wp

    total = 0
    for field in dataclasses.fields(owner):
        value = getattr(owner, field.name, None)
        if isinstance(value, wp.array):
            total += value.capacity
        elif dataclasses.is_dataclass(value):
            total += array_bytes(value)
    return total


@pytest.fixture(scope="module")
def measured(library, hands):
    from flashdex.envs.physics.config import PhysicsConfig
    from flashdex.envs.physics.warp.memory import measure_warp

    return lambda **values: measure_warp(
        library, hands, PhysicsConfig(engine="warp", **values)
    )


def test_arrays_are_those_of_the_engine(measured, library, hands):
    from flashdex.envs.physics.config import PhysicsConfig
    from flashdex.envs.physics.warp.engine import WarpPhysics

    found = measured()
    few, more = (
        WarpPhysics(library, hands, PhysicsConfig(engine="warp"), n) for n in (4, 11)
    )
    spread = array_bytes(more.data) - array_bytes(few.data)
    assert found.data == pytest.approx(spread / 7, abs=8)
    spread = array_bytes(more.model) - array_bytes(few.model)
    assert spread == pytest.approx(7 * found.model)


def test_contacts_and_rows_cost_what_they_say(measured):
    small, large = measured(nconmax=50, njmax=100), measured(nconmax=100, njmax=200)
    assert (small.room.contacts, small.room.rows) == (50, 100)
    assert large.model == small.model
    assert large.data > small.data
    # scratch of the convex collider goes with the contacts, and is most of it
    assert 1.5 * small.step < large.step < 2.1 * small.step


def test_nothing_stays_patched(measured):
    import warp as wp

    before = {n: getattr(wp, n) for n in ("launch", "empty", "zeros", "capture_while")}
    measured()
    assert all(getattr(wp, n) is f for n, f in before.items())
