"""Adds the effects of second order to the covariance of the pose.

If the true heading deviates from the estimated one, the robot gets less far in the estimated
direction. This is so for a deviation to either side, so the effect does not average out. It is an
effect of second order. On a straight drive, it causes nearly all of the error along the path. After
60 m with k = 1e-5 (`error_model.py`), the first-order error is 17 mm, but the true error is 0.12 m.

The path is divided into stretches. Each stretch composes the error e of the path before it with its
own error w. The formula of Baker, Campbell and Hausdorff gives the composed error, where [a, b] is
the Lie bracket (`se2.py`):

    log(exp(e) exp(w)) = e + w + [e, w] / 2 + [e, [e, w]] / 12 + [w, [w, e]] / 12 + ...

Each of the two errors has a part from noise and a part from the parameters, e = x + J p and w = n +
W p, with these symbols:

- x and n: the errors from noise on the path before and on the stretch, with covariances P and Q.
- p: the errors of the parameters in standard deviations, independent and normal. p_i is one of
  them.
- J and W: the effects of the parameters on the path before and on the stretch, with one column, J_i
  or W_i, for each parameter.

The term [e, w] / 2 then adds these errors to x and y. Sums are over all stretches:

    sum of [x, n] / 2           independent in each stretch, so the covariances are summed
    sum over i of p_i M_i       M_i = sum of ([J_i, n] + [x, W_i]) / 2, where M_i correlates with x
    sum over i <= k of p_i p_k C_ik
                                C_ik = sum of ([J_i, W_k] + [J_k, W_i]) / 2, or half of that sum
                                if i = k

Each p_i is independent of the rest and has the mean 0, so these sums are uncorrelated with each
other and with e. From the last two terms of the series, only the part from noise is used. Without
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

MAX_HEADING_VARIANCE = 1.0
"""Largest variance of the heading for which the second-order terms are computed, rad2. The limit
applies before and after a stretch of the path. With a larger variance, the series does not
converge, and its terms could make the covariance of the pose indefinite. The stretch then adds
nothing to the terms."""

NO_TERMS = PoseCovariance(0.0, 0.0, 0.0, 0.0, 0.0, 0.0)


class SecondOrder:
    """Computes the second-order terms in the covariance of x and y.

    The symbols such as [x, n], M_i and C_ik are those of the module's docstring.
    """

    def __init__(self, columns: int) -> None:
        self._noise: Vector = ORIGIN
        """Covariance (xx, xy, yy), m2, of the sum of all [x, n] / 2 and all M_i (see the
        module)."""
        self._with_x: list[tuple[Vector, Vector]] = []
        """For each parameter, the covariance of M_i with the error x (see the module). The first
        row is for the component of M_i along the x axis, and the second row for that along the y
        axis."""
        self._bent: dict[tuple[int, int], Planar] = {}
        """C_ik (see the module) for each pair of parameters, m. In the key, the larger index comes
        first."""
        for _ in range(columns):
            self.add_parameter()
        self.xx = self.xy = self.yy = 0.0
        """Second-order terms in the covariance of x and y, m2, in the axes of odom. A motion of the
        robot does not change these terms, because they have no yaw (`se2.seen_from`)."""

    def add_parameter(self) -> None:
        """Add one more parameter, which must not have affected the pose yet."""
        self._with_x.append((ORIGIN, ORIGIN))
        i = len(self._with_x) - 1
        self._bent |= {(i, k): (0.0, 0.0) for k in range(i + 1)}

    def carry(self, dx: float, dy: float) -> None:
        """Transform the stored covariances when the robot has moved by `dx`, `dy` m in odom."""
        self._with_x = [(seen_from(a, dx, dy), seen_from(b, dx, dy)) for a, b in self._with_x]

    def compose(
        self, p: PoseCovariance, q: PoseCovariance, j: list[Vector], w: list[Vector]
    ) -> PoseCovariance:
        """Add a stretch of the path, and update `xx`, `xy` and `yy`.

        The caller must first call `carry` with the displacement of the stretch. All arguments must
        be expressed at the robot's position at the end of the stretch (`se2.seen_from`).

        Args:
            p: the covariance of the noise on the path before the stretch.
            q: the covariance of the noise on the stretch itself.
            j: the effect of each uncertain parameter, such as the track, on the path before the
                stretch.
            w: the effect of each of these parameters on the stretch itself.

        Returns:
            The second-order terms that the caller must add to the covariance of the noise on the
            whole path, which is otherwise p + q.
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
        """Add ([J_i, n] + [x, W_i]) / 2 to M_i (see the module) for the parameter `i`.

        `p` and `q` are the covariances of x and of n. `column` is J_i, and `new` is W_i.
        """
        x, y = self._with_x[i]
        by_new_x, by_new_y = brackets(new, p, -0.5)
        by_noise_x, by_noise_y = brackets(column, q, 0.5)
        # [x, W_i] / 2 also correlates with M_i before this stretch. The variance of their sum
        # contains this covariance twice.
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
        # For independent unit normals, E[p_i p_k p_l p_m] is 3 if all four indices are equal, 1 if
        # they form two pairs, and 0 otherwise.
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
