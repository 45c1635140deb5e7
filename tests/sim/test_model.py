"""Paths and fingerprints of models, and the slices of their sensors."""

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np
import pytest

from tsbench import TsbenchError, tasks
from tsbench.sim import model


def test_models_are_found(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    assert model.model_path("rocket").read_text("utf-8").count("<mujoco") == 1
    (tmp_path / "laikago.xml").write_text("<mujoco/>")
    monkeypatch.setattr(model, "_FOLDERS", (tmp_path / "nowhere", tmp_path))
    assert model.model_path("laikago") == tmp_path / "laikago.xml"
    with pytest.raises(TsbenchError, match=r"lacks models/rocket.xml"):
        model.model_path("rocket")


def test_a_fingerprint_is_the_physics() -> None:
    """A fingerprint ignores rounding and shows other changes; the compiled hash shows both."""
    seen = {name: model.fingerprint(tasks.make(name).spec()) for name in tasks.names()}
    exactly = {model.compiled_hash(tasks.make(name).spec()) for name in tasks.names()}
    assert len(set(seen.values())) == len(exactly) > 1
    for name, fingerprint in seen.items():
        assert model.fingerprint(tasks.make(name).spec()) == fingerprint
    spec = tasks.make("laikago_walk").spec()
    exact = model.compiled_hash(spec)
    spec.body("FR_calf").mass += 1e-9  # as another mujoco may compute it
    assert model.fingerprint(spec) == seen["laikago_walk"]
    assert model.compiled_hash(spec) != exact
    spec.body("FR_calf").mass += 1e-4
    assert model.fingerprint(spec) != seen["laikago_walk"]
    spec = tasks.make("rocket_navigation").spec()
    spec.option.gravity = np.array([0.0, 0.0, -2.501])
    assert model.fingerprint(spec) != seen["rocket_navigation"]


def test_another_mujoco_does_not_change_a_fingerprint() -> None:
    """mujoco 4.0 centres the rocket's fins at 1e-15 instead of 0."""

    def marked(x: float) -> str:
        spec = tasks.make("rocket_navigation").spec()
        spec.worldbody.add_site(name="mark", pos=[x, 1.0, 0.0])
        return model.fingerprint(spec)

    assert marked(-1.88738e-15) == marked(0.0) != marked(1e-6)


def test_sensors_by_name() -> None:
    compiled = tasks.make("rocket_obstacles").spec().compile()
    slices = model.sensor_slices(compiled)
    assert slices == {"obstacle_1": slice(0, 1), "obstacle_2": slice(1, 2)}
    laikago = model.compiled("laikago")
    slices = model.sensor_slices(laikago)
    assert [(part.start, part.stop) for part in slices.values()] == [
        (0, 3), (3, 6), (6, 9), (9, 12), (12, 15),
    ]  # fmt: skip
    data = mujoco.MjData(laikago)
    mujoco.mj_resetDataKeyframe(laikago, data, 0)
    mujoco.mj_forward(laikago, data)
    foot = data.sensordata[slices["RR_foot_position"]]
    np.testing.assert_array_equal(foot, data.site("RR_foot").xpos)
    np.testing.assert_array_equal(data.sensordata[slices["com"]], data.subtree_com[1])


def test_the_shared_model_is_compiled_once() -> None:
    assert model.compiled("laikago") is model.compiled("laikago")
