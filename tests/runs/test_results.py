"""Oracles: what was written, means and spreads worked out by hand, the labels that a reader must see."""

import csv
import io
import json

import pytest

from emgs_jax.report.tables import average, full_table, paper_table, to_csv
from emgs_jax.runs.provenance import RESULT_FORMAT
from emgs_jax.runs.results import is_finished, read_estimates, result_folder

QUOTED = {"method": "MASt3R-SLAM", "source": "Table II", "protocol": "its own"}
QUOTED |= {"seven_scenes": [0.11, 0.16, 0.05, 85.0, 41.7, 88.4], "tum": [0.08, None, 0.03, 83.8, 44.2, 86.1]}


def write_result(
    out, ate, sequence="chess/seq-01", variant="default", seed=0, dataset="seven_scenes", simulated=True, **block
):
    folder = result_folder(out, dataset, sequence, variant, seed)
    folder.mkdir(parents=True)
    config = {"dataset": {"root": "here", "stride": 10}, "em": {"noise": 1.0}, "compilation_cache": None}
    about = {"format": RESULT_FORMAT, "protocol": "paper/sim3", "simulated": simulated, "config": config}
    about |= {"prior": {"name": "simulated" if simulated else "mapanything"}, "git": {"revision": "abc"}}
    block = about | {"data": {"name": dataset, "sequence": sequence}} | block
    metrics = {"trajectory/ate_sim3_m": ate, "trajectory/ate_se3_m": 2.0, "provenance": block}
    metrics["reconstruction/alignment_note"] = None
    if block["prior"]:
        metrics["raw_prior/trajectory/ate_sim3_m"] = 10 * ate
    (folder / "metrics.json").write_text(json.dumps(metrics))
    return folder


def of_kind(rows, kind):
    return next(row for row in rows if row.kind == kind)


def test_a_row_is_the_mean_over_sequences_and_its_spread_that_over_seeds(tmp_path):
    """Means over two sequences: seed 0 (1 + 3) / 2 = 2, seed 1 (2 + 6) / 2 = 4: mean 3, deviation √2."""
    for sequence, seed, ate in (("a", 0, 1.0), ("b", 0, 3.0), ("a", 1, 2.0), ("b", 1, 6.0)):
        write_result(tmp_path, ate, sequence, seed=seed)
    rows = average(read_estimates(tmp_path), each_sequence=False)
    ours, raw = of_kind(rows, "ours"), of_kind(rows, "raw prior")
    assert len(rows) == 2 and (ours.sequences, ours.seeds) == (("a", "b"), (0, 1))
    assert set(ours.values) == {"trajectory/ate_sim3_m", "trajectory/ate_se3_m"}
    assert set(raw.values) == {"trajectory/ate_sim3_m"}
    assert ours.values["trajectory/ate_sim3_m"] == 3.0
    assert ours.spreads["trajectory/ate_sim3_m"] == pytest.approx(2**0.5)
    assert raw.values["trajectory/ate_sim3_m"] == 30.0
    each = average(read_estimates(tmp_path), each_sequence=True)
    assert [(row.sequences, row.values["trajectory/ate_sim3_m"]) for row in each if row.kind == "ours"] == [
        (("a",), 1.5),
        (("b",), 4.5),
    ]


def test_a_seed_without_all_sequences_does_not_enter_the_mean_over_sequences(tmp_path):
    for sequence, seed, ate in (("a", 0, 1.0), ("b", 0, 3.0), ("a", 1, 2.0)):
        write_result(tmp_path, ate, sequence, seed=seed)
    ours = of_kind(average(read_estimates(tmp_path), each_sequence=False), "ours")
    assert ours.seeds == (0,) and ours.values["trajectory/ate_sim3_m"] == 2.0
    assert ours.spreads["trajectory/ate_sim3_m"] is None


def test_variants_protocols_and_priors_are_never_averaged_together(tmp_path):
    write_result(tmp_path, 1.0)
    write_result(tmp_path, 2.0, variant="paper")
    write_result(tmp_path, 3.0, seed=1, protocol="mast3r/sim3")
    write_result(tmp_path, 4.0, seed=2, simulated=False)
    rows = [row for row in average(read_estimates(tmp_path), each_sequence=False) if row.kind == "ours"]
    assert sorted(row.values["trajectory/ate_sim3_m"] for row in rows) == [1.0, 2.0, 3.0, 4.0]


def test_the_table_of_the_paper_labels_simulated_and_quoted_rows(tmp_path):
    write_result(tmp_path, 0.0321, seed=0)
    write_result(tmp_path, 0.0341, seed=1)
    write_result(tmp_path, 0.5, dataset="tum", sequence="freiburg1_xyz", simulated=False)
    table = paper_table(average(read_estimates(tmp_path), each_sequence=False), [QUOTED])
    lines = [line for line in table.splitlines() if line.startswith("|")]
    assert "must not be compared with quoted rows" in table
    assert lines[0].count("7-Scenes: ") == lines[0].count("TUM: ") == 6
    cells = {tuple(cell.strip() for cell in line.split("|")[1:4]): line for line in lines[2:]}
    ours = cells["ours, default", "**simulated**", "paper/sim3"]
    assert "| 7-Scenes 1 × 2 | – | – | 0.033 ± 0.001 | – |" in ours
    assert "| TUM 1 × 1 |" in cells["ours, default", "measured, mapanything", "paper/sim3"]
    quoted = cells["MASt3R-SLAM", "quoted: Table II", "its own"]
    assert quoted.endswith("| 0.11 | 0.16 | 0.05 | 85 | 41.7 | 88.4 | 0.08 | – | 0.03 | 83.8 | 44.2 | 86.1 |")
    assert len({line.count("|") for line in lines}) == 1
    # every row of ours that is made from the ground truth says so, the raw prior's too
    assert all("**simulated**" in line for line in lines if "7-Scenes 1 × 2" in line)


def test_the_trajectory_column_follows_the_alignment_and_quoted_rows_stand_beside_their_data_sets_only(tmp_path):
    write_result(tmp_path / "se3", 1.0, protocol="paper/se3")
    assert "| 2.000 |" in paper_table(average(read_estimates(tmp_path / "se3"), each_sequence=False), [])
    write_result(tmp_path / "room", 1.0, dataset="synthetic", sequence="room0")
    rows = average(read_estimates(tmp_path / "room"), each_sequence=False)
    assert paper_table(rows, [QUOTED]) == ""
    line = "| synthetic | room0 | ours, default | **simulated** | paper/sim3 | 1 | 100.00 | 200.00 |"
    assert line in full_table(rows)


def test_sim3_and_se3_stand_side_by_side_and_a_scale_beside_its_uncertainty(tmp_path):
    folder = write_result(tmp_path, 1.0, simulated=False, prior=None)
    (row,) = average(read_estimates(tmp_path), each_sequence=False)
    assert "| ATE Sim(3) [cm] | ATE SE(3) [cm] |" in full_table([row]) and "σ" not in full_table([row])
    metrics = json.loads((folder / "metrics.json").read_text())
    metrics |= {"prior/scale_std_percent": 2.51, "trajectory/scale_off_std": 1.24}
    (folder / "metrics.json").write_text(json.dumps(metrics))
    (row,) = average(read_estimates(tmp_path), each_sequence=False)
    titles, _, line = ([word.strip() for word in text.split("|")] for text in full_table([row]).splitlines())
    assert titles[-5:-2] == ["scale [%]", "scale ± [%]", "scale off [σ]"] and line[-4:-2] == ["2.5", "1.2"]


def test_another_system_is_no_run_of_ours(tmp_path):
    write_result(tmp_path, 1.0, variant="mast3r_slam", simulated=False, prior=None)
    (row,) = average(read_estimates(tmp_path), each_sequence=False)
    assert (row.kind, row.variant, row.prior) == ("scored", "mast3r_slam", None)
    assert "| scored, mast3r_slam | measured | paper/sim3 |" in full_table([row])


def test_baselines_are_rows_beside_ours_with_their_own_metrics(tmp_path):
    folder = write_result(tmp_path, 1.0)
    metrics = json.loads((folder / "metrics.json").read_text())
    metrics |= {"baseline_voxel_raw/rendering/psnr_db": 20.0, "baseline_tsdf_ours/rendering/psnr_db": 21.0}
    (folder / "metrics.json").write_text(json.dumps(metrics))
    rows = {item.kind: item.values for item in read_estimates(tmp_path)}
    assert list(rows) == ["ours", "raw prior", "voxel, raw poses", "TSDF, our poses"]
    assert rows["voxel, raw poses"] == {"rendering/psnr_db": 20.0}
    assert rows["TSDF, our poses"] == {"rendering/psnr_db": 21.0}
    assert "rendering/psnr_db" not in {*rows["ours"], *rows["raw prior"]}
    assert "| TSDF, our poses, default |" in full_table(average(read_estimates(tmp_path), each_sequence=True))


def test_the_csv_has_a_line_per_estimate_that_names_what_it_is_of(tmp_path):
    write_result(tmp_path, 0.5)
    ours, raw = csv.DictReader(io.StringIO(to_csv(read_estimates(tmp_path))))
    assert ours["kind"] == "ours" and raw["kind"] == "raw prior"
    assert float(ours["trajectory/ate_sim3_m"]) == 0.5 and float(raw["trajectory/ate_sim3_m"]) == 5.0
    assert raw["trajectory/ate_se3_m"] == ""
    for line in (ours, raw):
        names = ("dataset", "sequence", "variant", "seed", "protocol", "is_simulated", "revision")
        of = ["seven_scenes", "chess/seq-01", "default", "0", "paper/sim3", "True", "abc"]
        assert [line[name] for name in names] == of


def test_a_result_is_finished_if_it_was_made_with_the_same_settings_wherever_the_data_lies(tmp_path):
    config = {"dataset": {"root": "there", "stride": 10}, "em": {"noise": 1.0}, "compilation_cache": "cache"}
    assert not is_finished(tmp_path, config)
    folder = write_result(tmp_path, 0.5)
    assert is_finished(folder, config)
    with pytest.raises(
        ValueError, match=r"metrics.json was made with other settings \(em.noise was 1.0, now it is 2.0\)"
    ):
        is_finished(folder, config | {"em": {"noise": 2.0}})
    with pytest.raises(ValueError, match=r"em.window was None, now it is 3"):
        is_finished(folder, config | {"em": {"noise": 1.0, "window": 3}})


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ('{"provenance": {"format": 99}}', "was written by another version .format 99"),
        ('{"provenance": {}}', "was written by another version .format None"),
        ('{"trajectory/ate_sim3_m": 1}', "is not the result of a run"),
        ("[1, 2", "is not the result of a run"),
    ],
)
def test_results_of_another_version_are_refused_with_a_remedy(tmp_path, content, message):
    folder = write_result(tmp_path, 0.5)
    (folder / "metrics.json").write_text(content)
    with pytest.raises(ValueError, match=f"metrics.json {message}.*move its folder away or choose another out="):
        read_estimates(tmp_path)


@pytest.mark.parametrize("name", ["..", ".", "", "../../..", "a/b", "a\\b", "a\0"])
def test_a_name_that_leads_out_of_the_folder_of_results_is_refused(tmp_path, name):
    """`variant=../../..` wrote into the folder above."""
    with pytest.raises(ValueError, match="variant or method must be a name that is one folder below"):
        result_folder(tmp_path, "tum", "desk", name, 0)
    assert result_folder(tmp_path, "tum", "a/b", "x", 0) == tmp_path / "tum" / "a_b" / "x" / "0"
    with pytest.raises(ValueError, match="sequence must be a name"):
        result_folder(tmp_path, "tum", "..", "x", 0)
