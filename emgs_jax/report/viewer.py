"""A finished run in the browser, with viser: map, cameras, words to look for.

The server listens on this machine only. A page of another site can send to it all the same, so nothing that is sent is
a path or a program: words are looked up among the class names of the run, numbers are places in its lists. Texts from
the run's files are escaped before a browser shows them.
"""

import socket
from html import escape
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.colors import to_rgb
from scipy.spatial.transform import Rotation

from emgs_jax.report.overview import view_from_above
from emgs_jax.report.page import render_config
from emgs_jax.report.page_map import map_layers
from emgs_jax.report.page_strip import OURS, STATUS_COLORS, placed_paths
from emgs_jax.report.recorded_run import RecordedRun
from emgs_jax.report.viewer_layers import LAYERS, ask, colors_of, covariances, find_words, highlighted, picked

if TYPE_CHECKING:
    import viser

HOST = "127.0.0.1"
TRUTH = "#2b8a3e"
MAX_FRUSTUMS = 300  # more are a carpet; the chosen frame has its own


class Viewer:
    """A run that is being served until `stop`.

    Args:
        run: that is shown.
        port: to listen on.

    Raises:
        ValueError: the port is taken, viser is not installed, or parts of the run do not fit each other.
    """

    def __init__(self, run: RecordedRun, port: int) -> None:
        viser = _viser()
        self.layers, config = map_layers(run.map, run.text), render_config(run)
        check_port(port)
        self._run, self._names = run, () if run.text is None else run.text.names
        self._covs = covariances(self.layers) * float(config.covariance_scale)
        self.server = viser.ViserServer(host=HOST, port=port, label="emgs_jax", verbose=False)
        if self.server.get_port() != port:  # taken since, by another program
            self.server.stop()
            raise ValueError(_taken(port))
        self.server.gui.configure_theme(show_share_button=False, control_width="large")
        self._add_map(float(config.opacity))
        self._add_paths()
        self._add_controls()
        self._place_camera()

    @property
    def address(self) -> str:
        """To open in a browser of this machine."""
        return f"http://{HOST}:{self.server.get_port()}"

    def stop(self) -> None:
        """End the server."""
        self.server.stop()

    def _add_map(self, opacity: float) -> None:
        scene, layers = self.server.scene, self.layers
        opacities = np.full((len(layers["mean"]), 1), opacity, np.float32)
        self.splats = scene.add_gaussian_splats("/map", layers["mean"], self._covs, layers["color"], opacities)
        self.points = scene.add_point_cloud(
            "/points", layers["mean"], layers["color"], point_size=0.01, precision="float32", visible=False
        )

    def _add_paths(self) -> None:
        run, scene = self._run, self.server.scene
        alignment = run.provenance["config"].get("evaluation", {}).get("alignment")
        truth = placed_paths(run, alignment == "sim3").truth[:, :3, 3]
        known = np.isfinite(truth).all(1)
        self.paths = [
            self._path("/our path", run.poses[:, :3, 3], run.is_placed, OURS),
            self._path("/true path", truth, known, TRUTH),
        ]
        self.frustums = []
        for row in np.unique(np.linspace(0, len(run.poses) - 1, min(len(run.poses), MAX_FRUSTUMS)).astype(int)):
            color = STATUS_COLORS.get(run.frames[row]["status"], OURS)
            self.frustums.append(self._frustum(f"/cameras/{row}", int(row), color, 0.04))
        self.chosen = self._frustum("/frame", 0, "#ffffff", 0.1)
        scene.set_up_direction(view_from_above(run.poses)[2])

    def _path(self, name: str, centers: np.ndarray, is_known: np.ndarray, color: str) -> Any:
        """Segments between neighbours that are both known; None where there are none."""
        joined = np.flatnonzero(is_known[1:] & is_known[:-1])
        if not len(joined):
            return None
        ends = np.stack([centers[joined], centers[joined + 1]], axis=1).astype(np.float32)
        return self.server.scene.add_line_segments(name, ends, _rgb(color), thickness=2.0, thickness_units="screen")

    def _frustum(self, name: str, row: int, color: str, scale: float) -> Any:
        camera, pose = self._run.camera, self._run.poses[row]
        fov = 2 * float(np.arctan2(camera.height / 2, float(camera.focal[1])))
        return self.server.scene.add_camera_frustum(
            name,
            fov,
            camera.width / camera.height,
            scale=scale,
            thickness=1.5,
            thickness_units="screen",
            color=_rgb(color),
            wxyz=_wxyz(pose),
            position=pose[:3, 3],
        )

    def _add_controls(self) -> None:
        """The words come first: people look for them."""
        gui, names = self.server.gui, self._names
        hint = "words of this run, apart by commas; what is closest to one of them lights up"
        self.words = gui.add_text("Look for", "", hint=hint)
        self.against = gui.add_text("Against", "", hint="what is closer to one of these words is left out")
        self.threshold = gui.add_slider("At least", 0.0, 1.0, 0.01, 0.5, hint="cosine that an answer needs")
        self.answer = gui.add_html(_shown(self._known()))
        self.layer = gui.add_dropdown("Colours", [name for name in LAYERS if name != "class" or names])
        self.kind = gui.add_dropdown("Map as", ["Gaussians", "points"])
        self.show_cameras = gui.add_checkbox("Cameras", True)
        self.show_paths = gui.add_checkbox("Paths (ours orange, true green)", True)
        last = max(len(self._run.frames) - 1, 1)
        self.frame = gui.add_slider("Frame", 0, last, 1, 0)
        self.go = gui.add_button("Look through its camera")
        self.facts = gui.add_html(_shown(self._facts(0)))
        self.number = gui.add_html(_shown("Click a Gaussian for its numbers."))
        for control in (self.words, self.against, self.threshold, self.layer):
            control.on_update(lambda _: self.recolor())
        for control in (self.kind, self.show_cameras, self.show_paths):
            control.on_update(lambda _: self._show())
        self.frame.on_update(lambda _: self._choose())
        self.go.on_click(lambda event: self._look(event.client))
        self.server.scene.on_click()(lambda event: self.pick(event.ray_origin, event.ray_direction))

    def _known(self) -> str:
        if not self._names:
            return (
                "This map has no features, or no words to compare them with: run with features=dinov3_text, or give "
                "features.text=FILE, to look for things."
            )
        return "Words of this run: " + escape(", ".join(self._names))

    def recolor(self) -> None:
        """Colours as the controls say."""
        colors, message = colors_of(self.layers, self.layer.value), self._known()
        if self._names and self.words.value.strip():
            wanted, num_unknown = find_words(self.words.value, self._names)
            against, more = find_words(self.against.value, self._names)
            if wanted:
                found = ask(self.layers["similarity"], wanted, against, self.threshold.value)
                colors = highlighted(colors, found)
                count = int(found.is_found.sum())
                message = f"{count:,} of {len(colors):,} Gaussians: {escape(', '.join(self._names[r] for r in wanted))}"
            if num_unknown + more:
                message += f"<br>{num_unknown + more} of the words are none of this run's. {self._known()}"
        with self.server.atomic():
            self.splats.rgbs = colors
            self.points.colors = colors
        self.answer.content = _shown(message)

    def pick(self, origin: Any, direction: Any) -> None:
        """Say the numbers of the Gaussian under a ray."""
        layers = self.layers
        row = picked(layers["mean"], self._covs, origin, direction)
        if row is None:
            self.number.content = _shown("There is no Gaussian.")
            return
        widths = np.sqrt(np.maximum(np.linalg.eigvalsh(self._covs[row].astype(np.float64)), 0))[::-1]
        lines = [
            f"centre {_numbers(layers['mean'][row])}",
            f"standard deviations {_numbers(widths)}, as drawn",
            f"normal {_numbers(layers['normal'][row] / 127)}",
            f"certainty {layers['existence'][row] / 255:.2f}, fused {layers['updates'][row]} times",
        ]
        if self._names and layers["label"][row] >= 0:
            label = layers["label"][row]
            lines.append(f"{escape(self._names[label])} ({layers['similarity'][row][label] / 255:.2f})")
        self.number.content = _shown("<br>".join(lines))

    def _show(self) -> None:
        self.splats.visible, self.points.visible = self.kind.value == "Gaussians", self.kind.value == "points"
        for path in filter(None, self.paths):
            path.visible = self.show_paths.value
        for frustum in (*self.frustums, self.chosen):
            frustum.visible = self.show_cameras.value

    def _choose(self) -> None:
        row = self._row()
        self.chosen.wxyz, self.chosen.position = _wxyz(self._run.poses[row]), self._run.poses[row][:3, 3]
        self.facts.content = _shown(self._facts(row))

    def _row(self) -> int:
        return min(int(self.frame.value), len(self._run.frames) - 1)

    def _facts(self, row: int) -> str:
        frame = self._run.frames[row]
        known = {name: frame[name] for name in ("inliers", "residual", "scale", "new") if frame.get(name) is not None}
        words = [f"frame {frame['index']}: {frame['status']}", *(f"{name} {value}" for name, value in known.items())]
        return escape(", ".join([*words, *([str(frame["reason"])] if frame.get("reason") else [])]))

    def _look(self, client: "viser.ClientHandle | None") -> None:
        if client is not None:
            pose = self._run.poses[self._row()]
            with client.atomic():
                client.camera.wxyz, client.camera.position = _wxyz(pose), pose[:3, 3]

    def _place_camera(self) -> None:
        """Behind the first camera, a little, looking as it does."""
        pose, first = self._run.poses[0], self.server.initial_camera
        first.position = pose[:3, 3] - 0.3 * pose[:3, 2]
        first.look_at, first.up = pose[:3, 3] + pose[:3, 2], -pose[:3, 1]


def check_port(port: int) -> None:
    """Raise ValueError where a port is taken; viser would quietly take the next one."""
    with socket.socket(socket.AF_INET, socket.SOCK_STREAM) as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((HOST, port))
        except OSError as error:
            raise ValueError(_taken(port)) from error


def _taken(port: int) -> str:
    return f"port={port} is taken by another program, or not allowed: give another one, such as port={port + 1}"


def _viser() -> Any:
    try:
        import viser
    except ImportError as error:
        raise ValueError('the viewer needs viser: pip install "emgs_jax[viewer]"') from error
    return viser


def _shown(words: str) -> str:
    return f'<div style="padding: 2px 10px; font-size: 13px">{words}</div>'


def _rgb(color: str) -> tuple[int, ...]:
    return tuple(round(255 * channel) for channel in to_rgb(color))


def _wxyz(pose: np.ndarray) -> np.ndarray:
    return Rotation.from_matrix(pose[:3, :3]).as_quat()[[3, 0, 1, 2]]


def _numbers(values: np.ndarray) -> str:
    return ", ".join(f"{value:.3f}" for value in values)
