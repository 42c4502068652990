"""Lists mutants that no test can notice, and the reason for each.

A mutant's key is its printed description without the line number.
"""

# ruff: noqa: E501 - as they are printed

from __future__ import annotations

EQUIVALENT: dict[str, str] = {
    "acsard/core/motion/limits.py _approach: 'slope = slope if slope * wanted > 0 else 0.0' -> 'slope = slope if slope * wanted >= 0 else 0.0'": "where the product is 0 the slope is",
    "acsard/core/guard.py Memory: 'ramp_ns: Ns = 0' -> 'ramp_ns: Ns = -1'": "a guard without a last line takes the ramps of its limits",
    "acsard/core/guard.py Memory: 'stop_ramp_ns: Ns = 0' -> 'stop_ramp_ns: Ns = -1'": "a guard without a last line takes the ramps of its limits",
    "acsard/core/link/codec.py Codec.wheels: 'wheel[index] = motor * sign' -> 'wheel[index] = motor / sign'": "the sign is 1 or -1",
    "acsard/calibration/fit.py Piece.residuals: 'off = run.yaw - np.interp(at, self.t, heading)' -> 'off = np.interp(at, self.t, heading) - run.yaw'": "a fit squares its residuals, whatever their sign",
    "acsard/calibration/hypotheses.py Turns.match: 'weight = known / np.maximum(off, LEAST_TURN)' -> 'weight = known / np.maximum(LEAST_TURN, off)'": "the larger of two is the same in any order",
    "acsard/calibration/hypotheses.py Comparison.rolls: 'rolled = np.abs(self.rolled(begin, end)).sum(axis=0)' -> 'rolled = np.abs(self.rolled(end, begin)).sum(axis=0)'": "only the size of the angle counts",
    "acsard/calibration/hypotheses.py Comparison.__init__: 'last = float(parts[-1][-1])' -> 'last = float(parts[-1][1])'": "no step spans two runs, so the offset between them is never seen",
    "acsard/calibration/hypotheses.py Places.match: 'moved = np.abs(self.place - (np.add.reduceat(self.place, self.first) / np.bincount(self.part))[self.part])' -> 'moved = np.abs((np.add.reduceat(self.place, self.first) / np.bincount(self.part))[self.part] - self.place)'": "only the size of the way counts",
    "acsard/calibration/log.py _sides: ' if len(v) else 0.0 for v in (a - b, np.maximum(np.abs(a), np.abs(b))))' -> ' if len(v) else 0.0 for v in (b - a, np.maximum(np.abs(a), np.abs(b))))'": "only the size of the difference counts",
    "acsard/calibration/log.py Run.rests: 'rolled = [np.abs(np.interp(end, self.t, side) - np.interp(begin, self.t, side)) for side in (self.left, self.right)]' -> 'rolled = [np.abs(np.interp(begin, self.t, side) - np.interp(end, self.t, side)) for side in (self.left, self.right)]'": "only the size of the angle counts",
    "acsard/calibration/guide.py _measured: 'std = math.hypot(TAPE_STD_M, SKID_LENGTH * metres)' -> 'std = math.hypot(SKID_LENGTH * metres, TAPE_STD_M)'": "the root of a sum of squares is the same in any order",
}
