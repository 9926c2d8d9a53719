"""Predictions in files as a prior: a file a frame, or the output of other programs.

*Frame.* All poses are in one world, so every window gets the same prediction of a frame: poses are relative to the
anchor's, or in that world if the anchor has none.

*Scale.* Lengths are metres, or multiplied by one factor that makes the first view's median depth `median_depth`.

*Grid.* A file's pixels are those of the resized image; its points lie where its own intrinsics have them, or else on
the rays of the data set's camera. Only sensors with a calibration of their own (ScanNet) are looked up ray by ray.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from tqdm import tqdm

from emgs_jax.data.base import Dataset, Frame
from emgs_jax.data.reading import Size, check_depth_scale, fingerprint, orientation, resize_intrinsics
from emgs_jax.prior.base import (
    DenseView,
    Prior,
    PriorPrediction,
    Provenance,
    Window,
    check_pose_std,
    equal_covariances,
    no_points,
    predicted,
    relative_poses,
)
from emgs_jax.prior.files.conventions import MIN_GAIN, Sight, check_conventions, median_misfit
from emgs_jax.prior.files.layouts import (
    DEPTH_MAPS,
    find_export,
    find_streaming,
    read_colmap_workspace,
    read_cut3r,
    read_da3_streaming,
    read_export,
    read_record3d,
    read_scannet,
)
from emgs_jax.prior.files.naming import rows_of
from emgs_jax.prior.files.own import GIVES_POSES, read_own
from emgs_jax.prior.files.pose_error import pose_angle
from emgs_jax.prior.files.view import (
    Camera,
    Intrinsics,
    Predictions,
    View,
    at_frame,
    by_rays,
    check_metres,
    grid_intrinsics,
    usable,
)

AUTO = "auto"
SCALES = ("auto", "metric", "arbitrary")
TURNS = {3: [[-1, 0], [0, -1]], 6: [[0, 1], [-1, 0]], 8: [[0, -1], [1, 0]]}  # R_stored_shown of an EXIF orientation
FOCAL_NOTE, FOCAL_ERROR = 1.03, 1.5  # ratio of the files' focal length and the data set's
STRAIGHTENED = "; images are straightened, and files with them: their depths lie on the rays of dataset.intrinsics"
NUM_CAMERAS = 16  # views whose intrinsics are looked at for the camera of the images
TURNED, FITS = np.radians(1.0), 0.01  # poses so wrong cannot have depths that fit so well
NUM_PAIRS, PAIR_GAP = 5, 5  # of views that are compared, and how many frames apart they are


class Files(Prior):
    """A prior that reads its predictions from files.

    Args:
        folder: in a layout of docs/predictions.md, or an .npz with all images.
        scale: `metric`, `arbitrary` (up to one factor), or `auto`: as known of the layout.
        median_depth: m, of the first view if the scale is arbitrary.
        depth_scale: raw units a metre in 16-bit .png files.
        max_depth_step: relative depth difference across which nothing is interpolated.
        pose_std: of every pose, (length in the files' unit, degrees); None: unknown; `auto`: see `pose_angle`.
        max_misfit: largest median difference of the depths of two views.
    """

    def __init__(
        self,
        folder: Path | str,
        scale: str,
        median_depth: float,
        depth_scale: float,
        max_depth_step: float,
        pose_std: Sequence[float] | str | None = AUTO,
        max_misfit: float = 0.1,
    ) -> None:
        if scale not in SCALES:
            raise ValueError(f"prior.scale must be one of {', '.join(SCALES)}, got {scale!r}")
        if not 0 < median_depth < np.inf:
            raise ValueError(f"prior.median_depth must be above 0 m, got {median_depth}")
        self.folder = Path(folder).expanduser()
        self._found = read_predictions(self.folder, check_depth_scale(depth_scale, "prior.depth_scale"))
        if not np.isfinite(self._found.poses).all((1, 2)).any():
            raise ValueError(f"{self._found.pose_source}: none of {len(self._found.poses)} is known: {GIVES_POSES}")
        self._max_depth_step, self._max_misfit = float(max_depth_step), float(max_misfit)
        self._is_metric = self._found.is_metric if scale == "auto" else scale == "metric"
        self._factor = 1.0 if self._is_metric else median_depth / self._first_depth()[1]
        self._pose_std = None if pose_std == AUTO else check_pose_std(pose_std)
        self._is_measured = pose_std == AUTO
        self._rows: list[int | None] = []  # of the frames
        self._dataset: Dataset | None = None  # that was checked
        self._points: dict[int, DenseView] = {}  # of the last window, by frame
        settings = {"layout": self._found.layout, "scale": "metric" if self._is_metric else "arbitrary"}
        settings |= {} if self._is_metric else {"median_depth": float(median_depth)}
        settings |= {"depth_scale": float(depth_scale), "max_depth_step": self._max_depth_step}
        settings |= {"pose_std": AUTO if self._is_measured else self._pose_std and [*self._pose_std]}
        settings |= {"fingerprint": fingerprint(self.folder, self._found.files, {})}
        self.provenance = Provenance("files", settings)

    def check(self, dataset: Dataset, window_size: int) -> None:
        """Match files with frames, check that they fit, and describe them; ValueError if they do not."""
        found = self._found
        remedy = "predict it, write one whose T_world_camera is nan"
        self._rows = rows_of(dataset, found.names, self.folder, found.may_lack, remedy)
        known = [index for index, row in enumerate(self._rows) if row is not None]
        camera = Camera((dataset.size[0], dataset.size[1]), dataset.intrinsics)
        self._dataset = dataset
        view, depth = self._first_depth()
        if self._is_metric:
            remedies = "write metres, give prior.depth_scale (units of a metre in .png files; 1000: mm), or"
            check_metres(depth, view.source, f"{remedies} prior.scale=arbitrary")
        turned = turned_files(dataset)
        poses = {index: self._pose(index) for index in known}
        poses = {index: pose for index, pose in poses.items() if np.isfinite(pose).all()}
        angle = pose_angle(dataset, poses) if self._is_measured or turned else None
        if angle is not None and (words := _stored_words(dataset, poses, turned, angle)):
            raise ValueError(f"{self.folder}: {words}")
        if self._is_measured:
            self._pose_std = None if angle is None else (angle * depth, float(np.degrees(angle)))
        scale = "metres" if self._is_metric else f"up to scale, times {self._factor:.4g}"
        unread = f"; not read: {', '.join(found.unread)}" if found.unread else ""
        lacking = f", {len(self._rows) - len(known)} frames have none" if len(known) < len(self._rows) else ""
        try:
            note = _focal_note(view, camera, found) if dataset.stored_pixels(0) is None else STRAIGHTENED
            note += _turned_note(turned)
        except ValueError as error:
            raise ValueError(f"{error}{_turned_note(turned)}") from error
        pairs = self._pairs(known, camera)
        misfit = median_misfit(pairs, dataset.intrinsics)
        if not np.isfinite(misfit):  # the camera turns fast
            pairs = self._pairs(known, camera, gap=1) or pairs
            misfit = median_misfit(pairs, dataset.intrinsics)
        fit = check_conventions(pairs, dataset.intrinsics, found.pose_source, self._max_misfit)
        if angle is not None and angle > TURNED and misfit < FITS:
            fit += (
                f", but by the images the poses are off by {np.degrees(angle):.1f} degrees: such files fit each other "
                "and not the images, as where they are in another order; check which file is of which image"
            )
        tqdm.write(
            f"prior=files: {self.folder}, layout {found.layout}, {scale}{lacking}; {fit}, "
            f"{_pose_note(self._pose_std)}{unread}{note}"
        )

    def predict(self, window: Window, frames: Sequence[Frame], intrinsics: Sequence[float]) -> PriorPrediction:
        """Predict a window from the files of its views, after `check` has matched them."""
        if not self._rows:
            raise ValueError("Files.check(dataset, window_size) finds which file is of which frame: call it first")
        size = frames[0].image.shape[1::-1]
        camera = Camera((size[0], size[1]), intrinsics)
        poses = np.stack([self._pose(index) for index in window.views])
        T_anchor_view = relative_poses(poses) if np.isfinite(poses[0]).all() else poses
        before, self._points = self._points, {}
        for index in window.dense:
            self._points[index] = before.get(index) or self._at_frame(index, camera)
        std = self._pose_std and (self._pose_std[0] * self._factor, self._pose_std[1])
        covariance = equal_covariances(std, T_anchor_view)
        return predicted(window, T_anchor_view, [*self._points.values()], pose_covariance=covariance)

    def revisit(self, window: Window, frames: Sequence[Frame], intrinsics: Sequence[float]) -> None:
        """Nothing: every window has the poses of one path, which measure no loop of that path a second time."""

    def _pose(self, index: int) -> np.ndarray:
        """T_world_camera of a frame, or NaN."""
        row = self._rows[index]
        pose = np.full((4, 4), np.nan) if row is None else self._found.poses[row].copy()
        pose[:3, 3] *= self._factor
        return pose

    def _at_frame(self, index: int, camera: Camera) -> DenseView:
        """Points, confidence and mask of a frame; none is valid without a pose or a file."""
        row = self._rows[index]
        if row is None or not np.isfinite(self._found.poses[row]).all():
            return no_points(camera.size)
        stored, place = None if self._dataset is None else self._dataset.stored_pixels(index), self._found.place
        if stored is not None and self._found.is_straight:  # by another program, which has cropped them otherwise
            stored, place = None, by_rays
        points, confidence, mask = at_frame(self._found.read(row), camera, place, self._max_depth_step, stored)
        return points * np.float32(self._factor), confidence, mask

    def _first_depth(self) -> tuple[View, float]:
        """The first view with a depth, and its median."""
        for row in range(len(self._found.names)):
            view = self._found.read(row)
            depth = view.geometry if view.geometry.ndim == 2 else view.geometry[..., 2]
            if usable(view.geometry).any():
                return view, float(np.median(depth[usable(view.geometry)]))
        raise ValueError(f"{self.folder}: none of its {len(self._found.names)} files has a depth above 0")

    def _pairs(self, known: list[int], camera: Camera, gap: int = PAIR_GAP) -> list[tuple[Sight, Sight]]:
        """Pairs of views with a pose, `gap` apart, evenly spread."""
        known = [index for index in known if np.isfinite(self._pose(index)).all()]
        places = np.linspace(0, max(len(known) - 1 - gap, 0), NUM_PAIRS).astype(int)
        chosen = {(known[place], known[min(place + gap, len(known) - 1)]) for place in places}
        sights = {}
        for index in sorted({index for pair in chosen for index in pair}):
            points, _, mask = self._at_frame(index, camera)
            sights[index] = Sight(points, mask, self._pose(index))
        return [(sights[a], sights[b]) for a, b in sorted(chosen) if a != b]


def read_predictions(folder: Path, units_per_metre: float) -> Predictions:
    """Read the predictions in a folder, in the layout that its files tell."""
    if not folder.exists():
        raise ValueError(f"prior.folder={folder} does not exist: give the folder of predictions (docs/predictions.md)")
    export = find_export(folder)
    if export is not None:
        return read_export(export)
    streamed = find_streaming(folder)
    if streamed is not None:
        return read_da3_streaming(streamed)
    if (folder / DEPTH_MAPS).is_dir():
        return read_colmap_workspace(folder)
    if (folder / "depth").is_dir() and (folder / "camera").is_dir():
        return read_cut3r(folder)
    if (folder / "depth").is_dir() and (folder / "pose").is_dir():
        return read_scannet(folder)
    if (folder / "depth").is_dir() and (folder / "metadata.json").is_file():
        return read_record3d(folder)
    return read_own(folder, units_per_metre)


def image_intrinsics(folder: Path, size: Size) -> Intrinsics | None:
    """The median camera of `NUM_CAMERAS` predictions, for images of a size.

    None if they have none, do not show the images, or are of a sensor with another camera.
    """
    (width, height), longest = size, float(max(size))
    camera, found = Camera(size, (longest, longest, (width - 1) / 2, (height - 1) / 2)), []
    predictions = read_predictions(folder, 1.0)
    if predictions.place is by_rays:
        return None
    for row in np.unique(np.linspace(0, len(predictions.names) - 1, NUM_CAMERAS).astype(int)).tolist():
        view = predictions.read(row)
        if view.intrinsics is None:
            return None
        try:
            (x, y), (left, top) = predictions.place(camera, view)
        except ValueError:
            return None
        fx, fy, cx, cy = view.intrinsics
        found.append(resize_intrinsics((fx, fy, cx + left, cy + top), (x, y), size))
    return tuple(float(value) for value in np.median(found, axis=0)) if found else None


def _pose_note(pose_std: tuple[float, float] | None) -> str:
    if pose_std is None:
        return "how sure the poses are is not known (prior.pose_std)"
    return f"prior.pose_std=[{pose_std[0]:.2g},{pose_std[1]:.2g}]"


def _focal_note(view: View, camera: Camera, found: Predictions) -> str:
    """Describe a difference between a file's intrinsics and the data set's; ValueError if it is too large."""
    if view.intrinsics is None:
        return ""
    expected = grid_intrinsics(camera, found.place(camera, view))
    ratio = view.intrinsics[0] / expected[0]
    words = (
        f"{view.source}: intrinsics say f = {view.intrinsics[0]:.1f}, and dataset.intrinsics {expected[0]:.1f} there"
    )
    if not 1 / FOCAL_ERROR < ratio < FOCAL_ERROR:
        raise ValueError(f"{words}: give those of the file's own size ({view.grid[0]}x{view.grid[1]}), or correct one")
    if 1 / FOCAL_NOTE < ratio < FOCAL_NOTE:
        return ""
    return f"; {words}: points lie where the files' have them; dataset.intrinsics times {ratio:.3f} would agree"


def turned_files(dataset: Dataset) -> dict[int, Path]:
    """The first image of each EXIF orientation that dataset=images turns, which not all programs do."""
    if dataset.name != "images":
        return {}
    files = [file for index in range(len(dataset)) for file in dataset.files(index)[:1]]
    return {turn: file for file in reversed(files) if (turn := orientation(file)) > 1}


def _turned_note(turned: Mapping[int, Path]) -> str:
    if not turned:
        return ""
    return (
        f"; images are shown turned by their EXIF orientation ({[*turned.values()][0].name}), and predictions must be "
        "of the turned images: VGGT and others take the pixels as they are stored (save the images upright for these)"
    )


def _stored_words(
    dataset: Dataset, poses: Mapping[int, np.ndarray], turned: Mapping[int, Path], angle: float
) -> str | None:
    """Describe that poses with the error `angle` fit the stored, unturned pixels much better; None if they do not."""
    if len(turned) != 1 or (turn := [*turned][0]) not in TURNS:
        return None
    upright = np.eye(4)
    upright[:2, :2] = TURNS[turn]
    found = pose_angle(dataset, {index: pose @ upright for index, pose in poses.items()})
    if found is None or MIN_GAIN * found > angle:
        return None
    return (
        f"poses err by {np.degrees(angle):.2g} degrees, and by {np.degrees(found):.2g} as those of images that are "
        f"not turned, while {turned[turn].name} is shown turned by its EXIF orientation: save the images upright and "
        "predict from these"
    )
