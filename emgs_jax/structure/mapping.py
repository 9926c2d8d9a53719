"""Map the matches in COLMAP's database: begin as often as it takes, and keep what explains most of them."""

import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float
from tqdm import tqdm

from emgs_jax.structure.config import StructureConfig
from emgs_jax.structure.evidence import (
    MIN_MATCHES,
    Evidence,
    contradicted,
    explained,
    joined,
    read_evidence,
    share,
    trust,
)
from emgs_jax.structure.library import bundle_of, load, options_of
from emgs_jax.structure.mirror import only, turned_right
from emgs_jax.structure.shots import DATABASE, IMAGES, Shots


class Start(NamedTuple):
    """How the mapper begins."""

    angle: float  # least, between the views of the first pair [deg]
    ahead: float  # most that its motion may point ahead
    is_near: bool  # only pairs of images near in time are used, for those far apart may show look-alikes


# COLMAP's own first; narrow pairs, and motions straight ahead, are for a camera that drives.
STARTS = Start(16.0, 0.95, False), Start(8.0, 0.95, True), Start(4.0, 1.0, False), Start(2.0, 1.0, True)
MAX_FOR_STARTS = 200  # images up to which a weak structure is begun anew
WEAK = 0.96  # of the matches that pairs alone explain: models that are right explain .97 and more
REFUSED = 0.7  # of them, below which a model is not believed
WORSE = 0.03  # of them, by which the start with the most matches explained may be worse than another
MIN_DOUBTFUL = 10  # images of a doubtful model that is kept: COLMAP's own least size of a model
MIN_IMAGES = 3  # of a model, that no larger one holds
MIN_FOR_CENTER = 30  # images to refine the principal point
MIN_DEPTH = 0.01  # of a point, in median depths of the image
WIDE = 2.0  # COLMAP's largest reprojection errors, while a mirror image is adjusted


class Mapped(NamedTuple):
    """Models, the largest first, and what a user must know of them."""

    models: list[Any]
    said: list[str]
    doubtful: frozenset[str] = frozenset()  # names of images of models that are said to be doubtful


def tell(said: Sequence[str]) -> None:
    """Say what is to be known of models."""
    for words in said:
        tqdm.write(words)


def map_database(shots: Shots, config: StructureConfig, folder: Path) -> Mapped:
    """Map the matches in a folder's database; ValueError, with a reason, if it fails."""
    evidence = read_evidence(folder / DATABASE, shots.names, max(1.0, max(shots.size) / config.max_image_size))
    found, said, doubtful = best_start(shots, config, folder, evidence)
    check_found(found, shots, config, folder)
    for model in found:
        adjust(model, shots, config)
    models, more, weak = told_apart(found, evidence)
    if not models:
        known = "; its camera may be another (dataset.intrinsics=estimate)" if shots.is_calibrated else ""
        raise ValueError(
            "prior=multiview_stereo finds no structure that the images' matches agree with: what they show may repeat "
            f"(tiles, doors) or move{known}; or bring predictions (prior=files). {' '.join(more)}"
        )
    return Mapped(models, said + more, doubtful | weak)


def best_start(shots: Shots, config: StructureConfig, folder: Path, evidence: Evidence) -> Mapped:
    """Begin once where the models explain what their matches allow, else up to all `STARTS`, and keep the best.

    The best explains the most matches among those that near pairs bear out.
    """
    begun: list[Mapped] = []
    trusted: list[float] = []
    while len(begun) < len(STARTS):
        begun.append(begin(len(begun), shots, config, folder, evidence))
        trusted.append(trust(begun[-1].models, evidence))
        if trusted[-1] >= WEAK or (len(shots.names) > MAX_FOR_STARTS and any(one.models for one in begun)):
            break
    shares = [share(one.models, evidence) for one in begun]
    taken = max((row for row, one in enumerate(trusted) if one >= max(trusted) - WORSE), key=lambda row: shares[row])
    best = begun[taken]
    if len(begun) == 1 or not best.models:
        return best
    tried = ", ".join(f"{start.angle:g}" for start in STARTS[: len(begun)])
    said = (
        f"structure: begun {len(begun)} times, with first pairs of {tried} degrees or more, which explain "
        f"{', '.join(f'{100 * one:.0f}' for one in trusted)} % of what images near in time explain by themselves; kept "
        f"is that of {STARTS[taken].angle:g}{' without pairs far apart in time' * STARTS[taken].is_near}"
    )
    return Mapped(best.models, [said, *best.said], best.doubtful)


def begin(number: int, shots: Shots, config: StructureConfig, folder: Path, evidence: Evidence) -> Mapped:
    """Map once, turn models that are inside out, and place images again that their matches contradict."""
    models, said, doubtful = [], [], []
    folder = near_only(folder, evidence) if STARTS[number].is_near else folder
    for model in find_models(shots, config, folder, number):
        leave_out(model, evidence)
        turned = turned_right(model, evidence, lambda other: settle(other, shots, config))
        if turned.is_mirrored:
            triangulate(turned.model, config, folder)
            said.append(
                f"structure: a model of {model.num_reg_images()} images was inside out: it explains "
                f"{100 * explained(model, evidence):.0f} % of their matches, its mirror image, which is kept, "
                f"{100 * explained(turned.model, evidence):.0f} %"
            )
        if turned.is_doubtful:
            said.append(
                f"structure: doubtful: a model of {model.num_reg_images()} images may be inside out, for its mirror "
                "image explains the matches as well: move the camera farther, or nearer to what it shows"
            )
            doubtful.append(turned.model)
        models.append(turned.model)
    register_rest(models, config, folder)
    for model in models:
        leave_out(model, evidence)
    kept = [model for model in models if model.num_reg_images() >= MIN_IMAGES]
    return Mapped(kept, said, names_in(doubtful))


def names_in(models: Sequence[Any]) -> frozenset[str]:
    """Names of the images with a pose in one of these models."""
    return frozenset(model.images[image].name for model in models for image in model.reg_image_ids())


def near_only(folder: Path, evidence: Evidence) -> Path:
    """A folder with a copy of the database, in which only images near in time match."""
    near = folder / "near"
    near.mkdir(exist_ok=True)
    shutil.copy(folder / DATABASE, near / DATABASE)
    with load().Database.open(near / DATABASE) as opened:
        for pair, is_near in zip(evidence.pairs, evidence.is_near, strict=True):
            if not is_near:
                opened.delete_two_view_geometry(*pair)
    return near


def leave_out(model: Any, evidence: Evidence) -> None:
    """Take the images from a model whose matches contradict their poses."""
    observations = load().ObservationManager(model)
    for image in contradicted(model, evidence):
        observations.deregister_frame(model.images[image].frame_id)


def told_apart(found: Sequence[Any], evidence: Evidence) -> Mapped:
    """Models whose images agreeing matches join, and words on what is split, doubtful or refused."""
    models, said = [], []
    for model in found:
        count = model.num_reg_images()
        leave_out(model, evidence)
        groups = [group for group in joined(model, evidence) if len(group) >= MIN_IMAGES]
        if lone := count - sum(map(len, groups)):
            said.append(f"structure: {lone} of {count} images of a model are left out: their matches contradict it")
        if len(groups) > 1:
            said.append(
                f"structure: a model of {model.num_reg_images()} images is split into {len(groups)} (of "
                f"{', '.join(str(len(group)) for group in groups)}): no matches between them agree with it"
            )
        is_whole = [len(group) for group in groups] == [model.num_reg_images()]
        models += [model] if is_whole else [only(model, group) for group in groups]
    believed, doubtful = [], []
    for model in sorted(models, key=lambda model: -model.num_reg_images()):
        trusted, count = trust([model], evidence, within=True), model.num_reg_images()
        about = (
            f"a model of {count} images explains {100 * trusted:.0f} % of what its images near in time explain by "
            f"themselves (usual: 98 or more), with {model.num_points3D()} points"
        )
        is_small = model.num_points3D() < MIN_MATCHES or (trusted < WEAK and count < MIN_DOUBTFUL)
        if trusted < REFUSED or is_small:
            said.append(f"structure: {about}: it is left out")
            continue
        if trusted < WEAK:
            said.append(f"structure: doubtful: {about}")
            doubtful.append(model)
        believed.append(model)
    return Mapped(believed, said, names_in(doubtful))


def refined_lens(shots: Shots, config: StructureConfig) -> tuple[bool, bool]:
    """Whether to refine the focal length, and the distortion."""
    return not shots.is_calibrated, not shots.is_calibrated or config.refine_distortion


def find_models(shots: Shots, config: StructureConfig, folder: Path, start: int = 0) -> list[Any]:
    """Run the mapper from one of `STARTS`; the largest model first."""
    pycolmap = load()
    is_free, is_bent = refined_lens(shots, config)
    seed, begun = (config.seed + start) % 2**31, STARTS[start]
    common = {"num_threads": config.num_threads, "random_seed": seed}
    given = config.options.get(config.mapper, {})
    output = folder / "models"
    for needed in (output, folder / IMAGES):  # of a database alone there are none
        needed.mkdir(exist_ok=True)
    if config.mapper == "global":
        refined = {"refine_focal_length": is_free, "refine_extra_params": is_bent}
        mapper = {"mapper": {**common, "bundle_adjustment": refined}}
        options = options_of("GlobalPipelineOptions", common, mapper, given)
        found = pycolmap.global_mapping(folder / DATABASE, folder / IMAGES, output, options)
    else:
        refined = {
            "ba_refine_focal_length": is_free,
            "ba_refine_extra_params": is_bent,
            "mapper": {
                **common,
                "init_min_tri_angle": begun.angle,
                "init_max_forward_motion": begun.ahead,
                "abs_pose_refine_focal_length": is_free,
                "abs_pose_refine_extra_params": is_bent,
            },
            "triangulation": {"random_seed": seed},
        }
        options = options_of("IncrementalPipelineOptions", common, refined, given)
        with tqdm(total=len(shots.names), unit="image", desc=f"structure{f', start {start + 1}' * (start > 0)}") as bar:
            found = pycolmap.incremental_mapping(
                folder / DATABASE, folder / IMAGES, output, options, "", lambda: bar.update(2), bar.update
            )
    held: set[int] = set()
    models = []
    for model in sorted(found.values(), key=lambda model: -model.num_reg_images()):
        if len(new := {*model.reg_image_ids()} - held) >= MIN_IMAGES:
            models.append(model)
            held |= new
    return models


def register_rest(models: Sequence[Any], config: StructureConfig, folder: Path) -> None:
    """Register remaining images with fewer inliers."""
    cache, names = cache_of(config, folder)
    placed = {image for model in models for image in model.reg_image_ids()}
    options = load().IncrementalMapperOptions(
        abs_pose_min_num_inliers=config.min_inliers,
        abs_pose_refine_focal_length=False,
        abs_pose_refine_extra_params=False,
        random_seed=config.seed,
    )
    for model in models:
        mapper = load().IncrementalMapper(cache)
        mapper.begin_reconstruction(model)
        rest = [image for image in sorted(names) if image not in placed and cache.exists_image(image)]
        new = [image for image in rest if mapper.register_next_image(options, image)]
        _triangulate(mapper, new, config)
        placed.update(new)
        mapper.end_reconstruction(False)


def triangulate(model: Any, config: StructureConfig, folder: Path) -> None:
    """Find points again that a model lacks."""
    mapper = load().IncrementalMapper(cache_of(config, folder)[0])
    mapper.begin_reconstruction(model)
    _triangulate(mapper, sorted(model.reg_image_ids()), config)
    mapper.end_reconstruction(False)


def _triangulate(mapper: Any, images: Sequence[int], config: StructureConfig) -> None:
    for image in images:
        mapper.triangulate_image(load().IncrementalTriangulatorOptions(random_seed=config.seed), image)


def cache_of(config: StructureConfig, folder: Path) -> tuple[Any, dict[int, str]]:
    """A folder's database in memory, and the names of its images."""
    pycolmap = load()
    with pycolmap.Database.open(folder / DATABASE) as opened:
        names = {image.image_id: image.name for image in opened.read_all_images()}
        options = pycolmap.DatabaseCacheOptions(min_num_matches=config.min_inliers)
        return pycolmap.DatabaseCache.create(opened, options), names


def adjust(model: Any, shots: Shots, config: StructureConfig) -> None:
    """Adjust a model once more with a robust loss, and the principal point of a camera that is being calibrated.

    The mapper itself uses squared residuals and holds the principal point in the middle of the image.
    """
    drop_points_at_cameras(model)
    _solve(model, shots, config, refined_lens(shots, config)[0] and model.num_reg_images() >= MIN_FOR_CENTER)
    filter_points(model, config)
    model.update_point_3d_errors()


def settle(model: Any, shots: Shots, config: StructureConfig) -> None:
    """Adjust a model that is far from its optimum."""
    drop_points_at_cameras(model)
    _solve(model, shots, config, is_center_free=False)
    filter_points(model, config, WIDE)
    _solve(model, shots, config, is_center_free=False)
    filter_points(model, config)


def _solve(model: Any, shots: Shots, config: StructureConfig, is_center_free: bool) -> None:
    """Minimise a robust loss."""
    pycolmap = load()
    if not model.num_points3D():
        return
    options = adjustment(shots, config, is_center_free)
    problem = bundle_of(model)  # `pycolmap.bundle_adjustment` prints whatever the level of the log
    problem.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    pycolmap.create_default_ceres_bundle_adjuster(options, problem, model).solve()


def adjustment(shots: Shots, config: StructureConfig, is_center_free: bool) -> Any:
    """pycolmap's options of an adjustment with a robust loss."""
    is_free, is_bent = refined_lens(shots, config)
    refined = {
        "refine_focal_length": is_free,
        "refine_principal_point": is_center_free,
        "refine_extra_params": is_bent,
        "print_summary": False,
    }
    options = options_of("BundleAdjustmentOptions", refined)
    options.ceres.loss_function_type = load().LossFunctionType.CAUCHY
    options.ceres.solver_options.num_threads = config.num_threads
    return options


def filter_points(model: Any, config: StructureConfig, factor: float = 1.0) -> None:
    """Drop what the robust loss may have moved anywhere; `factor` multiplies the largest error."""
    filters = options_of("IncrementalPipelineOptions", config.options.get("incremental", {})).mapper
    observations = load().ObservationManager(model)
    observations.filter_all_points3D(factor * filters.filter_max_reproj_error, filters.filter_min_tri_angle)
    drop_points_at_cameras(model)


def drop_points_at_cameras(model: Any) -> None:
    """Delete points at a camera that shows them: their rays determine nothing, and no covariance would be finite."""
    for image in [image for image in model.images.values() if image.has_pose]:
        keys, depths = depths_seen(model, image)
        for key in np.array(keys)[depths < MIN_DEPTH * np.median(depths)] if keys else ():
            model.delete_point3D(int(key))


def depths_seen(model: Any, image: Any) -> tuple[list[int], Float[np.ndarray, " k"]]:
    """Keys and depths of the points that an image with a pose shows."""
    keys = sorted({point.point3D_id for point in image.points2D if point.has_point3D()})
    pose = image.cam_from_world().matrix()
    return keys, np.array([pose[2, :3] @ model.points3D[key].xyz + pose[2, 3] for key in keys])


def check_found(found: Sequence[Any], shots: Shots, config: StructureConfig, folder: Path) -> None:
    """Raise ValueError, with the likeliest reason, if no model was found."""
    pycolmap = load()
    if found:
        return
    count = len(shots.names)
    with pycolmap.Database.open(folder / DATABASE) as opened:
        keypoints = [opened.num_keypoints_for_image(image.image_id) for image in opened.read_all_images()]
        _, geometries = opened.read_two_view_geometries()
    few = sum(number < 50 for number in keypoints)
    kinds = [int(geometry.config) for geometry in geometries]
    turned = sum(kind in (4, 5, 6) for kind in kinds)  # planar or a rotation alone
    if count < 3:
        reason = f"{count} images are too few: give 3 or more of one place (dataset.stop, dataset.stride)"
    elif few > count / 2:
        masked = " and masks.folder" if config.masks.folder is not None else ""
        reason = f"{few} of {len(keypoints)} images show hardly anything to recognise: check the images{masked}"
    elif not geometries:
        reason = "no two images share enough: take them closer together (dataset.stride)"
    elif turned > len(kinds) / 2:
        reason = (
            f"{turned} of {len(kinds)} pairs of images differ by a rotation or show one plane, which tells no depth: "
            "move the camera sideways, or take images farther apart (dataset.stride)"
        )
    else:
        reason = "no pair of images has parallax to begin with: take images farther apart (dataset.stride)"
    raise ValueError(f"prior=multiview_stereo finds no structure: {reason}; or bring predictions (prior=files)")
