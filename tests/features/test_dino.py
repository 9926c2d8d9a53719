"""The adapter on tiny random models of `transformers`: which token is which patch, which half is text, what fails."""

import hashlib

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

KINDS = {"dinov3_text": (dinov3, True, 16), "dinov2_text": (dinov2, False, 14)}
MEAN, STD = [0.485, 0.456, 0.406], [0.229, 0.224, 0.225]


def as_frame(image):
    return Frame(0, 0.0, "", image)


@pytest.fixture(params=KINDS)
def kind(request):
    return request.param


def write(folder, kind):
    """A checkpoint in the folder."""
    backbone, is_one_file, _ = KINDS[kind]
    return write_checkpoint(folder, backbone(), is_one_file)


def make(folder, kind, files=None, classes=("wall", "chair"), text=None):
    """The model on a checkpoint, which is written first; 5x3 patches for an image of 100x60."""
    image = ImageConfig(5 * KINDS[kind][2], MEAN, STD)
    files = files or write(folder, kind)
    return DinoText(kind, str(folder), files, 4, image, NUM_HEADS, "cpu", classes, ("a {}.", "the {}."), text)


def images():
    """A uniform image, and the same with another colour in the patch of row 1 and column 3."""
    plain = np.full((60, 100, 3), 90, np.uint8)
    marked = plain.copy()
    marked[20:40, 60:80] = 200, 40, 10
    return plain, marked


def local(model):
    """The model with nothing but the embedding of each patch: what its blocks add is multiplied by zero."""
    backbone, head = model._vision
    with torch.no_grad():
        for name, value in backbone.named_parameters():
            if "lambda1" in name:
                value.zero_()
    for name, value in head.items():
        if name.endswith("gamma"):
            value.zero_()
    return model


def test_a_patch_is_the_cell_of_its_row_and_column(tmp_path, kind):
    model = local(make(tmp_path, kind))
    assert isinstance(model, FeatureModel)
    plain, marked = (model.extract(as_frame(image)) for image in images())
    differs = np.zeros((3, 5), bool)
    differs[1, 3] = True
    np.testing.assert_array_equal((plain != marked).any(axis=-1), differs)


def test_features_are_the_unit_tokens_of_the_head_on_the_backbones(tmp_path, kind):
    model, (_, image) = make(tmp_path, kind), images()
    backbone, head = model._vision
    patch = KINDS[kind][2]
    values = network_input(image, (5, 3), patch, ImageConfig(5 * patch, MEAN, STD))
    with torch.inference_mode():
        states = KINDS[kind][0]()(torch.from_numpy(values)[None]).last_hidden_state
        assert states.shape[1] == 1 + 4 + 15  # class token, registers, patches
        expected = vision_head(states, head, NUM_HEADS)[0, 5:].reshape(3, 5, DIM)
    expected = torch.nn.functional.normalize(expected, dim=-1)
    features = model.extract(as_frame(image))
    assert features.dtype == np.float16
    np.testing.assert_allclose(features, expected.numpy(), atol=1e-3)  # float16


def test_class_and_register_tokens_are_left_out():
    patches = torch.eye(6)
    tokens = torch.cat([torch.full((5, 6), 7.0), 3 * patches])[None]
    torch.testing.assert_close(patch_grid(tokens, (3, 2)), patches.reshape(2, 3, 6))


def test_text_is_the_second_half_of_the_encoders_vector_averaged_over_the_templates(tmp_path, kind):
    model = make(tmp_path, kind)
    weights = random_text_encoder(12, NUM_TOKENS, 10, 2 * DIM)
    prompts = Tokenizer(tmp_path / "bpe.txt.gz", NUM_TOKENS, 10)(["a chair.", "the chair."])
    vectors = text_tower(torch.from_numpy(prompts), weights, NUM_HEADS).numpy()[:, DIM:]
    mean = (vectors / np.linalg.norm(vectors, axis=1, keepdims=True)).mean(axis=0)
    assert model.text.names == ("wall", "chair") and model.text.vectors.shape == (2, DIM)
    np.testing.assert_allclose(model.text.vectors[1], mean / np.linalg.norm(mean), atol=1e-5)


def test_a_file_of_embeddings_replaces_text_encoder_and_vocabulary(tmp_path):
    files, path = write(tmp_path, "dinov2_text"), tmp_path / "text.npz"
    live = make(tmp_path, "dinov2_text", files)
    save_text(path, live.embed(("chair", "wall")))
    expected = live.text.vectors
    for name in ("text.pth", "bpe.txt.gz"):
        (tmp_path / name).unlink()
    replay = make(tmp_path, "dinov2_text", files, text=str(path))
    assert set(replay.settings) == {"backbone", "image"}
    assert replay.text.names == ("wall", "chair")
    np.testing.assert_array_equal(replay.text.vectors, expected)
    assert make(tmp_path, "dinov2_text", files, (), str(path)).text.names == ("chair", "wall")
    assert make(tmp_path, "dinov2_text", files, ()).text.vectors.shape == (0, DIM)  # features without any class


def test_settings_tell_the_backbone_by_its_content(tmp_path):
    files = write(tmp_path, "dinov3_text")
    settings = make(tmp_path, "dinov3_text", files).settings
    content = (tmp_path / "model.safetensors").read_bytes()
    assert settings["backbone"] == hashlib.sha256(content).hexdigest()
    assert settings["image"] == {"long_side": 80, "mean": MEAN, "std": STD}


def test_embeddings_of_another_checkpoint_are_refused(tmp_path, kind):
    files, path = write(tmp_path, kind), tmp_path / "text.npz"
    save_text(path, make(tmp_path, kind, files).embed(("wall",)))
    head = tmp_path / files.vision_head
    torch.save({name: 2 * value for name, value in torch.load(head, weights_only=True).items()}, head)
    with pytest.raises(ValueError, match="text.npz was embedded by .*vision_head.*but the features are of"):
        _ = make(tmp_path, kind, files, text=str(path)).text


def test_without_pytorch_the_message_says_which_extra_to_install(tmp_path, monkeypatch):
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(ValueError, match=r"needs torch and transformers: pip install 'emgs_jax\[features\]'"):
        make(tmp_path, "dinov3_text", files="unread")


def test_a_folder_without_its_files_names_them_all(tmp_path):
    model = make(tmp_path, "dinov3_text")
    for path in tmp_path.iterdir():
        path.unlink()
    with pytest.raises(ValueError, match="lacks config.json, model.safetensors, dinotxt.pth, bpe.txt.gz.*the tests"):
        _ = model.settings
    with pytest.raises(ValueError, match="lacks dinotxt.pth, bpe.txt.gz"):
        model.embed(("wall",))


def test_damaged_and_foreign_weights_are_refused(tmp_path):
    model = make(tmp_path, "dinov2_text")
    head = (tmp_path / "head.pth").read_bytes()
    (tmp_path / "head.pth").write_bytes(head[: len(head) // 2])
    with pytest.raises(ValueError, match="head.pth is no file of weights, or damaged"):
        model.extract(as_frame(images()[0]))
    (tmp_path / "head.pth").write_bytes((tmp_path / "text.pth").read_bytes())
    with pytest.raises(ValueError, match="head.pth has no visual_model.head.ln_final.weight"):
        model.extract(as_frame(images()[0]))
    (tmp_path / "head.pth").write_bytes(head)
    weights = (tmp_path / "model.safetensors").read_bytes()
    (tmp_path / "model.safetensors").write_bytes(weights[: len(weights) // 2])
    with pytest.raises(ValueError, match="holds no backbone that can be read .*: fetch config.json .*, from the tests"):
        model.extract(as_frame(images()[0]))
    dinov2(dim=8).save_pretrained(tmp_path, safe_serialization=True)
    with pytest.raises(ValueError, match="is for a backbone of width 16, the one in .* has 8"):
        model.extract(as_frame(images()[0]))


def test_a_backbone_whose_weights_are_not_exactly_its_own_is_refused_with_the_names(tmp_path):
    """transformers fills what is missing with random numbers, and only the width was compared."""
    model, path = make(tmp_path, "dinov2_text"), tmp_path / "model.safetensors"
    tensors = load_file(path)
    name = sorted(tensors)[3]
    save_file({key: value for key, value in tensors.items() if key != name}, path, {"format": "pt"})
    with pytest.raises(ValueError, match=rf"model.safetensors does not fit .*config.json, 1 missing \({name}\): fetch"):
        model.extract(as_frame(images()[0]))
    save_file(tensors | {"encoder.more": torch.zeros(2)}, path, {"format": "pt"})
    with pytest.raises(ValueError, match=r"1 that it does not have \(encoder.more\)"):
        model.extract(as_frame(images()[0]))


def test_a_backbone_without_registers_is_refused(tmp_path):
    model = make(tmp_path, "dinov2_text")
    config = transformers.Dinov2Config(
        hidden_size=DIM, num_hidden_layers=2, num_attention_heads=NUM_HEADS, mlp_ratio=2, patch_size=14, image_size=56
    )
    transformers.Dinov2Model(config).save_pretrained(tmp_path, safe_serialization=True)
    with pytest.raises(ValueError, match="is for a backbone with 4 registers, the one in .* has 0: take the backbone"):
        model.extract(as_frame(images()[0]))


def test_a_package_of_another_pytorch_is_named_instead_of_the_files(tmp_path, monkeypatch):
    """torchaudio comes with uniception; transformers imports it where it is there and then cannot import its models."""
    model = make(tmp_path, "dinov2_text")
    (tmp_path / "site").mkdir()
    cause = 'raise OSError("libcudart.so.13: cannot open shared object file")'
    (tmp_path / "site" / "torchaudio.py").write_text(cause)
    monkeypatch.syspath_prepend(tmp_path / "site")

    def fail(*arguments, **options):
        raise ModuleNotFoundError("Could not import module 'Dinov2WithRegistersModel'")

    monkeypatch.setattr(transformers.AutoModel, "from_pretrained", fail)
    with pytest.raises(ValueError, match=r"torchaudio .*does not fit torch .*libcudart.*pip uninstall torchaudio"):
        model.extract(as_frame(images()[0]))


def test_a_cpu_that_nobody_asked_for_is_mentioned(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    make(tmp_path, "dinov2_text")
    assert "finds no GPU" not in capsys.readouterr().err
    image = ImageConfig(70, MEAN, STD)
    DinoText("dinov2_text", str(tmp_path), None, 4, image, NUM_HEADS, None, (), ("a {}.",), None)
    assert "finds no GPU, so features=dinov2_text runs on the CPU" in capsys.readouterr().err


def test_weights_that_would_run_code_are_refused(tmp_path):
    model = make(tmp_path, "dinov2_text")

    class Runs:
        def __reduce__(self):
            return (tmp_path.joinpath("ran").touch, ())

    torch.save({"ln_final.weight": Runs()}, tmp_path / "head.pth")
    with pytest.raises(ValueError, match="head.pth is no file of weights"):
        model.extract(as_frame(images()[0]))
    assert not (tmp_path / "ran").exists()


def test_a_gpu_without_memory_says_what_to_lower(tmp_path):
    class Full:
        config = dinov3().config

        def __call__(self, values):
            raise torch.cuda.OutOfMemoryError("CUDA out of memory")

    model = make(tmp_path, "dinov3_text")
    model.__dict__["_vision"] = Full(), {}
    with pytest.raises(
        ValueError, match="no memory for 5x3 patches: lower features.image.long_side=80 or set features"
    ):
        model.extract(as_frame(images()[0]))
