"""Text embeddings to a file and back into a run; oracle: the model that embeds when the run starts."""

import numpy as np
import pytest
from hydra.utils import instantiate
from tiny_run import compose, dataset

from emgs_jax.config import configure
from emgs_jax.config.configure import build_prior
from experiments.embed import embed


def write(path, *overrides, features="random"):
    return embed(configure.compose(f"features={features}", f"out={path}", *overrides, name="embed"))


def test_a_run_with_the_file_has_the_embeddings_of_a_run_with_the_classes(tmp_path, capsys):
    path = write(tmp_path / "new" / "text.npz", "classes=[wall,floor,chair]")
    assert "3 classes of width 16" in capsys.readouterr().out
    assert build_prior(compose("features=random"), dataset()).feature_names == tuple(dataset().classes)
    prior = build_prior(compose("features=random", f"features.text={path}"), dataset())
    live = build_prior(compose("features=random", "features.classes=[wall,floor,chair]"), dataset())
    assert prior.feature_names == live.feature_names == ("wall", "floor", "chair")
    np.testing.assert_array_equal(prior.text_features, live.text_features)
    chosen = build_prior(compose("features=random", f"features.text={path}", "features.classes=[chair]"), dataset())
    np.testing.assert_array_equal(chosen.text_features, live.text_features[2:])


def test_what_cannot_be_embedded_is_refused(tmp_path):
    with pytest.raises(ValueError, match="features=none has no text encoder"):
        write(tmp_path / "text.npz", "classes=[wall]", features="none")
    for classes in ("[]", "[wall,wall]"):
        with pytest.raises(ValueError, match="classes must name at least one class, each once"):
            write(tmp_path / "text.npz", f"classes={classes}")


def test_dinov2s_images_have_mapanythings_patches():
    image = instantiate(compose("features=dinov2_text", "features.checkpoint=x").features.image)
    assert (image.long_side, list(image.mean)) == (518, [0.485, 0.456, 0.406])
