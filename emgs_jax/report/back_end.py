"""What a back end has measured, and what became of the candidates of loops: for graph.g2o, loops.json, metrics.json."""

import math
from collections import Counter
from dataclasses import replace
from typing import Any

import jax.numpy as jnp
import numpy as np

from emgs_jax.graph.measurements import Graph
from emgs_jax.loops.two_views import rescaled
from emgs_jax.running.back_end import BackEnd, Refusal
from emgs_jax.running.measuring import stacked
from emgs_jax.running.revisiting import MEASURED, SILENT, UNUSABLE


def metric_graph(end: BackEnd) -> Graph:
    """Poses and measurements in the map's scale, without scales of their own: what other solvers read."""
    scaled = [
        edge._replace(Z_a_b=rescaled(edge.Z_a_b, np.exp(end.log_scales[edge.a])), log_ratio=0.0) for edge in end.edges
    ]
    nodes = end.nodes()
    return Graph(replace(nodes, log_scale=jnp.zeros_like(nodes.log_scale)), stacked(scaled))


def loop_list(end: BackEnd) -> list[dict[str, Any]]:
    """What became of every candidate, for loops.json, in the order of the frames.

    `frame` and `other` are places among the frames in use, the later first; `outcome` is accepted, known (the poses
    said so already), unconfirmed (others do not agree), unsolved (no better poses were found with it, and `reason` says
    why) or refused, and then `gate` and `measured` say by what.
    """
    unsolved = {(loop.a, loop.b): one.info.reason for one in end.closures if one.info.reason for loop in one.loops}
    accepted = {(loop.a, loop.b) for loop in end.accepted}
    found = [Refusal(loop.a, loop.b, "", math.nan) for loop in end.verified]
    agreed = {(loop.a, loop.b) for loop in end.agreed()}
    lines = []
    known = (item for item in [*found, *end.refusals] if item.a >= end.first)  # what is older is of another run
    for a, b, gate, measured in sorted(known, key=lambda item: (item.b, item.a)):
        verified = "accepted" if (a, b) in accepted else "known" if (a, b) in agreed else "unconfirmed"
        if verified == "known" and (a, b) in unsolved:
            verified = "unsolved"
        line = {"frame": end.frames[b], "other": end.frames[a], "outcome": "refused" if gate else verified}
        line |= {"reason": unsolved[a, b]} if line["outcome"] == "unsolved" else {}
        lines.append(line | ({"gate": gate, "measured": measured} if gate else {}))
    return lines


def revisit_note(end: BackEnd | None, is_sequential: bool) -> list[str]:
    """A line where the prior could be asked for no loop, and how it can; none where it was asked, or never can be."""
    if end is None or is_sequential or set(end.asked.values()) != {SILENT}:
        return []
    return [
        f"loops: {len(end.asked)} were measured by keypoints alone, because this prior has no answer for both visits; "
        "a recording has them if it is made with `python -m experiments.predict … graph=default`, but for a prior that "
        "answers in order only, as multiview_stereo does"
    ]


def counts(end: BackEnd) -> dict[str, Any]:
    """What became of the candidates of this run, for metrics.json; what its map was saved with does not count."""
    gates = Counter(refusal.gate for refusal in end.refusals)
    refused = {f"loops/refused_{gate}": count for gate, count in sorted(gates.items())}
    solved = [closure for closure in end.closures if closure.loops]
    return {
        "loops/verified": sum(loop.b >= end.first for loop in end.verified),
        "loops/contradicted": sum(loop.b >= end.first for loop in end.contradicted),
        "loops/accepted": sum(loop.b >= end.first for loop in end.accepted),
        "loops/measured_again": sum(told == MEASURED for told in end.asked.values()),
        "loops/unusable_answers": sum(told == UNUSABLE for told in end.asked.values()),
        "loops/closures": sum(not closure.info.reason for closure in solved),
        "loops/closures_refused": sum(bool(closure.info.reason) for closure in solved),
    } | refused
