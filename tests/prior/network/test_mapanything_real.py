"""The real package with a tiny random MapAnything: interfaces only, since random weights give no geometry."""

import json
from pathlib import Path

import hydra
import numpy as np
import pytest
import yaml
from network_double import Sphere
from tiny_run import compose

from emgs_jax.prior.base import windows

torch = pytest.importorskip("torch", reason="torch is not installed")
models = pytest.importorskip("mapanything.models", reason="the package mapanything is not installed")
safetensors = pytest.importorskip("safetensors.torch", reason="safetensors is not installed")


def tiny():
    return yaml.safe_load(Path(__file__).with_name("tiny_mapanything.yaml").read_text())


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory):
    """A local folder as the published ones are."""
    folder = tmp_path_factory.mktemp("checkpoint")
    (folder / "config.json").write_text(json.dumps(tiny()))  # before the constructor changes the dicts
    torch.manual_seed(0)
    safetensors.save_model(models.MapAnything(**tiny()), str(folder / "model.safetensors"))
    return folder


def predict(checkpoint, *overrides):
    keys = ("masks.drop_ambiguous=0", "masks.max_edge_step=inf", "compute.device=cpu", *overrides)
    names = (f"prior.checkpoint={checkpoint}", "prior.resolution=[84,56]", *(f"prior.{key}" for key in keys))
    prior = hydra.utils.instantiate(compose("prior=mapanything", *names).prior)
    data = Sphere(num_frames=4, size=(60, 40))
    calls = list(windows(range(len(data)).__contains__, 3))
    return [prior.predict(window, [data[i] for i in window.views], data.intrinsics) for window in calls]


def test_a_local_checkpoint_predicts_the_record_that_the_mapping_takes(checkpoint):
    for prediction in predict(checkpoint):
        dense, views = len(prediction.window.dense), len(prediction.window.views)
        assert prediction.points.shape == (dense, 40, 60, 3) and prediction.points.dtype == np.float32
        assert prediction.T_anchor_view.shape == (views, 4, 4) and prediction.T_anchor_view.dtype == np.float64
        np.testing.assert_array_equal(prediction.T_anchor_view[0], np.eye(4))
        rotations = prediction.T_anchor_view[:, :3, :3]
        np.testing.assert_allclose(rotations @ rotations.swapaxes(1, 2), np.tile(np.eye(3), (views, 1, 1)), atol=1e-5)
        assert np.isfinite(prediction.points).all() and prediction.confidence.min() >= 1


def test_the_same_window_gives_the_same_bits(checkpoint):
    for a, b in zip(predict(checkpoint), predict(checkpoint), strict=True):
        assert a.points.tobytes() == b.points.tobytes() and a.T_anchor_view.tobytes() == b.T_anchor_view.tobytes()


def test_the_anchors_pose_and_its_metric_flag_change_what_comes_out(checkpoint):
    answers = [
        predict(checkpoint, key)[0].T_anchor_view
        for key in ("anchor_pose=on", "anchor_pose=off", "anchor_is_metric=true")
    ]
    for one, other in ((0, 1), (0, 2), (1, 2)):
        assert np.abs(answers[one] - answers[other]).max() > 0


def test_weights_that_leave_a_parameter_of_the_real_model_random_are_refused(checkpoint, tmp_path):
    """`from_pretrained` took them, and every process predicted something else."""
    tensors = safetensors.load_file(str(checkpoint / "model.safetensors"))
    name = next(name for name in tensors if name.endswith("weight"))
    (tmp_path / "config.json").write_bytes((checkpoint / "config.json").read_bytes())
    renamed = {("other." + key if key == name else key): value for key, value in tensors.items()}
    safetensors.save_file(renamed, str(tmp_path / "model.safetensors"))
    with pytest.raises(hydra.errors.InstantiationException) as raised:
        predict(tmp_path)
    said = str(raised.value.__cause__)
    assert f'"{name}"' in said and f'"other.{name}"' in said and str(tmp_path) in said
