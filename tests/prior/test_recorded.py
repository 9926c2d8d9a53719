"""The recorded format: replay is the live run, and nothing damaged or foreign passes for it."""

import hashlib
import io
import json
from dataclasses import fields, replace

import numpy as np
import pytest

from emgs_jax.prior.base import visits, windows
from emgs_jax.prior.recorded import Recorded, record
from emgs_jax.prior.recorded_visits import record_visits
from emgs_jax.prior.simulated.prior import Simulated
from emgs_jax.prior.wrapped import Wrapped

WINDOW_SIZE = 3


class Asked(Simulated):
    """Counts its calls and may stop at one, as a user would."""

    stop_at, num_calls = 99, 0

    def predict(self, window, frames, intrinsics):
        if window.inference == self.stop_at:
            raise KeyboardInterrupt
        self.num_calls += 1
        return super().predict(window, frames, intrinsics)


@pytest.fixture
def prior(room):
    return Asked(seed=5, feature_size=4, classes=room.classes)


@pytest.fixture
def folder(tmp_path, room):
    record(Simulated(seed=5, feature_size=4, classes=room.classes), room, WINDOW_SIZE, tmp_path / "recording")
    return tmp_path / "recording"


def calls(dataset):
    return [
        (window, [dataset[i] for i in window.views])
        for window in windows(range(len(dataset)).__contains__, WINDOW_SIZE)
    ]


def contents(folder):
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def assert_same_bits(a, b):
    assert a.window == b.window
    assert a.adjusted == b.adjusted == {}  # a recording is of a prior that does not change its mind
    for name in [field.name for field in fields(a) if field.name not in ("window", "adjusted")]:
        x, y = (np.asarray(getattr(one, name)) for one in (a, b))
        assert (x.dtype, x.shape, x.tobytes()) == (y.dtype, y.shape, y.tobytes()), name


def forge_manifest(folder, edit):
    manifest = json.loads((folder / "manifest.json").read_text())
    del manifest["sha256"]
    edit(manifest)
    content = json.dumps(manifest, sort_keys=True, separators=(",", ":")).encode()
    manifest["sha256"] = hashlib.sha256(content).hexdigest()
    (folder / "manifest.json").write_text(json.dumps(manifest))


def forge(folder, name, edit):
    """Change one file of a recording and make all of its checksums fit again."""
    content = edit((folder / name).read_bytes())
    (folder / name).write_bytes(content)
    forge_manifest(folder, lambda manifest: manifest["files"].update({name: hashlib.sha256(content).hexdigest()}))


def with_array(name, change):
    """An edit of an .npz: `change` of one array."""

    def edit(content):
        with np.load(io.BytesIO(content)) as arrays:
            new = dict(arrays)
        new[name] = change(new[name])
        buffer = io.BytesIO()
        np.savez(buffer, **new)
        return buffer.getvalue()

    return edit


def test_replay_is_the_live_prior_bit_for_bit_and_another_version_is_refused(folder, prior, room):
    names = ["000000.npz", "000001.npz", "000002.npz", "000003.npz", "manifest.json", "text_features.npz"]
    assert sorted(contents(folder)) == names, "nothing but the documented files is left"
    replay = Recorded(folder)
    replay.check(room, WINDOW_SIZE)
    assert replay.provenance == prior.provenance
    assert replay.feature_names == prior.feature_names
    assert replay.text_features.tobytes() == prior.text_features.tobytes()
    for window, frames in calls(room):
        live = prior.predict(window, frames, room.intrinsics)
        assert_same_bits(replay.predict(window, frames, room.intrinsics), live)
    forge_manifest(folder, lambda manifest: manifest.update(version=2))
    with pytest.raises(
        ValueError, match=r"manifest\.json has version 2, this program reads 3: record into another folder"
    ):
        Recorded(folder)


class Sure(Simulated):
    """The simulated prior, which says how sure it is of its poses and of its scale."""

    def predict(self, window, frames, intrinsics):
        found = super().predict(window, frames, intrinsics)
        covariance = np.multiply.outer(1.0 + np.arange(len(window.views)), 1e-4 * np.eye(6))
        return replace(found, pose_covariance=covariance, scale_std=np.float64(0.02))


def test_a_prior_that_adjusts_poses_is_not_recorded(prior, room, tmp_path):
    """Symptom: the recording of an online structure lacked the adjusted poses, and its map was another one."""
    prior.adjusts_poses = True
    for one in (prior, Wrapped(prior)):
        with pytest.raises(ValueError, match=r"recording cannot hold that: record with prior\.structure\.online=false"):
            record(one, room, WINDOW_SIZE, tmp_path / "recording")
    assert not (tmp_path / "recording").exists() and prior.num_calls == 0


def test_how_sure_poses_are_is_replayed_and_what_the_key_says_stands_in_its_place(tmp_path, room):
    prior = Sure(seed=5, feature_size=4, classes=room.classes)
    record(prior, room, WINDOW_SIZE, tmp_path)
    window, frames = calls(room)[1]
    live = prior.predict(window, frames, room.intrinsics)
    found = Recorded(tmp_path).predict(window, frames, room.intrinsics)
    np.testing.assert_array_equal(found.pose_covariance, live.pose_covariance)
    assert found.scale_std == 0.02
    other = Recorded(tmp_path, pose_std=[0.02, 3.0])
    found = other.predict(window, frames, room.intrinsics)
    expected = np.diag(np.repeat([0.02, np.radians(3.0)], 3) ** 2)
    np.testing.assert_allclose(found.pose_covariance, np.broadcast_to(expected, live.pose_covariance.shape))
    assert other.provenance.settings["pose_std"] == [0.02, 3.0]


def test_an_interrupted_recording_says_so_and_is_completed_without_repeating_work(tmp_path, folder, prior, room):
    prior.stop_at = 2
    with pytest.raises(KeyboardInterrupt):
        record(prior, room, WINDOW_SIZE, tmp_path / "part")
    with pytest.raises(ValueError, match="2 of 4 inferences.*experiments.predict"):
        Recorded(tmp_path / "part")
    prior.stop_at = 99
    record(prior, room, WINDOW_SIZE, tmp_path / "part")
    assert prior.num_calls == 4 and contents(tmp_path / "part") == contents(folder)
    whole = (folder / "000001.npz").read_bytes()
    (folder / "000001.npz").write_bytes(whole[:-7])  # only this is asked again
    record(prior, room, WINDOW_SIZE, folder)
    assert prior.num_calls == 5 and (folder / "000001.npz").read_bytes() == whole


def test_arrays_of_another_precision_or_shape_are_refused_even_with_fitting_hashes(tmp_path, room):
    class Other(Simulated):
        change = {}

        def predict(self, window, frames, intrinsics):
            prediction = super().predict(window, frames, intrinsics)
            return replace(prediction, **{name: f(getattr(prediction, name)) for name, f in self.change.items()})

    prior, (window, frames) = Other(), calls(room)[0]
    prior.change = {"points": lambda a: a.astype(np.float64)}
    with pytest.raises(ValueError, match="points must be float32"):
        record(prior, room, WINDOW_SIZE, tmp_path / "double")
    prior.change = {"confidence": lambda a: a[:, :, 1:]}
    record(prior, room, WINDOW_SIZE, tmp_path / "narrow")
    with pytest.raises(ValueError, match=r"confidence must be float32 \(3, 30, 40\), got float32 \(3, 30, 39\)"):
        Recorded(tmp_path / "narrow").predict(window, frames, room.intrinsics)


def test_another_sequence_window_or_calibration_is_refused_by_name(folder, room, make_room):
    replay, (window, frames) = Recorded(folder), calls(room)[1]
    small = [make_room(size=(20, 30))[i] for i in window.views]
    for message, *question in (
        ("another window", replace(window, dense=(0, 1)), frames, room.intrinsics),
        ("intrinsics", window, frames, (1.0, 2.0, 3.0, 4.0)),
        ("size", window, small, room.intrinsics),
    ):
        with pytest.raises(ValueError, match=message):
            replay.predict(*question)
    for name, value in (
        ("sequence", "two"),
        ("name", "tum"),
        ("size", (32, 24)),
        ("intrinsics", (50.0, 48.0, 19.25, 15.0)),
        ("fingerprint", lambda: "other"),
    ):
        other = make_room()
        setattr(other, name, value)
        with pytest.raises(ValueError, match=f"recorded with {name} .*but this run has"):
            replay.check(other, WINDOW_SIZE)


def damaged(content, seed):
    """Yield 60 versions of `content`: cut short, with one flipped bit, with a run of random bytes."""
    rng = np.random.default_rng(seed)
    for _ in range(20):
        yield content[: rng.integers(len(content))]
        at, length = int(rng.integers(len(content))), int(rng.integers(1, 40))
        yield content[:at] + bytes([content[at] ^ (1 << int(rng.integers(8)))]) + content[at + 1 :]
        yield content[:at] + rng.bytes(length) + content[at + length :]


def test_no_damage_to_an_inference_or_to_the_manifest_goes_unnoticed(folder, room):
    """A flipped bit in the manifest's white space may leave the same content."""
    path, replay, (window, frames) = folder / "000001.npz", Recorded(folder), calls(room)[1]
    for version in damaged(path.read_bytes(), seed=1):
        path.write_bytes(version)
        with pytest.raises(ValueError, match="000001.npz is damaged"):
            replay.predict(window, frames, room.intrinsics)
    path, noticed = folder / "manifest.json", 0
    whole = path.read_bytes()
    for version in damaged(whole, seed=0):
        path.write_bytes(version)
        try:
            assert Recorded(folder) and json.loads(version) == json.loads(whole)
        except ValueError as error:
            assert str(path) in str(error)
            noticed += 1
    assert noticed > 50


def poisoned(array, value):
    array = array.copy()
    array.reshape(-1)[-1] = value
    return array


FORGED = [
    (with_array("points", lambda a: poisoned(a, np.nan)), "points under the mask are not finite, or farther"),
    (with_array("points", lambda a: a * np.float32(1e7)), "points under the mask are not finite, or farther than 1e"),
    (with_array("confidence", lambda a: poisoned(a, np.nan)), "a confidence under the mask is negative or not finite"),
    (with_array("confidence", lambda a: -a), "a confidence under the mask is negative"),
    (with_array("features", lambda a: poisoned(a, np.nan)), "features are not finite"),
    (with_array("T_anchor_view", lambda a: 7 * a), "a pose is no rigid motion"),
    (with_array("T_anchor_view", lambda a: a * np.array([-1, 1, 1, 1.0])), "a pose is no rigid motion"),
    (with_array("T_anchor_view", lambda a: a + 1e8 * np.eye(4)[[0], :, None] * np.eye(4)[3]), "a pose is"),
    (with_array("T_anchor_view", lambda a: a.astype(np.float32)), "T_anchor_view must be float64"),
    (with_array("mask", lambda a: a.astype(np.uint8)), "mask must be bool"),
    # A header of 224 GiB ended in a MemoryError.
    (lambda content: content.replace(b"(2, 30, 40, 3)", b"(2,9999999,99)"), "is no file of this format"),
]


@pytest.mark.parametrize(("edit", "message"), FORGED)
def test_a_forged_recording_is_refused_even_with_fitting_checksums(folder, room, edit, message):
    forge(folder, "000001.npz", edit)
    window, frames = calls(room)[1]
    with pytest.raises(ValueError, match=rf"000001\.npz:? {message}.*experiments\.predict"):
        Recorded(folder).predict(window, frames, room.intrinsics)


def test_a_pose_that_is_not_there_is_no_fault_and_forged_text_features_are_one(folder, room):
    """A prior without a pose for a view says NaN, and the step marks the frame as lost."""
    edit = with_array("T_anchor_view", lambda a: np.where(np.arange(len(a))[:, None, None] == 1, np.nan, a))
    forge(folder, "000001.npz", edit)
    window, frames = calls(room)[1]
    assert np.isnan(Recorded(folder).predict(window, frames, room.intrinsics).T_anchor_view[1]).all()
    forge(folder, "text_features.npz", with_array("text_features", lambda a: poisoned(a, np.inf)))
    with pytest.raises(ValueError, match=r"text_features\.npz must hold a finite vector for each of 2 names"):
        Recorded(folder)


@pytest.mark.parametrize(
    ("edit", "message"),
    [
        (lambda m: m.pop("files"), "files must be there as dict"),
        (lambda m: m.update(window_size="3"), "window_size must be there as int"),
        (lambda m: m.update(dataset=None), "dataset must be there as dict with name"),
        (lambda m: m["dataset"].pop("size"), "size must be there as list"),
        (lambda m: m["provenance"].pop("is_simulated"), "is_simulated must be there as bool"),
        (lambda m: m["provenance"].update(more=1), "provenance must be there as dict with name, settings, is_sim"),
    ],
)
def test_a_manifest_that_lacks_a_key_is_refused_even_with_a_fitting_checksum(folder, edit, message):
    """It was a KeyError or a TypeError."""
    forge_manifest(folder, edit)
    with pytest.raises(ValueError, match=rf"manifest\.json is no manifest: {message}.*experiments\.predict"):
        Recorded(folder)


def test_both_visits_of_a_place_are_replayed_bit_for_bit_and_what_is_not_recorded_is_none(folder, prior, room):
    window, other = visits(0, 4, 1, WINDOW_SIZE), visits(0, 4, 2, WINDOW_SIZE)
    assert window.views == (0, 1, 3, 4) and window.dense == (0, 4) and window.inference == 2
    frames, of_other = ([room[index] for index in one.views] for one in (window, other))
    assert Recorded(folder).revisit(window, frames, room.intrinsics) is None
    assert record_visits(prior, room, WINDOW_SIZE, folder, [(0, 4)], 1) == 1
    live = prior.revisit(window, frames, room.intrinsics)
    assert_same_bits(Recorded(folder).revisit(window, frames, room.intrinsics), live)
    assert Recorded(folder).revisit(other, of_other, room.intrinsics) is None
    before, prior.num_calls = contents(folder), 0
    assert record_visits(prior, room, WINDOW_SIZE, folder, [(0, 4)], 1) == 1
    record(prior, room, WINDOW_SIZE, folder)  # completing it again loses nothing
    assert prior.num_calls == 0 and contents(folder) == before
    next(folder.glob("visits_*")).write_bytes(b"")
    with pytest.raises(ValueError, match=r"visits_000000_000001_000003_000004\.npz is damaged"):
        Recorded(folder).revisit(window, frames, room.intrinsics)


def test_what_the_simulated_prior_says_again_is_another_draw_about_the_same_truth(prior, room):
    """It was the step's own answer, bit for bit: a second measurement without an error of its own."""
    window = visits(0, 4, 1, WINDOW_SIZE)
    frames = [room[index] for index in window.views]
    again = prior.revisit(window, frames, room.intrinsics)
    (step,) = [call for call in calls(room) if call[0].current == 4]
    first = prior.predict(*step, room.intrinsics)
    now, before = again.points[1][..., 2], first.points[step[0].dense.index(4)][..., 2]
    both = (now > 0) & (before > 0)
    assert 0.002 < np.median(np.abs(np.log(now[both] / before[both]))) < 0.1
    truth = np.linalg.inv(room[0].T_world_camera) @ room[4].T_world_camera
    exact = Simulated(level=0).revisit(window, frames, room.intrinsics).T_anchor_view[-1]
    np.testing.assert_allclose(exact, truth, atol=1e-9)


def test_of_visits_of_which_the_prior_knows_nothing_nothing_is_recorded(folder, prior, room, monkeypatch):
    before = contents(folder)
    monkeypatch.setattr(prior, "revisit", lambda *_: None)
    assert record_visits(prior, room, WINDOW_SIZE, folder, [(0, 4)], 1) == 0 and contents(folder) == before


def test_a_metre_of_the_settings_is_recorded_and_a_recording_without_one_is_in_metres(tmp_path, room, folder):
    class Other(Simulated):
        metre = 5.15

    record(Other(seed=5), room, WINDOW_SIZE, tmp_path / "other")
    assert Recorded(tmp_path / "other").metre == 5.15 and Recorded(folder).metre == 1.0
    with pytest.raises(ValueError, match="holds a recording with metre None, not 5.15"):
        record(Other(seed=5, feature_size=4, classes=room.classes), room, WINDOW_SIZE, folder)
    forge_manifest(tmp_path / "other", lambda manifest: manifest.update(metre=-1.0))
    with pytest.raises(ValueError, match="manifest.json: metre must be a positive number, got -1.0: record"):
        _ = Recorded(tmp_path / "other").metre
