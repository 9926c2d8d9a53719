"""Which files of tests one process takes, and in which order: those that need the same executables stay together."""

from pathlib import Path

import pytest

TESTS = Path(__file__).resolve().parent
# A whole run costs a process some 25 CPU seconds before its first frame, whatever is on disk: tracing and lowering.
# The longest first: a long one at the end would leave the other processes without work.
GROUPS = {
    "tiny": (
        "mapping/test_budgets.py",  # counts what is compiled, so it clears what others compiled
        "scripts/test_run.py",
        "mapping/test_pipeline.py",
        "mapping/test_moving_scenes.py",
        "mapping/test_checkpoint.py",
        "scripts/test_query_and_segment.py",
        "scripts/test_predict.py",
        "prior/files/test_prior_files.py",
        "scripts/test_quality.py",
        "test_soak.py",
        "test_front_door.py",
        "test_notebooks.py",
        "report/test_live_browser.py",
        "polish/test_polish.py",
    ),
    "smoke": ("mapping/test_coming_back.py", "mapping/test_disconnected_submaps.py", "scripts/test_walk.py"),
    "browser": ("report/test_page_browser.py", "report/test_table_page.py", "report/test_viewer.py"),  # one Chromium
    "small": (
        "mapping/test_capacity.py",
        "test_slam.py",
        "test_worlds.py",
    ),  # the first counts, as above
}
# What the quick subset (-m "not slow") takes nothing of, beside the marked tests: some five CPU seconds and more each.
SLOW = {
    "data/test_apartment.py",
    "data/test_movers.py",
    "mapping/test_moving_scenes.py",
    "test_motion.py",
    "data/test_rosbag.py",
    "features/test_dino.py",
    "features/test_dinotxt.py",
    "pose_graph/test_pose_graph_optimize.py",
    "loop_closure/test_verification.py",
    "ops/test_neighbours.py",
    "polish/test_polish.py",
    "prior/files/test_prior_files.py",
    "prior/multiview/test_depth.py",
    "prior/multiview/test_plane_sweep.py",
    "prior/simulated/test_simulated_drift.py",
    "registration/test_pose_noise.py",
    "registration/test_problem.py",
    *(f"report/{name}.py" for name in ("test_page", "test_page_browser", "test_query", "test_repeat")),
    "back_end/test_back_end.py",
    "config/test_values.py",
    "device/test_compilation.py",
    "mapping/test_relocalized_start.py",
    *(f"scripts/{name}.py" for name in ("test_command_line", "test_evaluate", "test_score")),
    "test_advice.py",
    "test_existence.py",
    "test_front_door.py",
    "test_mutants.py",
    "test_splitting.py",
}
_PLACES = {name: (group, place) for group, names in GROUPS.items() for place, name in enumerate(names)}


def group_of(path: Path | str) -> str:
    """The group of a file of tests, else its own name."""
    path = Path(path)
    name = path.relative_to(TESTS).as_posix() if path.is_relative_to(TESTS) else path.as_posix()
    name = name.removeprefix("tests/")
    return _PLACES.get(name, (name, 0))[0]


def in_order(items: list[pytest.Item]) -> list[pytest.Item]:
    """Groups as above, one after the other, then the files with most slow tests first."""
    num_slow: dict[str, int] = {}
    for item in items:
        group = group_of(item.path)
        num_slow[group] = num_slow.get(group, 0) + (item.get_closest_marker("slow") is not None)
    groups = [
        *GROUPS,
        *sorted((group for group in num_slow if group not in GROUPS), key=lambda group: -num_slow[group]),
    ]

    def place(item: pytest.Item) -> tuple[int, int]:
        name = item.path.relative_to(TESTS).as_posix() if item.path.is_relative_to(TESTS) else ""
        return groups.index(group_of(item.path)), _PLACES.get(name, ("", 0))[1]

    return sorted(items, key=place)


def scheduler(config: pytest.Config, log):
    """xdist's `loadfile`, with a group in the place of its files; None where another way was asked for."""
    from xdist.scheduler import LoadFileScheduling

    class LoadGroups(LoadFileScheduling):
        def _split_scope(self, nodeid: str) -> str:
            return group_of(nodeid.split("::")[0])

    return LoadGroups(config, log) if config.getvalue("dist") == "loadfile" else None
