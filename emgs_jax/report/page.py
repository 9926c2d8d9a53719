"""report.html: a run as one file that opens by double click, asks for nothing, and is read without a program, too.

The page's own source is in the folder `web/`; here it is put together with what the run says.
"""

import base64
import hashlib
import json
import re
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from emgs_jax.data.base import Dataset
from emgs_jax.io.files import atomic_write, jsonable
from emgs_jax.render.composite import RenderConfig
from emgs_jax.report import page_words
from emgs_jax.report.overview import class_colors, view_from_above
from emgs_jax.report.page_map import COV_UNIT, feature_layer, fitted, map_layers
from emgs_jax.report.page_pictures import Views, draw_views, jpeg
from emgs_jax.report.page_strip import PlacedPaths, key_of, placed_paths, strip
from emgs_jax.report.recorded_run import REPORT_FILE, RecordedRun
from emgs_jax.report.repeat import repeat
from emgs_jax.running.values import check_value, declared

MAX_BYTES = 5_000_000
POLICY = "default-src 'none'; img-src data:; style-src 'unsafe-inline'"
_MAP_BYTES = 2_800_000  # of base64; the rest is for pictures and words
_MAX_PICTURES = 120  # frames, evenly spread
_SOURCE = Path(__file__).parent / "web"
_SCRIPTS = ("data.js", "vectors.js", "splats.js", "layers.js", "controls.js", "overlay.js", "frames.js", "main.js")
LAYERS = {
    "color": "colour",
    "class": "class",
    "similarity": "similarity to a class",
    "feature": "features (main directions)",
    "normal": "normals",
    "existence": "certainty",
    "updates": "updates",
    "birth": "frame of birth",
}
PATHS = {
    "poses": "estimated path",
    "online": "estimated as placed",
    "truth": "true path",
    "raw": "raw prior's path",
    "loops": "accepted loops",
}
_PATH_COLORS = {"poses": "#ff6b4a", "online": "#f3c969", "truth": "#2fd1b2", "raw": "#8f9bff", "loops": "#63e68b"}


def write_report(run: RecordedRun, dataset: Dataset | None, note: str = "") -> Path:
    """Write report.html into the folder of a run; the same run gives the same bytes.

    Args:
        run: as its folder tells it.
        dataset: in use, for the images; None: the page has none.
        note: what could not be shown, and why.

    Returns:
        The path of the page.

    Raises:
        ValueError: parts of the run do not fit each other; nothing is written.
    """
    evaluation = run.provenance["config"].get("evaluation", {})
    paths = placed_paths(run, evaluation.get("alignment") == "sim3")
    layers, config = map_layers(run.map, run.text) | feature_layer(run.map), render_config(run)
    rows = sorted({int(row) for row in np.linspace(0, len(run.poses) - 1, min(_MAX_PICTURES, len(run.poses)))})
    placed = run.is_placed
    views = draw_views(run.map, run.poses, rows, placed, run.camera, config, dataset)
    arrays, packing, left_out = fitted(layers, _path_arrays(run, paths), _MAP_BYTES)
    about = _about(run, layers, paths) | {"arrays": arrays, "render": _for_shader(config)}
    page = _page(run, paths, views, about, packing, " ".join(filter(None, [note, left_out])))
    target = run.folder / REPORT_FILE
    with atomic_write(target) as handle:
        handle.write(page.encode())
    return target


def render_config(run: RecordedRun) -> RenderConfig:
    """As the run drew its map."""
    settings = {key: value for key, value in run.provenance["config"]["densify"]["render"].items() if key != "_target_"}
    try:
        for name, field in declared(RenderConfig).items():
            check_value(f"densify.render.{name}", settings.get(name), field)
        return RenderConfig(**settings)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{run.folder}/metrics.json has settings of another version ({error}): run again") from error


def _for_shader(config: RenderConfig) -> dict[str, float]:
    return {name: float(getattr(config, name)) for name in ("blur", "radius", "opacity")}


def _path_arrays(run: RecordedRun, paths: PlacedPaths) -> dict[str, np.ndarray]:
    """The upper three rows of poses (n, 12), float32, in the frame of the map; only what is known."""
    found = {"poses": run.poses, "online": run.online, "truth": paths.truth, "raw": paths.raw}
    return {
        name: poses[:, :3].reshape(-1, 12).astype(np.float32)
        for name, poses in found.items()
        if poses is not None and np.isfinite(poses).any()
    }


def _about(run: RecordedRun, layers: dict[str, np.ndarray], paths: PlacedPaths) -> dict[str, Any]:
    """Return the data that the page's program needs, beside the attributes of Gaussians."""
    means = layers["mean"].astype(np.float64) if len(layers["mean"]) else run.poses[:, :3, 3]
    low, high = np.percentile(np.concatenate([means, run.poses[:, :3, 3]]), [1, 99], axis=0)
    rotation = view_from_above(run.poses)
    camera, names = run.camera, () if run.text is None else run.text.names
    return {
        "up": rotation[2].tolist(),
        "front": rotation[1].tolist(),
        "pivot": (0.5 * (low + high)).tolist(),
        "size": max(float(np.linalg.norm(high - low)), 1e-3),
        "covUnit": COV_UNIT,
        "isMetric": page_words.is_metric(run),
        "camera": {
            **dict(zip(("fx", "fy"), map(float, camera.focal), strict=True)),
            **dict(zip(("cx", "cy"), map(float, camera.center), strict=True)),
            "width": camera.width,
            "height": camera.height,
        },
        "classes": list(names),
        "classColors": np.rint(255 * class_colors(len(names))).astype(int).tolist() if names else [],
        "classesSeen": sorted({int(label) for label in layers.get("label", ())} - {-1}),
        "frames": {
            "title": [f"frame {line['index']}" for line in run.frames],
            "status": [line["status"] for line in run.frames],
            "reason": [str(line.get("reason") or "") for line in run.frames],
            "facts": [page_words.frame_facts(line) for line in run.frames],
        },
        "loops": [[loop["frame"], loop["other"], loop["outcome"]] for loop in run.loops],
    }


def _page(run: RecordedRun, paths: PlacedPaths, views: Views, about: dict[str, Any], packing: str, note: str) -> str:
    """All of it, with pictures of as many frames as fit."""
    script = "\n".join(source(name) for name in _SCRIPTS)
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode("ascii")
    block, again = run.provenance, repeat(run.provenance["config"])
    parts = {
        "policy": f"{POLICY}; script-src 'sha256-{digest}'",
        "title": _text(f"{block['data']['name']} {block['data']['sequence']}: report of a run"),
        "style": source("page.css"),
        "head": page_words.head(run, again),
        "footer": page_words.licences(run),
    }
    stage = {
        "overview": _overview(run),
        "layers": _layers(run, {array["name"] for array in about["arrays"]}),
        "words": _options({-1: "all"} | dict(enumerate(about["classes"]))),
        "paths": _path_boxes(about),
        "depths": f"{views.near:.1f} to {views.far:.1f} {'m' if page_words.is_metric(run) else 'units'}",
        "strip": strip(run, paths.errors),
        "key": key_of(run, paths.errors),
        "sections": page_words.errors(run)
        + page_words.polished(run)
        + page_words.loops(run)
        + page_words.settings(again)
        + page_words.files(run, note),
    }
    parts["main"] = filled(source("page.html"), stage)
    programs = {"arrays": packing, "script": script}
    programs |= {"vertex": source("splats.vert"), "fragment": source("splats.frag")}
    pictures, step = [list(picture) for picture in views.pictures], 1
    while True:
        shown = about | {"pictures": pictures[::step]}
        parts["programs"] = "\n" + filled(source("programs.html"), programs | {"about": _json(shown)})
        page = filled(source("shell.html"), parts)
        if len(page.encode()) <= MAX_BYTES or step >= max(len(pictures), 1):
            return page
        step += 1


def filled(template: str, parts: Mapping[str, str]) -> str:
    """The template with its {names} replaced, once: what comes in is not looked at again."""
    return re.sub(r"\{(\w+)\}", lambda match: parts[match[1]], template)


def _json(value: Any) -> str:
    """JSON that ends no element of HTML, whatever text is in it."""
    text = json.dumps(jsonable(value), allow_nan=False, separators=(",", ":"))
    return text.replace("&", "\\u0026").replace("<", "\\u003c").replace(">", "\\u003e")


def source(name: str) -> str:
    """A file of `web/`."""
    return (_SOURCE / name).read_text(encoding="utf-8").strip()


def _text(text: str) -> str:
    return page_words.escape(text)


def _options(values: Mapping[Any, str]) -> str:
    return "".join(f'<option value="{_text(str(value))}">{_text(name)}</option>' for value, name in values.items())


def _layers(run: RecordedRun, there: Collection[str]) -> str:
    """Without features there are no classes to show, and the page says so."""
    unknown = {"feature"} - {*there} | ({"class", "similarity"} if run.text is None else set())
    known = {name: words for name, words in LAYERS.items() if name not in unknown}
    missing = "" if run.text is not None else "<option disabled>class: the map has no classes</option>"
    return _options(known) + missing


def _path_boxes(about: Mapping[str, Any]) -> str:
    there = {array["name"] for array in about["arrays"]} | ({"loops"} if about["loops"] else set())
    return "".join(
        f'<label><input type="checkbox" data-path="{name}"{" checked" * (name in ("poses", "truth"))}>'
        f'<i style="background:{_PATH_COLORS[name]}"></i> {words}</label>'
        for name, words in PATHS.items()
        if name in there
    )


def _overview(run: RecordedRun) -> str:
    """The picture of the run for who reads without a program."""
    path = run.folder / "overview.png"
    if not path.is_file():
        return ""
    with Image.open(path) as image:
        small = image.convert("RGB")
    small.thumbnail((1200, 1200))
    return f'<img alt="the map from above, and some frames" src="data:image/jpeg;base64,{jpeg(small)}">'
