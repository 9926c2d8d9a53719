"""The images of a finished run, where they are gone."""

from types import SimpleNamespace

import pytest
from omegaconf import OmegaConf

from emgs_jax.config.configure import compose
from emgs_jax.runs.images import images_of


@pytest.mark.parametrize(("root", "remedy"), [("/gone", "put them, or a link"), ("gone", "repeat this command")])
def test_images_that_are_gone_are_said_with_a_remedy_and_stop_nothing(root, remedy):
    """Symptom: report, export and merge of a run ended in an error of Hydra once its images had moved.

    Later: `emgs run images` named images that `emgs polish`, in another folder, did not find, and did not say why.
    """
    words = "dataset=images", f"dataset.root={root}", "dataset.intrinsics=[100,100,79.5,59.5]"
    settings = OmegaConf.to_container(compose(*words), resolve=True)
    dataset, note = images_of(SimpleNamespace(provenance={"config": settings}, poses=[None] * 3))
    assert dataset is None
    assert note.startswith(f"The images are not available: dataset.root={root} does not exist")
    assert remedy in note and note.endswith(".")
