"""Features on top of any prior: the geometry is the prior's to the bit, the features are the model's, once an image."""

from dataclasses import replace

import numpy as np
import pytest

from emgs_jax.features.random import RandomFeatures
from emgs_jax.features.text import save_text
from emgs_jax.prior.base import Prior, windows
from emgs_jax.prior.recorded import Recorded, record
from emgs_jax.prior.simulated.prior import Simulated
from emgs_jax.prior.wrapped import Featured, Requeried

WINDOW_SIZE = 3


class Counting(RandomFeatures):
    num_images = 0

    def extract(self, frame):
        self.num_images += 1
        return super().extract(frame)


def make_model(seed=0, classes=("wall", "box"), text=None):
    return Counting(width=8, cell=5, seed=seed, classes=classes, templates=["a {}."], text=text)


@pytest.fixture
def textured(room):
    """The room with an image that differs in every frame."""

    class Textured(type(room)):
        def __getitem__(self, index):
            noise = np.random.default_rng(index).integers(0, 256, (30, 40, 3), np.uint8)
            return replace(super().__getitem__(index), image=noise)

    return Textured()


def predictions(prior, dataset):
    for window in windows(range(len(dataset)).__contains__, WINDOW_SIZE):
        yield prior.predict(window, [dataset[i] for i in window.views], dataset.intrinsics)


def test_geometry_is_bit_identical_and_features_are_the_models_which_describes_each_image_once(textured):
    plain, model = Simulated(seed=3, classes=textured.classes), make_model()
    prior = Featured(plain, model)
    assert isinstance(prior, Prior)
    for got, expected in zip(predictions(prior, textured), predictions(plain, textured), strict=True):
        for name in ("T_anchor_view", "points", "confidence", "mask"):
            assert getattr(got, name).tobytes() == getattr(expected, name).tobytes(), name
        frames = [textured[index] for index in got.window.dense]
        np.testing.assert_array_equal(got.features, np.stack([RandomFeatures.extract(model, f) for f in frames]))
        assert got.features.shape[1:] == (6, 8, 8) and got.features.dtype == np.float16
    assert model.num_images == len(textured), "though an image is dense in two windows"


def test_another_image_of_the_same_number_is_described_anew(textured):
    model = make_model()
    prior, window = Featured(Simulated(), model), next(windows(range(1).__contains__, 1))
    first, second = (replace(textured[index], index=0) for index in (0, 1))
    prior.predict(window, [first], textured.intrinsics)
    features = prior.predict(window, [second], textured.intrinsics).features[0]
    np.testing.assert_array_equal(features, model.extract(second))


def test_provenance_tells_the_geometry_and_the_features():
    geometry = Simulated(level=0.5, seed=3)
    prior = Featured(geometry, make_model(seed=7))
    assert prior.provenance.name == "simulated+random" and prior.provenance.is_simulated
    model = {"name": "random", "version": 1, "width": 8, "seed": 7}
    told = {"features": {"model": model, "cell": 5, "templates": ["a {}."]}}
    assert prior.provenance.settings == geometry.provenance.settings | told


def test_replay_is_the_live_prior_bit_for_bit_and_a_recording_with_other_features_is_not_mixed(tmp_path, textured):
    prior = Featured(Simulated(seed=1), make_model())
    record(prior, textured, WINDOW_SIZE, tmp_path)
    replay = Recorded(tmp_path)
    assert replay.provenance == prior.provenance and replay.feature_names == ("wall", "box")
    assert replay.text_features.tobytes() == prior.text_features.tobytes()
    for live, again in zip(predictions(prior, textured), predictions(replay, textured), strict=True):
        assert (live.features.shape, live.features.tobytes()) == (again.features.shape, again.features.tobytes())
        assert live.points.tobytes() == again.points.tobytes()
    with pytest.raises(ValueError, match="holds a recording with provenance.*choose another folder"):
        record(Featured(Simulated(seed=1), make_model(seed=1)), textured, WINDOW_SIZE, tmp_path)


def test_features_are_added_to_a_recording_without_the_prior(tmp_path, textured):
    record(Simulated(seed=2), textured, WINDOW_SIZE, tmp_path / "geometry")
    later = Featured(Recorded(tmp_path / "geometry"), make_model())
    at_once = Featured(Simulated(seed=2), make_model())
    record(later, textured, WINDOW_SIZE, tmp_path / "later")
    record(at_once, textured, WINDOW_SIZE, tmp_path / "at_once")
    for path in (tmp_path / "at_once").iterdir():
        assert path.read_bytes() == (tmp_path / "later" / path.name).read_bytes(), path.name


def test_a_recording_is_compared_with_the_classes_of_a_file(tmp_path, textured):
    record(Featured(Simulated(), make_model()), textured, WINDOW_SIZE, tmp_path / "recording")
    save_text(tmp_path / "lamp.npz", make_model().embed(("lamp", "wall")))
    recorded = Recorded(tmp_path / "recording")
    prior = Requeried(recorded, str(tmp_path / "lamp.npz"))
    assert prior.feature_names == ("lamp", "wall")
    np.testing.assert_array_equal(prior.text_features, make_model(classes=("lamp", "wall")).text.vectors)
    for got, expected in zip(predictions(prior, textured), predictions(recorded, textured), strict=True):
        assert got.features.tobytes() == expected.features.tobytes()
    save_text(tmp_path / "other.npz", make_model(seed=1).embed(("lamp",)))
    with pytest.raises(ValueError, match="other.npz was embedded by .*'seed': 1.*but the features are of .*'seed': 0"):
        Requeried(Recorded(tmp_path / "recording"), str(tmp_path / "other.npz"))
    with pytest.raises(ValueError, match="goes with features of a model, but prior simulated has none"):
        Requeried(Simulated(classes=("wall",)), str(tmp_path / "lamp.npz"))
