"""Plausible bugs of the core: small algebra, search, registration, the stages, rendering, and the step."""

from mutant import Mutant


def own(file: str, *tests: str):
    """Mutants of one file: its own tests, then (text, what stands there instead, the bug) of each."""
    paths = tuple(f"tests/{test}.py" for test in tests)
    return lambda *changes: [Mutant(f"emgs_jax/{file}.py", before, after, paths, bug) for before, after, bug in changes]


OPS = [
    *own("ops/camera", "ops/test_camera")(
        ("camera.focal / stride, camera", "camera.focal, camera", "a smaller image keeps the focal length"),
        ("jnp.round(pixels)", "jnp.floor(pixels)", "the pixel to the upper left, not the nearest"),
        ("row * width + column", "row * height + column", "rows are numbered by the image's height"),
        ("NEAREST_DEPTH = 1e-3", "NEAREST_DEPTH = 1e-2", "a point is in front from a centimetre on"),
        ("(pixels - camera.center) / camera.focal", "pixels / camera.focal", "rays without the principal point"),
    ),
    *own("ops/clustering", "ops/test_clustering")(
        (
            "max(height, width).bit_length()",
            "min(height, width).bit_length()",
            "the Z curve misses the long side's bits",
        ),
        ("wanted = spacing // 2 + ", "wanted = ", "seeds at the start of what they stand for"),
        ("jnp.where(valid, nearest[:, 0], seeds.shape[0])", "nearest[:, 0]", "invalid points pull a cluster"),
        ("exists & (count > 0)", "exists", "an empty cluster exists"),
    ),
    *own("ops/k_smallest", "ops/test_k_smallest")(
        ("[::-1])", ")", "runs are merged without turning one round"),
        ("jax.lax.top_k(-values.T, k)", "jax.lax.top_k(values.T, k)", "the largest on an accelerator"),
    ),
    *own("ops/linalg", "ops/test_linalg")(
        ("3.0 * jnp.log(scale)", "jnp.log(scale)", "the log-determinant of the scaled matrix"),
        ("(growth * (growth + 1.0))", "(growth * (growth - 1.0))", "the other root, which mirrors along the noise"),
        ("0.5 * jnp.arctan2", "jnp.arctan2", "principal axes at twice their angle"),
        ("stack([c, -b], -1)", "stack([a, -b], -1)", "the inverse of a 2x2 matrix with its diagonal as it was"),
    ),
    *own("ops/neighbours", "ops/test_neighbours")(
        ("distance_sq[-1] <= nearest_sq", "distance_sq[0] <= nearest_sq", "the search ends with the nearest"),
        ("jnp.where(valid[:, None], points, jnp.inf)[order]", "points[order]", "invalid points are neighbours"),
        ("jnp.maximum(count - capacity, 0)", "count - capacity", "free places count as a negative overflow"),
    ),
    *own("ops/pytree", "ops/test_pytree")(
        ('set(value, mode="drop")', 'set(value, mode="clip")', "a row past the end overwrites the last"),
        ("max(-(-num_rows // max_rows), 1)", "max(num_rows // max_rows, 1)", "parts are larger than they may be"),
    ),
]

REGISTRATION = [
    *own("registration/rigid", "registration/test_rigid")(
        ("start @ jaxlie.SE3.exp(share", "jaxlie.SE3.exp(share", "a pose on the way that begins at the origin"),
        ("jnp.maximum(count - 1, 0) // 2", "count // 2", "the upper median"),
        ("T.rotation(), scale * T.translation()", "T.rotation(), T.translation()", "a pose that ignores the scale"),
        ("jnp.sign(jnp.linalg.det(u @ vt))", "1.0", "mirrored points give a reflection"),
        ("length=3)", "length=1)", "one reweighting"),
        ("(distance / (2.0 * spread)) ** 2", "(distance / (2.0 * spread))", "weights that forgive too much"),
        ("jnp.sum(paired) >= MIN_PAIRS", "jnp.sum(paired) > MIN_PAIRS", "sixteen pairs are too few"),
    ),
    *own("registration/matching", "registration/test_icp")(
        (
            "surface.plane_vars[row] + jnp.sum(normals * noise, axis=-1) ** 2",
            "surface.plane_vars[row]",
            "the distance to a plane does not know of the ray's noise",
        ),
        ("jnp.min(distance_sq, axis=-1) <= max_mahalanobis_sq", "True", "no gate on the distance"),
        (">= min_normal_cos", ">= -1.0", "no gate on the normal"),
        (
            "widen(whiten(triangles, offsets), whiten(triangles, jnp.unstack(noise[:, None], axis=-1)))",
            "whiten(triangles, offsets)",
            "the best Gaussian is chosen without the noise",
        ),
        ("points.valid & is_near", "is_near", "invalid points are inliers"),
    ),
    *own("registration/noise", "registration/test_uncertainty")(
        ('side="left"', 'side="right"', "equal confidences are the highest"),
        ("jnp.where(valid, confidence, jnp.inf)", "confidence", "invalid points are ranked, too"),
        ("NORMAL * median", "median", "the misfit is no standard deviation"),
        (">= MIN_PAIRS, found, ", ">= 0, found, ", "two points make a level"),
        ("jnp.clip(num_cells * ratio, num_cells, num_points)", "num_cells * ratio", "more measurements than points"),
        ("total**2 / jnp.maximum(count, 1.0)", "total**2", "the sum of a cell for its mean"),
        ("jnp.where(num_points > 0, found, NUM_CELLS**2)", "found", "no point, no weight"),
    ),
    *own("registration/problem", "registration/test_icp")(
        ("jnp.stack(uncertainty.pose), 3)", "jnp.stack(uncertainty.pose[::-1]), 3)", "metres for radians"),
        (
            "uncertainty.num_effective / jnp.maximum(jnp.sum(source.valid), 1)",
            "1 / jnp.maximum(jnp.sum(source.valid), 1)",
            "points as one",
        ),
        ("config.noise * uncertainty.depth,", "uncertainty.depth,", "the factor on the points' noise is dropped"),
        ("matches.plane_vars / depth**2", "matches.plane_vars", "a plane's thickness in metres beside a log"),
        ("problem.depth_noise**2 +", "problem.depth_noise +", "a noise for its square"),
        ("1.0 + distance / depth, LEAST", "1.0 - distance / depth, LEAST", "points are pulled away from their planes"),
        ("jnp.clip(ray, -edge, edge)", "plane", "metres are fitted where the logarithm was asked for"),
        ("scale_unit=config.scale_noise * scale_unit", "scale_unit=config.scale_noise", "scale in absolute units"),
        ("jnp.sqrt(config.prior_information) /", "config.prior_information /", "information for its root"),
        ("jnp.abs(distance) <= config.max_misfit", "jnp.abs(distance) >= 0", "what is far away counts as noise"),
        ("matches.normals, axis=-1) / depth", "matches.normals, axis=-1)", "distances in metres"),
        ("jnp.cross(jnp.concatenate([points, points]), axes)", "axes", "turning tells what moving tells"),
        ("normals / matches.plane_std[:, None]", "normals", "information without its unit"),
        ("jnp.clip(shade, -edge, edge)", "shade", "an intensity pulls however different it is"),
        (
            "(placed.colors)) / config.color_std",
            "(placed.colors)) * config.color_std",
            "the weight of the intensity inverted",
        ),
        ("rays @ T.rotation().as_matrix().T", "rays", "rays stay in the camera's frame"),
        ("~(has_plane | has_ray) * jnp", "1.0 * jnp", "`colored` with the offset"),
    ),
    *own("registration/problem", "registration/test_problem")(
        ("noise = scale * matches.noise", "noise = matches.noise", "a scale that shrinks noisy points fits best"),
        ("* (scale_unit / uncertainty.pose[1])", "", "what is known counts in full where the points do not fit"),
    ),
    *own("registration/icp", "registration/test_icp")(
        ("candidates_at(y, problem, config)", "candidates_at(0.0 * y, problem, config)", "it never follows the points"),
        ("jnp.maximum(misfit / noise[1], 1.0)", "1.0", "a pose is held however badly it fits"),
        ("jnp.maximum(of_levels, noise[1])[levels]", "of_levels[levels]", "`noise` is no lower bound"),
    ),
]

GRAPH = [
    *own("graph/measurements", "graph/test_graph_residuals")(
        ("jnp.exp(-ends.log_scale[0])", "jnp.exp(ends.log_scale[0])", "a translation that is scaled the wrong way"),
        ("ends.log_scale[1] - ends.log_scale[0] -", "ends.log_scale[0] - ends.log_scale[1] -", "scales swapped"),
        ("2.0 / (1.0 + excess)", "1.0 / (1.0 + excess)", "half the scaling, with a jump at φ"),
        ("edges.valid & exists & both", "edges.valid & exists", "an edge to a node that is not in use"),
        ("kind == LOOP, chi2 / kernel", "kind == ODOMETRY, chi2 / kernel", "odometry may be wrong, loops not"),
    ),
    *own("graph/sparse", "graph/test_graph_optimize")(
        ("jacobians * free.ravel()[unknowns][:, None]", "jacobians", "the gauge moves"),
        ("solved[rows, i]", "solved[rows, 0]", "covariances with the first node"),
    ),
    *own("graph/deform", "graph/test_deform")(
        ("self.scale[..., None] * (self.turn", "(self.turn", "the scale leaves the means"),
        ("scale[:, None, None] ** 2 * shapes", "scale[:, None, None] * shapes", "covariances by the scale once"),
        ("(jnp.abs(births - own) <= config.max_gap)", "(births >= 0)", "two visits move as one"),
        ("exists & (rows !=", "(rows !=", "free rows are neighbours"),
        ("share * sides, turns", "share, turns", "quaternions of either side cancel"),
        ("where_rows(has_moved & gaussians.valid, moved, gaussians)", "moved", "free rows move"),
        (
            "view, jnp.ones(())), motions.scale[row])",
            "view, motions.scale[row]), jnp.ones(()))",
            "a view scaled about the world's origin",
        ),
    ),
    *own("graph/start", "graph/test_graph_optimize")(
        ("turns.transpose(0, 2, 1)", "turns", "loops are spread against their direction"),
    ),
    *own("graph/problem", "graph/test_graph_optimize")(
        ("(part == part[np.argmax(valid)])", "(part >= 0)", "a part without a path to the gauge counts"),
        (
            "problem.scale_information * np.asarray(nodes.log_scale)\n",
            "0.0 * np.asarray(nodes.log_scale)\n",
            "a prior on the change of scale",
        ),
    ),
    *own("graph/optimize", "graph/test_graph_optimize")(
        ("keeps = bool(reason) or", "keeps =", "what is refused moves the nodes"),
        ("if gain > 0:  # not", "if True:  # not", "a step that costs more is taken"),
        ("other if other.cost < given.cost else given", "given", "the errors are never spread"),
        ("other if other[0].cost < found[0].cost else found", "found", "loops are never tried in full"),
        ("other if other[0].cost < found[0].cost else found", "other", "what costs more is taken"),
    ),
]

STAGES = [
    *own("localization", "test_localization")(
        ("1.0 + distance / config.anchor_range", "1.0", "a pose far from the anchor counts like one near it"),
        ("(1.0 + chi_sq / apart.shape[0])", "1.0", "a lost anchor counts in full"),
        ("config.scale_std**-2", "0.0", "the prior's own unit holds no scale"),
        ("coarse.scale * jnp.where(is_tracked, scale, 1.0)", "coarse.scale", "the accepted scale is dropped"),
        (
            "misfit_of_levels[confidence_levels(current.confidence, current.valid)]",
            "misfit_of_levels[0]",
            "one for all",
        ),
        (
            "scale_translation(raw_current.inverse() @ raw_newest, scale)",
            "raw_current.inverse() @ raw_newest",
            "the newest pose without its scale",
        ),
        (
            "coarse.depth_noise * coarse.mean_depth, coarse.depth_noise",
            "coarse.depth_noise, coarse.depth_noise",
            "a fraction of the depth for metres",
        ),
        (
            "repeat_rms / mean_depth, belief.depth_noise",
            "repeat_rms / mean_depth, 0.0",
            "what did not fit is forgotten",
        ),
        ("aligned.valid & coarse.is_usable", "aligned.valid", "a lost frame's points count"),
        ("jnp.where(is_linked[:, None], linked, anchored.wxyz_xyz)", "linked", "a broken chain goes on"),
    ),
    *own("registration/repeat", "test_localization")(
        ("<= max_pair_distance * depth", "<= jnp.inf", "pairs however far apart"),
        ("NORMAL * max_pair_distance", "max_pair_distance", "the disagreement is no standard deviation"),
        ("jnp.where(reading == 1, ratio, similarity)", "jnp.where(reading == 1, similarity, ratio)", "R8's readings"),
        ("(scale > 0.1)", "(scale > 0.0)", "any scale is believed"),
        ("jnp.where(is_found, scale, otherwise)", "scale", "the ratio of no pair"),
    ),
    *own("registration/belief", "registration/test_belief")(
        ("A @ covariance @ A.T + ", "covariance + ", "the errors stay in the axes of the camera before"),
        ("jnp.diag(noise**2)", "jnp.diag(noise)", "deviations for variances"),
        ("found.misfit / depth_noise, 1.0) ** 2", "found.misfit / depth_noise, 1.0)", "a deviation for its variance"),
        ("nothing, found.information / num_alike)", "nothing, found.information)", "a map without errors of its own"),
        ("difference, information / num_shared", "difference, information", "each frame's window is of other images"),
        ("update(belief.world_covariance, difference", "update(belief.covariance, difference", "one P for both"),
        ("set(num_alike**-0.5)", "set(1.0)", "a scale of one map as if of many"),
        ("jnp.where(is_tracked, new, old)", "new", "a frame that is not tracked counts"),
    ),
    *own("observation", "test_observation")(
        ("    valid &= jnp.any(normals != 0, axis=-1)\n", "", "points without a normal stay valid"),
        ("config.max_depth_step * inverse_depth)", "config.max_depth_step)", "a depth step in absolute units"),
        ("count > len(taps) / 5", "count > len(taps) / 9", "a normal from a nearly empty window"),
        ("moments[..., 0] - count * mean[..., 0] ** 2", "moments[..., 0]", "second moments about the pixel"),
        ("xx * yy - xy * xy\n", "xx * yy\n", "the determinant without its mixed term"),
        ("radius + 1, spacing) for dx", "radius + 1) for dx", "every row of the window"),
        (
            "confidence >= config.min_confidence",
            "confidence > config.min_confidence",
            "the least confidence is too little",
        ),
        ("+ 0.5) * (cells / length) - 0.5", ") * (cells / length)", "features by the cells' corners"),
        ("scale * observation.points @ rotate", "observation.points @ rotate", "points without their scale"),
        ("observation.normals @ rotate", "observation.normals", "normals do not turn"),
        ("jnp.where(valid, confidence, 1.0)", "confidence", "an invalid row keeps its confidence"),
    ),
    *own("gaussians", "test_gaussians")(
        ("jnp.where(config.feature > 0, count, 1.0)[:, None]", "1.0", "a new Gaussian has the evidence of one point"),
        ("(0.299, 0.587, 0.114)", "(0.333, 0.333, 0.333)", "luminance as a plain mean"),
        ("-0.5 * dot(white, white)", "-dot(white, white)", "eq. 1's weights with twice the exponent"),
        ("max(spacing // num_neighbours, 1)", "1", "a Gaussian smaller than its cluster"),
        ("count / spacing", "count", "a weight in points"),
        ("even.valid & row_exists", "even.valid", "points that are not there count in eq. 1"),
        ("0.01 * jnp.trace(moments", "0.1 * jnp.trace(moments", "ten times the ridge"),
        ("jnp.sum(found, axis=-1) >= 4", "jnp.sum(found, axis=-1) >= 3", "a covariance from three points"),
        ("config.min_std**2 * jnp.eye(3)", "config.min_std * jnp.eye(3)", "a deviation for a variance"),
        ("(gain * (1.0 - gain))", "gain", "the spread of a mixture by its gain alone"),
    ),
    *own("gaussian_map", "test_gaussian_map")(
        ("config.forgetting * map.weight", "map.weight", "nothing is forgotten"),
        ("config.max_weight)", "jnp.inf)", "certainty without end"),
        ("axis=0) + config.margin", "axis=0)", "no margin above"),
        ("jnp.where(config.gain > 0, kept, gain)", "kept", "the printed gain keeps the sum"),
        ("(evidence > 0) & map", "(evidence >= 0) & map", "no evidence counts as an update"),
        ("jnp.sum(exists & ~is_free)", "jnp.sum(~is_free)", "what was not fresh is counted as lost"),
    ),
    *own("initialization", "test_initialization")(
        ("weight * num_views", "weight", "weights of one view"),
        (
            "spacing(camera, thin, config) * num_views",
            "spacing(camera, thin, config)",
            "as many Gaussians for every view",
        ),
        ("transform(T, view, jnp.ones(()))", "transform(T.inverse(), view, jnp.ones(()))", "poses the wrong way round"),
    ),
    *own("em", "test_em")(
        ("config.feature * jnp.ones(owner.shape)", "jnp.ones(owner.shape)", "features accumulate as printed, too"),
        (
            "meaning = safe_normalize(gaussians.features)",
            "meaning = gaussians.features",
            "cosines grow with the evidence",
        ),
        ("config.noise * noise", "noise", "the factor on the noise is dropped"),
        ("(logdets[rows] + log_growth)", "logdets[rows]", "the determinant does not know of the noise"),
        (
            "config.normal_weight * (normal_cos - 1.0)",
            "config.normal_weight * normal_cos / 2",
            "half the normals' weight",
        ),
        (
            "jnp.sum(jnp.where(found, normal_cos, 0.0), axis=-1)",
            "jnp.sum(normal_cos, axis=-1)",
            "normals of no neighbour",
        ),
        ("log_gap <= config.max_log_gap", "log_gap <= jnp.inf", "τ_π is not looked at"),
        ("second - outer(mean[:, :3])", "second", "a covariance about the old mean"),
        ("+ config.min_std**2 * jnp.eye(3)", "", "no floor under new covariances"),
        ("2.0 * jnp.minimum(sums[:, :2]", "jnp.minimum(sums[:, :2]", "half the support"),
        ("jnp.min(both, axis=-1)", "jnp.max(both, axis=-1)", "the better of the two axes"),
        ("total > config.min_responsibility", "total > 0", "any responsibility is enough"),
        ("jnp.where(step.is_fused, best, 0.0)", "best", "the mean log-joint of all points"),
        ("dot(white, noise) ** 2 / growth", "dot(white, noise) ** 2", "Sherman and Morrison without the denominator"),
    ),
    *own("refinement", "test_refinement")(
        ("jnp.where(is_merged, jnp.sum(omega, axis=-1), 1.0)[:, None]", "1.0", "shared evidence is not all of it"),
        (".at[rows].max(omega)", ".at[rows].add(omega)", "γ from the sum of ω"),
        ("softmax(-0.5 * distance_sq", "softmax(-distance_sq", "eq. 5 with twice the exponent"),
        ("jnp.maximum(cosine, 0.0)", "jnp.abs(cosine)", "opposite meanings merge"),
        ("+ (1.0 - config.cosine_weight)", "", "features that decide nothing merge nothing"),
        ("map_splats.covs[rows] + candidate_splats.covs[:, None]", "map_splats.covs[rows]", "one of two covariances"),
        ("(relative >= -config.front_margin)", "(relative >= -config.back_margin)", "one margin for both sides"),
        ("depth / surface - 1.0", "depth - surface", "margins in metres"),
        ("candidates.covs[:, None] + outer(around)", "candidates.covs[:, None]", "no spread of the merged means"),
        ("candidates.valid & ~is_merged", "candidates.valid", "merged candidates are inserted, too"),
        ("map_splats.depth <= own_depth + reach", "map_splats.depth <= jnp.inf", "occluded Gaussians merge"),
        (
            "axis2=-1) / config.render.covariance_scale)",
            "axis2=-1))",
            "the widest splat with the factor that closes surfaces",
        ),
        ("has_depth & within", "within", "candidates merge where the map has no depth"),
        ("found &= show_one_surface", "_ = show_one_surface", "pairs across a depth edge"),
        ("is_near & (normal_cos", "(normal_cos", "pairs at any depth"),
        ("is_near & (normal_cos >= config.min_normal_cos)", "is_near", "pairs that face different ways"),
        ("jnp.where(both, share, 1.0)", "share", "no feature, no merging"),
    ),
    *own("continuation", "test_continuation")(
        ("* own_share", "", "the map's own error is taken for the frame's"),
        ("jnp.clip(slope, 0.0, 1.0)", "1.0", "errors that are not alike move points"),
        ("& ~is_fused & (expected", "& (expected", "what is fused is moved"),
        ("jnp.exp(-expected)", "jnp.exp(expected)", "away from the map"),
        (" - weighted) / (1.0 + near - precision)", ") / (1.0 + near)", "a point foretells itself"),
        ("(least / jnp.where(noise > 0, noise, 1.0)) ** 2", "1.0", "all points tell alike"),
        ("is_known &= jnp.abs(error) <= config.max_error", "is_known &= True", "another surface is an error"),
        ("config.min_cos * ", "0.0 * ", "flat looks tell"),
        ("/ (1.0 + near)\n    is_moved", "/ jnp.maximum(near, 1e-9)\n    is_moved", "what is far tells as much"),
    ),
    *own("existence", "test_existence")(
        (
            "features = old.features + config.feature * other.gaussians.features",
            "features = old.features",
            "the evidence of a joined layer is lost",
        ),
        ("jax.lax.min, (3, 3)", "jax.lax.min, (1, 1)", "the pixel alone"),
        ("(depth < nearest - reach)", "(depth < farthest - reach)", "an edge shows what is behind"),
        ("& is_steep", "", "grazing looks count"),
        (
            "config.num_std * jnp.sqrt((depth_noise * depth) ** 2 + variance)",
            "config.num_std * jnp.sqrt(variance)",
            "no noise",
        ),
        (
            "jnp.clip(map.existence + change, -config.max_log_odds, config.max_log_odds)",
            "map.existence + change",
            "no limit",
        ),
        ("existence < config.refuted", "existence < 0.0", "one look refutes"),
        ("config.hit * (is_seen & (use > 0))", "config.hit * is_seen", "what explains nothing is confirmed"),
        ("is_seen_through | is_superfluous", "is_seen_through", "what is of no use stays"),
        ("is_seen & (use < 0)", "is_seen & (use <= 0)", "what is outside the submap is of no use"),
        ("(has_points | (map.existence <= 0))", "has_points", "what is tentative and small stays"),
        ("(has_points | (map.existence <= 0))", "(map.existence <= 0)", "a second layer stays once it is confirmed"),
        ("(depth / camera.focal[0]) ** 2", "0.0", "what a view from afar has no point for goes"),
        (
            "share * (1.0 - share))[:, None, None] * outer(along)",
            "share * (1.0 - share))[:, None, None] * outer(difference)",
            "thicker",
        ),
        ("partner[partner] == jnp.arange(count)", "partner >= 0", "whom nobody chose"),
        ("(rows != jnp.arange(count)[:, None])", "True", "with itself"),
        (">= config.min_normal_cos", ">= -1.0", "both sides of a panel"),
        ("distance_under(noise**2)", "distance_under(noise)", "a deviation for a variance"),
        ("is_behind & (of", "(of", "neighbours of one sheet"),
        ("1.0 / frames[:, None] + 1.0 / frames[rows]", "1.0", "as if one frame had made each"),
        ("jnp.maximum(_along(normals, gaussians.covs[:, None]), ", "(", "the thickness of the other alone"),
    ),
    Mutant(
        "emgs_jax/em.py",
        "jnp.any(step.responsibilities > 0, axis=-1)",
        "step.responsibilities[:, 0] >= 0",
        ("tests/test_splitting.py",),
        "points that nothing explains",
    ),
    *own("splitting", "test_splitting")(
        ("count >= config.min_points * spacing", "count >= spacing", "a view from as far"),
        ("height_sq - height**2 >", "height_sq >", "an offset of all points"),
        ("(noise_sq + config.min_std**2)", "config.min_std**2", "what is within the noise"),
        ("covs - 2 / jnp.pi * outer(step)", "covs - outer(step)", "a covariance without its spread"),
        ("covs, 0.5 * map.weight)", "covs, map.weight)", "the weight twice"),
        ("exists &= variance >= config.min_std**2", "", "halves of a floor"),
        (")[..., 0]\n    axes =", ")[..., 1]\n    axes =", "across the shorter axis"),
    ),
    *own("semantics", "test_semantics")(
        ("products / jnp.sqrt(jnp.where(squared > 0, squared, 1.0))", "products", "features by their length"),
        ("gaussians.valid & has_feature", "has_feature", "free rows have a class"),
    ),
    *own("slam", "test_slam")(
        (
            "SlamState(map, aligned, T, localization.belief, time), info",
            "SlamState(map, trusted, T, localization.belief, time), info",
            "a rejected frame is no previous one",
        ),
        ("view = downscale(camera, thin)", "view = camera", "the full camera for the thinned rows"),
        (
            "rows_each, place = spacing(camera, thin, config.fit)",
            "rows_each, place = spacing(camera, 1, config.fit)",
            "λ in rows",
        ),
        ("aligned.valid & localization.is_tracked", "aligned.valid", "a frame that is not tracked is mapped"),
        ("trusted.valid & ~explained.is_fused", "trusted.valid", "fused points become Gaussians, too"),
        ("(trusted.points - T.translation())", "trusted.points", "the noise along rays from the world's origin"),
        ("judge(write_back(map, submap, rows)", "judge(map", "the submap is not put back"),
        (
            "localize_fine(current, confirmed(submap)",
            "localize_fine(current, submap.gaussians",
            "tentative ones are aligned against",
        ),
        ("insert(write_back(map, submap, rows), born", "insert(map, born", "layers are not joined"),
        (
            "jnp.where(config.gain > 0, weight, 1.0)",
            "jnp.ones_like(weight)",
            "every new Gaussian weighs one",
        ),
        (
            "T_world_camera=T,",
            "T_world_camera=state.T_world_previous,",
            "one frame late",
        ),
        (
            "SlamState(map, aligned, T, localization.belief, time), info",
            "SlamState(map, aligned, coarse.T_world_camera, localization.belief, time), info",
            "the coarse pose stays",
        ),
        (
            "T_world_newest=coarse.T_world_newest,",
            "T_world_newest=coarse.T_world_camera,",
            "the newest image where the current is",
        ),
    ),
    *own("semantics", "test_semantics")(
        ("(leads >= margin) &", "", "an answer that is hardly closer than another"),
        ("& (words >= min_cosine)", "", "an answer that is far from every word"),
        ("jnp.where(is_best, second, highest)", "highest", "a word is its own rival"),
        ("known[:, count:], _is_known", "known[:, :0], _is_known", "rivals are not heard"),
        ("jnp.concatenate([rivals, words], axis=-1)", "jnp.concatenate([words, rivals[:, :0]], axis=-1)", "likewise"),
        (
            "jnp.where(is_best, -1.0, known)",
            "jnp.where(is_best, 0.0, known)",
            "without another word a lead is too small",
        ),
        ("directions[:, ::-1]", "directions", "the directions in which features differ least"),
        ("jnp.where(largest < 0, -directions, directions)", "directions", "colours whose sign is the solver's choice"),
    ),
]

RENDER = [
    *own("render/composite", "render/test_composite")(
        ("jnp.sqrt(variance)", "variance", "a variance for a deviation"),
        ("-0.5 * distance_sq", "-distance_sq", "splats that fall off twice as fast"),
        ("2.0 * precision[:, None, 0, 1]", "precision[:, None, 0, 1]", "half the mixed term"),
        ("config.radius * splats.depth_std", "splats.depth_std", "a splat's extent of one deviation"),
        ("0.1 * splats.depth)", "0.5 * splats.depth)", "a near splat is cut at half its depth"),
        ("alpha * light_before", "alpha", "nothing hides what is behind"),
        ("alpha >= jnp.maximum(config.min_alpha", "alpha >= jnp.maximum(0.0", "any coverage has a depth"),
    ),
    *own("render/densify", "render/test_densify")(
        (
            "config.render, config.min_alpha)",
            "config.render, config.render.min_alpha)",
            "the refinement's coverage",
        ),
        (
            "config.surface_depth), nearness, 0.0)",
            "config.surface_depth), weights, 0.0)",
            "the first layer weighs most",
        ),
        ("reach * middle", "reach", "a layer in metres"),
        ("0.5 * weights.sum(0)", "0.25 * weights.sum(0)", "the first quartile for the median"),
        ("values_sum[..., :3] / weight", "values_sum[..., :3] / whole[1]", "a surface's colour by the whole weight"),
    ),
    *own("render/project", "render/test_project")(
        ("jnp.clip(means, low, high)", "means", "unbounded Jacobians outside the image"),
        ("+ blur * jnp.eye(2)", "", "no low-pass filter"),
        ("SMALLEST_COSINE * jnp", "SMALLEST_COSINE / 2 * jnp", "slopes at grazing angles"),
        ("scale * jnp.einsum", "jnp.einsum", "covariances without the factor that closes surfaces"),
        (" & (z > NEAREST_STD * depth_std)", "", "splats of what reaches the camera's plane"),
        (" & (facing <= limit)", "", "surfaces that are seen from behind"),
    ),
    *own("render/tiles", "render/test_tiles")(
        ("(tile_size - 1)", "tile_size", "a tile a pixel too wide"),
        ("radius * jnp.sqrt", "jnp.sqrt", "boxes of one standard deviation"),
        ("splats.valid, splats.depth, jnp.inf", "splats.valid, -splats.depth, jnp.inf", "farthest first"),
    ),
]

MUTANTS = (*OPS, *REGISTRATION, *GRAPH, *STAGES, *RENDER)
