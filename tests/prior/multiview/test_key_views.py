"""Which views stay when they leave the window, and what they are good for."""

from collections.abc import Sequence

import numpy as np
from stereo_scene import SIZE, calibration, matrix, projected, structure_config

from emgs_jax.prior.multiview.keys import KeyConfig, kept, key_views
from emgs_jax.prior.multiview.landmarks import NONE, Structure, View, forget, link, triangulate

WIDTH, NUM_POINTS = 100, 40


def shifted(*shifts: float) -> Structure:
    """Views that show the same landmarks, each so many pixels to the right."""
    views = {
        frame: View(
            np.column_stack([np.arange(NUM_POINTS) + shift, np.zeros(NUM_POINTS)]),
            np.zeros((NUM_POINTS, 128), np.float32),
            np.arange(NUM_POINTS),
            np.eye(4),
        )
        for frame, shift in enumerate(shifts)
    }
    return Structure(np.eye(3), views, np.ones((NUM_POINTS, 3)))


def stay(structure: Structure, views: Sequence[int], config: KeyConfig, width: int = WIDTH) -> list[int]:
    """The views that stay beside those of the window."""
    return kept(structure, key_views(structure, views, width, config), config)


def test_a_view_that_leaves_stays_where_it_is_far_from_the_key_before_it():
    structure = shifted(0, 4, 8, 11, 15, 22, 30, 31)
    assert stay(structure, (6, 7), KeyConfig(8, 0.1)) == [0, 3, 5]
    assert stay(structure, (0, 6, 7), KeyConfig(8, 0.1)) == [1, 4], "view 0 is in the window anyway"
    assert stay(structure, (6, 7), KeyConfig(0, 0.1)) == []
    structure = shifted(0, 10, 20, 30, 40)  # those go that share least with the newest view
    structure.views[1].landmark[5:] = -1
    assert stay(structure, (4,), KeyConfig(3, 0.1)) == [0, 2, 3]
    structure.views[1].landmark[:] = -1
    assert stay(structure, (4,), KeyConfig(4, 0.1)) == [0, 1, 2, 3], "nothing in common is far"
    structure.views[2].T_ref_view = None
    assert stay(structure, (4,), KeyConfig(4, 0.1)) == [0, 1, 3], "what is not placed is no key"


def seen_from(T: np.ndarray, points: np.ndarray, descriptors: np.ndarray) -> View:
    """A placed view of the points that are in the image."""
    pixels, depth = projected(T, points), (points - T[:3, 3]) @ T[:3, 2]
    inside = np.all((pixels >= 0) & (pixels < SIZE), axis=1) & (depth > 0)
    return View(pixels[inside], descriptors[inside], np.full(inside.sum(), NONE), T)


def test_a_camera_that_turns_back_shows_the_landmarks_of_a_key_again():
    turns = (0.0, 0.15, 0.3, 0.6, 0.9, 1.2, 0.6, 0.2)
    poses = np.stack([matrix((0.0, turn, 0.0), (turn, 0.0, 0.0)) for turn in turns])
    rng, config, known = np.random.default_rng(0), structure_config().matching, {}
    points, descriptors = rng.uniform((-2.0, -1.0, 1.0), (6.0, 1.0, 3.0), (600, 3)), rng.uniform(size=(600, 128))
    descriptors = np.float32(descriptors / np.linalg.norm(descriptors, axis=1, keepdims=True))
    for max_keys in (8, 0):
        structure = Structure(calibration())
        for frame, T in enumerate(poses):
            window = range(max(frame - 2, 0), frame + 1)
            stays = {*window, *stay(structure, window, KeyConfig(max_keys, 0.1), SIZE[0])}
            forget(structure, [one for one in structure.views if one not in stays], config)
            structure.views[frame] = seen_from(T, points, descriptors)
            link(structure, frame, config)
            triangulate(structure, structure.unknown(), config)
        last = structure.views[frame]
        first = structure.views.get(0, View(*3 * (np.zeros(0),)))
        known[max_keys] = np.isin(last.landmark[structure.known(last)], first.landmark).sum()
    assert known[8] > 20 and known[0] == 0
