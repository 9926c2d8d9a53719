"""A walk in chunks: how it is cut, what is done again, and the joined run; oracles: the whole walk, its true path."""

import json
from pathlib import Path

import cv2
import numpy as np
import own_process
import pytest
from loop_scene import matrix
from tiny_run import TINY, compose

from emgs_jax.config import configure
from emgs_jax.config.configure import build_dataset
from emgs_jax.data.synthetic import Synthetic
from emgs_jax.io.files import owned
from emgs_jax.mapping import tracking, window_input
from emgs_jax.mapping.window_input import first_pose
from emgs_jax.runs.finished_run import read_run
from emgs_jax.runs.images import images_of
from experiments import chunks
from experiments.chunks import check_same, cut, fingerprint_of, run_chunks, walk_of, words_of
from experiments.run import run

pytestmark = pytest.mark.xdist_group("tiny")


@pytest.mark.parametrize("num", [2, 3, 4, 7, 12])
@pytest.mark.parametrize("overlap", [2, 3, 5, 20])
def test_every_frame_is_in_one_chunk_or_shared_by_two_neighbours(num, overlap):
    least = (num + 1) * overlap
    for count in range(least, least + 60):
        parts = cut(count, num, overlap)
        times = np.bincount(np.concatenate(parts), minlength=count)
        assert len(times) == count and set(times) <= {1, 2} and len(parts) == num
        assert all(len(set(one) & set(other)) == overlap for one, other in zip(parts, parts[1:], strict=False))
        assert np.ptp([len(part) for part in parts]) <= 1, "the last is no rest"
    with pytest.raises(ValueError, match=f"chunks={num} overlap={overlap} would leave"):
        cut(least - 1, num, overlap)


@pytest.mark.parametrize("every", [2, 3, 5])
def test_neighbours_have_keyframes_in_common_however_far_these_are_apart(every):
    """Every `every`-th frame of a chunk is one, but not its first."""
    overlap, num = 2 * every, 3
    least = overlap + num * (overlap + every - 1)
    for count in range(least, least + 40):
        parts = cut(count, num, overlap, every)
        assert set(np.bincount(np.concatenate(parts), minlength=count)) <= {1, 2}
        known = [{frame for row, frame in enumerate(part) if row % every == 0 and row} for part in parts]
        assert all(one & other for one, other in zip(known, known[1:], strict=False))
    with pytest.raises(ValueError, match="give chunks=2 or fewer"):
        cut(least - 1, num, overlap, every)
    with pytest.raises(ValueError, match=f"no keyframe of graph.every={every}: give overlap={2 * every}"):
        cut(1000, num, every, every)


@pytest.mark.parametrize(("num", "overlap"), [(1, 5), (2, 0), (2.5, 5), ("four", 5), (-2, 5)])
def test_what_is_no_number_of_chunks_is_refused(num, overlap):
    with pytest.raises(ValueError, match="chunks must be 2 or more and overlap 1 or more"):
        cut(100, num, overlap)


@pytest.mark.parametrize(("start", "stop", "stride"), [(0, 40, 1), (3, 37, 2), (1, 40, 3)])
def test_chunks_have_the_frames_that_the_keys_of_the_walk_choose(start, stop, stride):
    words = [f"dataset.start={start}", f"dataset.stop={stop}", f"dataset.stride={stride}"]
    config = compose(*words, "graph=default")
    whole = [frame.name for frame in build_dataset(config)]
    assert len(walk_of(config)) == len(whole)
    for part in cut(len(whole), 3, 2):
        own = words_of(config, part)
        assert own[0] == "chunks=null"
        assert [frame.name for frame in build_dataset(compose(*words, *own[1:]))] == [whole[row] for row in part]
        assert compose(*words, *own[1:]).prior.first == part[0]  # whatever start and stride are


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ((), "add graph=default"),
        (("graph=default", "map=monday"), "map= is of one run"),
        (("graph=default", "view=live"), "view= is of one run"),
        (("graph=default", "polish=default"), "polish= is of one run"),
        (("graph=default", "scale.distance=[a.png,1,2,3,4,1.5]"), "scale.distance= is of an image that one chunk has"),
    ],
)
def test_keys_of_one_run_are_refused(tmp_path, words, message):
    with pytest.raises(ValueError, match=message):
        run_chunks(compose("chunks=2", *words), tmp_path, None)


def test_chunks_of_other_images_are_not_taken_for_those_of_this_walk(tmp_path):
    walks = [Synthetic(num_frames=6, size=[64, 48], seed=seed).fingerprint() for seed in (0, 1)]
    path = tmp_path / "chunks" / "walk.json"
    check_same(path, walks[0])
    check_same(path, walks[0])
    with pytest.raises(
        ValueError, match=r"chunks has chunks of other images or masks: choose another hydra\.run\.dir="
    ):
        check_same(path, walks[1])


@pytest.mark.parametrize("text", ["", '{"fingerprint": "ab', "[]", "{}", "7"])
def test_a_damaged_note_of_the_images_is_named_with_what_to_do(tmp_path, text):
    """It ended with the words of the parser of json, which name no file."""
    path = tmp_path / "walk.json"
    path.write_text(text)
    with pytest.raises(ValueError, match=rf"{path} is damaged.*: if the images are those of its chunks, delete this"):
        check_same(path, "ab")
    path.unlink()
    check_same(path, "ab")
    check_same(path, "ab")


def test_other_masks_are_another_walk(tmp_path):
    """Finished chunks of other masks were joined with new ones."""
    config = compose("graph=default", f"masks.folder={tmp_path}")
    (walk, plain) = walk_of(config), fingerprint_of(compose("graph=default"), walk_of(config))
    for row in range(len(walk)):
        assert cv2.imwrite(str(tmp_path / f"{row:06d}.png"), np.full((48, 64), 255, np.uint8))
    first = fingerprint_of(config, walk)
    assert first == fingerprint_of(config, walk) == build_dataset(config).fingerprint() != plain
    assert cv2.imwrite(str(tmp_path / "000003.png"), np.eye(48, 64, dtype=np.uint8) * 255)
    assert fingerprint_of(config, walk) not in (first, plain)
    assert plain == walk.fingerprint(), "walks without masks are those of earlier versions"


def test_only_a_simulated_prior_is_told_where_its_frames_are_in_the_walk():
    config = configure.compose("dataset=images", "prior=multiview_stereo", "chunks=2")
    assert words_of(config, range(3, 9)) == ["chunks=null", "dataset.start=3", "dataset.stop=9"]


def test_a_camera_cannot_be_cut(tmp_path):
    config = configure.compose("chunks=2", "dataset=camera", "prior=stream", "graph=default")
    with pytest.raises(ValueError, match="needs a recorded walk"):
        run_chunks(config, tmp_path, None)


def test_chunks_are_of_the_command_that_joins_them(tmp_path):
    with pytest.raises(ValueError, match="is for emgs run"):
        run(compose("chunks=2"), tmp_path)


def test_all_chunks_that_are_missing_are_named_if_too_few_are_left(tmp_path, monkeypatch):
    monkeypatch.setattr(chunks, "launch", lambda folder, words, job: ["no disk", ""][: len(words)])
    with pytest.raises(ValueError) as error:
        run_chunks(compose("chunks=2", "overlap=2", "graph=default"), tmp_path, None)
    assert str(error.value).splitlines() == [
        "chunk 1 (dataset.start=0 dataset.stop=4) is missing: no disk",
        "       chunk 2 (dataset.start=2 dataset.stop=6) is missing: it was ended",
        "       so there is nothing to join",
    ]


WALK = ("dataset.stop=12", "prior.level=0", "graph=default", "checkpoint.every=2")
CHUNKS = ("chunks=3", "overlap=2")  # frames 0 to 4, 3 to 7, 6 to 11
WHOLE = "3 chunks of up to 6 frames, {} of them to do"


def in_this_process(folder: Path, todo: list[list[str]], job) -> list[str]:
    """A launcher for which each chunk begins in a world of its own, as with images alone: only a join places it."""
    said = []
    for *own, subfolder in todo:
        number = int(subfolder.removeprefix("hydra.sweep.subdir="))
        elsewhere = matrix((20 * number, 60, 10), (4.0, number, -3.0))
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(window_input, "first_pose", lambda frames, at=elsewhere: at @ first_pose(frames))
            try:
                run(compose(*WALK, *CHUNKS, *own), folder / str(number))
                said.append("")
            except ValueError as error:
                said.append(str(error))
    return said


@pytest.fixture
def walk_to(monkeypatch):
    """Run the walk in chunks into a folder, in this process."""
    monkeypatch.setattr(chunks, "launch", in_this_process)
    return lambda folder: run_chunks(compose(*WALK, *CHUNKS), folder, None)[1]


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("undisturbed")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(chunks, "launch", in_this_process)
        assert not run_chunks(compose(*WALK, *CHUNKS), folder, None)[1]
    check_joined(folder, [*range(12)])
    return folder


def times_of(folder: Path) -> dict[str, int]:
    return {path.parent.name: path.stat().st_mtime_ns for path in folder.glob("chunks/*/metrics.json")}


def same_files(folder: Path, other: Path) -> None:
    """Map, path and factors, to the bit."""
    for name in ("map.npz", "trajectory.txt", "places.npz", "graph.g2o", "loops.json"):
        assert (folder / name).read_bytes() == (other / name).read_bytes(), name


@pytest.mark.slow
def test_a_chunk_that_is_missing_is_named_and_made_by_the_same_command_again_and_the_rest_is_joined(
    tmp_path, walk_to, undisturbed
):
    """The last chunk cannot be written at first. The prior is exact, so the joined path is the true one."""
    with owned(tmp_path / "chunks" / "3"):
        (problem,) = walk_to(tmp_path)
    assert problem.startswith("chunk 3 (dataset.start=6 dataset.stop=12) is missing: another program is writing")
    first = times_of(tmp_path)
    assert first.keys() == {"1", "2"}
    check_joined(tmp_path, [*range(8)])

    assert walk_to(tmp_path) == []
    assert {name: time for name, time in times_of(tmp_path).items() if name in first} == first
    check_joined(tmp_path, [*range(12)])
    assert (tmp_path / "previous-1" / "metrics.json").exists() and (tmp_path / "report.html").exists()
    same_files(tmp_path, undisturbed)


class Killed(BaseException):
    """As a signal is: nobody catches it as an error."""


@pytest.mark.slow
@pytest.mark.parametrize("number", [pytest.param(2, marks=pytest.mark.weekly), 7])
def test_a_walk_that_is_killed_while_a_chunk_maps_has_the_same_map_in_the_end(
    tmp_path, walk_to, undisturbed, monkeypatch, number
):
    """Before this step of all chunks: in the first and in the second one."""
    steps, advance = [], tracking.advance

    def counted(*arguments):
        steps.append(1)
        if len(steps) == number:
            raise Killed
        return advance(*arguments)

    monkeypatch.setattr(tracking, "advance", counted)
    with pytest.raises(Killed):
        walk_to(tmp_path)
    assert not (tmp_path / "map.npz").exists() and len(times_of(tmp_path)) == number // 5
    assert walk_to(tmp_path) == []
    same_files(tmp_path, undisturbed)


@pytest.mark.weekly
@pytest.mark.parametrize("launcher", ["basic", "joblib"])
def test_the_command_goes_on_where_it_was_killed(tmp_path, launcher):
    """By SIGKILL, while the second chunk maps; then the third one cannot be written."""
    if launcher != "basic":
        pytest.importorskip(f"hydra_plugins.hydra_{launcher}_launcher")
    words = (*TINY, *WALK, *CHUNKS, f"hydra/launcher={launcher}")
    folders = {name: tmp_path / name for name in ("whole", "killed")}
    done = own_process.run("experiments.run", *words, f"hydra.run.dir={folders['whole']}", timeout=600)
    assert done.returncode == 0 and WHOLE.format(3) in done.stderr + done.stdout, done.stderr
    check_joined(folders["whole"], [*range(12)])

    words, log = (*words, f"hydra.run.dir={folders['killed']}"), folders["killed"] / "chunks" / "2" / "frames.jsonl"
    if launcher == "basic":  # the workers of another one may outlive the command
        program = own_process.begin("experiments.run", *words, said=tmp_path / "said")
        own_process.wait_for(lambda: log.exists() and log.read_bytes().count(b"\n") >= 2, program)
        program.kill()
        own_process.ended(program)
        assert not (folders["killed"] / "map.npz").exists()
    with owned(folders["killed"] / "chunks" / "3"):
        done = own_process.run("experiments.run", *words, timeout=600)
    assert done.returncode == 1, done.stderr
    assert "error: chunk 3 (dataset.start=6 dataset.stop=12) is missing: another program is writing" in done.stderr
    assert f"the same command with hydra.run.dir={folders['killed']}" in done.stderr
    check_joined(folders["killed"], [*range(8)])
    done = own_process.run("experiments.run", *words, timeout=600)
    assert done.returncode == 0 and WHOLE.format(1) in done.stderr + done.stdout, done.stderr
    same_files(folders["killed"], folders["whole"])


def check_joined(folder: Path, frames: list[int]) -> None:
    """Each frame is once in the path, which is the true one, and the images are found again."""
    joined = read_run(folder)
    assert [int(line["timestamp"]) for line in joined.frames] == frames
    assert [line["index"] for line in joined.frames] == [*range(len(frames))]
    assert joined.is_placed.all() and len((folder / "trajectory.txt").read_text().splitlines()) >= len(frames)
    here = np.linalg.inv(joined.poses[0]) @ joined.poses
    true = np.linalg.inv(joined.truth[0]) @ joined.truth
    np.testing.assert_allclose(here, true, atol=0.005)
    images, note = images_of(joined)
    assert not note and [frame.timestamp for frame in images] == [float(row) for row in frames]
    metrics, alone = (json.loads((path / "metrics.json").read_text()) for path in (folder, folder / "chunks" / "1"))
    assert metrics["map/double_wall_percent"] < alone["map/double_wall_percent"] + 2
    births = np.asarray(joined.map.birth)[np.asarray(joined.map.gaussians.valid)]
    assert births.min() >= 0 and frames[-1] >= births.max() > 4
