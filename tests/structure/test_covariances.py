"""Covariances of large models in stretches; oracle: those of the model as a whole."""

from itertools import pairwise

import numpy as np
import pycolmap
import pytest

from emgs_jax.structure import uncertainty
from emgs_jax.structure.uncertainty import covariances

NUM, FOCAL, SIZE = 48, 100.0, (160, 120)


@pytest.fixture(scope="module")
def walk(tmp_path_factory):
    """Along a wall of bumps, of which every point is seen from some ten places: exact, each image with its points."""
    folder, rng = tmp_path_factory.mktemp("walk"), np.random.default_rng(0)
    points = rng.uniform((-2, -1, 2), (12, 1, 3), (1500, 3))
    seen, tracks = [[] for _ in range(NUM)], [[] for _ in points]
    x, y, z = (points[:, None] - np.arange(NUM)[:, None] * (0.2, 0, 0)).transpose(2, 1, 0)
    us, vs = FOCAL * x / z + SIZE[0] / 2, FOCAL * y / z + SIZE[1] / 2
    is_inside = (us > 0) & (us < SIZE[0]) & (vs > 0) & (vs < SIZE[1])
    for image, (u, v) in enumerate(zip(us, vs, strict=True)):
        for key in np.flatnonzero(is_inside[image] & (is_inside.sum(0) > 1)):
            tracks[key].append(f"{image + 1} {len(seen[image])}")
            seen[image].append(f"{u[key]:.9g} {v[key]:.9g} {key + 1}")
    lines = [
        f"{image + 1} 1 0 0 0 {-0.2 * image:.9g} 0 0 1 {image:03d}.png\n{' '.join(seen[image])}" for image in range(NUM)
    ]
    (folder / "cameras.txt").write_text(f"1 PINHOLE {SIZE[0]} {SIZE[1]} {FOCAL} {FOCAL} {SIZE[0] / 2} {SIZE[1] / 2}\n")
    (folder / "images.txt").write_text("\n".join(lines) + "\n")
    known = [(key, track) for key, track in enumerate(tracks) if len(track) > 1]
    (folder / "points3D.txt").write_text(
        "\n".join(f"{key + 1} {' '.join(map(str, points[key]))} 0 0 0 0 {' '.join(track)}" for key, track in known)
    )
    return pycolmap.Reconstruction(folder)


def in_use(model, step):
    images = sorted(model.images.values(), key=lambda image: image.name)
    return dict(enumerate(images[::step]))


@pytest.mark.parametrize(("step", "most"), [(1, 24), (2, 24), (2, 14)])
def test_covariances_of_stretches_are_about_those_of_the_whole(walk, monkeypatch, step, most):
    images = in_use(walk, step)
    whole = covariances(walk, images, 1.0)
    monkeypatch.setattr(uncertainty, "STRETCH", 18 if step == 1 else 12)
    monkeypatch.setattr(uncertainty, "OVERLAP", 8 if step == 1 else 6)
    monkeypatch.setattr(uncertainty, "MOST", most)
    parts, real = [], uncertainty._part
    monkeypatch.setattr(uncertainty, "_part", lambda *given: parts.append(real(*given)) or parts[-1])
    found = covariances(walk, images, 1.0)
    assert found.keys() == whole.keys() == images.keys()
    assert len(parts) > 1 and max(part.num_reg_images() for part in parts) <= most
    std = {frame: np.sqrt(np.diag(found[frame]) / np.diag(whole[frame])) for frame in images if frame}
    assert min(one.min() for one in std.values()) > 0.94  # a stretch has its own unit
    assert max(one.max() for one in std.values()) < (1.06 if most > 14 else 1.3)  # fewer images know less
    assert not found[0].any()


def test_a_frame_is_judged_by_what_is_on_both_sides_of_it(walk, monkeypatch):
    """The first frames of a stretch are of the stretch before: its own would be held, and so without error."""
    monkeypatch.setattr(uncertainty, "STRETCH", 18)
    monkeypatch.setattr(uncertainty, "OVERLAP", 8)
    monkeypatch.setattr(uncertainty, "MOST", 24)
    found = covariances(walk, in_use(walk, 1), 1.0)
    steps = [np.sqrt(np.trace(found[frame][:3, :3])) for frame in range(2, NUM)]
    assert max(max(a / b, b / a) for a, b in pairwise(steps)) < 1.2
