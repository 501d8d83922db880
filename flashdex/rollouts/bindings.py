"""What a rollout is bound to: hashes of what it was scored on, and by which limits."""

from __future__ import annotations

import hashlib
from typing import Any

import numpy as np

from flashdex.metrics.criteria_table import make_criteria, resolve_criterion
from flashdex.rollouts.rollout import Rollout

REFERENCE = ("ref_object_pos", "ref_object_quat", "ref_fingertips", "ref_joints")


def reference_sha256(rollout: Rollout) -> str:
    """SHA-256 of the reference that a rollout was scored on."""
    found = hashlib.sha256()
    for name in REFERENCE:
        value = np.ascontiguousarray(getattr(rollout, name), "<f8")
        found.update(f"{name} {value.shape}".encode())
        found.update(value.tobytes())
    return found.hexdigest()


def limits_of(rollout: Rollout) -> dict[str, Any]:
    """Grace and limits of the criterion of a rollout, as this version has them."""
    name = resolve_criterion(rollout.criterion)
    for criterion in make_criteria(grace=rollout.grace):
        if name in (criterion.name + s for s in ("", "_left", "_right")):
            limits = {term.quantity: term.limit for term in criterion.terms}
            return {"grace": criterion.grace, **limits}
    raise AssertionError(name)


def bindings_of(rollout: Rollout) -> dict[str, Any]:
    """What the provenance of a rollout says of it."""
    return {
        "reference_sha256": reference_sha256(rollout),
        "limits": limits_of(rollout),
    }
