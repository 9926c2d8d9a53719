"""A run in the browser, with viser: map, cameras, search for words.

The server listens on this machine only. Pages of other sites can still send to it, so no input is a path or a program:
words are looked up among the class names of the run, and numbers are positions in its lists. Texts from the run's files
are escaped before a browser shows them.
"""

import socket
import threading
from collections.abc import Callable
from functools import wraps
from html import escape
from typing import TYPE_CHECKING, Any

import numpy as np

from emgs_jax.drawing.colors import to_bytes
from emgs_jax.drawing.layers import ALWAYS, layers_of, painted
from emgs_jax.io.packages import extra
from emgs_jax.runs.moving import frame_facts
from emgs_jax.viewer.answers import Answer, ask, find_words, highlighted, picked
from emgs_jax.viewer.scene import KINDS, Scene, Shown, field_of_view, wxyz

if TYPE_CHECKING:
    import viser

HOST = "127.0.0.1"


def _alone(method: Callable) -> Callable:
    """Make a method hold the viewer's lock, because browsers and a mapping run call from several threads."""

    @wraps(method)
    def locked(self: "Viewer", *arguments: Any) -> Any:
        with self._lock:
            return method(self, *arguments)

    return locked


class Viewer:
    """A run that is being served until `stop`; ValueError if the port is taken, or viser is not installed."""

    def __init__(self, run: Shown, port: int) -> None:
        viser = extra("viser", "the viewer needs viser", "viewer")
        check_port(port)
        self.server = viser.ViserServer(host=HOST, port=port, label="emgs_jax", verbose=False)
        if self.server.get_port() != port:  # taken meanwhile by another program
            self.server.stop()
            raise ValueError(_taken(port))
        self.server.gui.configure_theme(show_share_button=False, control_width="large")
        self._lock = threading.RLock()
        self._run, self._names = run, run.names
        self.scene, self.picture = Scene(self.server), None
        self._add_controls()
        self._draw(run)

    @property
    def address(self) -> str:
        """Address to open in a browser of this machine."""
        return f"http://{HOST}:{self.server.get_port()}"

    def stop(self) -> None:
        """End the server."""
        self.server.stop()

    @_alone
    def update(self, run: Shown) -> None:
        """Show the progress of a run; browsers that show its last frame follow it."""
        is_last = self._row() == max(len(self._run.frames) - 1, 0)
        with self.server.atomic():
            self._draw(run)
            if is_last:
                self.frame.value = max(len(run.frames) - 1, 0)
            self._choose()

    def _draw(self, run: Shown) -> None:
        self._run, self.layers = run, run.layers
        if not run.frames:
            return
        colors, _, message = self._colors()
        self.scene.draw(run, colors)
        self._show()
        self.answer.content = _shown(message)
        self.frame.max = max(len(run.frames) - 1, 1)
        self.progress.content = _shown(escape(run.progress)) if run.progress else ""
        if self.picture is not None:
            self.picture.image = run.image
        elif run.image is not None:
            self.picture = self.server.gui.add_image(run.image, label="Newest frame")

    def _add_controls(self) -> None:
        """Add the controls, search first, because people look for it."""
        gui, names = self.server.gui, self._names
        shown = layers_of({*ALWAYS, *self._run.layers, *(["label"] if names else [])})
        titles = [layer.title for name, layer in shown.items() if name != "similarity"]  # shown by the search
        hint = "words of this run, apart by commas; what is closest to one of them lights up"
        self.words = gui.add_text("Look for", "", hint=hint)
        self.against = gui.add_text("Against", "", hint="what is closer to one of these words is left out")
        self.threshold = gui.add_slider("At least", 0.0, 1.0, 0.01, 0.5, hint="cosine that an answer needs")
        self.answer = gui.add_html(_shown(self._known()))
        self.layer = gui.add_dropdown("Colours", titles)
        self.kind = gui.add_dropdown("Map as", KINDS if self._run.splats is not None else KINDS[1:])
        self.show_cameras = gui.add_checkbox("Cameras", True)
        self.show_paths = gui.add_checkbox("Paths (ours orange, true green)", True)
        self.frame = gui.add_slider("Frame", 0, 1, 1, 0)
        self.go = gui.add_button("Look through its camera")
        self.progress = gui.add_html("")
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

    @_alone
    def recolor(self) -> None:
        """Colour the map according to the controls."""
        if not self._run.frames:
            return
        colors, of_splats, message = self._colors()
        with self.server.atomic():
            self.scene.recolor(colors, of_splats)
        self.answer.content = _shown(message)

    def _colors(self) -> tuple[np.ndarray, np.ndarray | None, str]:
        """Compute the colours of all Gaussians, (n, 3), and splats, and comment on the words."""
        name = next(name for name, layer in layers_of(self.layers).items() if layer.title == self.layer.value)
        colors, message = painted(self.layers, name), self._known()
        splats, rows = self._run.splats, self._run.owners
        of_splats = None
        if splats is not None:
            of_splats = to_bytes(splats.colors[:, :3]) if name == "color" else colors[rows]
        if "label" not in self.layers or not self.words.value.strip():
            return colors, of_splats, message
        (wanted, unknown), (against, more) = (find_words(box.value, self._names) for box in (self.words, self.against))
        if wanted:
            found = ask(self.layers, wanted, against, self.threshold.value)
            colors, words = highlighted(colors, found), escape(", ".join(self._names[row] for row in wanted))
            if of_splats is not None:
                of_splats = highlighted(of_splats, Answer(found.cosines[rows], found.is_found[rows]))
            message = f"{int(found.is_found.sum()):,} of {len(colors):,} Gaussians: {words}"
        if unknown + more:
            message += f"<br>{unknown + more} of the words are none of this run's. {self._known()}"
        return colors, of_splats, message

    @_alone
    def pick(self, origin: Any, direction: Any) -> None:
        """Show the numbers of the Gaussian under a ray."""
        layers = self.layers
        row = picked(layers["mean"], self.scene.covs, origin, direction) if layers else None
        if row is None:
            self.number.content = _shown("There is no Gaussian.")
            return
        widths = np.sqrt(np.maximum(np.linalg.eigvalsh(self.scene.covs[row].astype(np.float64)), 0))[::-1]
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

    @_alone
    def _show(self) -> None:
        is_placed = bool(self._run.frames) and bool(self._run.is_placed[self._row()])
        self.scene.show(self.kind.value, self.show_cameras.value, self.show_paths.value, is_placed)

    @_alone
    def _choose(self) -> None:
        if self._run.frames:
            row = self._row()
            self.scene.choose(self._run.poses[row], self._run.image if row == len(self._run.frames) - 1 else None)
            self._show()
            self.facts.content = _shown(self._facts(row))

    def _row(self) -> int:
        return min(int(self.frame.value), max(len(self._run.frames) - 1, 0))

    def _facts(self, row: int) -> str:
        if not self._run.frames:
            return "No frame is mapped yet."
        frame = self._run.frames[row]
        words = [f"frame {frame['index']}: {frame['status']}", frame_facts(frame), str(frame.get("reason") or "")]
        return escape(", ".join(filter(None, words)))

    def _look(self, client: "viser.ClientHandle | None") -> None:
        if client is not None and self._run.frames and self._run.is_placed[self._row()]:
            pose = self._run.poses[self._row()]
            with client.atomic():
                client.camera.wxyz, client.camera.position = wxyz(pose), pose[:3, 3]
                client.camera.fov = field_of_view(self._run.camera)


def check_port(port: int) -> None:
    """Raise ValueError if a port is taken; viser would silently take the next one."""
    with socket.socket(socket.AF_INET, socket.SOCK_STREAM) as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((HOST, port))
        except OSError as error:
            raise ValueError(_taken(port)) from error


def _taken(port: int) -> str:
    with socket.socket(socket.AF_INET, socket.SOCK_STREAM) as free:
        free.bind((HOST, 0))
        other = free.getsockname()[1]
    return f"port={port} is taken by another program, or not allowed: give another one, such as port={other}"


def _shown(words: str) -> str:
    return f'<div style="padding: 2px 10px; font-size: 13px">{words}</div>'


def _numbers(values: np.ndarray) -> str:
    return ", ".join(f"{value:.3f}" for value in values)
