"""Which images are matched; oracles: all pairs, and a search by brute force."""

import itertools

import numpy as np
import pycolmap
from stereo_scene import structure_config

from emgs_jax.loop_closure.place_recognition import train_words, vlad
from emgs_jax.structure.pairs import MAX_TRAINING, NUM_ITERATIONS, NUM_WORDS, choose_pairs, similar

NAMES = [f"{row:02d}.png" for row in range(24)]
SPARSE = ("prior.structure.max_exhaustive=10", "prior.structure.overlap=3")


def database_of(path, names=NAMES):
    """Two places in turn: the descriptors of an image are those of its place, and a few of its own."""
    rng = np.random.default_rng(0)
    places = rng.integers(0, 255, (6, 120, 128), np.uint8)
    database = pycolmap.Database.open(path)
    camera = database.write_camera(pycolmap.Camera.create_from_model_name(1, "SIMPLE_PINHOLE", 100.0, 160, 120))
    for row, name in enumerate(names):
        image = database.write_image(pycolmap.Image(name=name, camera_id=camera))
        found = np.concatenate([places[row % 6], rng.integers(0, 255, (40, 128), np.uint8)])
        kind = pycolmap.FeatureExtractorType.SIFT
        database.write_descriptors(image, pycolmap.FeatureDescriptors(kind, found))
    return database


def test_few_images_are_matched_each_with_each_and_those_without_features_with_none(tmp_path):
    with database_of(tmp_path / "a.db", NAMES[:9]) as database:
        found = choose_pairs(database, NAMES[:10], structure_config("prior.structure.max_exhaustive=9"))
    assert found == list(itertools.combinations(NAMES[:9], 2))


def test_many_are_matched_with_neighbours_powers_of_two_and_what_looks_alike(tmp_path):
    with database_of(tmp_path / "a.db") as database:
        alone = choose_pairs(database, NAMES, structure_config(*SPARSE, "prior.structure.num_similar=0"))
        found = choose_pairs(database, NAMES, structure_config(*SPARSE, "prior.structure.num_similar=2"))
    steps = {1, 2, 3, 4}  # 2 ** 2 is the last power of three neighbours
    expected = [(NAMES[a], NAMES[b]) for a, b in itertools.combinations(range(24), 2) if b - a in steps]
    assert alone == expected
    more = {(NAMES.index(a), NAMES.index(b)) for a, b in set(found) - set(alone)}
    assert more and all((b - a) % 6 == 0 for a, b in more), "images of the same place"
    assert {row for pair in more for row in pair} == set(range(24)) and found == sorted(set(found))


def test_what_looks_alike_is_what_a_search_of_all_finds():
    rng, config = np.random.default_rng(1), structure_config(*SPARSE)
    descriptors = [np.float32(rng.normal(size=(30, 16))) for _ in range(15)]
    descriptors = [one / np.linalg.norm(one, axis=1, keepdims=True) for one in descriptors] + [np.zeros((0, 16), "f")]
    words = train_words(np.concatenate(descriptors), (NUM_WORDS, MAX_TRAINING, NUM_ITERATIONS), config.seed)
    vectors, expected = [vlad(one, words) for one in descriptors], set()
    for a in range(16):
        likeness = sorted((-vectors[a] @ vectors[b], b) for b in range(16) if abs(a - b) > config.overlap)
        expected |= {(min(a, b), max(a, b)) for value, b in likeness[: config.num_similar] if value < 0}
    assert similar(descriptors, config) == expected
