"""Merge two maps: relocalize a finished run in another one by its keyframes, and join it by a similarity.

Loops between both are verified like those of one run, but with a free ratio of units, so that runs of different cameras
and priors can be joined.
"""

from collections import Counter
from collections.abc import Sequence
from dataclasses import is_dataclass, replace
from typing import Any

import jax.numpy as jnp
import numpy as np

from emgs_jax.back_end.loops import consistent_loops, detect_loops_between
from emgs_jax.back_end.optimization import close_loops, one_layer_of_state
from emgs_jax.back_end.saved_map import LEFT_OUT
from emgs_jax.back_end.state import BackEnd, Node, transform_nodes
from emgs_jax.gaussian_map import transformed
from emgs_jax.geometry import Sim3, scale_pose
from emgs_jax.loop_closure.place_recognition import train_database
from emgs_jax.loop_closure.verification import LoopMeasurement
from emgs_jax.mapping.atlas import Atlas, Submap, with_state
from emgs_jax.mapping.capacity import add_map

MEASURED = "factors", "verified", "violating", "accepted", "refusals"  # fields that connect two nodes each


def join(atlas: Atlas, other: Atlas) -> Atlas | str:
    """Join the active submap of another atlas with that of `atlas`, whose world and unit stay.

    The other's nodes come after those of `atlas`; nodes of saved maps come before both.

    Returns:
        The atlas of both, or why they cannot be joined.
    """
    widths = [one.state.map.gaussians.features.shape[-1] for one in (atlas, other)]
    if widths[0] != widths[1]:
        return f"its features have width {widths[1]}, those of the first run {widths[0]}: map both with one prior"
    both = beside(atlas, other)
    number = max(both.submaps)
    graph = detect_loops_between(both.graph, number)
    found = placement(graph, number)
    if isinstance(found, str):
        return found
    similarity, loops = found
    graph = place_submap(graph, number, similarity)
    map = transformed(both.submaps[number].state.map, **vars(similarity))
    map, config = add_map(both.state.map, map, both.config)
    graph, state = close_loops(graph, replace(both.state, map=map), loops)
    if graph.closures[-1].info.reason:
        return f"no poses fit the {len(loops)} loops between both: {graph.closures[-1].info.reason}"
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
    keyframes = sorted((one for graph in graphs for one in graph.database.keyframes), key=lambda one: one.frame)
    graph = replace(
        here.graph,
        nodes=tuple(nodes[row] for row in np.argsort(np.concatenate(rows))),
        database=train_database(keyframes, here.graph.config.place_recognition),
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
    tried: list[tuple[Sim3, list[LoopMeasurement]]] = []
    for loop in sorted(of_query.values(), key=lambda loop: -loop.num_inliers)[:most]:
        similarity = implied(graph, loop)
        good = {(one.a, one.b) for one in consistent_loops(place_submap(graph, number, similarity))}
        tried.append((similarity, [one for one in between if (one.a, one.b) in good]))
    similarity, loops = max(tried, key=lambda one: len(one[1]))
    if loops:
        return similarity, loops
    against = sum(graph.nodes[loop.b].submap == number for loop in graph.violating)
    return (
        f"{len(between)} loops to it are verified, but too few imply the same place, or there one map sees through "
        f"surfaces of the other ({against} do)"
    )


def implied(graph: BackEnd, loop: LoopMeasurement) -> Sim3:
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
