"""Weights that do not fit are refused, however little strict the framework is; huggingface_hub's own loader loads."""

import re

import pytest
from network_stand_in import DINOV2, WEIGHTS, clone, settings, write_checkpoint, write_weights

from emgs_jax.prior.network import loading
from emgs_jax.prior.network.torch_network import load_network


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
        (b"", "model.safetensors is no file of weights, or damaged "),  # upstream says "header too large"
        (b"version https://git-lfs.github.com/spec/v1\noid sha256:0\n", "or damaged (Error while deserializing header"),
    ],
)
def test_weights_that_leave_a_parameter_random_or_are_none_are_refused_by_name(framework, tmp_path, shapes, text):
    """They were accepted: two runs predicted differently under one checksum. One of two names of a tensor is enough."""
    clone(tmp_path / "hub")
    folder = write_checkpoint(tmp_path / "weights", DINOV2)
    write_weights(folder)
    load_network(settings(checkpoint=folder))
    write_weights(folder, **shapes) if isinstance(shapes, dict) else (folder / "model.safetensors").write_bytes(shapes)
    with pytest.raises(ValueError, match=re.escape(text)) as error:
        load_network(settings(checkpoint=folder))
    assert "repeat hf download" in str(error.value)


def test_a_wrapper_may_leave_weights_aside_but_must_not_lack_any_and_strictness_ends_with_the_loading(framework, torch):
    """DUSt3R's wrapper loads MASt3R's file, which has more; both load without strictness."""
    _, model, models = framework
    own = {"weight": torch.zeros(1, 2), "bias": torch.zeros(1)}

    def make(state):
        def init(name, device):
            torch.nn.Linear(2, 1).load_state_dict(state, strict=False)
            return model

        return init

    load = torch.nn.Module.load_state_dict
    models.init_model_from_config = make(own | {"head_local": torch.zeros(3)})
    load_network(settings("metric_dust3r"))
    models.init_model_from_config = make({"weight": torch.zeros(1, 2)})
    with pytest.raises(ValueError, match=r"the file of MASt3R, metric.* does not fit Linear, 1 missing \(bias\)"):
        load_network(settings("metric_dust3r"))
    with pytest.raises(RuntimeError), loading.whole_weights(torch, "file", "remedy"):
        assert torch.nn.Module.load_state_dict is not load
        raise RuntimeError
    assert torch.nn.Module.load_state_dict is load
