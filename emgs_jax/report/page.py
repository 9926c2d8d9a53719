"""report.html of a run: the map in three dimensions, frames in time, errors, settings, files."""

import base64
import hashlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from markupsafe import Markup

from emgs_jax.data.base import Dataset
from emgs_jax.drawing.colors import NO_CLASS, PATHS, class_colors, rgb, to_bytes
from emgs_jax.drawing.layers import COV_UNIT, feature_layer, fitted, layers_of, map_layers, packed, thinned
from emgs_jax.drawing.overview import view_from_above
from emgs_jax.drawing.splats import owners, read_splats, splats_for_page
from emgs_jax.io.files import jsonable
from emgs_jax.report import page_words
from emgs_jax.report.html import MAX_BYTES, POLICY, page, picture, source, thumbnails, write_page
from emgs_jax.report.page_pictures import Views, draw_views
from emgs_jax.report.page_strip import key_of, strip
from emgs_jax.runs.finished_run import SPLATS_FILE, FinishedRun, PlacedPaths, placed_paths, render_config
from emgs_jax.runs.moving import frame_facts
from emgs_jax.runs.repeat import repeat

_MAP_BYTES = 2_800_000  # of base64; the rest is for pictures and words
_SPLAT_BYTES = 2_400_000  # of these for the splats of emgs polish, if any
_MAX_PICTURES = 120  # frames, evenly spread
_SCRIPTS = ("data.js", "vectors.js", "splats.js", "layers.js", "controls.js", "overlay.js", "frames.js", "main.js")


def write_report(run: FinishedRun, dataset: Dataset | None, note: str = "") -> Path:
    """Write report.html into the folder of a run and return its path; the same run gives the same bytes.

    Raises ValueError, and writes nothing, if parts of the run do not fit each other.

    Args:
        dataset: for the images; None: the page has none.
        note: what could not be shown, and why.
    """
    paths = placed_paths(run)
    layers, config = map_layers(run.map, run.text) | feature_layer(run.map), render_config(run)
    rows = sorted({int(row) for row in np.linspace(0, len(run.poses) - 1, min(_MAX_PICTURES, len(run.poses)))})
    views = draw_views(run, rows, config, dataset)
    splats, packed_splats, few_splats, means = _splats(run)
    limit, num = _MAP_BYTES - len(packed_splats), len(layers["mean"])
    arrays, packed_map, shown = fitted(layers, _path_arrays(run, paths), layers["updates"], limit)
    kept = thinned({"mean": layers["mean"]}, layers["updates"], shown)["mean"]
    owned = {"owner": owners(means, kept)} if len(kept) else {}
    about_owned, packed_owners = packed(owned)
    few = f"The page shows the {shown:,} of {num:,} Gaussians that most frames agree on; map.npz has all of them."
    render = {name: float(getattr(config, name)) for name in ("blur", "radius", "opacity")}
    about = _about(run, layers) | {"arrays": arrays, "render": render, "splats": splats, "owners": about_owned}
    note = " ".join(filter(None, [note, few if shown < num else "", few_splats]))
    return write_page(run.folder, _page(run, paths, views, about, (packed_map, packed_splats, packed_owners), note))


def _splats(run: FinishedRun) -> tuple[dict[str, Any] | None, str, str, np.ndarray]:
    """Pack the run's splats of `emgs polish` by `splats_for_page`; None without splats."""
    splats = read_splats(run.folder / SPLATS_FILE)
    if splats is None or not len(splats.means):
        return None, "", "", np.zeros((0, 3))
    about, *rest = splats_for_page(splats, _SPLAT_BYTES)
    return about | {"render": {"blur": 0.3, "radius": 3.0, "opacity": 1.0}}, *rest  # as 3DGS renders


def _path_arrays(run: FinishedRun, paths: PlacedPaths) -> dict[str, np.ndarray]:
    """Collect the upper three rows of the poses (n, 12), float32, in the frame of the map; nan where not placed."""
    placed = np.where(run.is_placed[:, None, None], run.poses, np.nan)
    found = {"poses": placed, "online": run.online, "truth": paths.truth, "raw": paths.raw}
    return {
        name: poses[:, :3].reshape(-1, 12).astype(np.float32)
        for name, poses in found.items()
        if poses is not None and (name == "poses" or np.isfinite(poses).any())
    }


def _about(run: FinishedRun, layers: dict[str, np.ndarray]) -> dict[str, Any]:
    """Collect the data that the page's program needs, besides the attributes of Gaussians."""
    poses = run.poses[run.is_placed] if run.is_placed.any() else run.poses[:1]
    means = layers["mean"].astype(np.float64) if len(layers["mean"]) else poses[:, :3, 3]
    low, high = np.percentile(np.concatenate([means, poses[:, :3, 3]]), [1, 99], axis=0)
    rotation = view_from_above(poses, layers["normal"])
    camera, names = run.camera, () if run.text is None else run.text.names
    (fx, fy), (cx, cy) = map(float, camera.focal), map(float, camera.center)
    return {
        "up": rotation[2].tolist(),
        "front": rotation[1].tolist(),
        "pivot": (0.5 * (low + high)).tolist(),
        "size": max(float(np.linalg.norm(high - low)), 1e-3),
        "covUnit": COV_UNIT,
        "isMetric": run.is_metric,
        "camera": {"fx": fx, "fy": fy, "cx": cx, "cy": cy, "width": camera.width, "height": camera.height},
        "layers": {name: layer._asdict() for name, layer in layers_of(layers).items()},
        "paths": {name: look.dark for name, look in PATHS.items()},
        "classes": list(names),
        "classColors": to_bytes(class_colors(len(names))).tolist(),
        "noClass": to_bytes(rgb(NO_CLASS)).tolist(),
        "classesSeen": sorted({int(label) for label in layers.get("label", ())} - {-1}),
        "frames": {
            "title": [f"frame {line['index']}" for line in run.frames],
            "status": [line["status"] for line in run.frames],
            "reason": [str(line.get("reason") or "") for line in run.frames],
            "facts": [frame_facts(line) for line in run.frames],
        },
        "loops": [[loop["frame"], loop["other"], loop["outcome"]] for loop in run.loops],
    }


def _page(
    run: FinishedRun,
    paths: PlacedPaths,
    views: Views,
    about: Mapping[str, Any],
    blocks: tuple[str, str, str],
    note: str,
) -> bytes:
    """Fill the page, with pictures of as many frames as fit."""
    script, again = Markup("\n".join(map(source, _SCRIPTS))), repeat(run.provenance["config"])
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode("ascii")
    (overview,) = thumbnails([run.folder / "overview.png"], (1200,))
    shown_paths = {array["name"] for array in about["arrays"]} | ({"loops"} if about["loops"] else set())
    values = {
        "overview": picture(overview, "the map from above, and some frames"),  # for reading without the program
        "layers": layers_of({array["name"] for array in about["arrays"]}),
        "paths": {name: look for name, look in PATHS.items() if name in shown_paths},
        "depths": f"{views.near:.1f} to {views.far:.1f} {'m' if run.is_metric else 'units'}",
        "num_frames": len(run.frames),
        "strip": strip(run, paths.errors),
        "key": key_of(run, paths.errors),
        "errors": page_words.errors(run),
        "no_errors": page_words.no_errors(run),
        "protocol": page_words.protocol_words(run),
        "polished": page_words.polished(run),
        "loops": page_words.loops(run),
        "settings": page_words.settings(again),
        "files": page_words.files(run),
        "note": note,
        "arrays": Markup(blocks[0]),
        "splats": Markup(blocks[1]),
        "owners": Markup(blocks[2]),
        "script": script,
        "vertex": source("splats.vert"),
        "fragment": source("splats.frag"),
    }
    head, policy = page_words.head(run, again), f"{POLICY}; script-src 'sha256-{digest}'"
    pictures, step = [list(view) for view in views.pictures], 1
    while True:
        shown = jsonable({**about, "pictures": pictures[::step]})
        content = page("run.html", head, policy, about=shown, **values)
        if len(content) <= MAX_BYTES or step >= max(len(pictures), 1):
            return content
        step += 1
