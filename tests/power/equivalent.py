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
}
