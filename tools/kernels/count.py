"""Count of the kernels that an optimised program launches, read from its text."""

import re
from collections import Counter

NO_KERNEL = {"parameter", "constant", "get-tuple-element", "tuple", "bitcast", "after-all", "opt-barrier"}
INSTRUCTION = re.compile(r"(?:ROOT )?%?[\w.\-]+ = (?:\(.*?\)|\S+) ([\w\-]+)\(")
INSIDE = r"(body|condition|to_apply|calls|true_computation|false_computation)=%?([\w.\-]+)"
UNKNOWN_TRIPS = 4  # of a loop whose length the compiler does not know, as those of the pose's solver


def computations(text: str) -> tuple[dict[str, list[str]], str]:
    """The instructions of every computation of an HLO module, and the name of its entry."""
    found: dict[str, list[str]] = {}
    name = entry = ""
    for line in text.splitlines():
        head = re.match(r"(ENTRY )?%?([\w.\-]+) .*\{$", line)
        if head:
            name = head.group(2)
            found[name], entry = [], name if head.group(1) else entry
        elif line.startswith("  ") and name:
            found[name].append(re.sub(r"/\*.*?\*/", "", line.strip()))
    return found, entry


def kernels(text: str) -> tuple[Counter[str], int]:
    """Launches by kind of instruction, and how many different kernels there are to compile.

    A loop counts as often as it turns, each branch of a conditional by its share. A library call or a sort counts once,
    though it may launch several kernels.
    """
    bodies, entry = computations(text)
    launched: Counter[str] = Counter()
    different = 0

    def walk(name: str, times: float) -> None:
        nonlocal different
        for line in bodies[name]:
            match = INSTRUCTION.match(line)
            kind = match.group(1) if match else ""
            if not kind or kind in NO_KERNEL:
                continue
            inside = dict(re.findall(INSIDE, line))
            if kind == "while":
                trips = re.search(r"known_trip_count\D*(\d+)", line)
                turns = times * (int(trips.group(1)) if trips else UNKNOWN_TRIPS)
                walk(inside["body"], turns)
                walk(inside["condition"], turns)
            elif kind == "conditional":
                branches = re.search(r"branch_computations=\{([^}]*)\}", line)
                names = re.split(r",\s*%?", branches.group(1).lstrip("%")) if branches else []
                names = names or [inside["true_computation"], inside["false_computation"]]
                for branch in names:
                    walk(branch, times / len(names))
            elif kind in ("call", "async-start"):
                walk(inside["to_apply"] if "to_apply" in inside else inside["calls"], times)
            else:
                launched[kind] += times  # ty: ignore[invalid-assignment]
                different += 1

    walk(entry, 1.0)
    return launched, different
