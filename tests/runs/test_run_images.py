"""The images of a finished run, where they are gone."""

from types import SimpleNamespace

from omegaconf import OmegaConf

from emgs_jax.config.configure import compose
from emgs_jax.runs.images import images_of


def test_images_that_are_gone_are_said_and_stop_nothing(tmp_path):
    """Symptom: report, export and merge of a run ended in an error of Hydra once its images had moved."""
    words = "dataset=images", f"dataset.root={tmp_path}/gone", "dataset.intrinsics=[100,100,79.5,59.5]"
    settings = OmegaConf.to_container(compose(*words), resolve=True)
    dataset, note = images_of(SimpleNamespace(provenance={"config": settings}, poses=[None] * 3))
    assert dataset is None
    assert note.startswith(f"The images are not available: dataset.root={tmp_path}/gone does not exist")
