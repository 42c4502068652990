"""Generates repeatable random numbers: the n-th of a seed, in any order, without a state.

They come from the mixing function of SplitMix64 (Steele, Lea & Flood, Fast splittable pseudorandom
number generators, 2014), applied to n.
"""

from __future__ import annotations

import math

_MASK = (1 << 64) - 1
_STEP = 0x9E3779B97F4A7C15


def uniform(seed: int, n: int) -> float:
    """Return the n-th random number of `seed`, uniform in [0, 1)."""
    z = (_mixed(seed & _MASK) + n * _STEP) & _MASK
    return (_mixed(z) >> 11) / (1 << 53)


def gauss(seed: int, n: int) -> float:
    """Return the n-th random number of `seed`, normal with variance 1 (Box-Muller transform)."""
    radius = math.sqrt(-2.0 * math.log(1.0 - uniform(seed, 2 * n)))
    return radius * math.cos(math.tau * uniform(seed, 2 * n + 1))


def _mixed(z: int) -> int:
    z = ((z ^ (z >> 30)) * 0xBF58476D1CE4E5B9) & _MASK
    z = ((z ^ (z >> 27)) * 0x94D049BB133111EB) & _MASK
    return z ^ (z >> 31)
