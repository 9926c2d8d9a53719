"""Images alone of a corridor that repeats: what is placed is right, or it is not placed; oracle: the renderer."""

import numpy as np
import pytest
from look_alikes import FOCAL_PER_WIDTH, Corridor
from stereo_scene import similarity_error, structure_config

from emgs_jax.structure.mapping import find_models
from emgs_jax.structure.model import stem
from emgs_jax.structure.reconstruct import map_images
from emgs_jax.structure.shots import Shots

SIZE = 240, 180
pytestmark = pytest.mark.slow


def corridor(look):
    world = Corridor(look, 30, 0.2, SIZE)
    camera = (FOCAL_PER_WIDTH * SIZE[0], SIZE[0] / 2, SIZE[1] / 2, 0.0)
    names = [f"{row:03d}" for row in range(len(world))]
    return Shots(names, world.image, SIZE, ("SIMPLE_RADIAL", camera), True), world.T_world_camera[:, :3, 3]


def error(model, names, truth):
    """Relative to the path: root mean square error after the best Sim(3)."""
    images = sorted((image for image in model.images.values() if image.has_pose), key=lambda image: image.name)
    rows = [names.index(stem(image.name)) for image in images]
    path = np.linalg.norm(np.diff(truth[rows], axis=0), axis=1).sum()
    return similarity_error(np.array([image.projection_center() for image in images]), truth[rows]) / path


def test_doors_that_look_alike_are_not_taken_for_each_other(tmp_path):
    """One start with all pairs has all 30 images, and an error of 30 % of the path."""
    shots, truth = corridor("doors")
    config = structure_config()
    models, said, *_ = map_images(shots, config, tmp_path)
    assert models[0].num_reg_images() == 30 and error(models[0], shots.names, truth) < 0.01
    assert "begun 2 times" in said[0] and "without pairs far apart in time" in said[0]
    first = find_models(shots, config, tmp_path)
    assert error(first[0], shots.names, truth) > 0.1, "the case"


@pytest.mark.weekly
def test_of_white_tiles_what_is_placed_is_right_or_nothing_is(tmp_path):
    shots, truth = corridor("tiles")
    try:
        models, said, *_ = map_images(shots, structure_config(), tmp_path)
    except ValueError as refused:
        assert "finds no structure" in str(refused)
        return
    wrong = [model for model in models if error(model, shots.names, truth) > 0.03]
    assert len([words for words in said if "doubtful" in words]) >= len(wrong)
