"""A run as the viewer shows it, finished or not, and its scene: the map, both paths, the cameras."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from emgs_jax.drawing.colors import OURS, PATHS, STATUS_COLORS, rgb, to_bytes
from emgs_jax.drawing.layers import covariances, feature_layer, map_layers
from emgs_jax.drawing.overview import view_from_above
from emgs_jax.drawing.splats import Splats, owners, read_splats
from emgs_jax.mapping.records import UNPLACED
from emgs_jax.ops.camera import Camera
from emgs_jax.render.composite import RenderConfig
from emgs_jax.runs.finished_run import SPLATS_FILE, FinishedRun, placed_paths, render_config

MAX_FRUSTUMS = 300  # more would hide the map; the chosen frame has its own
KINDS = ("splats", "Gaussians", "points")  # ways to draw a map


@dataclass(frozen=True)
class Shown:
    """A run as the viewer has it."""

    layers: Mapping[str, np.ndarray]  # of `map_layers` and `feature_layer`; empty before there is a map
    names: tuple[str, ...]  # of the classes; none without
    frames: Sequence[Mapping[str, Any]]
    poses: np.ndarray  # T_world_camera of `frames`, (n, 4, 4)
    truth: np.ndarray  # true camera centres in the frame of the map, (n, 3); nan where unknown
    camera: Camera
    render: RenderConfig
    image: np.ndarray | None = None  # of the last frame, uint8 (h, w, 3); None if unavailable
    splats: Splats | None = None  # of `emgs polish`; None if it was not run
    owners: np.ndarray | None = None  # of `splats`, rows of `layers`
    progress: str = ""  # of a run that is not finished, in words

    @property
    def is_placed(self) -> np.ndarray:
        """Whether each frame's pose is meaningful, bool (n,); a lost frame's is a guess."""
        return np.array([frame["status"] not in UNPLACED for frame in self.frames], bool)


def shown(run: FinishedRun) -> Shown:
    """Prepare a finished run; raise ValueError if its parts do not fit each other."""
    layers, names = map_layers(run.map, run.text) | feature_layer(run.map), () if run.text is None else run.text.names
    truth = placed_paths(run).truth[:, :3, 3]
    splats = read_splats(run.folder / SPLATS_FILE)
    owned = None if splats is None else owners(splats.means, layers["mean"])
    facts = layers, names, run.frames, run.poses, truth, run.camera, render_config(run)
    return Shown(*facts, splats=splats, owners=owned)


class Scene:
    """The scene of a viser server."""

    def __init__(self, server: Any) -> None:
        self._server, self._scene = server, server.scene
        self.splats: Any = None  # the Gaussians, and their means as points
        self.points: Any = None
        self.sharp: Any = None  # the splats of `emgs polish`
        self.chosen: Any = None  # the frustum of one frame
        self.paths: list[Any] = []
        self.frustums: dict[int, Any] = {}
        self.covs = np.zeros((0, 3, 3), np.float32)  # of the Gaussians as they are drawn

    def draw(self, run: Shown, colors: np.ndarray) -> None:
        """Show a run with frames in place of the current one, with colours (n, 3) of its Gaussians."""
        self.covs, means = covariances(run.layers), run.layers["mean"]
        opacities = np.full((len(means), 1), float(run.render.opacity), np.float32)
        if self.splats is not None:
            self.splats.set_gaussians(means, self.covs, colors, opacities)
        elif len(means):
            self.splats = self._scene.add_gaussian_splats("/map", means, self.covs, colors, opacities)
        if len(means):
            self.points = self._scene.add_point_cloud("/points", means, colors, point_size=0.01, precision="float32")
        if run.splats is not None and self.sharp is None:
            places = (values.astype(np.float32) for values in (run.splats.means, run.splats.covs))
            look = to_bytes(run.splats.colors[:, :3]), run.splats.colors[:, 3:].astype(np.float32)
            self.sharp = self._scene.add_gaussian_splats("/splats", *places, *look)
        self.paths = [
            self._path("/our path", run.poses[:, :3, 3], run.is_placed, OURS),
            self._path("/true path", run.truth, np.isfinite(run.truth).all(1), PATHS["truth"].paper),
        ]
        self._draw_cameras(run)
        if self.chosen is None:
            placed = run.poses[run.is_placed] if run.is_placed.any() else run.poses[:1]
            self.chosen = self._frustum(run, "/frame", 0, "#ffffff", 0.1)
            self._scene.set_up_direction(view_from_above(placed, run.layers.get("normal"))[2])
            self._place_views(placed[0])

    def recolor(self, colors: np.ndarray, of_splats: np.ndarray | None) -> None:
        """Set colours (n, 3) of all Gaussians, and of the splats, if there are any."""
        if self.sharp is not None:
            self.sharp.rgbs = of_splats
        if self.splats is not None:
            self.splats.rgbs = colors
            self.points.colors = colors

    def show(self, kind: str, cameras: bool, paths: bool, is_chosen_placed: bool = True) -> None:
        """Choose what is visible: the map as one of `KINDS`, cameras, paths; a frame has a camera if it is placed."""
        for name, drawn in zip(KINDS, (self.sharp, self.splats, self.points), strict=True):
            if drawn is not None:
                drawn.visible = kind == name
        for path in filter(None, self.paths):
            path.visible = paths
        for frustum in self.frustums.values():
            frustum.visible = cameras
        if self.chosen is not None:
            self.chosen.visible = cameras and is_chosen_placed

    def choose(self, pose: np.ndarray, image: np.ndarray | None) -> None:
        """Place the frustum of the chosen frame at its pose, with its image if there is one."""
        _place(self.chosen, pose)
        self.chosen.image = image

    def _draw_cameras(self, run: Shown) -> None:
        """Draw the cameras of placed frames; move existing ones, because a back end moves poses."""
        placed = np.flatnonzero(run.is_placed)
        rows = {int(row) for row in placed[np.linspace(0, len(placed) - 1, min(len(placed), MAX_FRUSTUMS)).astype(int)]}
        for row in set(self.frustums) - rows:
            self.frustums.pop(row).remove()
        for row in sorted(rows):
            if row in self.frustums:
                _place(self.frustums[row], run.poses[row])
            else:
                color = STATUS_COLORS.get(run.frames[row]["status"], OURS)
                self.frustums[row] = self._frustum(run, f"/cameras/{row}", row, color, 0.04)

    def _path(self, name: str, centers: np.ndarray, is_known: np.ndarray, color: str) -> Any:
        """Draw segments between neighbours that are both known; None if there are none."""
        joined = np.flatnonzero(is_known[1:] & is_known[:-1])
        if not len(joined):
            return None
        ends = np.stack([centers[joined], centers[joined + 1]], axis=1).astype(np.float32)
        return self._scene.add_line_segments(name, ends, _rgb(color), thickness=2.0, thickness_units="screen")

    def _frustum(self, run: Shown, name: str, row: int, color: str, scale: float) -> Any:
        look = {"scale": scale, "thickness": 1.5, "thickness_units": "screen", "color": _rgb(color)}
        ratio = run.camera.width / run.camera.height
        frustum = self._scene.add_camera_frustum(name, field_of_view(run.camera), ratio, **look)
        _place(frustum, run.poses[row])
        return frustum

    def _place_views(self, pose: np.ndarray) -> None:
        """Look from a little behind the first camera, as it does."""
        position, ahead, up = pose[:3, 3] - 0.3 * pose[:3, 2], pose[:3, 3] + pose[:3, 2], -pose[:3, 1]
        first = self._server.initial_camera
        first.position, first.look_at, first.up = position, ahead, up
        for client in self._server.get_clients().values():  # browsers that wait for the first frame
            client.camera.up_direction = up
            client.camera.position, client.camera.look_at = position, ahead


def field_of_view(camera: Camera) -> float:
    """Return the vertical field of view in radians."""
    return 2 * float(np.arctan2(camera.height / 2, float(camera.focal[1])))


def wxyz(pose: np.ndarray) -> np.ndarray:
    """Return the quaternion of a pose (4, 4), as viser takes it."""
    return Rotation.from_matrix(pose[:3, :3]).as_quat()[[3, 0, 1, 2]]


def _place(frustum: Any, pose: np.ndarray) -> None:
    frustum.wxyz, frustum.position = wxyz(pose), pose[:3, 3]


def _rgb(color: str) -> tuple[int, ...]:
    return tuple(round(255 * channel) for channel in rgb(color))
