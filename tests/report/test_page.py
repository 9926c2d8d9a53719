"""report.html as text; oracles: an HTML parser, unpacking by hand, metrics that are known, hostile names."""

import base64
import hashlib
import json
import re
import zlib
from dataclasses import replace

import numpy as np
import pytest
from hand_run import STATUSES, random_similarity
from page_elements import HOSTILE, Elements
from written_run import CLASSES, two_walls, written_run

from emgs_jax.config.configure import groups
from emgs_jax.drawing.layers import COV_UNIT, closing_covariances, fitted, packed, thinned
from emgs_jax.drawing.splats import read_splats, splats_for_page
from emgs_jax.features.text import TextEmbeddings, save_text
from emgs_jax.io.ply import save_gaussians_ply
from emgs_jax.report.evaluation_page import run_facts
from emgs_jax.report.html import DATA_LICENCES
from emgs_jax.report.page import write_report
from emgs_jax.report.page_strip import strip
from emgs_jax.report.page_words import errors, verdict
from emgs_jax.report.printout import metrics_table
from emgs_jax.runs.finished_run import placed_paths, read_run
from emgs_jax.runs.provenance import is_metric
from experiments.report import report

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = written_run(tmp_path_factory.mktemp("run"))
    write_report(read_run(folder), None)
    return folder


def text_of(folder) -> str:
    return (folder / "report.html").read_text()


def edited(path, change) -> None:
    path.write_text(change(path.read_text()))


def unpacked(elements) -> dict[str, np.ndarray]:
    """What the page's program makes of its bytes."""
    return unpack_block(elements.scripts["arrays"], json.loads(elements.scripts["about"])["arrays"])


def unpack_block(text: str, described: list[dict]) -> dict[str, np.ndarray]:
    """Of each number all first bytes stand before all second ones."""
    content, arrays = zlib.decompress(base64.b64decode(text)), {}
    for about in described:
        kind, shape = np.dtype(about["type"]), (about["columns"], about["rows"])
        size = kind.itemsize * shape[0] * shape[1]
        raw = np.frombuffer(content[about["offset"] : about["offset"] + size], np.uint8).reshape(kind.itemsize, -1)
        arrays[about["name"]] = raw.T.copy().view(kind).reshape(shape).T
    return arrays


def test_the_page_holds_the_map_as_it_is(folder):
    arrays, walls = unpacked(Elements(text_of(folder))), two_walls()
    np.testing.assert_array_equal(arrays["mean"], walls.means)
    covs = closing_covariances(walls.means, walls.covs, walls.normals)
    upper = covs[:, *np.triu_indices(3)]
    np.testing.assert_allclose(
        arrays["cov"].astype(float) * COV_UNIT, upper, rtol=1e-3, atol=1e-9
    )  # float16 has 11 bits
    np.testing.assert_allclose(arrays["color"] / 255, walls.colors, atol=0.5 / 255)
    np.testing.assert_array_equal(arrays["normal"], np.tile([0, 0, -127], (len(walls.means), 1)))
    np.testing.assert_array_equal(arrays["label"][:, 0], np.asarray(walls.features).argmax(1))
    np.testing.assert_array_equal(arrays["similarity"], 255 * np.asarray(walls.features))
    sofa = np.asarray(walls.features)[:, 1] > 0.5  # two features differ along one direction, from one end to the other
    shown = [{tuple(color.tolist()) for color in arrays["feature"][rows]} for rows in (sofa, ~sofa)]
    assert shown in ([{(255, 128, 128)}, {(0, 128, 128)}], [{(0, 128, 128)}, {(255, 128, 128)}])
    is_lost = np.array([status == "lost" for status in STATUSES])
    expected = np.where(is_lost, np.nan, np.linspace(0, 0.5, 6))  # a guess is no place
    np.testing.assert_allclose(arrays["poses"].reshape(6, 3, 4)[:, 0, 3], expected, atol=1e-6)
    online = arrays["online"].reshape(6, 12)
    assert np.isnan(online).any(1).tolist() == [row == 0 or one == "lost" for row, one in enumerate(STATUSES)]


def test_the_program_that_may_run_is_the_pages_own_and_the_same_run_gives_the_same_bytes(folder, tmp_path):
    elements = Elements(text_of(folder))
    policy = next(a["content"] for _, a in elements.found if a.get("http-equiv") == "Content-Security-Policy")
    digest = base64.b64encode(hashlib.sha256(elements.scripts[""].encode()).digest()).decode()
    assert policy.startswith("default-src 'none'") and policy.endswith(f"script-src 'sha256-{digest}'")
    other = written_run(tmp_path)
    write_report(read_run(other), None)
    assert (other / "report.html").read_bytes() == (folder / "report.html").read_bytes()


def test_hostile_names_stay_text_and_loops_name_frames_as_the_rest_of_the_page_does(folder, tmp_path):
    """After a skipped image places in use and indices of the data set are not the same."""
    hostile = written_run(tmp_path, sequence=HOSTILE, has_truth=False)
    lines = [json.loads(line) for line in (hostile / "frames.jsonl").read_text().splitlines()]
    lines = [line | {"index": line["index"] + 1} for line in lines]
    lines[0] |= {"reason": HOSTILE, "status": HOSTILE}
    (hostile / "frames.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    level, words = verdict(read_run(hostile))
    assert level == "bad" and "no ground truth" in words and "(1 degraded, 1 lost)" in words  # a sixth is lost
    write_report(read_run(hostile), None)
    elements = Elements(text_of(hostile))
    tags, plain = ([tag for tag, _ in page.found] for page in (elements, Elements(text_of(folder))))
    assert tags.count("script") == plain.count("script") == 7 and "alert" not in elements.scripts[""]
    assert "<" not in elements.scripts["about"]  # an end of a script may have a space or a slash before its >
    assert json.loads(elements.scripts["about"])["frames"]["reason"][0] == HOSTILE
    assert not any(name.startswith("on") for _, attributes in elements.found for name in attributes)
    assert "None: the data set has no ground truth" in text_of(hostile)
    assert "frames 6 and 1: accepted" in text_of(hostile) and "frames 5 and 0" not in text_of(hostile)


def test_without_a_program_the_words_and_curves_are_there(folder):
    text = re.sub(r"<script.*?</script>", "", text_of(folder), flags=re.DOTALL)
    assert "The path is off by 1.2 cm" in text and "60 % less than the prior alone (3.0 cm)" in text
    assert "refused: what both show is in a small part of an image" in text and "frames 5 and 0: accepted" in text
    assert all(
        word in text for word in ("SIMULATED", "emgs run", "dataset.stop", "paper/sim3", "map.npz", "Apache-2.0")
    )
    assert text.count("<svg") == 8  # statuses, six curves, loops


def test_a_large_map_is_thinned_to_what_most_frames_agree_on_and_paths_alone_may_be_too_many():
    """Symptom: after 20,000 frames the run ended with 'cannot reshape array of size 0', and no page."""
    rng = np.random.default_rng(0)
    layers = {"updates": rng.permutation(1000), "mean": rng.normal(size=(1000, 3)).astype(np.float32)}
    paths = {"poses": rng.normal(size=(6, 12)).astype(np.float32)}
    updates = layers["updates"]
    about, text, count = fitted(layers, paths, updates, 5_000)
    assert 4_000 < len(text) <= 5_000 and about[1]["rows"] == count < 1000
    most = np.flatnonzero(updates >= 1000 - count)  # in the order of the map
    np.testing.assert_array_equal(thinned(layers, updates, count)["mean"], layers["mean"][most])
    assert text == packed(thinned(layers, updates, count) | paths)[1]
    assert fitted(layers, paths, updates, 10**6) == (*packed(layers | paths), 1000)
    about, _, count = fitted(layers, paths, updates, 10)
    assert [item["rows"] for item in about] == [0, 0, 6] and count == 0


def test_the_page_holds_the_splats_of_a_polished_run_and_of_too_many_those_that_cover_most(tmp_path):
    """Means to a 65,535th of their box, covariances to float16; half of them are a hundredth as opaque."""
    walls = two_walls()
    opacity = np.where(np.arange(len(walls.means)) % 2, 0.9, 0.009)
    folder = written_run(tmp_path / "run")
    save_gaussians_ply(folder / "splats.ply", walls.means, walls.covs, walls.colors, opacity, walls.normals)
    elements = Elements(write_report(read_run(folder), None).read_text())
    about = json.loads(elements.scripts["about"])["splats"]
    arrays = unpack_block(elements.scripts["splats"], about["arrays"])
    means = np.array(about["low"]) + arrays["mean"] * np.array(about["step"])
    np.testing.assert_allclose(means, walls.means, atol=4.0 / 65535)
    variances = arrays["cov"].astype(float)[:, [0, 3, 5]] * COV_UNIT
    np.testing.assert_allclose(variances, [[3e-3, 2.5e-3, 1e-4]] * len(means), rtol=1e-3)
    np.testing.assert_allclose(arrays["color"] / 255, np.c_[walls.colors, opacity], atol=0.5 / 255 + 1e-6)
    np.testing.assert_array_equal(arrays["normal"], 127 * np.asarray(walls.normals))
    owned = unpack_block(elements.scripts["owners"], json.loads(elements.scripts["about"])["owners"])["owner"]
    np.testing.assert_array_equal(owned.ravel(), np.arange(len(means)), "splats where the Gaussians are")
    few, text, note, kept = splats_for_page(read_splats(folder / "splats.ply"), 2_000)
    count = few["arrays"][0]["rows"]
    assert f"shows the {count:,} of {len(means):,} splats" in note and count < len(means) / 2
    assert len(kept) == count
    assert len(text) <= 2_000 and (unpack_block(text, few["arrays"])["color"][:, 3] > 200).all()
    damaged = (folder / "splats.ply").read_bytes().replace(b"rot_3", b"turn3")
    (folder / "splats.ply").write_bytes(damaged)
    with pytest.raises(ValueError, match=r"splats.ply has no rot_3.*run emgs polish again"):
        write_report(read_run(folder), None)


@pytest.mark.parametrize(
    ("settings", "expected"),
    [
        ({"level": 1.0}, True),
        ({"structure": {"median_depth": 2.0}}, False),  # multiview_stereo, and a recording of it
        ({"structure": {"median_depth": 2.0}, "unit": "m"}, True),  # by scale=, or a network in metres
        ({"scale": "arbitrary", "anchor_depth_m": 2.0}, False),
        ({"scale": "metric"}, True),
    ],
)
def test_whether_lengths_are_metres_is_what_the_prior_says_of_itself(settings, expected):
    assert is_metric(settings) == expected


def test_a_true_path_that_is_ours_in_another_frame_and_size_lies_on_ours(folder):
    run = read_run(folder)
    placed = placed_paths(run)
    assert np.nanmax(placed.errors["ours"]) < 0.035 and set(placed.errors) == {"ours", "online", "raw"}
    assert np.nanmax(placed.errors["raw"]) < 1e-6  # its path is the true one, in this run
    np.testing.assert_allclose(placed.raw, placed.truth, atol=1e-9)
    lost = np.array(STATUSES) == "lost"
    assert np.isnan(placed.errors["online"]).tolist() == [True, *lost[1:]]
    assert np.isnan(placed.errors["ours"]).tolist() == lost.tolist()
    similarity = random_similarity(np.random.default_rng(0), 2.5)
    run = replace(run, truth=similarity.apply_to_poses(run.poses))
    run.truth[2] = np.nan  # known of the others only
    placed = placed_paths(run)
    np.testing.assert_allclose(np.delete(placed.truth, 2, 0), np.delete(run.poses, 2, 0), atol=1e-9)  # float64
    assert np.isnan(placed.truth[2]).all() and np.isnan(placed.errors["ours"]).sum() == 2
    assert np.nanmax(placed.errors["ours"]) < 1e-9


def test_without_truth_the_raw_path_of_a_run_in_a_saved_map_is_placed_on_ours(folder):
    run = read_run(folder)
    raw = random_similarity(np.random.default_rng(0), 2.5).apply_to_poses(run.poses)
    run = replace(run, truth=np.full_like(run.truth, np.nan), raw=raw)
    np.testing.assert_array_equal(placed_paths(run).raw, raw)  # it began in one world with ours
    config = run.provenance["config"] | {"map": "lab"}
    run = replace(run, metrics=run.metrics | {"provenance": run.provenance | {"config": config}})
    np.testing.assert_allclose(placed_paths(run).raw, run.poses, atol=1e-9)


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
    whole = [line for line in (folder / "frames.jsonl").read_text().splitlines() if '"lost"' not in line]
    (folder / "frames.jsonl").write_text("\n".join(whole).replace('"degraded"', '"tracked"') + "\n")
    (folder / "loops.json").unlink()  # which name frames
    assert verdict(read_run(folder))[0] == level


@pytest.mark.parametrize(("name", "unit"), [("colmap", "0.0123 units of the reference"), ("tum", "1.2 cm")])
def test_errors_against_poses_of_another_program_are_in_its_unit(tmp_path, name, unit):
    folder = written_run(tmp_path, **{"trajectory/ate_sim3_m": 0.0123, "raw_prior/trajectory/ate_sim3_m": 0.03})
    run = read_run(folder)
    block = run.provenance | {"data": run.provenance["data"] | {"name": name}}
    run = replace(run, metrics=run.metrics | {"provenance": block})
    assert f"The path is off by {unit}" in verdict(run)[1] and f"path off by {unit} (prior" in run_facts(run.metrics)
    of_page = " ".join(line[0] for line in errors(run).lines) + strip(run, {"ours": np.ones(6)})[1].unit
    for said in (metrics_table(run.metrics), of_page):
        assert ("units" in said, "cm" in said) == ((True, False) if name == "colmap" else (False, True))


def damage(name: str, before: str, after: str):
    """One edit of a file, once."""
    return name, lambda text: text.replace(before, after, 1)


@pytest.mark.parametrize(
    ("edit", "words"),
    [
        (damage("metrics.json", '"emgs_jax": ', '"emgs_jaz": '), "provenance.versions.emgs_jax is None"),
        (damage("metrics.json", '"git": null', '"git": {"a": 1}'), "git has no revision"),
        (damage("metrics.json", '"protocol": "', '"prottocol": "'), "provenance.protocol is None"),
        (
            ("metrics.json", lambda text: re.sub('"tile_batch": [0-9]+', '"tile_batch": null', text)),
            "render.tile_batch must be",
        ),
        (damage("metrics.json", "0.012", '"0.012"'), "trajectory/ate_sim3_m is '0.012'"),
        (("metrics.json", lambda text: text.replace('"intrinsics"', '"other"')), "which camera"),
        (damage("metrics.json", "emgs_jax.data.synthetic.Synthetic", "os.system"), "os.system"),
        (("frames.jsonl", lambda text: text + '{"index": 3\n'), "frames.jsonl:7 is no record"),
        (
            ("frames.jsonl", lambda text: "".join(text.splitlines(True)[:-1])),
            "4 frames that are placed and trajectory.txt 5",
        ),
        (damage("loops.json", "5", "77"), "loops.json names frames"),
        (damage("loops.json", '"accepted"', '"</script>"'), "loops.json names frames"),
        (("trajectory_online.txt", lambda text: text + 3 * text.splitlines()[-1] + "\n"), "expected"),
    ],
)
def test_a_damaged_or_foreign_file_is_named_and_the_page_stays_as_it_is(tmp_path, edit, words):
    folder, (name, change) = written_run(tmp_path), edit
    (folder / "report.html").write_text("old")
    edited(folder / name, change)
    with pytest.raises(ValueError, match=words):
        report(folder)
    assert (folder / "report.html").read_text() == "old"


def test_a_folder_that_lacks_a_file_or_has_the_text_of_another_run_is_refused(tmp_path):
    folder = written_run(tmp_path)
    save_text(folder / "text.npz", TextEmbeddings(CLASSES, np.eye(2, 5, dtype=np.float32), (), {}))
    with pytest.raises(ValueError, match="embeddings of width 5 and map.npz features of width 2"):
        write_report(read_run(folder), None)
    for name in ("map.npz", "trajectory.txt", "frames.jsonl", "metrics.json"):
        (folder / name).unlink()
        with pytest.raises(ValueError, match=f"holds no finished run: it lacks .*{name}"):
            report(folder)


def test_settings_of_older_code_make_a_page_without_images_that_says_so(tmp_path, capsys):
    folder = written_run(tmp_path)
    edited(folder / "metrics.json", lambda text: text.replace('"on_bad_frame"', '"of_older_code"', 1))
    report(folder)
    assert "the run is of another version (Missing key on_bad_frame)" in capsys.readouterr().out
    assert "of another version" in text_of(folder)


def test_every_data_set_has_a_word_on_its_licence():
    assert {*groups()["dataset"]} == {*DATA_LICENCES}
