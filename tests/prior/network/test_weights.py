"""Weights that do not fit are refused, however little strict the framework is; huggingface_hub's own loader loads."""

import re

import pytest
from network_stand_in import DINOV2, WEIGHTS, clone, settings, write_checkpoint, write_weights

from emgs_jax.prior.network import loading
from emgs_jax.prior.network.torch_network import load_network


@pytest.fixture
def folder(framework, tmp_path):
    clone(tmp_path / "hub")
    return write_checkpoint(tmp_path / "weights", DINOV2)


@pytest.mark.parametrize(
    ("shapes", "text"),
    [
        ({"head__weight": (2, 3)}, "model.safetensors does not fit MapAnything, 2 missing (head.bias, same_head.bias)"),
        (
            {"body__weight": (2, 3), "head__bias": (2,)},
            "2 missing (head.weight, same_head.weight) and 1 that it does not have (body.weight): both files must be",
        ),
        (WEIGHTS | {"more": (1,)}, "1 that it does not have (more): both files must be of one download"),
        (WEIGHTS | {f"more_{n}": (1,) for n in range(5)}, "5 that it does not have (more_0, more_1, more_2, …)"),
        ({"head__weight": (2, 4), "head__bias": (2,)}, "1 of another shape (size mismatch for head.weight: "),
    ],
)
def test_weights_that_leave_a_parameter_random_are_refused_with_its_name(folder, shapes, text):
    """They were accepted: two runs predicted differently under one checksum."""
    write_weights(folder, **shapes)
    with pytest.raises(ValueError, match=re.escape(text)):
        load_network(settings(checkpoint=folder))


def test_one_of_the_two_names_of_a_tensor_is_enough(folder):
    write_weights(folder)
    load_network(settings(checkpoint=folder))


@pytest.mark.parametrize("content", [b"", b"version https://git-lfs.github.com/spec/v1\noid sha256:0\n"])
def test_a_file_that_is_none_is_named_with_the_remedy(folder, content):
    """Upstream says "header too large"."""
    (folder / "model.safetensors").write_bytes(content)
    with pytest.raises(ValueError, match="model.safetensors is no file of weights, or damaged .*: repeat hf download"):
        load_network(settings(checkpoint=folder))


def test_a_wrapper_may_leave_weights_aside_but_must_not_lack_any(framework, torch):
    """DUSt3R's wrapper loads MASt3R's file, which has more; both load without strictness."""
    _, model, models = framework
    own = {"weight": torch.zeros(1, 2), "bias": torch.zeros(1)}

    def make(state):
        def init(name, device):
            torch.nn.Linear(2, 1).load_state_dict(state, strict=False)
            return model

        return init

    models.init_model_from_config = make(own | {"head_local": torch.zeros(3)})
    load_network(settings("metric_dust3r"))
    models.init_model_from_config = make({"weight": torch.zeros(1, 2)})
    with pytest.raises(ValueError, match=r"the file of MASt3R, metric.* does not fit Linear, 1 missing \(bias\)"):
        load_network(settings("metric_dust3r"))


def test_strictness_ends_with_the_loading(torch):
    load = torch.nn.Module.load_state_dict
    with pytest.raises(RuntimeError), loading.whole_weights(torch, "file", "remedy"):
        assert torch.nn.Module.load_state_dict is not load
        raise RuntimeError
    assert torch.nn.Module.load_state_dict is load
