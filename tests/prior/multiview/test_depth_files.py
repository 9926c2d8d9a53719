"""Depths in the files that public programs write, matched with frames by name or in order, and what is wrong with some.

The layouts are those of the programs' own code: Video-Depth-Anything run.py --save_npz (`depths`), DepthCrafter
--save_npz (`depth`), Depth Anything V2 run.py --pred-only --grayscale, its metric_depth/run.py --save-numpy
(`_raw_depth_meter.npy`), MiDaS run.py (`NAME-MODEL.png` and .pfm), Marigold script/depth/run.py (`_depth.npy`).
"""

from functools import partial
from pathlib import Path
from types import SimpleNamespace

import cv2
import hydra
import numpy as np
import pytest
from scene import compose

from emgs_jax.data.synthetic import Synthetic
from emgs_jax.ops.camera import Camera
from emgs_jax.prior.files.naming import rows_of
from emgs_jax.prior.multiview.dense import Scene
from emgs_jax.prior.multiview.depth_files import open_depths, way_of_files
from emgs_jax.prior.multiview.landmarks import landmarks_of, point_information
from emgs_jax.prior.multiview.lens import Lens
from emgs_jax.structure.model import Structure, World

pytestmark = pytest.mark.slow


STEMS = ["a 1", "a 2", "a 10"]
VALUES = np.float32(np.random.default_rng(0).uniform(0.1, 1.0, (3, 6, 8)))


class Frames:
    """Frames of which only names and size matter."""

    size, intrinsics = (8, 6), (8.0, 8.0, 3.5, 2.5)

    def __init__(self, stems):
        self._files = [[Path(f"{stem}.jpg" if stem else "video.mp4")] for stem in stems]

    def __len__(self):
        return len(self._files)

    def files(self, index):
        return self._files[index]


def png(path, values, bits=8, channels=1):
    scaled = np.round((values - values.min()) / np.ptp(values) * (2**bits - 1)).astype(f"uint{bits}")
    cv2.imwrite(str(path), scaled if channels == 1 else np.repeat(scaled[..., None], channels, -1))


def pfm(path, values):
    """Portable float map as MiDaS writes it: rows from the bottom, little endian."""
    header = f"Pf\n{values.shape[1]} {values.shape[0]}\n-1.000000\n".encode()
    path.write_bytes(header + np.flipud(values).astype("<f4").tobytes())


def each(folder, write, ending):
    for stem, values in zip(STEMS, VALUES, strict=True):
        write(folder / f"{stem}{ending}", values)


def save(path, values):
    np.save(path, values)


LAYOUTS = {
    "Video-Depth-Anything": lambda d: np.savez_compressed(d / "video_depths.npz", depths=VALUES),
    "DepthCrafter": lambda d: np.savez_compressed(d / "video.npz", depth=VALUES),
    "an array of all": lambda d: np.save(d / "depths.npy", VALUES[:, None]),
    "Depth Anything V2": lambda d: each(d, partial(png, channels=3), ".png"),
    "Depth Anything V2 metric": lambda d: each(d, save, "_raw_depth_meter.npy"),
    "MiDaS pictures": lambda d: each(d, partial(png, bits=16), "-dpt_beit_large_512.png"),
    "MiDaS": lambda d: (each(d, pfm, "-dpt_beit_large_512.pfm"), each(d, png, "-dpt_beit_large_512.png")),
    "Marigold": lambda d: each(d, save, "_depth.npy"),
    "an npz each": lambda d: each(d, lambda path, v: np.savez(path, disparity=v, other=v[0]), ".npz"),
}


@pytest.mark.parametrize("layout", LAYOUTS)
def test_what_a_program_writes_is_read_for_the_frame_that_it_is_of(tmp_path, layout):
    LAYOUTS[layout](tmp_path)
    found = open_depths(tmp_path, "affine_inverse", 1000.0)
    for frame, row in enumerate(rows_of(Frames(STEMS), found.names, tmp_path)):
        read, expected = found.read(row), VALUES[frame]
        if found.files[0].suffix == ".png":  # each is stretched to its range
            read, expected = (np.float64(v - v.min()) / np.ptp(v) for v in (read, expected))
            np.testing.assert_allclose(read, expected, atol=1 / 255)
        else:
            np.testing.assert_array_equal(read, expected)


def test_files_without_the_frames_names_are_in_the_order_of_their_numbers(tmp_path):
    for number, values in zip((2, 9, 10), VALUES, strict=True):
        np.save(tmp_path / f"frame{number}.npy", values)
    found = open_depths(tmp_path, "affine_inverse", 1000.0)
    for stems in (["x", "y", "z"], [None] * 3):
        rows = rows_of(Frames(stems), found.names, tmp_path)
        np.testing.assert_array_equal([found.read(row) for row in rows], VALUES)
    with pytest.raises(ValueError, match=r"3 predictions \(frame2 ...\) and the data set 5 frames"):
        rows_of(Frames([None] * 5), found.names, tmp_path)


@pytest.mark.parametrize("name", ["{:06d}", "{:04d}", None])
def test_depths_of_every_frame_of_a_video_are_found_by_the_numbers_of_those_in_use(tmp_path, name):
    every = np.float32(np.random.default_rng(1).uniform(0.1, 1.0, (30, 6, 8)))
    for number, values in enumerate(every if name else []):
        np.save(tmp_path / f"{name.format(number)}.npy", values)
    if name is None:  # one file has all
        np.savez(tmp_path / "video_depths.npz", depths=every)
    found = open_depths(tmp_path, "affine_inverse", 1000.0)
    video = Frames([None] * 4)
    video.number = lambda index: 5 + 7 * index
    np.testing.assert_array_equal([found.read(row) for row in rows_of(video, found.names, tmp_path)], every[5:27:7])
    if name:
        for number in range(30, 0, -1):  # ffmpeg counts from 1
            (tmp_path / f"{name.format(number - 1)}.npy").rename(tmp_path / f"{name.format(number)}.npy")
        with pytest.raises(ValueError, match="and their names do not tell which is whose"):
            rows_of(video, open_depths(tmp_path, "affine_inverse", 1000.0).names, tmp_path)


def test_more_files_than_frames_are_no_error_by_name_and_a_frame_without_a_file_is(tmp_path):
    each(tmp_path, save, "_depth.npy")
    found = open_depths(tmp_path, "affine_inverse", 1000.0)
    rows = rows_of(Frames(["a 10", "a 2"]), found.names, tmp_path)
    assert [found.names[row] for row in rows] == ["a 10_depth", "a 2_depth"]
    with pytest.raises(ValueError, match="no file for 1 of 3 frames, the first is a 3_depth"):
        rows_of(Frames(["a 1", "a 2", "a 3"]), found.names, tmp_path)


def test_where_there_is_no_depth_there_is_none(tmp_path):
    values = VALUES[0].copy()
    values[0, :3] = 0, np.nan, np.inf
    for stem in STEMS:
        np.save(tmp_path / f"{stem}.npy", values)
    for kind, lacking in (("affine_inverse", 2), ("affine", 2), ("up_to_scale", 3), ("metric", 3)):
        assert np.isnan(open_depths(tmp_path, kind, 1000.0).read(0)).sum() == lacking


def test_metric_pictures_have_units_of_a_metre(tmp_path):
    for stem in STEMS:
        cv2.imwrite(str(tmp_path / f"{stem}.png"), np.full((6, 8), 2500, np.uint16))
    assert (open_depths(tmp_path, "metric", 1000.0).read(0) == 2.5).all()
    assert (open_depths(tmp_path, "up_to_scale", 1000.0).read(0) == 2500).all()


def config(folder, kind="affine_inverse"):
    words = f"prior.dense.folder='{folder}'", f"prior.dense.kind={kind}"
    return hydra.utils.instantiate(compose("prior=multiview_stereo", "prior/dense=files", *words).prior.dense)


def test_provenance_knows_the_contents_and_not_the_place(tmp_path):
    contents = []
    for name, values in (("here", VALUES), ("there", VALUES), ("other", VALUES + 1)):
        (tmp_path / name).mkdir()
        np.savez(tmp_path / name / "v.npz", depths=values)
        contents.append(way_of_files(config(tmp_path / name)).contents)
    assert contents[0] == contents[1] != contents[2]


def room(factor=1.0):
    """Frames of the built-in room with true poses, and landmarks on its surfaces, lengths times a factor."""
    drawn = Synthetic(num_frames=40, stop=8, size=(160, 120))
    frames = [drawn[index] for index in range(len(drawn))]
    camera = Camera(np.float32(drawn.intrinsics[:2]), np.float32(drawn.intrinsics[2:]), 160, 120)
    T = np.stack([frame.T_world_camera for frame in frames])
    rng, points, landmarks = np.random.default_rng(0), [], [[] for _ in frames]
    for frame, pose in zip(frames, T, strict=True):
        for row, column in zip(rng.integers(0, 120, 40), rng.integers(0, 160, 40), strict=True):
            z = frame.depth[row, column]
            ray = (np.array([column, row]) - camera.center) / camera.focal
            points.append(pose[:3, :3] @ (z * np.append(ray, 1.0)) + pose[:3, 3])
    points = np.stack(points)
    for index, (frame, pose) in enumerate(zip(frames, T, strict=True)):
        local = (points - pose[:3, 3]) @ pose[:3, :3]
        pixels = np.rint(camera.focal * local[:, :2] / local[:, 2:] + camera.center).astype(int)
        inside = (local[:, 2] > 0) & (pixels >= 0).all(1) & (pixels < (160, 120)).all(1)
        row, column = np.where(inside, pixels.T[1], 0), np.where(inside, pixels.T[0], 0)
        is_seen = inside & (np.abs(frame.depth[row, column] / local[:, 2] - 1) < 0.02)
        landmarks[index] = np.flatnonzero(is_seen)
    T[:, :3, 3] *= factor
    world = World(factor * points, SimpleNamespace(mean_focal_length=lambda: float(camera.focal[0])))
    count = len(frames)
    covariance = np.zeros((count, 6, 6))
    found = Structure([world], np.zeros(count, int), T, covariance, landmarks)
    return drawn, found, camera, frames


@pytest.mark.parametrize("kind", ["metric", "up_to_scale", "affine", "affine_inverse"])
def test_depths_of_the_room_come_back_in_the_unit_of_the_structure_with_the_scale_of_metres(tmp_path, kind):
    drawn, found, camera, frames = room(factor=0.4)
    for index, frame in enumerate(frames):
        y = 1 / frame.depth if kind == "affine_inverse" else frame.depth
        by_kind = {"metric": (1, 0), "up_to_scale": (3 + 0.1 * index, 0)}.get(kind, (0.7 + 0.02 * index, 0.3))
        np.save(tmp_path / f"{index:03d}.npy", by_kind[0] * y + by_kind[1])
    lens = Lens(camera.focal, camera.center)
    way = way_of_files(config(tmp_path, kind))
    way.check(drawn)
    depth_of, scales = way.begin(Scene(drawn, lambda: found, lambda world: lens, camera))
    assert len(scales) == (kind == "metric")
    for scale in scales:
        assert scale.factor == pytest.approx(1 / 0.4, rel=1e-2) and scale.source == "the depth network"
        assert 0.2 < scale.std < 0.25, "the frames agree, and the bias of the scene stays"
    for index, frame in enumerate(frames):
        depth, std, _, scale_std = depth_of(index)
        assert 0 < scale_std < 0.05  # of a scale that landmarks tell
        is_known = depth > 0
        assert is_known.mean() > 0.9
        ratio = depth[is_known] / frame.depth[is_known] / 0.4
        assert abs(np.median(ratio) - 1) < 0.01 and np.percentile(np.abs(ratio - 1), 90) < 0.02
        assert std[is_known].max() < 0.1


@pytest.mark.parametrize(
    ("kind", "unit", "is_refused"), [("metric", 1, False), ("metric", 1000, True), ("affine", 1000, False)]
)
def test_metric_depths_in_millimetres_are_refused_at_once_by_the_key_that_tells_their_unit(
    tmp_path, kind, unit, is_refused
):
    """Symptom: after the structure was made, an error advised another prior."""
    drawn, _, _, frames = room()
    for index, frame in enumerate(frames):
        np.save(tmp_path / f"{index:03d}.npy", np.uint16(np.rint(unit * (frame.depth + 1))))
    check = way_of_files(config(tmp_path, kind)).check
    if not is_refused:
        check(drawn)
        return
    with pytest.raises(
        ValueError, match=r"000.npy has a median of 3\d\d\d, .* write metres .*prior\.dense\.depth_scale"
    ):
        check(drawn)


def test_a_landmark_is_as_uncertain_as_its_parallax_says():
    """σ of log z is σ_px z / (f b) of a view at a baseline b across, the frame's own says nothing."""
    _, found, camera, _ = room()
    T = np.tile(np.eye(4), (2, 1, 1))
    T[1, 0, 3] = 0.1
    points = np.array([[0.0, 0.0, 2.0], [0.0, 0.0, 4.0]])
    world, shown = World(points, found.worlds[0].camera), [np.arange(2)] * 2
    two = Structure([world], np.zeros(2, int), T, np.zeros((2, 6, 6)), shown)
    landmarks = landmarks_of(two, 0, point_information(two, 0, pixel_std=0.5), camera, cell=0.1)
    expected = 0.5 * landmarks.depth / (float(camera.focal[0]) * 0.1)
    np.testing.assert_allclose(landmarks.std, expected, rtol=3e-3)  # f b / distance, which z is to (b / z)²
    np.testing.assert_allclose(landmarks.weight, 0.5)  # both at one pixel
