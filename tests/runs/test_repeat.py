"""The command that repeats a run; oracle: composing it gives the same config."""

import shlex
from functools import cache

import pytest
from omegaconf import OmegaConf

from emgs_jax.config.configure import compose
from emgs_jax.runs.repeat import check_targets, repeat

pytestmark = pytest.mark.slow


@cache
def composed(*words):
    return compose(*words)


def settings_of(*words):
    return OmegaConf.to_container(composed(*words), resolve=True)


@pytest.mark.parametrize(
    "words",
    [
        ("dataset=apartment", "dataset.walk=out_and_back", "prior.version=2", "graph=default", "graph.every=3"),
        ("dataset=images", r"dataset.root='a b/it\'s [1], $x'", "dataset.intrinsics=[1.5,2,3,4]", "prior.level=.5"),
        ("experiment=paper", "slam.em.max_log_gap=inf", "render.opacity=.7", "baseline=voxel"),
        ("slam.em.max_log_gap=inf", "slam.existence.refuted=-inf"),  # null, which is refused
    ],
    ids=["walk", "images", "paper", "infinite"],
)
def test_the_words_compose_the_same_config(words):
    settings = settings_of(*words)
    again = shlex.split(repeat(settings).command)
    assert again[:2] == ["emgs", "run"]
    assert settings_of(*again[2:]) == settings


def test_words_are_few_and_say_the_default_beside():
    settings = settings_of("dataset=apartment", "slam.em.max_log_gap=9.5", "render.opacity=.5")
    assert repeat(settings).words == ["dataset=apartment", "render.opacity=0.5", "slam.em.max_log_gap=9.5"]
    default = settings_of()
    assert repeat(settings).differences == [
        ("dataset", "apartment", "synthetic"),
        ("render.opacity", 0.5, default["render"]["opacity"]),
        ("slam.em.max_log_gap", 9.5, default["slam"]["em"]["max_log_gap"]),
    ]


def test_a_key_of_another_version_is_added():
    settings = settings_of()
    settings["slam"]["em"]["bygone"] = 3
    assert repeat(settings).words == ["+slam.em.bygone=3"]
    assert repeat(settings).differences == [("slam.em.bygone", 3, ...)]


def test_only_classes_that_conf_names_are_made():
    check_targets(settings_of()["dataset"])
    with pytest.raises(ValueError, match=r"os\.system.*which no file of conf/ does"):
        check_targets({"_target_": "emgs_jax.data.synthetic.Synthetic", "x": {"_target_": "os.system"}})
