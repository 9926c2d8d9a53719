"""Polishing; oracles: finite differences, known splats, images that must not count, a fit that nobody stopped."""

import json
import shutil
import sys
from dataclasses import replace
from types import SimpleNamespace

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest
import scene as sc
from omegaconf import OmegaConf
from tiny_run import compose

from emgs_jax.config import configure
from emgs_jax.config.configure import build
from emgs_jax.data.spool import Spool
from emgs_jax.io.run_lengths import to_run_lengths
from emgs_jax.ops.camera import Camera
from emgs_jax.polish.fit import Rates, Views, fit, is_held_out, place_on_splats, without_transparent
from emgs_jax.polish.seeds import Seeds
from emgs_jax.polish.splats import Anchors, Appearance, Shot, draw, gaussians_of, initial, loss, ssim
from emgs_jax.report.printout import polish_lines
from emgs_jax.runs.finished_run import read_run
from emgs_jax.runs.polished import polish, target_of
from experiments.polish import polish_run
from experiments.run import run

pytestmark = [pytest.mark.slow, pytest.mark.xdist_group("tiny")]

pytest.importorskip("optax", reason="the extra of emgs polish: pip install -e .[polish]")
CAMERA = Camera([20.0, 23.0], [14.5, 12.25], 32, 24)
POSES = np.stack([np.eye(4)] * 2)
POSES[1, 0, 3] = 0.05


def config(*overrides: str, folder="x"):
    return configure.compose(f"folder='{folder}'", *overrides, name="polish")


def fitting(*overrides: str):
    return build(config("polish.loss.render.tile_size=16", *overrides), "polish")


def wall() -> Anchors:
    """Flat splats on a wall 2 m away, a sixth of it wide, which fill the image."""
    x, y = np.meshgrid(np.linspace(-1.6, 1.6, 9), np.linspace(-1.2, 1.2, 7), indexing="ij")
    means = np.stack([x.ravel(), y.ravel(), np.full(x.size, 2.0)], axis=1)
    axes = np.broadcast_to(np.diag([1.0, -1.0, -1.0]), (len(means), 3, 3))
    std = np.full((len(means), 2), 0.16)
    return Anchors(*(jnp.asarray(v, jnp.float32) for v in (means, axes, std, np.full(len(means), 0.02))))


ANCHORS = wall()
GAIN = jnp.ones(3)
COLORS = np.random.default_rng(0).uniform(0.1, 0.9, (len(ANCHORS.means), 3)).astype(np.float32)


@pytest.fixture(scope="module")
def frames():
    """What the wall looks like from two poses, in the splats' true colours."""
    return drawn_from(ANCHORS)


def drawn_from(anchors: Anchors) -> Views:
    settings, spool = fitting(), Spool()
    gaussians, opacity = gaussians_of(anchors, initial(jnp.asarray(COLORS), jnp.float32(settings.opacity)))
    for pose in POSES:
        T = jaxlie.SE3.from_matrix(jnp.asarray(pose, jnp.float32))
        drawn = jax.jit(draw)(gaussians, opacity, T, CAMERA, settings.loss.render)
        spool.append(np.concatenate([drawn.values, drawn.depth[..., None]], axis=-1).astype(np.float32))
    return Views(spool, POSES, np.zeros((2, 6, 6)), np.ones((2, 3)))


def tilted() -> Anchors:
    """The wall at a slant: which splat is in front of which, where the loss jumps, stays as it is."""
    means = ANCHORS.means.at[:, 2].add(0.2 * ANCHORS.means[:, 0] + 0.13 * ANCHORS.means[:, 1])
    return eqx.tree_at(lambda a: a.means, ANCHORS, means)


def test_the_gradient_is_that_of_finite_differences(frames):
    """Away from where they begin, so that no term is at its minimum; the largest component of each parameter."""
    rng, settings = np.random.default_rng(1), fitting()
    begin = initial(jnp.asarray(COLORS), jnp.float32(settings.opacity))
    anchors = tilted()
    at = jax.tree.map(lambda x: x + jnp.asarray(rng.uniform(-0.2, 0.2, x.shape), jnp.float32), begin)
    target, T = jnp.asarray(frames.targets[0]), sc.pose()
    value = jax.jit(lambda fitted: loss(fitted, anchors, Shot(target, T, GAIN), CAMERA, settings.loss)[0])
    slope = jax.jit(jax.grad(value))(at)
    for name in ("colors", "logit", "log_std", "turn", "shift"):
        leaf = np.asarray(getattr(slope, name))
        row = np.unravel_index(np.abs(leaf).argmax(), leaf.shape)

        def moved(step, name=name, row=row):
            changed = {key: getattr(at, key) for key in vars(at)}
            changed[name] = changed[name].at[row].add(step)
            return float(value(Appearance(**changed)))

        step = 2e-2 if name == "shift" else 4e-3
        found = (moved(step) - moved(-step)) / (2 * step)
        np.testing.assert_allclose(leaf[row], found, rtol=0.1, err_msg=name)  # float32, and a curved loss


def test_the_gradient_by_the_pose_is_that_of_finite_differences(frames):
    """Splats in other colours than the target's, so that no term is at its minimum."""
    settings, target = fitting(), jnp.asarray(frames.targets[0])
    begin = initial(jnp.asarray(COLORS[::-1].copy()), jnp.float32(settings.opacity))
    value = jax.jit(lambda xi: loss(begin, ANCHORS, Shot(target, jaxlie.SE3.exp(xi), GAIN), CAMERA, settings.loss)[0])
    at = jnp.asarray([0.02, -0.03, 0.05, 0.01, -0.02, 0.03])
    slope = np.asarray(jax.jit(jax.grad(value))(at))
    steps = 2e-3 * np.eye(6)
    found = [(float(value(at + step)) - float(value(at - step))) / 4e-3 for step in steps]
    np.testing.assert_allclose(slope, found, rtol=0.1, atol=0.03 * np.abs(slope).max())


def test_the_colours_of_a_map_that_was_drawn_are_recovered_and_its_shape_stays(frames, tmp_path):
    settings = fitting("polish.steps=300", "polish.rates.colors=0.05", "polish.final_rate=0.01", "polish.loss.dssim=0")
    settings = replace(settings, rates=Rates(settings.rates.colors, 0.0, 0.0, 0.0, 0.0, 1.0))
    fitted, found = fit(ANCHORS, np.full_like(COLORS, 0.5), frames, CAMERA, settings, tmp_path / "state.npz")
    gaussians, _ = gaussians_of(ANCHORS, fitted)
    pixels = np.asarray(ANCHORS.means)[:, :2] / 2.0 * [20.0, 23.0] + [14.5, 12.25]
    inside = ((pixels > 1) & (pixels < [30, 22])).all(1)
    assert inside.sum() > 30
    np.testing.assert_allclose(np.asarray(gaussians.colors)[inside], COLORS[inside], atol=0.01)
    np.testing.assert_array_equal(gaussians.means, ANCHORS.means)
    np.testing.assert_array_equal(found.poses, POSES, "without a spread")


def test_poses_that_are_off_find_back_to_where_the_images_were_taken(tmp_path):
    """Both in the fit and on splats that stay; the splats are the true ones, so only the poses can be wrong."""
    anchors = tilted()
    settings = fitting("polish.steps=80", "polish.pose_steps=40", "polish.final_rate=0.01", "polish.loss.dssim=0")
    settings = replace(settings, rates=Rates(0.0, 0.0, 0.0, 0.0, 0.0, 0.3))
    spread = np.diag([0.03] * 3 + [0.01] * 3)
    xi = spread @ np.random.default_rng(3).choice([-1.0, 1.0], (2, 6, 1))
    off = POSES @ np.asarray(jax.vmap(lambda x: jaxlie.SE3.exp(x).as_matrix())(jnp.asarray(xi[..., 0], jnp.float32)))
    views = Views(drawn_from(anchors).targets, off, np.stack([spread] * 2), np.ones((2, 3)))
    fitted, found = fit(anchors, COLORS, views, CAMERA, settings, tmp_path / "state.npz")
    # Where the splats are in the images: along a flat wall a turn and a shift nearly do the same.
    pixels = [
        pixels_of(anchors, poses)
        for poses in (POSES, off, found.poses, place_on_splats(anchors, fitted, views, CAMERA, settings))
    ]
    before, *after = (np.sqrt(np.mean((p - pixels[0]) ** 2)) for p in pixels[1:])
    assert before > 0.3 and max(after) < 0.2 * before


@pytest.mark.weekly
def test_gains_of_frames_are_told_from_colours(tmp_path):
    """The second frame is taken brighter and bluer; with one exposure for both, neither is drawn right."""
    ratio, sound, spool = np.array([1.2, 1.2, 1.4]), drawn_from(ANCHORS), Spool()
    for target, gain in zip(sound.targets, (np.ones(3), ratio), strict=True):
        spool.append(target * np.float32([*gain, 1.0]))
    settings = fitting("polish.steps=200", "polish.final_rate=0.01", "polish.loss.dssim=0")
    settings = replace(settings, rates=Rates(0.03, 0.0, 0.0, 0.0, 0.0, 0.0))
    errors = []
    for own in (0.0, 0.9):
        views = sound._replace(targets=spool)
        path = tmp_path / "state.npz"
        fitted, found = fit(ANCHORS, COLORS, views, CAMERA, replace(settings, exposures=own), path)
        shots = [
            Shot(
                jnp.asarray(spool[row]), jaxlie.SE3.from_matrix(jnp.asarray(POSES[row])), jnp.asarray(found.gains[row])
            )
            for row in range(2)
        ]
        errors.append([float(loss(fitted, ANCHORS, shot, CAMERA, settings.loss)[1].mean_sq) for shot in shots])
    assert max(errors[1]) < 0.1 * max(errors[0])
    np.testing.assert_allclose(found.gains[1] / found.gains[0], ratio, rtol=0.08)


def pixels_of(anchors: Anchors, poses: np.ndarray) -> np.ndarray:
    """Where the splats' means are in the images, (m, n, 2)."""
    local = (np.asarray(anchors.means) - poses[:, None, :3, 3]) @ poses[:, :3, :3]
    return local[..., :2] / local[..., 2:] * [20.0, 23.0] + [14.5, 12.25]


def test_splats_that_find_no_room_get_it_and_the_fit_is_that_with_room_from_the_start(frames, tmp_path):
    settings = [fitting("polish.steps=2", f"polish.loss.render.tile_capacity={room}") for room in (8, 512)]
    few, many = (fit(ANCHORS, COLORS, frames, CAMERA, s, tmp_path / "state.npz")[0] for s in settings)
    jax.tree.map(np.testing.assert_array_equal, few, many)


def test_a_frame_makes_no_splats_where_it_sees_a_surface_from_the_side_or_beside_a_silhouette():
    """A wall at 2 m, the left half of which is a box's face at 1 m; the wall's right quarter is seen along it."""
    depth = np.where(np.arange(32) < 16, 1.0, 2.0) * np.ones((24, 1))
    rays = (np.stack(np.meshgrid(np.arange(32), np.arange(24)), -1) - [14.5, 12.25]) / [20.0, 23.0]
    points = np.concatenate([rays, np.ones((24, 32, 1))], -1) * depth[..., None]
    normals = np.zeros_like(points) + [0, 0, -1.0]
    normals[:, 24:] = np.array([-1.0, 0, 0.45]) / np.hypot(1, 0.45)  # a cosine of .26 at most
    is_there = np.ones((24, 32), bool)
    view = SimpleNamespace(points=points, normals=normals, depth=depth, valid=is_there)
    seeds = Seeds(CAMERA, 1)
    seeds.add(view, np.zeros((24, 32, 3)), np.eye(4))
    anchors, _ = seeds.anchors(lambda means, normals: np.ones(len(means)))
    columns = np.rint(np.asarray(anchors.means)[:, 0] / np.asarray(anchors.means)[:, 2] * 20 + 14.5).astype(int)
    assert set(columns) == set(range(24)) - {15, 16}


def test_a_fit_that_was_stopped_goes_on_to_the_same_bits(frames, tmp_path):
    settings = fitting("polish.steps=6", "polish.every=2")
    whole = fit(ANCHORS, COLORS, frames, CAMERA, settings, tmp_path / "whole.npz")
    steps = []

    def stop(step, _):
        steps.append(step)
        if step == 3 and steps.count(3) == 1:
            raise KeyboardInterrupt

    for _ in range(2):
        try:
            parts = fit(ANCHORS, COLORS, frames, CAMERA, settings, tmp_path / "parts.npz", stop)
        except KeyboardInterrupt:
            continue
    assert steps == [0, 1, 2, 3, 2, 3, 4, 5] and not (tmp_path / "parts.npz").exists()
    steps.clear()
    with pytest.raises(KeyboardInterrupt):
        fit(ANCHORS, COLORS, frames, CAMERA, settings, tmp_path / "parts.npz", stop)
    fit(ANCHORS, COLORS, frames, CAMERA, replace(settings, seed=1), tmp_path / "parts.npz", stop)
    assert steps == [0, 1, 2, 3, 0, 1, 2, 3, 4, 5], "other settings begin anew"
    for a, b in zip(_arrays(whole), _arrays(parts), strict=True):
        np.testing.assert_array_equal(a, b)


def _arrays(found) -> list:
    return jax.tree.leaves((found[0], found[1]._replace(targets=None)))


def test_a_fit_of_which_nothing_would_be_left_is_refused():
    """A picture of no splat was a TypeError of a gather."""
    anchors, fitted = sc.rows_of(ANCHORS, slice(3)), initial(jnp.zeros((3, 3)), jnp.float32(0.4))
    with pytest.raises(ValueError, match=r"polish.min_opacity=1 leaves no splat: the largest opacity is 0.4"):
        without_transparent(anchors, fitted, 1.0)
    assert len(without_transparent(anchors, fitted, 0.3)[1].logit) == 3


def test_ssim_is_one_of_equal_images_and_that_of_the_formula_in_a_slow_loop():
    rng = np.random.default_rng(2)
    a, b = jnp.asarray(rng.uniform(size=(2, 13, 15, 1)), jnp.float32)
    np.testing.assert_allclose(ssim(a, a), 1.0, atol=1e-6)
    offsets = np.arange(-5, 6)
    window = np.exp(-(offsets[:, None] ** 2 + offsets**2) / (2 * 1.5**2))
    window /= window.sum()
    x, y = (np.pad(image[..., 0].astype(float), 5) for image in (a, b))
    values = []
    for i in range(13):
        for j in range(15):
            p, q = x[i : i + 11, j : j + 11], y[i : i + 11, j : j + 11]
            mp, mq = (window * p).sum(), (window * q).sum()
            vp, vq, c = ((window * u * v).sum() - m for u, v, m in ((p, p, mp**2), (q, q, mq**2), (p, q, mp * mq)))
            values.append((2 * mp * mq + 1e-4) * (2 * c + 9e-4) / ((mp**2 + mq**2 + 1e-4) * (vp + vq + 9e-4)))
    np.testing.assert_allclose(ssim(a, b), np.mean(values), atol=1e-5)


def test_a_depth_that_a_half_float_does_not_hold_is_none():
    """A room in millimetres, and what lies 70 m away."""
    depth = np.float32([[2000.0, 70000.0]])
    target = target_of(np.zeros((1, 2, 3)), SimpleNamespace(valid=depth > 0, depth=depth))
    np.testing.assert_array_equal(target[..., 3], [[2000.0, 0.0]])


SHORT = ("polish.steps=2", "polish.held_out_every=3", "polish.loss.render.tile_capacity=256")


@pytest.fixture
def folder(exact_run, tmp_path):
    return shutil.copytree(exact_run[0], tmp_path / "run")


class Edited:
    """A data set in which the images of the held-out frames are noise."""

    def __init__(self, dataset, settings) -> None:
        self._dataset, self._settings = dataset, settings

    def __getattr__(self, name):
        return getattr(self._dataset, name)

    def __len__(self):
        return len(self._dataset)

    def __getitem__(self, row):
        frame = self._dataset[row]
        if not is_held_out(row, self._settings):
            return frame
        return replace(frame, image=np.random.default_rng(row).integers(0, 255, frame.image.shape).astype(np.uint8))


def test_what_is_held_out_never_enters_the_fit_and_the_files_say_what_came_out(folder):
    from experiments.report import images_of

    found = polish_run(config(*SHORT, folder=folder))
    splats = (folder / "splats.ply").read_bytes()
    assert json.loads((folder / "polish.json").read_text()) == found and (folder / "polish.png").is_file()
    assert found["polish/num_held_out"] == 2 and found["polish/num_fitted"] == 4
    assert 0 < found["polish/after_ssim"] < 1 and found["polish/after_depth_within_5_percent"] > 75
    assert f"{found['polish/num_splats']:,} splats" in (folder / "report.html").read_text()
    assert (folder / "polish.txt").is_file()
    polish_run(config(*SHORT, "polish.poses=false", folder=folder))
    assert not (folder / "polish.txt").exists(), "they are not the poses of these splats"
    run, settings = read_run(folder), build(config(*SHORT), "polish")
    densify = build(OmegaConf.create(dict(run.provenance["config"])), "densify")
    other = polish(run, Edited(images_of(run)[0], settings), settings, densify)
    assert (folder / "splats.ply").read_bytes() == splats
    assert other["polish/before_psnr_db"] < found["polish/before_psnr_db"] - 3, "they are what is compared"


@pytest.mark.weekly
def test_what_was_taken_for_moving_enters_no_fit(folder):
    """Noise there, in the images of fitted frames: the splats are those without it."""
    from experiments.report import images_of

    lines = [json.loads(line) for line in (folder / "frames.jsonl").read_text().splitlines()]
    is_moving = np.zeros((48, 64), bool)
    is_moving[10:30, 12:40] = True
    for line in lines:
        line["moving_pixels"] = to_run_lengths(is_moving)
    (folder / "frames.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    run, settings = read_run(folder), build(config(*SHORT), "polish")
    densify = build(OmegaConf.create(dict(run.provenance["config"])), "densify")
    dataset, splats = images_of(run)[0], []

    class Noisy(Edited):
        def __getitem__(self, row):
            frame = self._dataset[row]
            noise = np.random.default_rng(row).integers(0, 255, frame.image.shape).astype(np.uint8)
            return replace(frame, image=np.where(is_moving[..., None], noise, frame.image))

    for frames in (dataset, Noisy(dataset, settings)):
        polish(run, frames, settings, densify)
        splats.append((folder / "splats.ply").read_bytes())
    assert splats[0] == splats[1]


@pytest.mark.weekly
def test_a_run_can_end_with_it_and_says_at_once_that_optax_is_missing(exact_run, tmp_path, monkeypatch, capsys):
    """The map is that of the run without it, and the splats are those of the command."""
    own, short = tmp_path / "own", SHORT + ("polish=default",)
    run(compose("prior.level=0", *short), own)
    assert "splats; of 2 frames that were not fitted" in "".join(capsys.readouterr())
    assert (own / "map.npz").read_bytes() == (exact_run[0] / "map.npz").read_bytes()
    page = (own / "report.html").read_text()
    assert "polish=default" in page and 'value="splats" selected' in page
    polish_run(config(*SHORT, folder=shutil.copytree(exact_run[0], tmp_path / "later")))
    assert (own / "splats.ply").read_bytes() == (tmp_path / "later" / "splats.ply").read_bytes()
    monkeypatch.setitem(sys.modules, "optax", None)
    with pytest.raises(ValueError, match=r"polish=none fits none.*pip install .*polish"):
        run(compose("prior.level=0", *short), tmp_path / "without")
    assert not (tmp_path / "without" / "map.npz").exists()


def test_a_held_out_frame_that_the_map_does_not_cover_is_counted_and_left_out(folder):
    """Symptom: the PSNR was nan."""
    before = polish_run(config(*SHORT, folder=shutil.copytree(folder, folder.parent / "other")))
    lines = (folder / "trajectory.txt").read_text().splitlines()
    rows = [row for row, line in enumerate(lines) if line and not line.startswith("#")]
    time = lines[rows[3]].split()[0]
    lines[rows[3]] = f"{time} 0 0 500 0 0 0 1"  # held out, and looks away from everything
    (folder / "trajectory.txt").write_text("\n".join(lines) + "\n")
    found = polish_run(config(*SHORT, folder=folder))
    assert found["polish/num_covered"] == 1 and found["polish/num_held_out"] == before["polish/num_covered"] == 2
    assert np.isfinite(found["polish/before_psnr_db"]) and np.isfinite(found["polish/after_psnr_db"])
    assert "splats; of the 1 that the map covers of 2 frames that were not fitted" in polish_lines(found)[0]


def test_a_run_of_one_frame_is_not_polished_and_says_why(tmp_path, capsys):
    """Symptom: it ended in an error after all was mapped, without a report."""
    run(compose("prior.level=0", "dataset.stop=1", *SHORT, "polish=default"), tmp_path / "one")
    said = "".join(capsys.readouterr())
    assert "not polished: " in said and "has 1 placed frames, of which polishing fits some and compares" in said
    assert (tmp_path / "one/report.html").is_file() and not (tmp_path / "one/polish.json").exists()


def test_splats_that_look_worse_than_the_map_are_named():
    """Of five frames metres apart of TUM's cabinet: 19.0 dB in the map, 11.8 in the splats."""
    numbers = {"polish/num_splats": 9, "polish/num_held_out": 1, "polish/num_covered": 1, "polish/before_psnr_db": 19.0}
    worse, better = (polish_lines(numbers | {"polish/after_psnr_db": value}) for value in (11.8, 30.0))
    assert "too far apart" in worse[-1] and "too far" not in "".join(better)
