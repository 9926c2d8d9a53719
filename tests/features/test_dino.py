"""The adapter on tiny random models of `transformers`: which token is which patch, which half is text, what fails."""

import hashlib
import shutil
from functools import cache

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="dino.txt runs in PyTorch")
transformers = pytest.importorskip("transformers", reason="the backbone is one of transformers")

from safetensors.torch import load_file, save_file  # noqa: E402
from tiny_dino import DIM, NUM_HEADS, NUM_TOKENS, dinov2, dinov3, random_text_encoder, write_checkpoint  # noqa: E402

from emgs_jax.data.base import Frame  # noqa: E402
from emgs_jax.features.base import FeatureModel  # noqa: E402
from emgs_jax.features.dino import DinoText, patch_grid  # noqa: E402
from emgs_jax.features.dinotxt import text_tower, vision_head  # noqa: E402
from emgs_jax.features.images import ImageConfig, network_input  # noqa: E402
from emgs_jax.features.text import save_text  # noqa: E402
from emgs_jax.features.tokens import Tokenizer  # noqa: E402

pytestmark = pytest.mark.slow

KINDS = {"dinov3_text": (dinov3, True, 16), "dinov2_text": (dinov2, False, 14)}
MEAN, STD = [0.485, 0.456, 0.406], [0.229, 0.224, 0.225]
PLAIN = np.full((60, 100, 3), 90, np.uint8)
both = pytest.mark.parametrize("kind", KINDS)


@pytest.fixture(scope="session")
def written(tmp_path_factory):
    """Folder and files of a checkpoint, which is written once."""

    @cache
    def of(kind):
        folder, (backbone, is_one_file, _) = tmp_path_factory.mktemp(kind), KINDS[kind]
        return folder, write_checkpoint(folder, backbone(), is_one_file)

    return of


@pytest.fixture
def checkpoint(written, tmp_path):
    """The same in a folder that the test may change."""

    def copied(kind):
        folder, files = written(kind)
        shutil.copytree(folder, tmp_path, dirs_exist_ok=True)
        return tmp_path, files

    return copied


def make(folder, files, kind="dinov2_text", classes=("wall", "chair"), text=None, device="cpu"):
    """The model on a checkpoint; 5x3 patches for an image of 100x60."""
    image = ImageConfig(5 * KINDS[kind][2], MEAN, STD)
    return DinoText(kind, str(folder), files, 4, image, NUM_HEADS, device, classes, ("a {}.", "the {}."), text)


def extract(model, image=PLAIN):
    return model.extract(Frame(0, 0.0, "", image))


@both
def test_a_patch_is_the_cell_of_its_row_and_column(checkpoint, kind):
    """What blocks add is multiplied by zero, so that a patch is nothing but its own embedding."""
    folder, files = checkpoint(kind)
    backbone = KINDS[kind][0]()
    with torch.no_grad():
        for name, value in backbone.named_parameters():
            if "lambda1" in name:
                value.zero_()
    backbone.save_pretrained(folder, safe_serialization=True)
    state = torch.load(folder / files.vision_head, weights_only=True)
    torch.save({n: 0 * v if n.endswith("gamma") else v for n, v in state.items()}, folder / files.vision_head)
    model, marked = make(folder, files, kind), PLAIN.copy()
    assert isinstance(model, FeatureModel)
    marked[20:40, 60:80] = 200, 40, 10
    differs = np.zeros((3, 5), bool)
    differs[1, 3] = True
    np.testing.assert_array_equal((extract(model) != extract(model, marked)).any(axis=-1), differs)


@both
def test_features_are_the_unit_tokens_of_the_head_on_the_backbones(written, kind):
    folder, files = written(kind)
    patch, state = KINDS[kind][2], torch.load(folder / files.vision_head, weights_only=True)
    head = {name.removeprefix("visual_model.head.").replace("block_list.", "blocks."): v for name, v in state.items()}
    image = np.random.default_rng(0).integers(0, 256, PLAIN.shape, np.uint8)
    values = network_input(image, (5, 3), patch, ImageConfig(5 * patch, MEAN, STD))
    with torch.inference_mode():
        states = KINDS[kind][0]()(torch.from_numpy(values)[None]).last_hidden_state
        assert states.shape[1] == 1 + 4 + 15  # class token, registers, patches
        expected = vision_head(states, head, NUM_HEADS)[0, 5:].reshape(3, 5, DIM)
    expected = torch.nn.functional.normalize(expected, dim=-1)
    features = extract(make(folder, files, kind), image)
    assert features.dtype == np.float16
    np.testing.assert_allclose(features, expected.numpy(), atol=1e-3)  # float16


def test_class_and_register_tokens_are_left_out():
    patches = torch.eye(6)
    tokens = torch.cat([torch.full((5, 6), 7.0), 3 * patches])[None]
    torch.testing.assert_close(patch_grid(tokens, (3, 2)), patches.reshape(2, 3, 6))


@both
def test_text_is_the_second_half_of_the_encoders_vector_averaged_over_the_templates(written, kind):
    folder, files = written(kind)
    model, weights = make(folder, files, kind), random_text_encoder(12, NUM_TOKENS, 10, 2 * DIM)
    prompts = Tokenizer(folder / "bpe.txt.gz", NUM_TOKENS, 10)(["a chair.", "the chair."])
    vectors = text_tower(torch.from_numpy(prompts), weights, NUM_HEADS).numpy()[:, DIM:]
    mean = (vectors / np.linalg.norm(vectors, axis=1, keepdims=True)).mean(axis=0)
    assert model.text.names == ("wall", "chair") and model.text.vectors.shape == (2, DIM)
    np.testing.assert_allclose(model.text.vectors[1], mean / np.linalg.norm(mean), atol=1e-5)
    content = (folder / "model.safetensors").read_bytes()
    assert model.settings["backbone"] == hashlib.sha256(content).hexdigest()
    assert model.settings["image"] == {"long_side": 5 * KINDS[kind][2], "mean": MEAN, "std": STD}


@both
def test_a_file_of_embeddings_replaces_text_encoder_and_vocabulary_of_the_same_checkpoint_only(checkpoint, kind):
    folder, files = checkpoint(kind)
    path, live = folder / "text.npz", make(folder, files, kind)
    save_text(path, live.embed(("chair", "wall")))
    expected = live.text.vectors
    for name in {"text.pth", "bpe.txt.gz"} & {path.name for path in folder.iterdir()}:
        (folder / name).unlink()
    replay = make(folder, files, kind, text=str(path))
    assert set(replay.settings) == {"backbone", "image"} and replay.text.names == ("wall", "chair")
    np.testing.assert_array_equal(replay.text.vectors, expected)
    assert make(folder, files, kind, (), str(path)).text.names == ("chair", "wall")
    assert make(folder, files, kind, ()).text.vectors.shape == (0, DIM)  # features without any class
    head = folder / files.vision_head
    torch.save({name: 2 * value for name, value in torch.load(head, weights_only=True).items()}, head)
    with pytest.raises(ValueError, match="text.npz was embedded by .*vision_head.*but the features are of"):
        _ = make(folder, files, kind, text=str(path)).text


def test_what_is_not_there_is_named_with_what_to_install_or_fetch(checkpoint, monkeypatch):
    folder, files = checkpoint("dinov3_text")
    model = make(folder, files, "dinov3_text")
    for path in folder.iterdir():
        path.unlink()
    with pytest.raises(ValueError, match="lacks config.json, model.safetensors, dinotxt.pth, bpe.txt.gz.*the tests"):
        _ = model.settings
    with pytest.raises(ValueError, match="lacks dinotxt.pth, bpe.txt.gz"):
        model.embed(("wall",))
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(ValueError, match=r"needs torch and transformers: pip install 'emgs_jax\[features\]'"):
        make(folder, "unread", "dinov3_text")


class Runs:
    """Weights that would run code."""

    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return (self.path.touch, ())


def test_damaged_and_foreign_weights_are_refused(checkpoint):
    folder, files = checkpoint("dinov2_text")
    model, head, weights = make(folder, files), folder / "head.pth", folder / "model.safetensors"
    whole, tensors = head.read_bytes(), load_file(weights)
    name = sorted(tensors)[3]

    def refused(message):
        with pytest.raises(ValueError, match=message):
            extract(model)

    head.write_bytes(whole[: len(whole) // 2])
    refused("head.pth is no file of weights, or damaged")
    torch.save({"ln_final.weight": Runs(folder / "ran")}, head)
    refused("head.pth is no file of weights")
    assert not (folder / "ran").exists()
    head.write_bytes((folder / "text.pth").read_bytes())
    refused("head.pth has no visual_model.head.ln_final.weight")
    head.write_bytes(whole)
    # transformers fills what is missing with random numbers, and only the width was compared.
    save_file({key: value for key, value in tensors.items() if key != name}, weights, {"format": "pt"})
    refused(rf"model.safetensors does not fit .*config.json, 1 missing \({name}\): fetch")
    save_file(tensors | {"encoder.more": torch.zeros(2)}, weights, {"format": "pt"})
    refused(r"1 that it does not have \(encoder.more\)")
    weights.write_bytes(weights.read_bytes()[:2000])
    refused("holds no backbone that can be read .*: fetch config.json .*, from the tests")
    dinov2(dim=8).save_pretrained(folder, safe_serialization=True)
    refused("is for a backbone with 16 channels, the one in .* has 8")
    config = transformers.Dinov2Config(
        hidden_size=DIM, num_hidden_layers=2, num_attention_heads=NUM_HEADS, mlp_ratio=2, patch_size=14, image_size=56
    )
    transformers.Dinov2Model(config).save_pretrained(folder, safe_serialization=True)
    refused("is for a backbone with 4 registers, the one in .* has 0: take the backbone")


def test_a_package_of_another_pytorch_is_named_instead_of_the_files(written, tmp_path, monkeypatch):
    """torchaudio comes with uniception; transformers imports it where it is there and then cannot import its models."""
    (tmp_path / "torchaudio.py").write_text('raise OSError("libcudart.so.13: cannot open shared object file")')
    monkeypatch.syspath_prepend(tmp_path)

    def fail(*arguments, **options):
        raise ModuleNotFoundError("Could not import module 'Dinov2WithRegistersModel'")

    monkeypatch.setattr(transformers.AutoModel, "from_pretrained", fail)
    with pytest.raises(ValueError, match=r"torchaudio .*does not fit torch .*libcudart.*pip uninstall torchaudio"):
        extract(make(*written("dinov2_text")))


def test_a_cpu_that_nobody_asked_for_is_mentioned_and_a_gpu_without_memory_says_what_to_lower(
    written, monkeypatch, capsys
):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    folder, files = written("dinov2_text")
    model = make(folder, files)
    assert "finds no GPU" not in capsys.readouterr().err
    make(folder, None, device=None)
    assert "finds no GPU, so features=dinov2_text runs on the CPU" in capsys.readouterr().err

    def full(self, *arguments, **options):
        raise torch.cuda.OutOfMemoryError("CUDA out of memory")

    monkeypatch.setattr(transformers.Dinov2WithRegistersModel, "forward", full)
    with pytest.raises(
        ValueError, match="no memory for 5x3 patches: lower features.image.long_side=70 or set features"
    ):
        extract(model)
