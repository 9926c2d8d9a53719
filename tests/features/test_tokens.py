"""CLIP's tokens; oracle: the tokenizer of `transformers` with the same vocabulary."""

import gzip

import numpy as np
import pytest

from emgs_jax.features.tokens import Tokenizer, byte_symbols

MERGES = ["t h", "th e</w>", "c h", "ch a", "cha i", "i n</w>", "a n", "e n", "p h", "o t", "ot o</w>", "ph oto</w>"]
TEXTS = ["a photo of a chair.", "There IS  a wall-chair, isn't it?", "über 12 ænä_chains 日本", ""]
TEXTS += ["Café", "12 m² Ⅷx¾", "à la e\u0301te\u0301 chair's"]  # composed or not; numbers that are no digits


@pytest.fixture
def vocabulary(tmp_path):
    path = tmp_path / "bpe.txt.gz"
    path.write_bytes(gzip.compress(("#version\n" + "\n".join([*MERGES, "x y", "y z"]) + "\n").encode()))
    return path


def test_tokens_are_those_of_transformers(vocabulary):
    transformers = pytest.importorskip("transformers", reason="the tokenizer of transformers is the oracle")
    pairs = [tuple(line.split()) for line in MERGES]
    symbols = byte_symbols()
    marks = ["<|startoftext|>", "<|endoftext|>"]
    names = [*symbols, *(s + "</w>" for s in symbols), *("".join(pair) for pair in pairs), *marks]
    numbers = {name: number for number, name in enumerate(names)}
    reference = transformers.CLIPTokenizer(vocab=numbers, merges=pairs)
    rows = Tokenizer(vocabulary, len(names), 40)(TEXTS)
    for row, text in zip(rows, TEXTS, strict=True):
        expected = reference(text)["input_ids"]
        assert row[: len(expected)].tolist() == expected and not row[len(expected) :].any()


def test_words_are_those_of_dino_txts_own_tokenizer(vocabulary):
    """As ftfy 6.3.1's fix_text and its expression of words make them; "x" alone merges with nothing here."""
    pytest.importorskip("tokenizers", reason="tokenizers reads texts: pip install -e .[features]")
    tokenizer = Tokenizer(vocabulary, 512 + len(MERGES) + 2, 40)
    same = {
        "Café’s": "café 's",
        "Cafe\u0301’s": "café 's",
        "12 m²": "1 2 m ²",
        "“big” don’t—stop": '" big " don \'t — stop',
    }
    for text, words in ({"xⅧ¾y": "x ⅷ ¾ y", "sofa_1": "sofa _ 1"} | same).items():
        np.testing.assert_array_equal(*tokenizer([text, words]))


def test_pairs_merge_in_the_order_of_the_vocabulary_and_a_long_text_is_cut_before_its_end_mark(vocabulary):
    pytest.importorskip("tokenizers", reason="tokenizers reads texts: pip install -e .[features]")
    number = 512 + len(MERGES)
    names = [*byte_symbols(), *(s + "</w>" for s in byte_symbols()), *MERGES]
    tokenizer = Tokenizer(vocabulary, number + 2, 6)
    assert [names[n] for n in tokenizer(["the photo"])[0, 1:3]] == ["th e</w>", "ph oto</w>"]
    row = tokenizer(["a " * 20])[0]
    assert row[0] == number and row[-1] == number + 1 and len(set(row[1:-1])) == 1
    with pytest.raises(ValueError, match="bpe.txt.gz must hold 100 pairs"):
        Tokenizer(vocabulary, 614, 8)
    vocabulary.write_bytes(vocabulary.read_bytes()[:-12])
    with pytest.raises(ValueError, match="bpe.txt.gz is no vocabulary of CLIP, or damaged"):
        Tokenizer(vocabulary, number + 2, 8)
