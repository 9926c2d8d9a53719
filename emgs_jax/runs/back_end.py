"""Report of the back end: pose graph and outcomes of loop candidates, for graph.g2o, loops.json and metrics.json."""

from collections import Counter
from dataclasses import replace
from typing import Any

import jax.numpy as jnp
import numpy as np

from emgs_jax.back_end.factors import Factor, stack_factors
from emgs_jax.back_end.loops import MEASURED, SILENT, UNUSABLE, consistent_loops
from emgs_jax.back_end.optimization import nodes_of
from emgs_jax.back_end.state import BackEnd
from emgs_jax.geometry import scale_pose
from emgs_jax.loop_closure.verification import LoopMeasurement
from emgs_jax.pose_graph.factors import PoseGraph


def metric_graph(end: BackEnd) -> PoseGraph:
    """Convert poses and measurements to the map's scale, without scales of their own, as other solvers need."""

    def scaled(edge: Factor) -> Factor:
        scale = np.exp(end.nodes[edge.a].log_scale)
        sqrt_info = edge.sqrt_info / np.array([scale] * 3 + [1.0] * 4)
        return edge._replace(Z_a_b=scale_pose(edge.Z_a_b, scale), log_ratio=0.0, sqrt_info=sqrt_info)

    nodes = nodes_of(end, end.active)
    return PoseGraph(
        replace(nodes, log_scale=jnp.zeros_like(nodes.log_scale)), stack_factors([*map(scaled, end.factors)])
    )


def loop_list(end: BackEnd) -> list[dict[str, Any]]:
    """List the outcome of every loop candidate, for loops.json, in the order of the frames.

    `frame` and `other` are positions among the frames in use, the later first. `outcome` is accepted, known (the poses
    already agreed), unconfirmed (not spatially consistent with other loops), unsolved (the solver found no better
    poses; `reason` says why) or refused; then `gate` names the gate and `measured` is the value that it tested.
    """
    lines = [(loop.b, loop.a, said) for loop, said in zip(end.verified, _outcomes(end), strict=True)]
    for a, b, gate, measured in end.refusals:
        lines.append((b, a, {"outcome": "refused", "gate": gate, "measured": measured}))
    return [
        {"frame": end.nodes[b].frame, "other": end.nodes[a].frame} | said
        for b, a, said in sorted(lines, key=lambda line: line[:2])
        if a >= end.first_node  # older ones are of another run
    ]


def found_loops(end: BackEnd) -> list[LoopMeasurement]:
    """Select the accepted loops, and the known ones, with which the poses already agreed."""
    outcomes = zip(end.verified, _outcomes(end), strict=True)
    return [*end.accepted, *(loop for loop, said in outcomes if said["outcome"] == "known")]


def _outcomes(end: BackEnd) -> list[dict[str, str]]:
    """Return the outcome of every verified loop, for `loop_list`."""
    accepted, agreed = ({(loop.a, loop.b) for loop in loops} for loops in (end.accepted, consistent_loops(end)))
    reasons = {(loop.a, loop.b): one.info.reason for one in end.closures if one.info.reason for loop in one.loops}

    def said(ends: tuple[int, int]) -> dict[str, str]:
        if ends in accepted or ends not in agreed:
            return {"outcome": "accepted" if ends in accepted else "unconfirmed"}
        return {"outcome": "unsolved", "reason": reasons[ends]} if ends in reasons else {"outcome": "known"}

    return [said((loop.a, loop.b)) for loop in end.verified]


def revisit_note(end: BackEnd | None) -> list[str]:
    """Return a line, with the remedy, if the prior answered none of the queries for loops; otherwise no line."""
    if end is None or set(end.queries.values()) != {SILENT}:
        return []
    why = f"loops: {len(end.queries)} were measured by keypoints alone, because the prior has no answer for both visits"
    return [f"{why}; a recording of a network has them if it is made with `emgs predict … graph=default`"]


def counts(end: BackEnd) -> dict[str, Any]:
    """Count the outcomes of this run's loop candidates for metrics.json, without those of a loaded map."""
    gates, answers = Counter(refusal.gate for refusal in end.refusals), Counter(end.queries.values())
    is_refused = Counter(bool(closure.info.reason) for closure in end.closures if closure.loops)
    loops = {"verified": end.verified, "contradicted": end.violating, "accepted": end.accepted}
    found = {name: sum(loop.b >= end.first_node for loop in some) for name, some in loops.items()}
    found |= {"measured_again": answers[MEASURED], "unusable_answers": answers[UNUSABLE]}
    found |= {"closures": is_refused[False], "closures_refused": is_refused[True]}
    found |= {f"refused_{gate}": count for gate, count in sorted(gates.items())}
    return {f"loops/{name}": count for name, count in found.items()}
