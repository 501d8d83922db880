"""Arrays between torch and JAX, on one device without a copy through the host.

JAX works behind the caller's back: what torch changed in place after a call could
still be read by it. And JAX arrays must never change. So what goes in is a private
copy on the same device, lent to JAX for good, and ``to_torch`` gives a view that
only the engine itself may see.

Only imported where brax is known to be installed.
"""

from __future__ import annotations

import os
import platform
from pathlib import Path
from typing import Any

import jax
import torch
from jax import Array
from torch import Tensor

_NARROW = {torch.float64: torch.float32, torch.int64: torch.int32}


def set_up() -> torch.device:
    """Choose the device, share it with torch, keep compiled programs; torch's name.

    JAX would take three quarters of a GPU at its start; it does not here, unless
    ``XLA_PYTHON_CLIENT_PREALLOCATE`` says so. On a TPU torch stays on the host.
    """
    os.environ.setdefault("XLA_PYTHON_CLIENT_PREALLOCATE", "false")
    if jax.config.values["jax_compilation_cache_dir"] is None:
        home = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
        # Programs are for the processor that compiled them; homes can be shared.
        folder = home / "flashdex" / "jax" / platform.node()
        jax.config.update("jax_compilation_cache_dir", str(folder))
    device = _target()
    jax.config.update("jax_default_device", device)
    if device.platform == "gpu":
        return torch.device("cuda", device.local_hardware_id)
    return torch.device("cpu")


def to_jax(x: Tensor) -> Array:
    """A private copy of a tensor as a JAX array, 32 bit.

    Args:
        x: any shape; float64 and int64 become float32 and int32.
    """
    own = x.detach().to(_NARROW.get(x.dtype, x.dtype), copy=True).contiguous()
    return jax.device_put(jax.dlpack.from_dlpack(own), _target())


def to_torch(x: Array) -> Tensor:
    """A view of a JAX array: read it, never write it, and clone what leaves.

    Args:
        x: any shape.
    """
    if next(iter(x.devices())).platform not in ("cpu", "gpu"):
        x = jax.device_put(x, jax.devices("cpu")[0])
    return torch.from_dlpack(x)


def _target() -> Any:
    first = jax.devices()[0]
    alone = first.platform == "gpu" and not torch.cuda.is_available()
    return jax.devices("cpu")[0] if alone else first
