"""Merge two maps: relocalize a finished run in another one by its keyframes, and join it by a similarity.

Loops between both are verified like those of one run, but with a free ratio of units, so that runs of different cameras
and priors can be joined. If both runs have some images in common, such as consecutive parts of a walk, the poses of
these say where the other map is.
"""

from collections import Counter
from collections.abc import Sequence
from dataclasses import is_dataclass, replace
from typing import Any

import jax.numpy as jnp
import numpy as np
from scipy.spatial.transform import Rotation

from emgs_jax.back_end.factors import Factor, shared_factor
from emgs_jax.back_end.loops import consistent_loops, detect_loops_between
from emgs_jax.back_end.optimization import close_loops, one_layer_of_state
from emgs_jax.back_end.saved_map import LEFT_OUT
from emgs_jax.back_end.state import BackEnd, Node, transform_nodes
from emgs_jax.gaussian_map import transformed
from emgs_jax.geometry import Sim3, scale_pose
from emgs_jax.loop_closure.place_recognition import keyframes_but, with_keyframes
from emgs_jax.loop_closure.verification import LoopMeasurement
from emgs_jax.mapping.atlas import Atlas, Submap, with_state
from emgs_jax.mapping.capacity import add_map

MEASURED = "factors", "verified", "violating", "accepted", "refusals"  # fields that connect two nodes each


def join(atlas: Atlas, other: Atlas, shared: Sequence[tuple[int, int]] = ()) -> Atlas | str:
    """Join the active submap of another atlas with that of `atlas`, whose world and unit stay.

    The other's nodes come after those of `atlas`; nodes of saved maps come before both.

    Args:
        shared: a node of `atlas` and one of the other that are of one image, both counted from `first_node`.

    Returns:
        The atlas of both, or why they cannot be joined.
    """
    widths = [one.state.map.gaussians.features.shape[-1] for one in (atlas, other)]
    if widths[0] != widths[1]:
        return f"its features have width {widths[1]}, those of the first run {widths[0]}: map both with one prior"
    both = beside(atlas, other)
    number = max(both.submaps)
    first, begin = both.graph.first_node, len(both.graph.nodes) - len(other.graph.nodes) + other.graph.first_node
    factors = shared_factors(both.graph, [(first + a, begin + b) for a, b in shared])
    # An image is a keyframe once: the first frames of a walk's part are the worse candidates.
    is_repeated = {factor.b for factor in factors}
    database = keyframes_but(both.graph.database, is_repeated)
    graph = detect_loops_between(replace(both.graph, database=database), number, is_one_walk=bool(factors))
    found = shared_placement(graph, number, factors) if factors else placement(graph, number)
    if isinstance(found, str):
        return found
    similarity, loops = found
    graph = place_submap(replace(graph, factors=[*graph.factors, *factors]), number, similarity)
    map = transformed(both.submaps[number].state.map, **vars(similarity))
    map, config = add_map(both.state.map, map, both.config)
    graph, state = close_loops(graph, replace(both.state, map=map), loops)
    if graph.closures[-1].info.reason:
        between = f"{len(loops)} loops and {len(factors)} images" if factors else f"{len(loops)} loops"
        return f"no poses fit the {between} between both: {graph.closures[-1].info.reason}"
    is_other = [node.submap == number for node in both.graph.nodes]
    state = one_layer_of_state(state, graph, is_other, config.existence)
    submaps = {one: submap for one, submap in both.submaps.items() if one != number}
    return with_state(replace(both, graph=graph, submaps=submaps), state, config)


def beside(atlas: Atlas, other: Atlas) -> Atlas:
    """Add the active submap of another atlas to those of `atlas` without joining it; it gets the next number."""
    number, (a, num_a), (b, num_b) = (
        1 + max(atlas.submaps),
        *((one.graph.first_node, len(one.graph.nodes)) for one in (atlas, other)),
    )
    rows = [*range(a), *range(a + b, num_a + b)], [*range(a, a + b), *range(num_a + b, num_a + num_b)]
    here, there = (renumbered(one, at, num_a + num_b) for one, at in zip((atlas, other), rows, strict=True))
    others = (
        replace(node, submap=number if node.submap == other.graph.active else LEFT_OUT) for node in there.graph.nodes
    )
    nodes = [*here.graph.nodes, *others]
    graphs = here.graph, there.graph
    of_other, config = graphs[1].database.keyframes, here.graph.config.place_recognition
    graph = replace(
        here.graph,
        nodes=tuple(nodes[row] for row in np.argsort(np.concatenate(rows))),
        database=with_keyframes(graphs[0].database, of_other, config),
        first_node=a + b,
        connected_since=0,
        **{name: [one for graph in graphs for one in getattr(graph, name)] for name in MEASURED},
    )
    return replace(atlas, graph=graph, submaps={**here.submaps, number: there.active})


def with_lost(atlas: Atlas, lost: Sequence[Node]) -> Atlas:
    """Put nodes of lost frames before all others of the run."""
    first, count = atlas.graph.first_node, len(atlas.graph.nodes)
    rows = [*range(first), *range(first + len(lost), count + len(lost))]
    atlas = renumbered(atlas, rows, count + len(lost))
    nodes = atlas.graph.nodes
    return replace(atlas, graph=replace(atlas.graph, nodes=(*nodes[:first], *lost, *nodes[first:])))


def without_repeats(atlas: Atlas, kept: Sequence[int]) -> Atlas:
    """Leave out nodes that are of the image of another one, which stands for them wherever they are named.

    Args:
        kept: the node that stands for each one, itself if it stays; both counted from `first_node`.
    """
    first = atlas.graph.first_node
    stays = [True] * first + [row == one for row, one in enumerate(kept)]
    place = np.cumsum(stays) - 1
    is_repeated = {row for row, ok in enumerate(stays) if not ok}
    atlas = replace(atlas, graph=replace(atlas.graph, database=keyframes_but(atlas.graph.database, is_repeated)))
    found = renumbered(atlas, [int(place[row]) for row in [*range(first), *(first + one for one in kept)]], sum(stays))
    nodes = tuple(node for node, ok in zip(found.graph.nodes, stays, strict=True) if ok)
    between = {name: [one for one in getattr(found.graph, name) if one.a != one.b] for name in MEASURED}
    return replace(found, graph=replace(found.graph, nodes=nodes, **between))


def renumbered(atlas: Atlas, rows: Sequence[int], count: int) -> Atlas:
    """Renumber the nodes, among `count`, wherever they are named; nothing else changes."""
    graph, new_births = atlas.graph, jnp.asarray(rows, jnp.int32)

    def at(one: Any) -> Any:
        ends = {"a": rows[one.a], "b": rows[one.b]}
        return replace(one, **ends) if is_dataclass(one) else one._replace(**ends)

    def born(submap: Submap) -> Submap:
        map = submap.state.map
        map = replace(map, birth=new_births[map.birth])
        return replace(submap, state=replace(submap.state, map=map, time=jnp.asarray(count, jnp.int32)))

    keyframes = tuple(replace(one, frame=rows[one.frame]) for one in graph.database.keyframes)
    nodes = tuple(one if one.origin is None else replace(one, origin=rows[one.origin]) for one in graph.nodes)
    graph = replace(
        graph,
        nodes=nodes,
        database=replace(graph.database, keyframes=keyframes),
        **{name: [at(one) for one in getattr(graph, name)] for name in MEASURED},
    )
    return replace(atlas, graph=graph, submaps={number: born(one) for number, one in atlas.submaps.items()})


def placement(graph: BackEnd, number: int) -> tuple[Sim3, list[LoopMeasurement]] | str:
    """Find the similarity from a submap to the active one with which most loops are spatially consistent.

    Candidates are the similarities of the loops with most inliers, one for each keyframe.

    Returns:
        The similarity and these loops, or why there is none.
    """
    between = [loop for loop in graph.verified if graph.nodes[loop.b].submap == number]
    if not between:
        gates = Counter(one.gate for one in graph.refusals if graph.nodes[one.b].submap == number).most_common(2)
        return f"no keyframe shows the same place ({', '.join(f'{gate} {count}' for gate, count in gates) or 'none'})"
    of_query = {loop.b: loop for loop in sorted(between, key=lambda loop: loop.num_inliers)}
    most = graph.config.relocalization.num_candidates
    best = sorted(of_query.values(), key=lambda loop: -loop.num_inliers)[:most]
    tried = [consistent_at(graph, number, implied(graph, loop)) for loop in best]
    similarity, loops = max(tried, key=lambda one: len(one[1]))
    if loops:
        return similarity, loops
    against = sum(graph.nodes[loop.b].submap == number for loop in graph.violating)
    return (
        f"{len(between)} loops to it are verified, but too few imply the same place, or there one map sees through "
        f"surfaces of the other ({against} do)"
    )


def consistent_at(graph: BackEnd, number: int, similarity: Sim3) -> tuple[Sim3, list[LoopMeasurement]]:
    """Select the loops to a submap that are spatially consistent where the similarity, also returned, places it."""
    good = {(one.a, one.b) for one in consistent_loops(place_submap(graph, number, similarity))}
    between = (loop for loop in graph.verified if graph.nodes[loop.b].submap == number)
    return similarity, [loop for loop in between if (loop.a, loop.b) in good]


def shared_factors(graph: BackEnd, pairs: Sequence[tuple[int, int]]) -> list[Factor]:
    """Build the factors of pairs of nodes that are of one image: of those that are keyframes in both maps."""
    known = {one.frame: one for one in graph.database.keyframes if graph.nodes[one.frame].is_placed}
    keyframes = [(known[a], known[b]) for a, b in pairs if a in known and b in known]
    noise = [graph.nodes[one.frame].depth_noise for _, one in keyframes]
    found = (shared_factor(*pair, nu, graph.config.noise) for pair, nu in zip(keyframes, noise, strict=True))
    return [factor for factor in found if factor is not None]


def shared_placement(graph: BackEnd, number: int, factors: Sequence[Factor]) -> tuple[Sim3, list[LoopMeasurement]]:
    """Find the similarity from a submap to the active one by the poses of the images that both have.

    Returns:
        The mean of what these imply, and the other loops that are spatially consistent there.
    """
    found = [implied(graph, factor) for factor in factors]
    scale = float(np.exp(np.median([np.log(one.scale) for one in found])))
    rotation = Rotation.from_matrix([one.rotation for one in found]).mean().as_matrix()
    ends = [(graph.nodes[factor.a].pose[:3, 3], graph.nodes[factor.b].pose[:3, 3]) for factor in factors]
    translation = np.mean([here - scale * rotation @ there for here, there in ends], axis=0)
    return consistent_at(graph, number, Sim3(scale, rotation, translation))


def implied(graph: BackEnd, loop: LoopMeasurement | Factor) -> Sim3:
    """Compute the similarity that moves a loop's query, with its unit, to where the candidate sees it."""
    here, there = graph.nodes[loop.a], graph.nodes[loop.b]
    seen = here.pose @ scale_pose(loop.Z_a_b, float(np.exp(here.log_scale)))
    return motion(there, replace(there, pose=seen, log_scale=here.log_scale + loop.log_ratio))


def motion(before: Node, after: Node) -> Sim3:
    """Compute the similarity that moves a node, with its unit, from `before` to `after`."""
    of, to = (Sim3(float(np.exp(one.log_scale)), one.pose[:3, :3], one.pose[:3, 3]) for one in (before, after))
    return to @ of.inverse()


def place_submap(graph: BackEnd, number: int, similarity: Sim3) -> BackEnd:
    """Move the nodes of a submap into the active one, where the covariances of their poses are unknown."""
    rows = {row for row, node in enumerate(graph.nodes) if node.submap == number}
    graph = transform_nodes(graph, rows, similarity)
    nodes = tuple(
        replace(node, submap=graph.active, covariance=None) if row in rows else node
        for row, node in enumerate(graph.nodes)
    )
    return replace(graph, nodes=nodes, has_one_unit=False)
