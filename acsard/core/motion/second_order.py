"""Adds the effects of second order to the covariance of the pose.

A wrong heading to either side makes the robot get less far, so this does not average out. On a
straight drive it is nearly all of the error along the path: 0.12 m after 60 m with k = 1e-5
(`error_model.py`), of which the first order is 17 mm. `SecondOrder` has the equations. Without
parameters the result is equation 55 of Barfoot & Furgale, Associating Uncertainty with
Three-Dimensional Poses for Use in Estimation Problems, IEEE Transactions on Robotics 30 (2014).
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

# rad2, before and after a stretch. Beyond it the series does not converge, so the stretch adds
# nothing.
MAX_HEADING_VARIANCE = 1.0

NO_TERMS = PoseCovariance(0.0, 0.0, 0.0, 0.0, 0.0, 0.0)


class SecondOrder:
    """The second-order terms in the covariance of x and y, over stretches of the path.

    A stretch composes the error e of the path before it with its own error w (Baker, Campbell,
    Hausdorff; [a, b] is the Lie bracket of `se2.py`):

        log(exp(e) exp(w)) = e + w + [e, w] / 2 + [e, [e, w]] / 12 + [w, [w, e]] / 12 + ...

    e = x + J p and w = n + W p have the noises x and n, of covariances P and Q, and the effects J
    and W of the parameters p, in independent standard deviations. [e, w] / 2 adds to x and y,
    summed over the stretches:

        [x, n] / 2                  independent in each stretch, so the covariances are summed
        sum over i of p_i M_i       M_i = sum of ([J_i, n] + [x, W_i]) / 2, correlates with x
        sum over i <= k of p_i p_k C_ik     C_ik = sum of ([J_i, W_k] + [J_k, W_i]) / 2,
                                            half of it if i = k

    These are uncorrelated with each other and with e. From the last two terms of the series, only
    the part from noise is used.
    """

    def __init__(self, columns: int) -> None:
        self._noise: Vector = ORIGIN  # (xx, xy, yy), m2, of the sum of [x, n] / 2 and M_i
        self._with_x: list[tuple[Vector, Vector]] = []  # of each M_i with x, rows x and y
        self._bent: dict[tuple[int, int], Planar] = {}  # C_ik, m; the larger index comes first
        for _ in range(columns):
            self.add_parameter()
        # m2 in odom; a motion does not change them, as they have no yaw.
        self.xx = self.xy = self.yy = 0.0

    def add_parameter(self) -> None:
        """Add one more parameter, which must not have affected the pose yet."""
        self._with_x.append((ORIGIN, ORIGIN))
        i = len(self._with_x) - 1
        self._bent |= {(i, k): (0.0, 0.0) for k in range(i + 1)}

    def carry(self, dx: float, dy: float) -> None:
        """Transform the covariances when the robot has moved by `dx`, `dy` m in odom."""
        self._with_x = [(seen_from(a, dx, dy), seen_from(b, dx, dy)) for a, b in self._with_x]

    def compose(
        self, p: PoseCovariance, q: PoseCovariance, j: list[Vector], w: list[Vector]
    ) -> PoseCovariance:
        """Add a stretch, update `xx`, `xy` and `yy`, and return what adds to the noise p + q.

        First call `carry`. All arguments are at the end of the stretch (`se2.seen_from`):
        covariances of the noise before it (`p`) and on it (`q`), and effects of the parameters
        before (`j`) and on it (`w`).
        """
        xyaw, yyaw, yawyaw = p.xyaw, p.yyaw, p.yawyaw
        for x, y, yaw in j:
            xyaw, yyaw, yawyaw = xyaw + x * yaw, yyaw + y * yaw, yawyaw + yaw * yaw
        after = p.yawyaw + q.yawyaw + sum((a[2] + b[2]) ** 2 for a, b in zip(j, w, strict=True))
        if max(yawyaw, after) > MAX_HEADING_VARIANCE:
            return NO_TERMS
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
        # Adds ([J_i, n] + [x, W_i]) / 2 to M_i; `column` is J_i, `new` is W_i.
        x, y = self._with_x[i]
        by_new_x, by_new_y = brackets(new, p, -0.5)
        by_noise_x, by_noise_y = brackets(column, q, 0.5)
        # [x, W_i] / 2 correlates with M_i before, which the variance of their sum contains twice.
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
        # For independent unit normals, E[p_i p_k p_l p_m] is 3 if all indices are equal, 1 if they
        # form two pairs, and 0 otherwise.
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
