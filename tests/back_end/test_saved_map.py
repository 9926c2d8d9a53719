"""places.npz and the folders that hold it: what comes back is what was there, and what cannot be used is refused."""

import json
from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest
from loop_scene import keyframe, matrix, room
from scene import random_gaussians
from test_back_end import changed, loop, ring, walked

from emgs_jax import load_config, save_map
from emgs_jax.back_end.optimization import nodes_of
from emgs_jax.back_end.saved_map import load_places, load_saved_map, save_places
from emgs_jax.back_end.state import BackEnd
from emgs_jax.gaussian_map import new_map
from emgs_jax.loop_closure.place_recognition import Database, add_keyframe

CAMERA = (300.0, 300.0, 160.0, 120.0)


@pytest.fixture(scope="module")
def graph():
    return load_config(
        "graph=default", "graph.place_recognition.grid=[8,6]"
    ).graph  # as the keyframes of the scene have it


@pytest.fixture(scope="module")
def end(graph) -> BackEnd:
    """A walk with keyframes of every tenth node and loops of each kind."""
    poses = ring()
    database = Database()
    for frame in range(0, len(poses), 10):
        one = keyframe(room(), matrix((0, frame / 10, 0)), frame)
        database = add_keyframe(database, one, graph.place_recognition)
    return replace(
        changed(walked(graph, poses), is_placed=[row != 7 for row in range(len(poses))]),
        database=database,
        verified=[loop(poses), loop(poses, 2)],
        violating=[loop(poses, 3)],
        accepted=[loop(poses)],
    )


@pytest.fixture
def folder(end, tmp_path):
    save_places(tmp_path / "places.npz", end, 0.01)
    save_map(tmp_path / "map.npz", map_born(19))
    (tmp_path / "metrics.json").write_text("{}")
    return tmp_path


def map_born(node: int):
    return new_map(random_gaussians(20), jnp.ones(20), jnp.ones(()), jnp.asarray(node, jnp.int32))


def load(folder, graph, mode="extend"):
    return load_saved_map(str(folder), mode, graph, CAMERA, 0.01)


def rewritten(folder, **changes):
    """The file with other arrays, or other words in its header."""
    with np.load(folder / "places.npz") as file:
        arrays = dict(file)
    header = json.loads(str(arrays["__header__"]))
    header |= {key: value for key, value in changes.items() if key in header}
    arrays |= {key: value for key, value in changes.items() if key in arrays}
    np.savez(folder / "places.npz", **arrays | {"__header__": np.array(json.dumps(header))})


def test_what_is_read_is_what_was_written(end, graph, folder):
    read, depth_noise = load_places(folder / "places.npz", BackEnd(graph, CAMERA, 0.01))
    assert depth_noise == 0.01
    unsaved = {"online": None, "origin": None, "predicted": None}
    _same(*([replace(node, **unsaved) for node in one.nodes] for one in (read, end)))
    for name in ("factors", "verified", "violating", "accepted"):
        _same(getattr(read, name), getattr(end, name))
    assert (read.first_node, read.connected_since) == (len(end.poses), len(end.poses))
    np.testing.assert_array_equal(read.database.words, end.database.words)
    np.testing.assert_array_equal(read.database.vectors, end.database.vectors)
    assert read.database.num_trained == end.database.num_trained
    assert read.has_one_unit
    _same(read.database.keyframes, end.database.keyframes)


def _same(records, others) -> None:
    """Every field of every record, to the bit."""
    fields = lambda record: record if isinstance(record, tuple) else vars(record).values()  # noqa: E731
    for one, other in zip(records, others, strict=True):
        for value, expected in zip(fields(one), fields(other), strict=True):
            np.testing.assert_array_equal(value, expected)
    assert len(records) > 0


def test_a_run_without_loops_and_of_several_units_comes_back_too(graph, end, tmp_path):
    database = add_keyframe(Database(), end.database.keyframes[0], graph.place_recognition)
    plain = replace(walked(graph, ring()), has_one_unit=False, database=database)
    save_places(tmp_path / "places.npz", plain, 0.0)
    read, _ = load_places(tmp_path / "places.npz", BackEnd(graph, CAMERA, 0.01))
    assert read.accepted == [] and len(read.factors) == len(plain.factors) and not read.has_one_unit


def test_what_was_left_out_of_the_map_is_no_part_of_it_when_it_is_loaded_either(graph, end, tmp_path):
    """Symptom: the kept part was not the first, all its measurements were held by a node that nothing joined with it,
    and no loop ever moved anything again."""
    parted = walked(graph, ring())
    database = add_keyframe(Database(), end.database.keyframes[1], graph.place_recognition)
    nodes = [replace(node, submap=0 if row < 3 else 4) for row, node in enumerate(parted.nodes)]
    parted = replace(parted, nodes=nodes, active=4, database=database)
    save_places(tmp_path / "places.npz", parted, 0.0)
    read, _ = load_places(tmp_path / "places.npz", BackEnd(graph, CAMERA, 0.01))
    np.testing.assert_array_equal(nodes_of(read, read.active).valid, nodes_of(parted, parted.active).valid)
    with np.load(tmp_path / "places.npz") as file:
        arrays = {name: array for name, array in file.items() if name != "is_kept"}  # as of a version before
    np.savez(tmp_path / "places.npz", **arrays)
    before, _ = load_places(tmp_path / "places.npz", BackEnd(graph, CAMERA, 0.01))
    assert {node.submap for node in before.nodes} == {0}


def test_a_map_that_was_made_again_is_another_one(folder, graph):
    first = load(folder, graph).checksum
    assert load(folder, graph).checksum == first
    save_map(folder / "map.npz", map_born(18))
    assert load(folder, graph).checksum != first


def test_a_folder_is_loaded_with_its_next_node_as_the_first(graph, folder, end):
    saved = load(folder, graph, "localize")
    assert saved.is_frozen and saved.count == 20 and saved.depth_noise == 0.01
    assert saved.back_end.first_node == len(end.poses) and not load(folder, graph).is_frozen
    assert load_saved_map(None, "extend", None, CAMERA, 0.01) is None


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"version": 99}, "version is 99"),
        ({"descriptors": "orb"}, "descriptors is 'orb', this code reads 'rootsift'"),
        ({"format": "other"}, "format is 'other'"),
        ({"poses": np.full((60, 4, 4), np.nan)}, "poses is not finite"),
        ({"log_scales": np.zeros(3)}, "60 nodes have 3 scales"),
        ({"edges.a": np.full(1, 99)}, "edges.a is no node"),
        ({"words": np.zeros((4, 3), np.float32)}, "words have shape"),
        ({"keyframes.frame": np.array([5, 4, 3, 2, 1, 0])}, "keyframes are not nodes in their order"),
        ({"keyframes.pixels": np.zeros((1, 2), np.float32)}, "keyframes.pixels have shape"),
    ],
)
def test_a_file_that_cannot_be_used_is_named_with_the_reason(graph, folder, changes, message):
    rewritten(folder, **changes)
    with pytest.raises(ValueError, match=message) as error:
        load(folder, graph)
    assert "places.npz" in str(error.value) and "map again with graph=default" in str(error.value)


def test_keyframes_of_other_grids_are_written_on_that_of_the_first(graph, end, tmp_path):
    """Symptom: merged runs of other `graph.place_recognition.grid` ended in an error of NumPy."""
    first, *others = end.database.keyframes
    finer = [replace(one, depths=np.repeat(np.repeat(one.depths, 2, 0), 2, 1)) for one in others]
    mixed = replace(end, database=replace(end.database, keyframes=(first, *finer)))
    save_places(tmp_path / "places.npz", mixed, 0.02)
    found, _ = load_places(tmp_path / "places.npz", BackEnd(graph, CAMERA, 0.01))
    for one, before in zip(found.database.keyframes, (first, *others), strict=True):
        np.testing.assert_allclose(one.depths, before.depths, rtol=1e-6)
