"""Data of a run for the viewer, whether it is finished or still maps."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from emgs_jax.ops.camera import Camera
from emgs_jax.render.composite import RenderConfig
from emgs_jax.report.page import render_config
from emgs_jax.report.page_map import feature_layer, map_layers
from emgs_jax.report.page_strip import placed_paths
from emgs_jax.report.recorded_run import RecordedRun
from emgs_jax.report.viewer_layers import Layers


@dataclass(frozen=True)
class Shown:
    """A run as the viewer has it.

    Args:
        layers: of the confirmed Gaussians, as `map_layers` and `feature_layer` make them; empty before there is a map.
        names: of the classes; none without.
        frames: what is known of each, as in frames.jsonl.
        poses: T_world_camera of `frames`, (n, 4, 4).
        truth: true camera centres in the frame of the map, (n, 3); nan where unknown.
        camera: of the frames.
        render: how the map is drawn.
        image: of the last frame, uint8 (h, w, 3); None where nobody has it.
    """

    layers: Layers
    names: tuple[str, ...]
    frames: Sequence[Mapping[str, Any]]
    poses: np.ndarray
    truth: np.ndarray
    camera: Camera
    render: RenderConfig
    image: np.ndarray | None = None

    @property
    def is_placed(self) -> np.ndarray:
        """Of each frame, bool (n,): its pose means something; a lost one's is a guess."""
        return np.array([frame["status"] != "lost" for frame in self.frames], bool)


def shown(run: RecordedRun) -> Shown:
    """A finished run; raises ValueError where its parts do not fit each other."""
    alignment = run.provenance["config"].get("evaluation", {}).get("alignment")
    return Shown(
        layers=map_layers(run.map, run.text) | feature_layer(run.map),
        names=() if run.text is None else run.text.names,
        frames=run.frames,
        poses=run.poses,
        truth=placed_paths(run, alignment == "sim3").truth[:, :3, 3],
        camera=run.camera,
        render=render_config(run),
    )
