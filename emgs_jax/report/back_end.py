"""Report of the back end: its pose graph, and outcomes of loop candidates for graph.g2o, loops.json, metrics.json."""

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import jax.numpy as jnp
import numpy as np

from emgs_jax.back_end.factors import Factor, stack_factors
from emgs_jax.back_end.loops import MEASURED, SILENT, UNUSABLE, consistent_loops
from emgs_jax.back_end.optimization import nodes_of
from emgs_jax.back_end.state import BackEnd, Refusal
from emgs_jax.geometry import scale_pose
from emgs_jax.loop_closure.verification import LoopMeasurement
from emgs_jax.pose_graph.factors import PoseGraph


def metric_graph(end: BackEnd) -> PoseGraph:
    """Poses and measurements in the map's scale, without scales of their own: what other solvers read."""

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

    `frame` and `other` are positions among the frames in use, the later first; `outcome` is accepted, known (the poses
    agreed with it already), unconfirmed (not spatially consistent with other loops), unsolved (no better poses were
    found with it; `reason` says why) or refused; then `gate` names the gate and `measured` is the value that it tested.
    """
    unsolved, outcomes, lines = _unsolved(end), _outcomes(end), []
    found = [Refusal(loop.a, loop.b, "", math.nan) for loop in end.verified]
    known = (item for item in [*found, *end.refusals] if item.a >= end.first_node)  # what is older is of another run
    for a, b, gate, measured in sorted(known, key=lambda item: (item.b, item.a)):
        outcome = "refused" if gate else outcomes[a, b]
        line = {"frame": end.nodes[b].frame, "other": end.nodes[a].frame, "outcome": outcome}
        line |= {"reason": unsolved[a, b]} if line["outcome"] == "unsolved" else {}
        lines.append(line | ({"gate": gate, "measured": measured} if gate else {}))
    return lines


def found_loops(end: BackEnd) -> list[LoopMeasurement]:
    """The loops that are believed: what is accepted, and what is known, since the poses say so without it."""
    outcomes = _outcomes(end)
    return [*end.accepted, *(loop for loop in end.verified if outcomes[loop.a, loop.b] == "known")]


def _outcomes(end: BackEnd) -> dict[tuple[int, int], str]:
    """Of every verified loop, see `loop_list`."""
    unsolved, accepted, agreed = _unsolved(end), _ends(end.accepted), _ends(consistent_loops(end))
    outcomes = {}
    for ends in _ends(end.verified):
        known = "unsolved" if ends in unsolved else "known"
        outcomes[ends] = "accepted" if ends in accepted else known if ends in agreed else "unconfirmed"
    return outcomes


def _ends(loops: Sequence[LoopMeasurement]) -> set[tuple[int, int]]:
    return {(loop.a, loop.b) for loop in loops}


def _unsolved(end: BackEnd) -> dict[tuple[int, int], str]:
    """Why no better poses were found with a loop."""
    return {(loop.a, loop.b): one.info.reason for one in end.closures if one.info.reason for loop in one.loops}


def revisit_note(end: BackEnd | None) -> list[str]:
    """A line where the prior could be asked for no loop, and how it can; none where it was asked."""
    if end is None or set(end.queries.values()) != {SILENT}:
        return []
    return [
        f"loops: {len(end.queries)} were measured by keypoints alone, because the prior has no answer for both; a "
        "recording has them if it is made with `python -m experiments.predict … graph=default`"
    ]


def counts(end: BackEnd) -> dict[str, Any]:
    """Count the outcomes of this run's loop candidates, for metrics.json, without those of a loaded map."""
    gates = Counter(refusal.gate for refusal in end.refusals)
    refused = {f"loops/refused_{gate}": count for gate, count in sorted(gates.items())}
    solved = [closure for closure in end.closures if closure.loops]
    return {
        "loops/verified": sum(loop.b >= end.first_node for loop in end.verified),
        "loops/contradicted": sum(loop.b >= end.first_node for loop in end.violating),
        "loops/accepted": sum(loop.b >= end.first_node for loop in end.accepted),
        "loops/measured_again": sum(outcome == MEASURED for outcome in end.queries.values()),
        "loops/unusable_answers": sum(outcome == UNUSABLE for outcome in end.queries.values()),
        "loops/closures": sum(not closure.info.reason for closure in solved),
        "loops/closures_refused": sum(bool(closure.info.reason) for closure in solved),
    } | refused
