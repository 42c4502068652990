"""Plays random plans until so many hours are done: `python -m tests.simulate --seed N --hours H`."""

from __future__ import annotations

import time, sys
from tests.simulate.plan import made
from tests.simulate.actors import Run
from tests.simulate.promises import BrokenError

if __name__ == "__main__":
    a, b = int(sys.argv[1]), int(sys.argv[2])
    total = 0.0
    t0 = time.time()
    for seed in range(a, b):
        plan = made(seed)
        run = Run(plan)
        try:
            run.play()
            total += run.true_ns/1e9 - run.slept_ns/1e9
        except BrokenError as e:
            print(seed, plan["seconds"], str(e)[:330])
            if e.promise.startswith("no exc") and len(sys.argv) > 3:
                import traceback; traceback.print_exc()
    print(total, total/(time.time()-t0))
