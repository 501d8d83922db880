"""Robot hands: specs, MuJoCo models, kinematics."""

from pathlib import Path


def known_hands() -> list[str]:
    """Names of the hands: folders of the package that hold models."""
    models = (Path(root).glob("*/left.xml") for root in __path__)
    return sorted({model.parent.name for found in models for model in found})
