"""Adds what the linear covariance leaves out: errors of the heading that bend the position error.

A heading that errs and returns makes a straight shorter, never longer. This is an effect of second
order, and on a straight it is the whole error along the way. After 60 m at k = 1e-5
(`error_model.py`) the error is 17 mm to first order, and in truth 0.12 m.

Each stretch of the way composes the error e so far with an error w of its own. By Baker, Campbell
and Hausdorff

    log(exp(e) exp(w)) = e + w + [e, w] / 2 + [e, [e, w]] / 12 + [w, [w, e]] / 12 + ...

The error e = x + J p has a part x from noise, of covariance P, and one from the parameters' errors
p, unit normal, with the columns J. Likewise w = n + W p, with Q and W. The third term adds to x and
y

    [x, n] / 2           independent of all before: its covariance is summed
    p_i M_i              M_i = sum of ([J_i, n] + [x, W_i]) / 2, with its covariance with x
    p_i p_k C_ik         C_ik = sum of ([J_i, W_k] + [J_k, W_i]) / 2, or half of that for i = k

which are uncorrelated with each other and with e. Of the last two terms of the series only the
noise's part is used. Without parameters the result is equation 55 of Barfoot & Furgale, Associating
Uncertainty with Three-Dimensional Poses for Use in Estimation Problems, IEEE Transactions on
Robotics 30 (2014).
"""

from __future__ import annotations

from acsard.core.motion.se2 import (
    ORIGIN,
    Planar,
    Vector,
    bracket,
    bracket_covariance,
    brackets,
    plus,
    seen_from,
    twice_bracketed,
)
from acsard.core.values import PoseCovariance

MAX_HEADING_VARIANCE = 1.0
"""rad2. With a greater variance of the heading the series does not converge, and nothing is added
to the linear covariance."""

NOTHING = PoseCovariance(0.0, 0.0, 0.0, 0.0, 0.0, 0.0)


class SecondOrder:
    """The second moment that noise and parameters add to x and y besides the linear part."""

    def __init__(self, columns: int) -> None:
        self._noise: Vector = ORIGIN
        """xx, xy and yy of the sum of all [x, n] / 2 and M_i."""
        self._with_x: list[tuple[Vector, Vector]] = []
        """E[M_i x'], row by row."""
        self._bent: dict[tuple[int, int], Planar] = {}
        """C_ik."""
        for _ in range(columns):
            self.widen()
        self.xx = self.xy = self.yy = 0.0
        """m2 in the axes of odom. No step changes them, because x and y have no lever arm."""

    def widen(self) -> None:
        """Add a column that has had no effect so far."""
        self._with_x.append((ORIGIN, ORIGIN))
        i = len(self._with_x) - 1
        self._bent |= {(i, k): (0.0, 0.0) for k in range(i + 1)}

    def carry(self, dx: float, dy: float) -> None:
        """Transform the correlation with x after a move of the robot by `dx`, `dy` m in odom."""
        self._with_x = [(seen_from(a, dx, dy), seen_from(b, dx, dy)) for a, b in self._with_x]

    def compose(
        self, p: PoseCovariance, q: PoseCovariance, j: list[Vector], w: list[Vector]
    ) -> PoseCovariance:
        """Add a stretch with (`q`, `w`) to the way before it with (`p`, `j`).

        All arguments are as seen from the end of the stretch, to which `carry` has moved this
        object. Return the term to add to the linear p + q.
        """
        xyaw, yyaw, yawyaw = p.xyaw, p.yyaw, p.yawyaw
        for x, y, yaw in j:
            xyaw, yyaw, yawyaw = xyaw + x * yaw, yyaw + y * yaw, yawyaw + yaw * yaw
        if yawyaw > MAX_HEADING_VARIANCE:
            return NOTHING
        of_noise = bracket_covariance(p, q)
        self._noise = plus(self._noise, (of_noise[0] / 4, of_noise[1] / 4, of_noise[2] / 4))
        for i, (column, new) in enumerate(zip(j, w, strict=True)):
            self._bend_noise(i, p, q, column, new)
        for (i, k), (x, y) in self._bent.items():
            ax, ay = bracket(j[i], w[k])
            bx, by = bracket(j[k], w[i]) if i != k else (0.0, 0.0)
            self._bent[i, k] = (x + (ax + bx) / 2, y + (ay + by) / 2)
        self._settle()
        return _twelfth(
            twice_bracketed(q, (xyaw, yyaw, yawyaw)),
            twice_bracketed(p, (q.xyaw, q.yyaw, q.yawyaw)),
        )

    def _bend_noise(
        self, i: int, p: PoseCovariance, q: PoseCovariance, column: Vector, new: Vector
    ) -> None:
        """Apply M_i += ([J_i, n] + [x, W_i]) / 2."""
        x, y = self._with_x[i]
        by_new_x, by_new_y = brackets(new, p, -0.5)
        by_noise_x, by_noise_y = brackets(column, q, 0.5)
        # [x, W] / 2 also correlates with the earlier M, twice: once from each side.
        ax, ay = bracket(new, plus(plus(x, x), by_new_x))
        bx, by = bracket(new, plus(plus(y, y), by_new_y))
        cx, cy = bracket(column, by_noise_x)
        dx, dy = bracket(column, by_noise_y)
        added = ((cx - ax) / 2, (cy + dx - ay - bx) / 4, (dy - by) / 2)
        self._noise = plus(self._noise, added)
        self._with_x[i] = (
            plus(x, plus(by_new_x, by_noise_x)),
            plus(y, plus(by_new_y, by_noise_y)),
        )

    def _settle(self) -> None:
        # For unit normals E[p_i p_k p_l p_m] is 3 if all are the same one and 1 if they form two
        # pairs.
        xx, xy, yy = self._noise
        mean_x = mean_y = 0.0
        for (i, k), (x, y) in self._bent.items():
            times = 1.0
            if i == k:
                mean_x, mean_y, times = mean_x + x, mean_y + y, 2.0
            xx, xy, yy = xx + times * x * x, xy + times * x * y, yy + times * y * y
        self.xx = xx + mean_x * mean_x
        self.xy = xy + mean_x * mean_y
        self.yy = yy + mean_y * mean_y


def _twelfth(a: PoseCovariance, b: PoseCovariance) -> PoseCovariance:
    return PoseCovariance(
        (a.xx + b.xx) / 12,
        (a.xy + b.xy) / 12,
        (a.xyaw + b.xyaw) / 12,
        (a.yy + b.yy) / 12,
        (a.yyaw + b.yyaw) / 12,
        0.0,
    )
