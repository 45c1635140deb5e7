"""MJCF files and compiled models."""

from __future__ import annotations

import hashlib
import re
from functools import cache
from importlib.resources import files
from pathlib import Path

import mujoco
import numpy as np

from tsbench.core.errors import TsbenchError
from tsbench.core.plugins import OWN, walk

# A wheel ships models/ inside the package; a checkout has it beside the package.
_FOLDERS = (
    Path(__file__).parents[1] / "models",
    Path(__file__).parents[2] / "models",
)

_NUMBER = re.compile(r"(?<![\w.])-?\d+(?:\.\d+)?(?:e[-+]?\d+)?(?![\w.])")

# Kinds of warnings after which mujoco resets a simulation in the middle of an episode.
UNSTABLE = [
    int(kind)
    for kind in (
        mujoco.mjtWarning.mjWARN_BADQPOS,
        mujoco.mjtWarning.mjWARN_BADQVEL,
        mujoco.mjtWarning.mjWARN_BADQACC,
    )
]


def model_path(name: str) -> Path:
    """The path of tsbench's own MJCF `models/NAME.xml`.

    Raises:
        TsbenchError: the installation lacks the file.
    """
    for folder in _FOLDERS:
        path = folder / f"{name}.xml"
        if path.is_file():
            return path
    raise TsbenchError(
        f"the installation lacks models/{name}.xml: install tsbench again, "
        f"or give a plug-in's own model its package (load_spec({name!r}, __name__))"
    )


def load_spec(name: str, package: str = OWN) -> mujoco.MjSpec:
    """A MJCF as a spec, to which a task can add.

    Args:
        name: NAME in the file name `models/NAME.xml`.
        package: the package that contains the file, or a module of that package. Meshes, textures
            and included files lie in the same folder or below. mujoco gets them in memory, because
            it would compile the absolute path of a folder into the model.

    Raises:
        TsbenchError: there is no such file.
    """
    package = package.partition(".")[0]
    if package == OWN:
        return mujoco.MjSpec.from_file(str(model_path(name)))
    content = {path: file.read_bytes() for path, file in walk(files(package) / "models")}
    if (main := f"{name}.xml") not in content:
        raise TsbenchError(f"the package {package} lacks models/{main}")
    return mujoco.MjSpec.from_string(content[main].decode(), include=content, assets=content)


@cache
def compiled(name: str, package: str = OWN) -> mujoco.MjModel:
    """The compiled model of a MJCF without additions (see `load_spec`). It is shared: do not change
    it."""
    model: mujoco.MjModel = load_spec(name, package).compile()
    return model


def fingerprint(spec: mujoco.MjSpec) -> str:
    """Hash of a task's MJCF with the task's additions. Numbers are rounded to nine decimals and to
    six significant digits, so versions of mujoco that centre a mesh at 0 and at 1e-15 give the same
    hash. `compiled_hash` sees all digits."""
    text = _NUMBER.sub(lambda found: f"{round(float(found[0]), 9) + 0.0:g}", spec.to_xml())
    return hashlib.sha256(text.encode()).hexdigest()


def compiled_hash(spec: mujoco.MjSpec) -> str:
    """Hash of the compiled model, to the last bit. It differs between versions of mujoco."""
    model = spec.compile()
    buffer = np.empty(mujoco.mj_sizeModel(model), np.uint8)
    mujoco.mj_saveModel(model, None, buffer)
    return hashlib.sha256(buffer.tobytes()).hexdigest()


def sensor_slices(model: mujoco.MjModel) -> dict[str, slice]:
    """The slice of `sensordata` that holds each sensor's values, by name of the sensor."""
    return {
        model.sensor(i).name: slice(
            int(model.sensor_adr[i]), int(model.sensor_adr[i] + model.sensor_dim[i])
        )
        for i in range(model.nsensor)
    }
