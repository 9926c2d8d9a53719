"""`python -m tools.sampled build/mutants.sqlite 40 [SEED]`: keep so many mutants of a session of cosmic-ray.

At most half of them change a number: three quarters of all do.
"""

import random
import sys

from cosmic_ray.work_db import WorkDB, use_db
from cosmic_ray.work_item import WorkerOutcome, WorkResult

path, count, seed = sys.argv[1], int(sys.argv[2]), "".join(sys.argv[3:])
with use_db(path, WorkDB.Mode.open) as session:
    pending = sorted(session.pending_work_items, key=lambda item: str(item.mutations))
    random.Random(seed).shuffle(pending)
    numbers = [item for item in pending if "Number" in item.mutations[0].operator_name]
    others = [item for item in pending if item not in numbers]
    kept = others[: max(count - len(numbers), count // 2)]
    kept += numbers[: count - len(kept)]
    for item in pending:
        if item not in kept:
            session.set_result(item.job_id, WorkResult(worker_outcome=WorkerOutcome.SKIPPED))
