"""Every value of conf/ is what its field declares, and what is not is refused in one line with the key to change."""

import dataclasses
from collections.abc import Sequence

import pytest
from hydra.core.override_parser.overrides_parser import OverridesParser
from omegaconf import OmegaConf
from omegaconf.errors import MissingMandatoryValue
from tiny_run import TINY, compose

from emgs_jax.config import configure
from emgs_jax.config.configure import build, groups, message_of
from emgs_jax.config.values import check_value, check_values, declared
from emgs_jax.data.images import Images
from emgs_jax.ops.pytree import choice, static, traced
from emgs_jax.ops.ranges import number
from emgs_jax.sequence import load_config

pytestmark = pytest.mark.slow

GROUPS = groups()
PARTS = ("slam", "densify", "evaluation", "graph", "dataset", "prior", "features", "baseline.voxel", "baseline.tsdf")


def check_all(*overrides: str) -> None:
    """The groups are chosen by Hydra, and then the values are put where it would put them, as it reads them."""
    words = [word for word in overrides if word.split("=")[0] in GROUPS]
    config = compose(*words)
    for word in OverridesParser.create().parse_overrides([word for word in overrides if word not in words]):
        OmegaConf.update(config, word.key_or_group, word.value(), merge=False)
    for part in PARTS:
        check_values(config, part)


def test_a_list_of_another_length_is_refused_and_one_of_any_length_may_have_any():
    """`graph.place_recognition.grid=[80]` ended in an error of zip."""
    with pytest.raises(ValueError, match=r"grid must be a list \[…, …\] of 2 whole numbers from 1 to 4096, got \[80\]"):
        check_all("graph=default", "graph.place_recognition.grid=[80]")
    check_all("graph=default", "graph.place_recognition.grid=[80,60]", "evaluation.f1_thresholds_m=[0.1]")


def test_every_value_of_conf_is_in_its_range():
    """The first options of all groups together, then the second ones, …; what is wrong is named by its full key."""
    others = ("suite", "experiment", "experiment_on", "densify_on", "protocol", "prior/dense")
    options = {group: names for group, names in groups().items() if group not in others}
    for place in range(max(map(len, options.values()))):
        config = configure.compose(*(f"{group}={names[place % len(names)]}" for group, names in options.items()))
        for part in PARTS:
            check_values(config, part)
    check_all("experiment=paper")
    for option in groups()["prior/dense"]:
        check_all("prior=multiview_stereo", f"prior/dense={option}")


def test_intrinsics_are_numbers_that_a_name_may_precede():
    field = declared(Images)["intrinsics"]
    check_value("dataset.intrinsics", ["OPENCV_FISHEYE", 130, 128.5, 80, 59, 0.02, 0, 0, 0], field)
    for given in (525, [float("nan"), 1, 2, 3], [[1, 2], 3]):
        with pytest.raises(ValueError, match="dataset.intrinsics must be a list .* of numbers or text or text or null"):
            check_value("dataset.intrinsics", given, field)


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("slam.em.max_mahalanobis_sq=nan", "slam.em.max_mahalanobis_sq must be a number from 0 to inf, got nan: give"),
        ("slam.em.noise=1e30", "slam.em.noise must be a number from 0 to 1000000, got 1e.30"),
        ("slam.em.normal_weight=abc", "slam.em.normal_weight must be a number from 0 to 1000000, got 'abc'"),
        ("slam.em.normal_weight=null", "slam.em.normal_weight must be a number from 0 to 1000000, got null"),
        ("slam.em.normal_weight=true", "slam.em.normal_weight must be a number .*, got True"),
        ("slam.em.max_log_gap=.nan", "slam.em.max_log_gap must be a number from 0 to inf, got '.nan'"),
        ("slam.em.max_log_gap=.inf", r"'.inf', which is text \(on the command line infinity is written inf\)"),
        ("slam.em.support=both", "slam.em.support must be one of printed, normalized; got 'both'"),
        ("slam.em.support=1", "slam.em.support must be one of printed, normalized; got 1"),
        ("slam.em.num_neighbours=0", "slam.em.num_neighbours must be a whole number from 1 to 256, got 0"),
        ("slam.localization.icp.tolerance=1e-9", "slam.localization.icp.tolerance must be a number from 1e-07 to 1"),
        ("slam.submap.map_capacity=0", "slam.submap.map_capacity must be a whole number from 1 to 67108864, got 0"),
        ("slam.window_size=2.5", "slam.window_size must be a whole number from 1 to 1000, got 2.5"),
        ("render.tile_size=0", "^render.tile_size must be a whole number from 1 to 1024, got 0"),
        ("evaluation.f1_thresholds_m=[0.1,nan]", r"evaluation.f1_thresholds_m must be a list .*got \[0.1, nan\]"),
        ("dataset.stride=2.5", "dataset.stride must be a whole number, got 2.5"),
        ("dataset.size=null", r"dataset.size must be a list \[…, …\] of whole numbers, got null"),
        ("dataset.size=[64.5,48]", r"dataset.size must be a list .* of whole numbers, got \[64.5, 48\]"),
        ("prior.level=nan", "prior.level must be a number, got nan"),
        (
            "graph=default graph.place_recognition.grid=[80,0]",
            r"graph.place_recognition.grid must be a list .* from 1 to 4096, got \[80, 0\]",
        ),
        ("prior=multiview_stereo prior.dense.depth.max_cost=nan", "prior.dense.depth.max_cost must be a number"),
        ("baseline=voxel baseline.voxel.voxel_m=-1", "baseline.voxel.voxel_m must be a number"),
        ("slam.em.average=3", "^slam.em.average=3 would replace all of its keys: give slam.em.average.KEY="),
        ("graph=default graph.noise=null", "^graph.noise=null would replace all of its keys"),
        ("evaluation.icp_voxel_m={}", "^evaluation.icp_voxel_m must be a number"),
        ("slam.em.support={}", "^slam.em.support must be one of printed, normalized"),
    ],
)
def test_a_value_out_of_range_is_one_line_with_its_full_key(override, message):
    """`slam.em.max_mahalanobis_sq=nan` fused nothing and reported every frame as tracked."""
    with pytest.raises(ValueError, match=message) as caught:
        check_all(*override.split())
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("override", ["slam.em.max_log_gap=inf", "slam.em.min_normal_cos=-inf", "dataset.stop=null"])
def test_what_a_field_allows_is_allowed(override):
    check_all(override)


def test_a_config_and_a_run_check_before_anything_is_made():
    with pytest.raises(ValueError, match=r"slam\.em\.noise must be"):
        load_config(*TINY, "slam.em.noise=nan")
    with pytest.raises(ValueError, match=r"evaluation\.voxel_m must be"):
        build(compose("evaluation.voxel_m=nan"), "evaluation")
    with pytest.raises(ValueError, match="^densify=2 would replace all of its keys"):
        load_config(*TINY, "densify=2")
    with pytest.raises(ValueError, match=r"^render=\[\]: .*render"):
        load_config("render=[]")


def test_a_value_that_is_referred_to_is_named_where_it_stands_and_one_in_its_place_where_that_is():
    config = compose("slam.fit.min_std=0.02")
    check_values(config, "slam")
    OmegaConf.update(config, "slam.em.min_std", -1.0)
    with pytest.raises(ValueError, match=r"^slam\.em\.min_std must be"):
        check_values(config, "slam")


@dataclasses.dataclass
class Plain:
    count: int
    share: float = number(low=0, high=1)
    sizes: tuple[int, ...] = number(low=2)
    name: str | None = None
    other: object = None


class Listed:
    def __init__(
        self, sizes: Sequence[int], what: str | Sequence[int | float], unknown: dict, flag: bool = True
    ) -> None:
        pass


def test_kinds_come_from_annotations_and_what_is_not_declared_is_left_alone():
    right = {"count": [3], "share": [0, 0.5, 1], "sizes": [[2, 300]], "name": ["a", None], "other": [3, None, "a", {}]}
    right |= {"flag": [True], "what": ["a", [1, 2.5]], "unknown": [3, "a", [1]]}
    wrong = {"count": [2.5, True, None, "3"], "share": [1.5, float("nan")], "sizes": [3, [1], ["a"], None], "name": [3]}
    wrong |= {"flag": [1, "true"], "what": [3, ["a"], None]}
    fields = declared(Listed) | declared(Plain)
    for name, values in right.items():
        for value in values:
            check_value(name, value, fields[name])
    for name, values in wrong.items():
        for value in values:
            with pytest.raises(ValueError, match=f"^{name} must be "):
                check_value(name, value, fields[name])


def test_the_makers_of_fields_keep_their_ranges():
    assert traced(low=0).metadata["range"] == (0, 1e6) and static(low=1, high=5).metadata["range"] == (1, 5)
    assert "range" not in traced().metadata and choice("a", "b").metadata["choices"] == ("a", "b")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda node: OmegaConf.update(node, "gone", 1, force_add=True), "unexpected keyword argument 'gone'"),
        (lambda node: dict.pop(node._content, "render"), "missing .* required .*argument: 'render'"),
    ],
)
def test_keys_of_another_version_are_said_to_be_that(change, message):
    """A run of older code, or a key that was added with +, ended in Python's words about `__init__`."""
    config = compose()
    change(config.densify)
    with pytest.raises(ValueError, match=rf"^the keys of densify are not those of .*DensifyConfig: .*{message}"):
        build(config, "densify")


def test_a_value_that_has_to_be_given_and_a_file_of_the_system_are_named_in_one_line(tmp_path):
    config = compose("features=dinov3_text")
    with pytest.raises(MissingMandatoryValue) as missing:
        _ = config.features.checkpoint
    assert message_of(missing.value) == "features.checkpoint is not given: add features.checkpoint=…"
    with pytest.raises(OSError) as absent:
        (tmp_path / "none").read_text()
    assert message_of(absent.value) == f"{tmp_path}/none: No such file or directory"
