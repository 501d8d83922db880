"""Downloads the recordings that anybody may have without a registration.

MyoDM: 95 recorded clips of one right hand and one object, inside the wheel of
``myosuite`` 2.12.2. pip fetches the wheel without its dependencies; its hash is checked
before anything is taken out of it.
"""

from __future__ import annotations

import hashlib
import json
import re
import shutil
import subprocess
import tempfile
import zipfile
from pathlib import Path

from flashdex.errors import DemoError, UnknownNameError
from flashdex.system.children import PYTHON
from flashdex.system.files import hash_file

WHEEL = "myosuite==2.12.2"
WHEEL_SHA256 = "bec0133d9d4ba0249aeccdd7de632eead4749436ffb4e5a3c44a8f9cedafd9ea"
CLIP = re.compile(r"myosuite/envs/myo/myodm/data/MyoHand_(([a-z]+)_\w+)\.npz")
OBJECTS = "myosuite/simhive/object_sim"
HAND = "myosuite/simhive/myo_sim/hand/assets/myohand_body.xml"
LICENCES = {
    "LICENSE": "myosuite-2.12.2.dist-info/licenses/LICENSE",
    "LICENSE.hand": "myosuite/simhive/myo_sim/LICENSE",
    "LICENSE.objects": "myosuite/simhive/object_sim/LICENSE",
}
NOTE = (
    "MyoDM: software, hand model and meshes are Apache-2.0 (licences beside the "
    "clips). The motions are kinematic fits to mocap of GRAB; the authors ask users to "
    "respect GRAB's licence: non-commercial research, no redistribution of the data."
)


class UnknownDatasetError(UnknownNameError):
    """A dataset that cannot be fetched."""

    kind = "dataset that can be fetched"


def myodm_dir() -> Path:
    """Where ``fetch myodm`` puts the recordings by default."""
    from flashdex.objects.asset import default_cache_dir  # needs torch, listing not

    return default_cache_dir() / "data" / "myodm"


def fetch(name: str, out: Path | None = None, *, wheel: Path | None = None) -> Path:
    """The folder of a dataset; what is already complete is not fetched again.

    It is ``<cache>/data/<name>`` by default; ``wheel`` is the package file, where it
    was downloaded by other means.

    Raises:
        UnknownDatasetError: names the known ones.
        DemoError: pip failed, the file is another one, or the disk refused.
    """
    if name != "myodm":
        raise UnknownDatasetError(name, ["myodm"])
    if wheel is not None and not wheel.is_file():
        raise DemoError(f"--wheel: there is no file {wheel}.")
    out = out or myodm_dir()
    if _is_complete(out):
        return out
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise DemoError(
            f"{out} holds other files, or what was fetched was changed or damaged; "
            f"give an empty folder with --out, or remove this one."
        )
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=out.parent, prefix=".fetch-") as scratch:
            work = Path(scratch)
            _unpack(_check(wheel or _download(work)), work / "data")
            if out.exists():
                out.rmdir()
            (work / "data").rename(out)
    except OSError as error:
        raise DemoError(f"{out}: cannot be written ({error}).") from error
    return out


def _is_complete(folder: Path) -> bool:
    try:
        stored = json.loads((folder / "source.json").read_text(encoding="utf-8"))
        files = stored["files"]
        complete = bool(files) and all((folder / name).is_file() for name in files)
        if isinstance(files, dict):  # a list of old has no hashes
            complete &= all(hash_file(folder / k) == files[k] for k in files)
        return complete and stored["sha256"] == WHEEL_SHA256
    except (OSError, ValueError, KeyError, TypeError):
        return False


def _download(folder: Path) -> Path:
    command = [*PYTHON, "-m", "pip", "download", "--no-deps", "--quiet"]
    command += ["--disable-pip-version-check", "--dest", str(folder), WHEEL]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    found = list(folder.glob("*.whl"))
    if done.returncode or len(found) != 1:
        told = (done.stderr or done.stdout).strip().splitlines()
        raise DemoError(
            f"pip could not download {WHEEL}: {told[-1] if told else 'no message'}. "
            f"Download the wheel elsewhere and give it with --wheel FILE."
        )
    return found[0]


def _check(wheel: Path) -> Path:
    with wheel.open("rb") as file:
        digest = hashlib.file_digest(file, "sha256").hexdigest()
    if digest != WHEEL_SHA256:
        raise DemoError(
            f"{wheel}: sha256 {digest[:16]}..., expected {WHEEL_SHA256[:16]}...: not "
            f"the wheel of {WHEEL}, or damaged. Nothing was taken from it."
        )
    return wheel


def _unpack(wheel: Path, out: Path) -> None:
    with zipfile.ZipFile(wheel) as archive:
        clips = {m[0]: m for m in map(CLIP.fullmatch, archive.namelist()) if m}
        wanted = {f"clips/{m[1]}.npz": name for name, m in clips.items()}
        names = sorted({m[2] for m in clips.values()})
        wanted |= {f"meshes/{n}.stl": f"{OBJECTS}/{n}/{n}.stl" for n in names}
        wanted |= {"myohand_body.xml": HAND, **LICENCES}
        for target, member in wanted.items():
            (out / target).parent.mkdir(parents=True, exist_ok=True)
            with archive.open(member) as source, (out / target).open("wb") as file:
                shutil.copyfileobj(source, file)
    hashes = {name: hash_file(out / name) for name in sorted(wanted)}
    stored = {"source": WHEEL, "sha256": WHEEL_SHA256, "files": hashes}
    (out / "source.json").write_text(json.dumps(stored, indent=1), encoding="utf-8")
