"""Dependencies point one way: the imports of every file, read with ast."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest
import yaml

ROOT = Path(__file__).parent.parent
PACKAGE = ROOT / "flashdex"
FILES = sorted(PACKAGE.rglob("*.py"))

# What a part may import from flashdex, besides itself.
LEAVES = {"geometry", "keys", "errors", "files", "recipe"}
DOMAIN = {"hands", "motions"}
MAY_IMPORT = {
    "geometry": set(),
    "keys": set(),
    "errors": set(),
    "files": set(),
    # `flashdex.hands` is only asked where it lies, to list the hands.
    "recipe": {"errors", "hands"},
    "hands": LEAVES,
    "motions": LEAVES | {"hands"},
    "modules": LEAVES,
    "objectives": LEAVES | {"modules"},
    "metrics": LEAVES,
    "envs": LEAVES | DOMAIN | {"metrics"},
}
NEVER = {
    "export": {"training", "cli"},
    "viz": {"training", "cli"},
    "envs": {"modules", "objectives", "training", "cli"},
}
# Files of the warp engine; kernels need warp at the top, so they are imported lazily.
WARP = {f"envs/physics/{path.name}" for path in PACKAGE.glob("envs/physics/warp*.py")}
WARP_KERNELS = "envs/physics/warp_kernels.py"
# Files of the brax engine; only its front imports the others, lazily, so they need not.
BRAX = {f"envs/physics/{path.name}" for path in PACKAGE.glob("envs/physics/brax*.py")}
BRAX_INSIDE = BRAX - {"envs/physics/brax.py"}
# Optional packages and the only files that may import them, inside a function.
OPTIONAL = {
    "mujoco_warp": WARP,
    "warp": WARP,
    "brax": BRAX,
    "jax": BRAX,
    "mujoco.mjx": BRAX,
    "wandb": {"training/logging.py"},
    "viser": {"viz/viewer.py", "viz/page.py"},
    "mjviser": {"viz/viewer.py", "viz/page.py"},
    "ray": {"motions/ray_pool.py", "training/distributed.py"},
    "gymnasium": {"training/gym.py"},
    "h5py": {"export/robomimic.py"},
    "pyarrow": {"export/lerobot.py"},
}
TENSOR_PACKAGES = {"__future__", "torch", "tensordict", "math"} | {
    "collections",
    "dataclasses",
    "typing",
}
TENSOR_PARTS = ("flashdex.geometry", "flashdex.keys", "flashdex.envs", "flashdex.hands")
PURE = ["envs/rewards.py", "envs/features.py", "envs/terminations.py", "envs/wrench.py"]


def imports_of(tree):
    """Yield (module, is_top_level) for each import; TYPE_CHECKING blocks left out."""
    typing_only = {
        id(node)
        for block in ast.walk(tree)
        if isinstance(block, ast.If) and "TYPE_CHECKING" in ast.dump(block.test)
        for statement in block.body
        for node in ast.walk(statement)
    }
    top = {id(node) for node in tree.body}
    for node in ast.walk(tree):
        if id(node) in typing_only:
            continue
        if isinstance(node, ast.Import):
            for alias in node.names:
                yield alias.name, id(node) in top
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, "absolute imports only"
            yield node.module, id(node) in top
            if node.module in ("flashdex", "mujoco"):
                for alias in node.names:
                    yield f"{node.module}.{alias.name}", id(node) in top


def part_of(path):
    return path.relative_to(PACKAGE).parts[0].removesuffix(".py")


def parts_imported(path):
    tree = ast.parse(path.read_text())
    names = [name.split(".") for name, _ in imports_of(tree)]
    return {name[1] for name in names if name[0] == "flashdex" and len(name) > 1}


def ids(path):
    return str(path.relative_to(PACKAGE))


@pytest.mark.parametrize("path", FILES, ids=ids)
def test_parts_import_only_what_lies_below(path):
    part = part_of(path)
    found = parts_imported(path) - {part}
    if part in MAY_IMPORT:
        assert found <= MAY_IMPORT[part]
    assert not found & NEVER.get(part, {"cli"})


@pytest.mark.parametrize("path", FILES, ids=ids)
def test_optional_packages_are_imported_lazily_in_their_file(path):
    for name, is_top in imports_of(ast.parse(path.read_text())):
        is_mjx = name.startswith("mujoco.mjx")
        package = "mujoco.mjx" if is_mjx else name.split(".")[0]
        if package in OPTIONAL:
            assert ids(path) in OPTIONAL[package], f"{package} does not belong here"
            if ids(path) not in {WARP_KERNELS, *BRAX_INSIDE}:
                assert not is_top, f"{package} must be imported inside a function"
        if name == "flashdex.envs.physics.warp.kernels":
            assert ids(path) in WARP
            assert not is_top, "kernels must be imported inside a function"
        if name.startswith("flashdex.envs.physics.brax_"):
            assert ids(path) in BRAX
            assert ids(path) in BRAX_INSIDE or not is_top


@pytest.mark.parametrize("name", PURE)
def test_pure_files_know_tensors_only(name):
    path = PACKAGE / name
    if not path.exists():
        pytest.skip(f"{name} does not exist")
    for module, _ in imports_of(ast.parse(path.read_text())):
        if module.startswith("flashdex."):
            assert module.startswith(TENSOR_PARTS)
        else:
            assert module.split(".")[0] in TENSOR_PACKAGES
    assert "open(" not in path.read_text()


def test_recipes_name_no_classes():
    for path in (ROOT / "recipes").rglob("*.yaml"):
        assert "_target_" not in str(yaml.safe_load(path.read_text()))


@pytest.mark.parametrize("path", FILES, ids=ids)
def test_files_stay_short(path):
    limit = 400 if ids(path) == "training/loop.py" else 300
    assert len(path.read_text().splitlines()) <= limit


def test_the_walk_sees_forbidden_imports():
    code = "import flashdex.cli\nfrom flashdex import envs\ndef f():\n    import ray\n"
    assert list(imports_of(ast.parse(code))) == [
        ("flashdex.cli", True),
        ("flashdex", True),
        ("flashdex.envs", True),
        ("ray", False),
    ]
