"""The geometry that the wheels and the configuration give: distances, turns and paths."""

from __future__ import annotations

import math

import numpy as np
from msgspec import Struct

from acsard.calibration.series import Complexes, Floats
from acsard.core.config.settings import DriveConfig
from acsard.core.values import Metres

LEFT, RIGHT, TRACK = range(3)  # of the parameters
CONFIGURED = np.zeros(TRACK + 1)  # parameters


class Base(Struct, frozen=True):
    """The configured geometry, m: radii and track with their multipliers."""

    left: Metres
    right: Metres
    track: Metres

    @classmethod
    def of(cls, drive: DriveConfig) -> Base:
        return cls(
            drive.wheel_radius * drive.left_wheel_radius_multiplier,
            drive.wheel_radius * drive.right_wheel_radius_multiplier,
            drive.wheel_separation * drive.wheel_separation_multiplier,
        )

    def motion(self, p: Floats, left: Floats, right: Floats) -> tuple[Floats, Floats]:
        """Return distances, m, and turns, rad, for the rolled angles of the sides."""
        a, b = self.left * math.exp(p[LEFT]) * left, self.right * math.exp(p[RIGHT]) * right
        return (a + b) / 2, (b - a) / (self.track * math.exp(p[TRACK]))

    def path(self, p: Floats, left: Floats, right: Floats) -> tuple[Complexes, Floats]:
        """Return positions, m, and headings, rad, for rolled angles, from zero."""
        return path(*self.motion(p, np.diff(left), np.diff(right)))


def path(distance: Floats, turn: Floats) -> tuple[Complexes, Floats]:
    """Return positions, m, and headings, rad, after each arc, from zero."""
    heading = np.concatenate(([0.0], np.cumsum(turn)))
    step = distance * np.sinc(turn / 2 / np.pi) * np.exp(1j * (heading[:-1] + turn / 2))
    return np.concatenate(([0j], np.cumsum(step))), heading
