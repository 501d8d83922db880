"""Dependencies point one way: the imports of every file, read with ast."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest
import yaml

ROOT = Path(__file__).parent.parent
PACKAGE = ROOT / "flashdex"
FILES = sorted(PACKAGE.rglob("*.py"))

# A package imports only what stands before it.
ORDER = (
    *("errors", "keys", "geometry", "system", "hands", "objects", "datasets"),
    *("metrics", "motions", "modules", "objectives", "envs", "replay", "algorithms"),
    *("search", "recipe", "rollouts", "training", "baselines", "export", "reports"),
    "cli",
)
# What stands before it, but is none of its business.
NEVER = {
    "metrics": {"hands", "objects", "datasets", "system"},
    "modules": {"hands", "objects", "datasets", "metrics", "motions"},
    "objectives": {"hands", "objects", "datasets", "metrics", "motions"},
    "envs": {"modules", "objectives"},
    "export": {"training"},
    "reports": {"training"},
}
# Optional packages and the only places that may import them, inside a function.
OPTIONAL = {
    "mujoco_warp": "envs/physics/warp/",
    "warp": "envs/physics/warp/",
    "brax": "envs/physics/brax/",
    "jax": "envs/physics/brax/",
    "mujoco.mjx": "envs/physics/brax/",
    "wandb": "training/logging.py",
    "viser": "reports/viewer/",
    "mjviser": "reports/viewer/",
    "ray": "motions/pipeline/workers.py",
    "gymnasium": "envs/gym.py",
    "h5py": "export/",
    "pyarrow": "export/",
}
# Only imported where the package is known to be installed: they need not be lazy.
INSIDE = {
    "envs/physics/warp/kernels.py",
    *("envs/physics/brax/model.py", "envs/physics/brax/step.py"),
    "envs/physics/brax/wrench.py",
}
TENSOR_PACKAGES = {"__future__", "torch", "tensordict", "math"} | {
    "collections",
    "dataclasses",
    "typing",
}
TENSOR_PARTS = ("flashdex.geometry", "flashdex.keys", "flashdex.envs", "flashdex.hands")
PURE = [
    *("envs/mdp/rewards.py", "envs/mdp/terminations.py", "envs/scene/wrench.py"),
    *("envs/transforms/proprioception.py", "envs/transforms/reference_delta.py"),
    *("envs/transforms/object_state.py", "envs/transforms/object_points.py"),
    *("envs/transforms/surface_distance.py", "envs/transforms/contact.py"),
    "envs/transforms/future_window.py",
]
MAX_LINES = 400
MAX_FILES = 15


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


def modules_imported(path):
    """Modules of flashdex that a file imports, also inside functions."""
    names = {name for name, _ in imports_of(ast.parse(path.read_text()))}
    return {name for name in names if name.startswith("flashdex.")}


def ids(path):
    return str(path.relative_to(PACKAGE))


@pytest.mark.parametrize("path", FILES, ids=ids)
def test_parts_import_only_what_lies_below(path):
    part = part_of(path)
    if part == "__init__":
        pytest.skip("the front door opens on everything")
    found = {name.split(".")[1] for name in modules_imported(path)} - {part}
    above = {name for name in found if ORDER.index(name) > ORDER.index(part)}
    assert not above
    assert not found & NEVER.get(part, set())


def test_no_file_imports_in_a_circle():
    modules = {".".join(p.relative_to(ROOT).with_suffix("").parts): p for p in FILES}
    modules = {name.removesuffix(".__init__"): path for name, path in modules.items()}
    graph = {
        name: modules_imported(path) & set(modules) - {name, "flashdex"}
        for name, path in modules.items()
    }
    while leaves := [name for name, needs in graph.items() if not needs]:
        for leaf in leaves:
            del graph[leaf]
        graph = {name: needs - set(leaves) for name, needs in graph.items()}
    assert not graph


@pytest.mark.parametrize("path", FILES, ids=ids)
def test_optional_packages_are_imported_lazily_in_their_place(path):
    for name, is_top in imports_of(ast.parse(path.read_text())):
        is_mjx = name.startswith("mujoco.mjx")
        package = "mujoco.mjx" if is_mjx else name.split(".")[0]
        if package in OPTIONAL:
            assert ids(path).startswith(OPTIONAL[package]), f"{package} is out of place"
            if ids(path) not in INSIDE:
                assert not is_top, f"{package} must be imported inside a function"
        inner = f"{name.removeprefix('flashdex.').replace('.', '/')}.py"
        if name.startswith("flashdex.") and inner in INSIDE:
            assert ids(path) in INSIDE or not is_top, f"{name} needs its package"
            assert Path(ids(path)).parent == Path(inner).parent


@pytest.mark.parametrize("name", PURE)
def test_pure_files_know_tensors_only(name):
    path = PACKAGE / name
    for module, _ in imports_of(ast.parse(path.read_text())):
        if module == "flashdex":
            continue  # `from flashdex import keys`, whose names come next
        if module.startswith("flashdex."):
            assert module.startswith(TENSOR_PARTS)
        else:
            assert module.split(".")[0] in TENSOR_PACKAGES
    assert "open(" not in path.read_text()


def test_recipes_name_no_classes():
    for path in (ROOT / "recipes").rglob("*.yaml"):
        assert "_target_" not in str(yaml.safe_load(path.read_text()))


@pytest.mark.parametrize("path", FILES, ids=ids)
def test_files_are_one_thought(path):
    assert len(path.read_text().splitlines()) <= MAX_LINES


def test_folders_are_one_room():
    folders = {path.parent for path in FILES}
    counts = {ids(f): len(list(f.glob("*.py"))) for f in folders if f != PACKAGE}
    crowded = {name: count for name, count in counts.items() if count > MAX_FILES}
    assert not crowded


def test_the_walk_sees_forbidden_imports():
    code = "import flashdex.cli\nfrom flashdex import envs\ndef f():\n    import ray\n"
    assert list(imports_of(ast.parse(code))) == [
        ("flashdex.cli", True),
        ("flashdex", True),
        ("flashdex.envs", True),
        ("ray", False),
    ]
