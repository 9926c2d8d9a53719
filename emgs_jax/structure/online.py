"""Structure from motion of images as they come: COLMAP's mapper, called for one keyframe at a time.

A frame that has moved from the last keyframe becomes one: it is matched with the last keyframes and with those that
look alike, placed by the points that they show, and adjusted with its neighbours. Any other frame is placed by the
points of its keyframe, and follows it. Before two keyframes have enough parallax, frames wait. Frames that do not fit
the points are left out. Nothing is asked of images that have not come.
"""

import copy
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, Int, UInt8
from scipy.spatial import cKDTree

from emgs_jax.keypoints.poses import essential, pose_of
from emgs_jax.keypoints.sift import detect, mutual
from emgs_jax.loop_closure.place_recognition import train_words, vlad
from emgs_jax.structure.config import StructureConfig
from emgs_jax.structure.evidence import MIN_MATCHES, NEAR, Evidence, count_own, trust
from emgs_jax.structure.library import bundle_of, load, options_of
from emgs_jax.structure.mapping import MIN_IMAGES, WEAK, drop_points_at_cameras
from emgs_jax.structure.mirror import turned_right
from emgs_jax.structure.model import NONE, Structure, World, scaled
from emgs_jax.structure.uncertainty import camera_in_world

CAMERA = 1  # COLMAP's number of the camera, and of its rig
NUM_FEATURES, MIN_CONTRAST, MAX_RATIO = 1500, 0.01, 0.8
MAX_ERROR = 2.0  # pixels of a match from the epipolar lines, and of a follower's points
MOVED = 0.04  # median motion of the matches of a keyframe, as a share of the image's width
FEW = 0.4  # share of the keypoints that match, below which a frame shows something new
# Keyframes that a new one is matched with: the last, those most alike, more if it is not placed; and those whose points
# are looked for in it once it is placed.
NUM_RECENT, NUM_SIMILAR, NUM_LOST, NUM_TIED = 3, 2, 8, 12
NUM_NEAR, MIN_LIKENESS = 4, 0.8  # keypoints that are compared there, and the least cosine of their descriptors
RADIUS = 8.0  # pixels around a point's place in which its keypoint is looked for
NUM_WORDS, MAX_TRAINING, NUM_ITERATIONS = 64, 10000, 10  # of place recognition
ANGLES = 8.0, 4.0, 2.0  # between the views of the first pair [deg], the next after so many keyframes as fit into
PATIENCE = 10
MAX_WAITING = 40  # keyframes
GLOBAL_RATIO = 1.2  # growth after which all is adjusted
NUM_LOCAL = 24  # keyframes that tell how sure a point is


class View(NamedTuple):
    """Keypoints of an image."""

    pixels: Float[np.ndarray, "k 2"]  # COLMAP's: from the border
    descriptors: UInt8[np.ndarray, "k 128"]


class Follower(NamedTuple):
    """A frame that shows what its keyframe shows."""

    keyframe: int
    rows: Int[np.ndarray, " m"]  # keypoints of the keyframe
    pixels: Float[np.ndarray, "m 2"]  # of the frame
    T_keyframe_view: Float[np.ndarray, "4 4"] | None = None  # in the model's unit; None until it is placed
    points: Int[np.ndarray, " p"] = np.zeros(0, int)  # that it shows


@dataclass
class Online:
    """The structure of the images so far. Frames are numbered in the order in which they come."""

    start: Any  # pycolmap's camera, as it is known at the beginning
    config: StructureConfig
    model: Any = None  # pycolmap's; None before it has begun
    unit: float = 1.0  # of its lengths
    views: dict[int, View] = field(default_factory=dict)  # of keyframes
    images: dict[int, Any] = field(default_factory=dict)  # pycolmap's, likewise
    pairs: dict[tuple[int, int], np.ndarray] = field(default_factory=dict)  # matches (m, 2) of keyframes
    E: dict[tuple[int, int], np.ndarray] = field(default_factory=dict)
    followers: dict[int, Follower] = field(default_factory=dict)
    words: np.ndarray = field(default_factory=lambda: np.zeros((0, 128), np.float32))
    vectors: dict[int, np.ndarray] = field(default_factory=dict)
    points: np.ndarray = field(default_factory=lambda: np.zeros((0, 3)))  # by COLMAP's number, NaN for those that went
    shown: dict[int, np.ndarray] = field(default_factory=dict)  # numbers of the points that each keyframe shows
    rows: dict[int, np.ndarray] = field(default_factory=dict)  # and its keypoints that show them
    covariance: dict[int, np.ndarray] = field(default_factory=dict)  # (6, 6) of a frame's pose when it was placed
    num_frames: int = 0
    num_adjusted: int = 0  # keyframes at the last adjustment of all
    num_trained: int = 0

    @property
    def has_begun(self) -> bool:
        """True once there is a model."""
        return self.model is not None

    @property
    def camera(self) -> Any:
        """Pycolmap's camera; its distortion is adjusted with the model."""
        return self.start if self.model is None else self.model.cameras[CAMERA]

    @property
    def K(self) -> Float[np.ndarray, "3 3"]:
        """Calibration matrix."""
        return self.start.calibration_matrix()

    def straight(self, pixels: Float[np.ndarray, "m 2"]) -> Float[np.ndarray, "m 2"]:
        """Pixels without distortion."""
        rays = np.asarray(self.camera.cam_from_img(pixels)).reshape(-1, 2)
        return rays * self.K[[0, 1], [0, 1]] + self.K[:2, 2]

    def placed_frames(self) -> list[int]:
        """Keyframes with a pose, in order of time."""
        return [] if self.model is None else sorted(image - 1 for image in self.model.reg_image_ids())


def look(image: UInt8[np.ndarray, "h w 3"], mask: Bool[np.ndarray, "h w"] | None = None) -> View:
    """Find the keypoints of an RGB image; none where the mask is on."""
    pixels, descriptors = detect(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), NUM_FEATURES, MIN_CONTRAST)
    pixels, descriptors = pixels[:NUM_FEATURES], descriptors[:NUM_FEATURES]
    if mask is not None and len(pixels):
        column, row = np.clip(np.round(pixels).astype(int), 0, np.array(mask.shape[::-1]) - 1).T
        pixels, descriptors = pixels[~mask[row, column]], descriptors[~mask[row, column]]
    return View(pixels + 0.5, np.uint8(np.clip(np.round(512 * descriptors), 0, 255)))


def unit_descriptors(view: View) -> Float32[np.ndarray, "k 128"]:
    """Descriptors of unit length."""
    found = np.float32(view.descriptors)
    return found / np.maximum(np.linalg.norm(found, axis=1, keepdims=True), 1.0)


def match(online: Online, a: View, b: View) -> tuple[Int[np.ndarray, "m 2"], np.ndarray]:
    """Matches of two views that fit one essential matrix, and it; none where fewer than MIN_MATCHES do."""
    first, second = mutual(unit_descriptors(a), unit_descriptors(b), MAX_RATIO)
    if len(first) >= MIN_MATCHES:
        pixels = online.straight(a.pixels[first]), online.straight(b.pixels[second])
        E, fits = essential(*pixels, online.K, MAX_ERROR)
        if E is not None and E.shape == (3, 3) and fits.sum() >= MIN_MATCHES:
            is_kept = fits.ravel() > 0
            return np.stack([first[is_kept], second[is_kept]], axis=1), E
    return np.zeros((0, 2), int), np.zeros((3, 3))


def add(online: Online, image: np.ndarray | None, mask: np.ndarray | None = None) -> bool:
    """Add the next frame, or None for one that cannot be read; True if it has a pose, or waits for one."""
    number = online.num_frames
    online.num_frames += 1
    if image is None:
        return False
    view = look(image, mask)
    if not online.views:
        keep(online, number, view)
        return True
    before = max(online.views)
    matches, E = match(online, online.views[before], view)
    if len(matches) and not is_new(online, before, view, matches):
        online.followers[number] = Follower(before, matches[:, 0], view.pixels[matches[:, 1]])
        return not online.has_begun or follow(online, number)
    keep(online, number, view)
    pair(online, before, number, matches, E)
    if not online.has_begun:
        for other in sorted(online.views)[-MAX_WAITING:-2]:
            pair(online, other, number, *match(online, online.views[other], view))
        begin(online, number)
        return True
    return place(online, number)


def is_new(online: Online, before: int, view: View, matches: np.ndarray) -> bool:
    """Test whether a view shows something that its keyframe does not."""
    moved = np.linalg.norm(view.pixels[matches[:, 1]] - online.views[before].pixels[matches[:, 0]], axis=1)
    count = min(len(view.pixels), len(online.views[before].pixels))
    return bool(np.median(moved) > MOVED * online.start.width or len(matches) < FEW * count)


def keep(online: Online, number: int, view: View) -> None:
    """Keep a view as a keyframe."""
    pycolmap = load()
    image = pycolmap.Image(name=str(number), camera_id=CAMERA, image_id=number + 1)
    image.points2D = pycolmap.Point2DList([pycolmap.Point2D(xy) for xy in view.pixels])
    image.frame_id = number + 1
    online.views[number], online.images[number] = view, image


def pair(online: Online, a: int, b: int, matches: np.ndarray, E: np.ndarray) -> None:
    """Keep the matches of two keyframes, if there are any."""
    if len(matches):
        online.pairs[a, b], online.E[a, b] = matches, E


def mapper_of(online: Online, model: Any, around: Sequence[int] | None = None) -> tuple[Any, Any]:
    """COLMAP's mapper of a model with the matches of these keyframes, or of all; and what must live as long."""
    pycolmap = load()
    cache, sensor, rig = pycolmap.DatabaseCache(), pycolmap.sensor_t(pycolmap.SensorType.CAMERA, CAMERA), pycolmap.Rig()
    rig.rig_id = CAMERA
    rig.add_ref_sensor(sensor)
    cache.add_camera(online.start)
    cache.add_rig(rig)
    for number, image in online.images.items():
        frame = pycolmap.Frame()
        frame.frame_id, frame.rig_id = number + 1, CAMERA
        frame.add_data_id(pycolmap.data_t(sensor, number + 1))
        cache.add_frame(frame)
        cache.add_image(image)
    near = None if around is None else {*around}
    for (a, b), matches in online.pairs.items():
        if near is None or a in near or b in near:
            found = pycolmap.TwoViewGeometry()
            found.config, found.E = pycolmap.TwoViewGeometryConfiguration.CALIBRATED, online.E[a, b]
            found.inlier_matches = matches
            cache.correspondence_graph.add_two_view_geometry(a + 1, b + 1, found)
    cache.correspondence_graph.finalize()
    mapper = pycolmap.IncrementalMapper(cache)
    mapper.begin_reconstruction(model)
    return mapper, cache


def settings(online: Online, angle: float = ANGLES[0], is_bent: bool = False) -> tuple[Any, Any, Any]:
    """COLMAP's options of mapper, adjustment and triangulation; `is_bent`: the distortion is adjusted, too.

    Without a number of threads there is one: with all of them the same images do not give the same bits.
    """
    num_threads = max(online.config.num_threads, 1)
    common = {"num_threads": num_threads, "random_seed": online.config.seed}
    mapper = {
        "init_min_tri_angle": angle,
        "init_max_reg_trials": 1000,
        "max_reg_trials": 1000,
        "abs_pose_min_num_inliers": online.config.min_inliers,
        "abs_pose_refine_focal_length": False,
        "abs_pose_refine_extra_params": False,
    }
    is_bent = is_bent and online.config.refine_distortion
    refined = {"refine_focal_length": False, "refine_extra_params": is_bent, "print_summary": False}
    adjustment = options_of("BundleAdjustmentOptions", refined)
    adjustment.ceres.loss_function_type = load().LossFunctionType.CAUCHY
    solver = adjustment.ceres.solver_options
    solver.num_threads, solver.function_tolerance, solver.max_num_iterations = num_threads, 1e-5, 50
    triangulation = load().IncrementalTriangulatorOptions(random_seed=online.config.seed)
    return load().IncrementalMapperOptions(**common, **mapper), adjustment, triangulation


def begin(online: Online, newest: int) -> None:
    """Begin with the first keyframe that has enough parallax to the newest, if the model is one to believe."""
    waiting = sorted(online.views)[-MAX_WAITING:]
    angle = ANGLES[min(len(waiting) // PATIENCE, len(ANGLES) - 1)]
    options, adjustment, triangulation = settings(online, angle)
    model = load().Reconstruction()
    mapper, cache = mapper_of(online, model)
    for other in waiting[:-1]:
        pose = (other, newest) in online.pairs and mapper.estimate_initial_two_view_geometry(
            options, other + 1, newest + 1
        )
        if not pose:
            continue
        mapper.register_initial_image_pair(options, other + 1, newest + 1, pose)
        for number in (other, newest):
            mapper.triangulate_image(triangulation, number + 1)
        if not model.num_points3D():
            break
        mapper.adjust_global_bundle(options, adjustment)
        mapper.filter_points(options)
        for number in (*reversed(waiting), *waiting):  # from the newest back; then those whose points came later
            if not model.images[number + 1].has_pose and mapper.register_next_image(options, number + 1):
                mapper.triangulate_image(triangulation, number + 1)
                mapper.iterative_local_refinement(2, 1e-3, options, adjustment, triangulation, number + 1)
        adjustment = settings(online, is_bent=True)[1]
        mapper.iterative_global_refinement(3, 1e-3, options, adjustment, triangulation)
        break
    mapper.end_reconstruction(False)
    if model.num_reg_images() >= MIN_IMAGES:
        adopt(online, model)


def adopt(online: Online, model: Any) -> None:
    """Take a first model, or its mirror image, if it explains the matches; its unit is from its depths."""
    evidence = evidence_of(online)

    def settle(other: Any) -> None:
        drop_points_at_cameras(other)
        problem = bundle_of(other)
        problem.set_constant_cam_intrinsics(CAMERA)
        problem.fix_gauge(load().BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
        adjustment = settings(online)[1]
        load().create_default_ceres_bundle_adjuster(adjustment, problem, other).solve()

    turned = turned_right(model, evidence, settle)
    if turned.is_doubtful or trust([turned.model], evidence, within=True) < WEAK:
        return
    online.model = turned.model
    refresh(online, online.placed_frames())
    depths = np.concatenate([depths_of(online, number) for number in online.placed_frames()])
    online.unit = online.config.median_depth / float(np.median(depths))
    online.num_adjusted = model.num_reg_images()
    learn_words(online)
    for number in online.placed_frames():
        measure(online, number)
    for number in online.followers:
        follow(online, number)


def evidence_of(online: Online) -> Evidence:
    """The matches of the keyframes, as evidence."""
    order = {number: row for row, number in enumerate(sorted(online.views))}
    own = [
        count_own(
            np.linalg.inv(online.K).T @ online.E[a, b] @ np.linalg.inv(online.K),
            online.straight(online.views[a].pixels[matches[:, 0]]),
            online.straight(online.views[b].pixels[matches[:, 1]]),
            1.0,
        )
        for (a, b), matches in online.pairs.items()
    ]
    near = [abs(order[a] - order[b]) <= NEAR for a, b in online.pairs]
    pairs = [(a + 1, b + 1) for a, b in online.pairs]
    keypoints = {number + 1: view.pixels for number, view in online.views.items()}
    return Evidence(pairs, [*online.pairs.values()], np.array(own, int), np.array(near, bool), keypoints, 1.0)


def place(online: Online, number: int) -> bool:
    """Place a new keyframe in the model, and adjust its neighbours; False if it fits nowhere."""
    placed, view = [one for one in online.placed_frames() if one != number], online.views[number]
    alike = [one for one in most_alike(online, view) if one in {*placed}]
    recent = placed[-NUM_RECENT:]
    others = [one for one in alike if one not in recent]
    for tried in ([*recent, *others[:NUM_SIMILAR]], others[NUM_SIMILAR : NUM_SIMILAR + NUM_LOST]):
        for other in tried:
            if (other, number) not in online.pairs:
                pair(online, other, number, *match(online, online.views[other], view))
        if register(online, number):
            measure(online, number)
            remember(online, number)
            if online.model.num_reg_images() >= GLOBAL_RATIO * online.num_adjusted:
                adjust_all(online)
            return True
    forget(online, number)
    return False


def register(online: Online, number: int) -> bool:
    """Place a keyframe by the points that its matches show, triangulate, and adjust the images beside it."""
    options, adjustment, triangulation = settings(online)
    mapper, cache = mapper_of(online, online.model, [number])
    is_placed = mapper.register_next_image(options, number + 1)
    mapper.end_reconstruction(False)
    if not is_placed:
        return False
    tie(online, number)
    beside = [a for a, b in online.pairs if b == number]
    mapper, cache = mapper_of(online, online.model, [number, *beside])
    mapper.triangulate_image(triangulation, number + 1)
    mapper.iterative_local_refinement(2, 1e-3, options, adjustment, triangulation, number + 1)
    is_placed = online.model.images[number + 1].has_pose
    adjusted = {number, *beside, *(image - 1 for image in mapper.find_local_bundle(options, number + 1))}
    mapper.end_reconstruction(False)
    refresh(online, [one for one in sorted(adjusted) if online.model.images[one + 1].has_pose])
    return is_placed


def tie(online: Online, number: int) -> None:
    """Match a placed keyframe with more of those alike, by where their points lie in it: cheaper than all with all."""
    view = online.views[number]
    T = np.linalg.inv(pose_at(online, number))
    pixels, descriptors = cKDTree(view.pixels), unit_descriptors(view)
    others = [one for one in most_alike(online, view)[:NUM_TIED] if (one, number) not in online.pairs]
    for other in (one for one in others if pose_at(online, one) is not None):
        points, rows = online.shown[other], online.rows[other]
        local = online.points[points] @ T[:3, :3].T + T[:3, 3]
        is_before = np.isfinite(local[:, 2]) & (local[:, 2] > 0)
        rows, local = rows[is_before], local[is_before]
        if len(rows) < MIN_MATCHES:
            continue
        places = np.asarray(online.camera.img_from_cam(local))
        distance, near = pixels.query(places, k=NUM_NEAR, distance_upper_bound=RADIUS)
        likeness = np.einsum(
            "pd,pkd->pk", unit_descriptors(online.views[other])[rows], descriptors[near % len(view.pixels)]
        )
        likeness[~np.isfinite(distance)] = -1.0
        best = likeness.argmax(axis=1)
        is_like = likeness.max(axis=1) > MIN_LIKENESS
        matches = np.stack([rows[is_like], near[np.arange(len(rows)), best][is_like]], axis=1)
        matches = matches[np.unique(matches[:, 1], return_index=True)[1]]
        if len(matches) >= MIN_MATCHES:
            pair(online, other, number, matches, np.zeros((3, 3)))


def adjust_all(online: Online) -> None:
    """Adjust all keyframes, and find points again."""
    options, adjustment, triangulation = settings(online, is_bent=True)
    mapper, cache = mapper_of(online, online.model)
    mapper.iterative_global_refinement(2, 1e-3, options, adjustment, triangulation, False)
    mapper.end_reconstruction(False)
    online.num_adjusted = online.model.num_reg_images()
    refresh(online, online.placed_frames())


def forget(online: Online, number: int) -> None:
    """Forget a keyframe that cannot be placed."""
    for key in [key for key in online.pairs if number in key]:
        del online.pairs[key], online.E[key]
    del online.views[number], online.images[number]


def forget_follower(online: Online) -> bool:
    """Forget the last frame if it shows only what its keyframe shows, as if it had not come; True if it does."""
    number = online.num_frames - 1
    if number not in online.followers:
        return False
    del online.followers[number]
    online.num_frames = number
    return True


def learn_words(online: Online) -> None:
    """Train place recognition on the keyframes, whenever their number has doubled."""
    descriptors = [unit_descriptors(view) for view in online.views.values()]
    online.words = train_words(
        np.concatenate(descriptors), (NUM_WORDS, MAX_TRAINING, NUM_ITERATIONS), online.config.seed
    )
    online.vectors = {number: vlad(one, online.words) for number, one in zip(online.views, descriptors, strict=True)}
    online.num_trained = len(online.views)


def remember(online: Online, number: int) -> None:
    """Add a keyframe to place recognition."""
    if len(online.views) >= 2 * online.num_trained:
        learn_words(online)
    else:
        online.vectors[number] = vlad(unit_descriptors(online.views[number]), online.words)


def most_alike(online: Online, view: View) -> list[int]:
    """Keyframes, the most similar first."""
    if not online.vectors:
        return []
    numbers, vectors = [*online.vectors], np.stack([*online.vectors.values()])
    return [numbers[row] for row in np.argsort(-(vectors @ vlad(unit_descriptors(view), online.words)), kind="stable")]


def refresh(online: Online, keyframes: Sequence[int]) -> None:
    """Read the points again that these keyframes show or have shown."""
    for number in keyframes:
        online.points[online.shown.get(number, [])] = np.nan
    for number in keyframes:
        image = online.model.images[number + 1]
        online.rows[number] = np.array(image.get_observation_point2D_idxs(), int)
        online.shown[number] = np.array([one.point3D_id for one in image.get_observation_points2D()], int)
    seen = np.unique(np.concatenate([online.shown[number] for number in keyframes]))
    if missing := int(seen.max(initial=-1)) + 1 - len(online.points):
        more = np.full((max(missing, len(online.points), 0), 3), np.nan)
        online.points = np.concatenate([online.points, more]) if missing > 0 else online.points
    known = online.model.points3D
    online.points[seen] = np.array([known[int(point)].xyz for point in seen]).reshape(-1, 3)


def shown_by(online: Online, number: int) -> Int[np.ndarray, " p"]:
    """Numbers of the points that a frame shows and that are still there."""
    points = online.shown[number] if number in online.shown else online.followers[number].points
    return points[np.isfinite(online.points[points, 0])]


def depths_of(online: Online, number: int) -> Float[np.ndarray, " p"]:
    """Depths of the points that a keyframe shows, in the model's unit."""
    T = pose_at(online, number)
    return (online.points[shown_by(online, number)] - T[:3, 3]) @ T[:3, 2]


def follow(online: Online, number: int) -> bool:
    """Place a frame by the points of its keyframe."""
    one = online.followers[number]
    if pose_at(online, one.keyframe) is None:
        return False
    point = np.full(len(online.views[one.keyframe].pixels), -1)
    point[online.rows[one.keyframe]] = online.shown[one.keyframe]
    seen, pixels = point[one.rows], online.straight(one.pixels)
    is_known = (seen >= 0) & np.isfinite(online.points[seen, 0])
    seen, pixels = seen[is_known], pixels[is_known]
    found = pose_of(online.points[seen], pixels, online.K, online.config.min_inliers, MAX_ERROR)
    if found is None:
        return False
    T_world_view, kept = found
    T_keyframe_view = np.linalg.inv(pose_at(online, one.keyframe)) @ T_world_view
    online.followers[number] = one._replace(T_keyframe_view=T_keyframe_view, points=seen[kept])
    measure(online, number)
    return True


def pose_at(online: Online, number: int) -> Float[np.ndarray, "4 4"] | None:
    """T_world_camera of a frame in the model's unit; None without one."""
    one = online.followers.get(number)
    keyframe = number if one is None else one.keyframe
    if not online.has_begun or keyframe not in online.views or (one is not None and one.T_keyframe_view is None):
        return None
    image = online.model.images[keyframe + 1] if online.model.exists_image(keyframe + 1) else None
    if image is None or not image.has_pose:
        return None
    return camera_in_world(image) if one is None else camera_in_world(image) @ one.T_keyframe_view


def measure(online: Online, number: int) -> None:
    """Estimate the covariance of a frame's pose, see `Structure`, from its points and theirs from other keyframes."""
    T, points = pose_at(online, number), shown_by(online, number)
    others = sorted((abs(one - number), one) for one in online.placed_frames() if one != number)[:NUM_LOCAL]
    information = np.zeros((len(points), 3, 3))
    focal = online.start.mean_focal_length()
    for _, other in others:
        ray = online.points[points] - pose_at(online, other)[:3, 3]
        across = (ray**2).sum(1)[:, None, None] * np.eye(3) - ray[:, :, None] * ray[:, None, :]
        is_shown = np.isin(points, online.shown[other])
        information += is_shown[:, None, None] * across * focal**2 / ((ray**2).sum(1) ** 2)[:, None, None]
    is_sure = np.linalg.det(information) > 0
    spread = np.linalg.inv(np.where(is_sure[:, None, None], information, np.eye(3)))
    local = (online.points[points] - T[:3, 3]) @ T[:3, :3]
    z, x = local[:, 2], local[:, :2] / local[:, 2:]
    onto = np.zeros((len(points), 2, 3))  # of pixels, by the point in the camera's axes
    onto[:, 0, 0] = onto[:, 1, 1] = focal / z
    onto[:, :, 2] = -focal * x / z[:, None]
    cross = np.zeros((len(points), 3, 3))
    cross[:, [2, 0, 1], [1, 2, 0]], cross[:, [1, 2, 0], [2, 0, 1]] = local, -local
    by_pose = onto @ np.concatenate([-np.broadcast_to(np.eye(3), cross.shape), cross], axis=2)
    by_point = onto @ T[:3, :3].T
    noise = np.eye(2) + by_point @ spread @ by_point.mT
    known = (by_pose.mT @ np.linalg.solve(noise, by_pose))[is_sure & (z > 0)].sum(axis=0)
    if np.linalg.matrix_rank(known) == 6:
        online.covariance[number] = online.config.pixel_std**2 * np.linalg.inv(known)


def newest(online: Online) -> Structure:
    """The structure of the frames so far, one world."""
    count = online.num_frames
    world, T, covariance = np.full(count, NONE), np.full((count, 4, 4), np.nan), np.full((count, 6, 6), np.nan)
    landmarks = [np.zeros(0, int)] * count
    for number in range(count):
        if (pose := pose_at(online, number)) is None:
            continue
        world[number], T[number] = 0, pose
        covariance[number] = online.covariance.get(number, np.nan)
        landmarks[number] = shown_by(online, number)
    camera = copy.copy(online.camera)
    structure = Structure([World(online.points, camera)], world, T, covariance, landmarks, online.num_adjusted)
    return scaled(structure, [online.unit])
