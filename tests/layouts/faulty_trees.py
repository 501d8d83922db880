"""Keys, types and shapes that are wrong: edits of one part of nested tables.

A file is read as a tree of dicts, lists and arrays; a part is chosen at random, level
by level, changed, and the tree is written back.
"""

from __future__ import annotations

import json
import pickle

import numpy as np
import torch

NAMES = (
    *("../../x", "/etc/passwd", "..", ".", "", "a/b", "a\\b", "line\nbreak", "nul\0"),
    *("=1+2", "@x", "x" * 300, "ünïcødé", "\u202ecod", "-rf", "CON", "%s%n", "${HOME}"),
)


def load(file):
    """The tree of a file that the tests themselves wrote."""
    if file.suffix == ".npz":
        with np.load(file, allow_pickle=True) as stored:
            return {k: _plain(stored[k]) for k in stored.files}
    if file.suffix == ".npy":
        return _plain(np.load(file, allow_pickle=True))
    if file.suffix == ".pkl":
        return pickle.loads(file.read_bytes())
    if file.suffix == ".pt":
        return torch.load(file, weights_only=False)
    if file.suffix == ".jsonl":
        return [json.loads(line) for line in file.read_text().splitlines()]
    return json.loads(file.read_text())


def _plain(array):
    return array.item() if array.dtype == object and array.ndim == 0 else array


def save(file, tree):
    """Write the tree back as the same kind of file."""
    if file.suffix == ".npz":
        tree = tree if isinstance(tree, dict) else {"arr_0": tree}
        np.savez(file, **{str(k).replace("/", "_"): _array(v) for k, v in tree.items()})
    elif file.suffix == ".npy":
        np.save(file, _array(tree), allow_pickle=True)
    elif file.suffix == ".pkl":
        file.write_bytes(pickle.dumps(tree))
    elif file.suffix == ".pt":
        torch.save(tree, file)
    elif file.suffix == ".jsonl":
        rows = tree if isinstance(tree, list) else [tree]
        file.write_text("\n".join(json.dumps(row, default=_listed) for row in rows))
    else:
        file.write_text(json.dumps(tree, default=_listed))


def _array(value):
    if isinstance(value, np.ndarray):
        return value
    if isinstance(value, dict):
        return np.array(value, dtype=object)
    try:
        return np.array(value)
    except (ValueError, TypeError):
        out = np.empty((), dtype=object)
        out[()] = value
        return out


def _listed(value):
    if not hasattr(value, "tolist"):
        return str(value)
    listed = value.tolist()
    plain = isinstance(listed, (int, float, str, list))
    return listed if plain else str(listed)


def change_part(tree, rng, change):
    """Change one part that is chosen level by level; stops early now and then."""
    if isinstance(tree, dict) and tree and rng.random() > 0.1:
        keys = list(tree)
        key = keys[rng.integers(len(keys))]
        if rng.random() < 0.15:
            tree = dict(tree)
            value = tree.pop(key)
            if rng.random() < 0.5:
                tree[f"{key}_"] = value
            return tree
        return {**tree, key: change_part(tree[key], rng, change)}
    if isinstance(tree, list) and tree and rng.random() > 0.2:
        place = int(rng.integers(len(tree)))
        return [
            *tree[:place],
            change_part(tree[place], rng, change),
            *tree[place + 1 :],
        ]
    return change(tree, rng)


def reshape(value, rng):
    """Another shape: transposed, longer, shorter, of another rank."""
    array = _numbers(value)
    if array is None or not array.size:
        return [[1.0], [2.0, 3.0]]
    count = len(array) if array.ndim else 0
    last = array[-1:] if array.ndim else array
    shapes = [
        array.T,
        array.reshape(-1),
        array[None],
        array[..., None],
        array[:0] if array.ndim else array,
        array[:1] if array.ndim else array,
        array[..., :-1] if array.ndim else array,
        np.float64(0.5),
        *(array[: max(count - cut, 0)] for cut in (1, 2, 20) if array.ndim),
        *(np.concatenate([array] + [last] * n) for n in (1, 20) if array.ndim),
    ]
    return _like(value, shapes[rng.integers(len(shapes))])


def retype(value, rng):
    """Another type, or nothing at all."""
    array = _numbers(value)
    kinds = [None, "text", b"bytes", True, {}, [], {"a": 1}, ["a", "b"], -1, 2**70]
    kinds += [float("nan"), float("inf"), 1e400, [None], [[1.0], [2.0, 3.0]], 1j]
    if array is not None and array.size:
        kinds += [array.astype(complex), array.astype("U8"), array.astype(bool)]
        kinds += [array.astype(object), array.astype("datetime64[s]"), array > 0]
        with np.errstate(all="ignore"):
            kinds += [array.astype(np.int8), array.astype(np.float16)]
    return kinds[rng.integers(len(kinds))]


def revalue(value, rng):
    """Other numbers of the same shape."""
    array = _numbers(value)
    if array is None or not array.size:
        return NAMES[rng.integers(len(NAMES))]
    array = np.array(array, dtype=float)
    with np.errstate(all="ignore"):
        values = [array * np.nan, array * 0, array * 1e30, array * 1e308, -array]
        values += [array * 1000, array * 1e-3, array + 1e6, np.full_like(array, np.inf)]
        values += [rng.normal(size=array.shape), array[..., ::-1] if array.ndim else 7]
    return _like(value, values[rng.integers(len(values))])


def rename(value, rng):
    """A name that is a path, a formula, too long, or of odd letters."""
    return NAMES[rng.integers(len(NAMES))]


def _numbers(value):
    """The numbers of a value, or None where it has none."""
    if isinstance(value, torch.Tensor):
        return value.detach().numpy()
    try:
        array = np.asarray(value)
    except ValueError:
        return None
    return array if array.dtype.kind in "fiu" else None


def _like(value, array):
    """The array as the kind of thing that the value was."""
    if isinstance(value, torch.Tensor):
        return torch.as_tensor(np.array(array, dtype=float))
    return np.asarray(array).tolist() if isinstance(value, list) else array


CHANGES = (reshape, retype, revalue, rename)
