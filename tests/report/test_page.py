"""report.html as text; oracles: an HTML parser, unpacking by hand, metrics that are known, hostile names."""

import base64
import hashlib
import json
import re
import zlib
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from hand_run import random_similarity
from page_elements import HOSTILE, Elements
from written_run import CLASSES, two_walls, written_run

from emgs_jax.report import page, page_words
from emgs_jax.report.page import MAX_BYTES, write_report
from emgs_jax.report.page_map import COV_UNIT, packed, thinned
from emgs_jax.report.page_strip import placed_paths
from emgs_jax.report.page_words import DATA_LICENCES, verdict
from emgs_jax.report.recorded_run import read_run
from emgs_jax.running.configure import groups
from experiments.report import report


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = written_run(tmp_path_factory.mktemp("run"))
    write_report(read_run(folder), None)
    return folder


def text_of(folder) -> str:
    return (folder / "report.html").read_text()


def unpacked(elements) -> dict[str, np.ndarray]:
    """What the page's program makes of its bytes: of each number all first bytes stand before all second ones."""
    content = zlib.decompress(base64.b64decode(elements.scripts["arrays"]))
    arrays = {}
    for about in json.loads(elements.scripts["about"])["arrays"]:
        kind, shape = np.dtype(about["type"]), (about["columns"], about["rows"])
        size = kind.itemsize * shape[0] * shape[1]
        raw = np.frombuffer(content[about["offset"] : about["offset"] + size], np.uint8).reshape(kind.itemsize, -1)
        arrays[about["name"]] = raw.T.copy().view(kind).reshape(shape).T
    return arrays


def test_the_page_holds_the_map_as_it_is(folder):
    arrays, walls = unpacked(Elements(text_of(folder))), two_walls()
    np.testing.assert_array_equal(arrays["mean"], walls.means)
    upper = np.asarray(walls.covs)[:, *np.triu_indices(3)]
    np.testing.assert_allclose(arrays["cov"].astype(float) * COV_UNIT, upper, rtol=1e-3)  # float16 has 11 bits
    np.testing.assert_allclose(arrays["color"] / 255, walls.colors, atol=0.5 / 255)
    np.testing.assert_array_equal(arrays["normal"], np.tile([0, 0, -127], (len(walls.means), 1)))
    np.testing.assert_array_equal(arrays["label"][:, 0], np.asarray(walls.features).argmax(1))
    np.testing.assert_array_equal(arrays["similarity"], 255 * np.asarray(walls.features))
    sofa = np.asarray(walls.features)[:, 1] > 0.5  # two features differ along one direction, from one end to the other
    shown = [{tuple(color.tolist()) for color in arrays["feature"][rows]} for rows in (sofa, ~sofa)]
    assert shown in ([{(255, 128, 128)}, {(0, 128, 128)}], [{(0, 128, 128)}, {(255, 128, 128)}])
    np.testing.assert_allclose(arrays["poses"].reshape(6, 3, 4)[:, 0, 3], np.linspace(0, 0.5, 6), atol=1e-6)
    assert np.isnan(arrays["online"][0]).all() and np.isfinite(arrays["online"][1:]).all()


def test_the_page_asks_for_nothing_and_runs_no_script_but_its_own(folder):
    text = text_of(folder)
    elements = Elements(text)
    for tag, attributes in elements.found:
        assert not any(name.startswith("on") for name in attributes), (tag, attributes)
        for name in ("src", "href", "action", "data", "poster", "srcset"):
            assert str(attributes.get(name) or "data:").startswith("data:"), (tag, attributes)
    assert "http:" not in text.replace("http-equiv", "") and "https:" not in text
    policy = next(a["content"] for _, a in elements.found if a.get("http-equiv") == "Content-Security-Policy")
    digest = base64.b64encode(hashlib.sha256(elements.scripts[""].encode()).digest()).decode()
    assert policy.startswith("default-src 'none'") and policy.endswith(f"script-src 'sha256-{digest}'")


def test_hostile_names_stay_text(tmp_path):
    folder = written_run(tmp_path, sequence=HOSTILE)
    lines = (folder / "frames.jsonl").read_text().splitlines()
    first = json.loads(lines[0]) | {"reason": HOSTILE, "status": HOSTILE}
    (folder / "frames.jsonl").write_text("\n".join([json.dumps(first), *lines[1:]]) + "\n")
    write_report(read_run(folder), None)
    elements, plain = Elements(text_of(folder)), written_run(tmp_path / "plain")
    write_report(read_run(plain), None)
    tags = [tag for tag, _ in elements.found]
    assert tags.count("script") == [tag for tag, _ in Elements(text_of(plain)).found].count("script") == 5
    assert "alert" not in elements.scripts[""]
    assert "<" not in elements.scripts["about"]  # an end of a script may have a space or a slash before its >
    assert json.loads(elements.scripts["about"])["frames"]["reason"][0] == HOSTILE
    assert not any("onerror" in attributes for _, attributes in elements.found)


def test_the_same_run_gives_the_same_bytes(folder, tmp_path):
    other = written_run(tmp_path)
    write_report(read_run(other), None)
    assert (other / "report.html").read_bytes() == (folder / "report.html").read_bytes()


def test_without_a_program_the_words_and_curves_are_there(folder):
    text = re.sub(r"<script.*?</script>", "", text_of(folder), flags=re.DOTALL)
    assert "SIMULATED" in text
    assert "The path is off by 1.2 cm" in text and "60 % less than the prior alone (3.0 cm)" in text
    assert "emgs run" in text and "dataset.stop" in text and "paper/sim3" in text
    assert "refused: what both show is in a small part of an image" in text and "frames 5 and 0: accepted" in text
    assert text.count("<svg") == 8 and "map.npz" in text and "Apache-2.0" in text  # statuses, six curves, loops


def test_a_large_map_is_thinned_to_the_size_of_a_page_and_the_page_says_so(tmp_path, monkeypatch):
    folder = written_run(tmp_path)
    monkeypatch.setattr(page, "_MAP_BYTES", 5_000)
    write_report(read_run(folder), None)
    elements = Elements(text_of(folder))
    shown, whole = len(unpacked(elements)["mean"]), len(two_walls().means)
    assert len(elements.scripts["arrays"]) <= 5_000 and 0 < shown < whole
    assert f"The page shows the {shown:,} of {whole:,} Gaussians" in text_of(folder)
    assert len(text_of(folder).encode()) < MAX_BYTES


def test_where_the_paths_alone_are_too_many_the_page_has_them_and_no_gaussian(tmp_path, monkeypatch):
    """Symptom: after 20,000 frames the run ended with 'cannot reshape array of size 0', and no page."""
    folder = written_run(tmp_path)
    monkeypatch.setattr(page, "_MAP_BYTES", 10)
    write_report(read_run(folder), None)
    arrays = unpacked(Elements(text_of(folder)))
    assert len(arrays["mean"]) == 0 and arrays["cov"].shape == (0, 6) and len(arrays["poses"]) == 6
    assert f"The page shows the 0 of {len(two_walls().means):,} Gaussians" in text_of(folder)


def test_loops_name_frames_as_the_rest_of_the_page_does(tmp_path):
    """After a skipped image places in use and indices of the data set are not the same."""
    folder = written_run(tmp_path)
    lines = [json.loads(line) for line in (folder / "frames.jsonl").read_text().splitlines()]
    lines = [line | {"index": line["index"] + 1} for line in lines]
    (folder / "frames.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    write_report(read_run(folder), None)
    text = text_of(folder)
    assert "frames 6 and 1: accepted" in text and "frames 5 and 0" not in text


@pytest.mark.parametrize(
    ("settings", "is_metric"),
    [
        ({"level": 1.0}, True),
        ({"structure": {"median_depth": 2.0}}, False),  # multiview_stereo, and a recording of it
        ({"scale": "arbitrary", "anchor_depth_m": 2.0}, False),
        ({"scale": "metric"}, True),
    ],
)
def test_whether_lengths_are_metres_is_what_the_prior_says_of_itself(settings, is_metric):
    run = SimpleNamespace(provenance={"prior": {"name": "recorded", "settings": settings}, "config": {"prior": {}}})
    assert page_words.is_metric(run) == is_metric


def test_thinning_keeps_what_most_frames_agree_on_in_its_order():
    layers = {"updates": np.array([5, 1, 9, 5, 5]), "mean": np.arange(5)}
    assert list(thinned(layers, 3)["mean"]) == [0, 2, 3]
    assert list(thinned(layers, 9)["mean"]) == [0, 1, 2, 3, 4]


def test_packing_is_undone_by_reading_columns_and_bytes():
    values = np.array([[1.5, -2.0], [1e-3, 7.0], [0.0, 4e4]], np.float32)
    about, text = packed({"a": values, "b": np.array([-3, 300], np.int16)})
    content = zlib.decompress(base64.b64decode(text))
    assert [(item["name"], item["rows"], item["columns"], item["offset"]) for item in about] == [
        ("a", 3, 2, 0),
        ("b", 2, 1, 24),
    ]
    first_bytes = np.ascontiguousarray(values.T).view(np.uint8).reshape(-1, 4)[:, 0]
    assert content[:6] == first_bytes.tobytes() and content[24:] == bytes([0xFD, 0x2C, 0xFF, 0x01])


def test_the_true_path_is_placed_on_ours_as_the_error_is_measured(folder):
    run = read_run(folder)
    placed = placed_paths(run, with_scale=True)
    left = np.linalg.norm(placed.truth[:, :3, 3] - run.poses[:, :3, 3], axis=1)
    assert left.max() < 0.03  # of .05 m that the paths are apart, and .03 m to the side
    assert placed.errors["ours"].max() < 0.035 and set(placed.errors) == {"ours", "online", "raw"}
    assert placed.errors["raw"].max() < 1e-6  # its path is the true one, in this run


def test_a_true_path_that_is_ours_in_another_frame_and_size_lies_on_ours(folder):
    run = read_run(folder)
    similarity = random_similarity(np.random.default_rng(0), 2.5)
    run = replace(run, truth=similarity.apply_to_poses(run.poses))
    placed = placed_paths(run, with_scale=True)
    np.testing.assert_allclose(placed.truth, run.poses, atol=1e-9)  # float64
    assert placed.errors["ours"].max() < 1e-9


@pytest.mark.parametrize(
    ("metrics", "level"),
    [
        ({}, "good"),
        ({"trajectory/ate_sim3_m": 0.04}, "bad"),  # worse than the raw prior's 3 cm
        ({"rendering/depth_within_5_percent": 50.0, "raw_prior/rendering/depth_within_5_percent": 60.0}, "mixed"),
        ({"rendering/depth_within_5_percent": 70.0, "raw_prior/rendering/depth_within_5_percent": 60.0}, "good"),
    ],
)
def test_the_verdict_compares_with_the_raw_prior(tmp_path, metrics, level):
    folder = written_run(tmp_path, **metrics)
    text = (folder / "frames.jsonl").read_text().replace('"degraded"', '"tracked"').replace('"lost"', '"tracked"')
    (folder / "frames.jsonl").write_text(text)
    assert verdict(read_run(folder))[0] == level


def test_without_truth_only_the_tracking_is_judged(tmp_path):
    level, words = verdict(read_run(written_run(tmp_path, has_truth=False)))
    assert level == "bad" and "no ground truth" in words and "(1 degraded, 1 lost)" in words  # a sixth is lost
    write_report(read_run(tmp_path), None)
    assert "None: the data set has no ground truth" in text_of(tmp_path)


@pytest.mark.parametrize("name", ["metrics.json", "frames.jsonl", "trajectory.txt", "map.npz"])
def test_a_folder_that_lacks_a_file_is_refused_by_its_name_and_left_as_it_is(tmp_path, name):
    folder = written_run(tmp_path)
    (folder / "report.html").write_text("old")
    (folder / name).unlink()
    with pytest.raises(ValueError, match=f"holds no finished run: it lacks {name}"):
        report(folder)
    assert (folder / "report.html").read_text() == "old"


def edited(path, change):
    path.write_text(change(path.read_text()))


@pytest.mark.parametrize(
    ("name", "change", "words"),
    [
        ("metrics.json", lambda text: text.replace('"format": 1', '"format": 9'), "another version"),
        ("metrics.json", lambda text: text[:50], "is not the result of a run"),
        (
            "metrics.json",
            lambda text: text.replace('"emgs_jax": ', '"emgs_jaz": '),
            "provenance.versions.emgs_jax is None",
        ),
        ("metrics.json", lambda text: text.replace('"git": null', '"git": {"a": 1}'), "git has no revision"),
        ("metrics.json", lambda text: text.replace('"git": null', '"gut": null'), "provenance.git is None"),
        (
            "metrics.json",
            lambda text: text.replace('"protocol": "', '"prottocol": "', 1),
            "provenance.protocol is None",
        ),
        (
            "metrics.json",
            lambda text: re.sub('"tile_batch": [0-9]+', '"tile_batch": null', text),
            "render.tile_batch must be",
        ),
        ("metrics.json", lambda text: text.replace("0.012", '"0.012"'), "trajectory/ate_sim3_m is '0.012'"),
        ("metrics.json", lambda text: text.replace('"intrinsics"', '"other"'), "which camera"),
        ("metrics.json", lambda text: text.replace("emgs_jax.data.synthetic.Synthetic", "os.system"), "os.system"),
        ("frames.jsonl", lambda text: text + '{"index": 3\n', "frames.jsonl:7 is no record"),
        ("frames.jsonl", lambda text: "".join(text.splitlines(True)[:-1]), "5 poses and trajectory.txt 6"),
        ("loops.json", lambda text: text.replace("5", "77"), "loops.json names frames"),
        ("loops.json", lambda text: text.replace('"accepted"', '"</script>"'), "loops.json names frames"),
        ("trajectory_online.txt", lambda text: text + 3 * text.splitlines()[-1] + "\n", "expected"),
    ],
)
def test_a_damaged_or_foreign_file_is_named_and_nothing_is_written(tmp_path, name, change, words):
    folder = written_run(tmp_path)
    edited(folder / name, change)
    with pytest.raises(ValueError, match=words):
        report(folder)
    assert not (folder / "report.html").exists()


def test_text_of_another_run_is_refused(tmp_path):
    from emgs_jax.features.text import TextEmbeddings, save_text

    folder = written_run(tmp_path)
    save_text(folder / "text.npz", TextEmbeddings(CLASSES, np.eye(2, 5, dtype=np.float32), (), {}))
    with pytest.raises(ValueError, match="embeddings of width 5 and map.npz features of width 2"):
        write_report(read_run(folder), None)


def test_settings_of_older_code_make_a_page_without_images_that_says_so(tmp_path, capsys):
    folder = written_run(tmp_path)
    edited(folder / "metrics.json", lambda text: text.replace('"on_bad_frame"', '"of_older_code"', 1))
    report(folder)
    assert "the run is of another version (Missing key on_bad_frame)" in capsys.readouterr().out
    assert "of another version" in (folder / "report.html").read_text()


def test_every_data_set_has_a_word_on_its_licence():
    assert {*groups()["dataset"]} == {*DATA_LICENCES}
